//! Whether a configuration lies within the cylinders' strokes, on the undeformed machine.

use super::error::{MachineError, Problem};
use super::text::MachineText;
use super::{FlexibleBody, Machine};
use hydroflex_openapi::machine::{Attachment, CylinderSpec, JointKind};
use nalgebra::Vector3;

impl Machine {
    /// Point of an attachment in its body's frame, undeformed, m.
    #[must_use]
    pub fn attachment_point_m(&self, attachment: &Attachment) -> Option<Vector3<f64>> {
        if let Some(point) = attachment.point_m {
            return Some(Vector3::from(point));
        }
        let name = attachment.interface.as_ref()?;
        let is_body = |body: &&FlexibleBody| body.name == attachment.body;
        let body = self.flexible.iter().find(is_body)?;
        let interface = body.interfaces.iter().find(|i| i.name == *name)?;
        Some(interface.weighted_mean_m(&body.mesh))
    }

    /// Eye distance of a cylinder between the ground and a body that turns about a revolute joint
    /// on the ground, at an absolute angle of that body, m. `None` for other arrangements, whose
    /// pose needs the assembly.
    #[must_use]
    pub fn undeformed_length_m(&self, cylinder: &CylinderSpec, angle_rad: f64) -> Option<f64> {
        let (ground, moving) = match (cylinder.base.body.as_str(), cylinder.rod.body.as_str()) {
            ("ground", _) => (&cylinder.base, &cylinder.rod),
            (_, "ground") => (&cylinder.rod, &cylinder.base),
            _ => return None,
        };
        let joint = self.file.joints.iter().find(|joint| {
            joint.kind == JointKind::Revolute
                && [&joint.from, &joint.to].iter().any(|a| a.body == "ground")
                && [&joint.from, &joint.to].iter().any(|a| a.body == moving.body)
        })?;
        let (fixed, turning) = if joint.from.body == "ground" {
            (&joint.from, &joint.to)
        } else {
            (&joint.to, &joint.from)
        };
        let (sin, cos) = libm::sincos(angle_rad);
        let arm = self.attachment_point_m(moving)? - self.attachment_point_m(turning)?;
        let eye = self.attachment_point_m(fixed)?
            + Vector3::new(cos * arm.x - sin * arm.y, sin * arm.x + cos * arm.y, arm.z);
        Some((eye - self.attachment_point_m(ground)?).norm())
    }

    /// The same for angles as a run table gives them. `None` where that needs the assembly.
    #[must_use]
    pub fn start_length_m(&self, cylinder: &CylinderSpec, angles_rad: &[f64]) -> Option<f64> {
        let angles = &self.file.angles;
        let index = angles
            .iter()
            .position(|a| a.body == cylinder.rod.body || a.body == cylinder.base.body)?;
        let minus = angles[index].minus.as_ref();
        let other = minus.and_then(|name| angles.iter().position(|a| &a.name == name));
        let subtracted = other.map_or(Some(0.0), |k| angles_rad.get(k).copied())?;
        self.undeformed_length_m(cylinder, angles_rad.get(index)? - subtracted)
    }

    /// Refuses ranges of angles that leave a cylinder's stroke.
    pub(super) fn check_reach(&self, text: &MachineText<'_>) -> Result<(), MachineError> {
        for (i, angle) in self.file.angles.iter().enumerate() {
            if angle.minus.is_some() {
                continue;
            }
            let [low, high] = angle.range_deg;
            for angle_deg in [low, 0.5 * (low + high), high] {
                self.check_angle(&angle.body, angle_deg)
                    .map_err(|problem| text.refuse(format!("angle[{i}].range_deg"), problem))?;
            }
        }
        Ok(())
    }

    fn check_angle(&self, body: &str, angle_deg: f64) -> Result<(), Problem> {
        for cylinder in &self.file.cylinders {
            if cylinder.base.body != body && cylinder.rod.body != body {
                continue;
            }
            let Some(length_m) = self.undeformed_length_m(cylinder, angle_deg.to_radians()) else {
                continue;
            };
            let (shortest_m, longest_m) = (
                cylinder.closed_length_m,
                cylinder.closed_length_m + cylinder.stroke_m,
            );
            if !(shortest_m..=longest_m).contains(&length_m) {
                return Err(Problem::OutOfReach {
                    cylinder: cylinder.name.clone(),
                    angle_deg,
                    length_m,
                    shortest_m,
                    longest_m,
                });
            }
        }
        Ok(())
    }
}
