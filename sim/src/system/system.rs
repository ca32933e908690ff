//! The constant part: bodies, joints, cylinders, payload, and where their unknowns are.

use hydroflex_openapi::machine::{
    Attachment, BodySpec, Conventions, GravityMoment, JointKind, MachineFile, RigidBodySpec,
};
use nalgebra::{Matrix3, Vector3};

use super::lu::DenseLu;
use super::state::State;
use super::workspace::{CylinderMotion, Rows, Workspace};
use crate::body::floating_frame::{BodyError, FloatingFrame};
use crate::body::marker::{BodyMarker, Marker, MarkerMotion};
use crate::hydraulics::cylinder::Cylinder;
use crate::joint::{Joint, needs_frames, row_count};
use crate::reduction::ReducedBody;

/// Why a machine cannot become a system.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SystemError {
    /// A body's constants are unusable.
    #[error(transparent)]
    Body(#[from] BodyError),
    /// No reduced body was given for a flexible body.
    #[error("no reduced body for flexible body `{0}`")]
    NotReduced(String),
    /// An attachment names a body that does not exist.
    #[error("attachment names body `{0}`, which is neither `ground` nor a body of the machine")]
    UnknownBody(String),
    /// An attachment names an interface that does not exist.
    #[error("body `{body}` has no interface `{interface}`")]
    UnknownInterface {
        /// Body name.
        body: String,
        /// Interface name.
        interface: String,
    },
    /// An attachment to a flexible body has no interface, or one to a rigid body no point.
    #[error("attachment to `{body}` needs {needs}")]
    IncompleteAttachment {
        /// Body name.
        body: String,
        /// What is missing.
        needs: &'static str,
    },
    /// A payload was asked for of a machine without a place for it.
    #[error("payload of {0} kg, but the machine has no payload attachment")]
    NoPayloadAttachment(f64),
}

/// A body with the places of its coordinates and unknowns.
#[derive(Debug, Clone)]
pub(crate) struct BodyEntry {
    pub(crate) name: String,
    pub(crate) frame: FloatingFrame,
    /// First coordinate.
    pub(crate) first_q: usize,
    /// First modal unknown.
    pub(crate) first_modal: usize,
    /// Rows (joints and cylinders) that touch this body.
    pub(crate) rows: Vec<usize>,
    /// First entry of its block in the workspace's coupling array.
    pub(crate) first_coupling: usize,
}

/// The payload: a point mass on a spherical joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PayloadMass {
    /// Mass, kg.
    pub mass_kg: f64,
    pub(crate) first_q: usize,
    pub(crate) first_frame: usize,
}

/// Constants of a system.
#[derive(Debug, Clone)]
pub struct System {
    pub(crate) bodies: Vec<BodyEntry>,
    pub(crate) payload: Option<PayloadMass>,
    pub(crate) markers: Vec<Marker>,
    /// Whether a marker's orientation is needed.
    pub(crate) marker_frames: Vec<bool>,
    pub(crate) joints: Vec<Joint>,
    pub(crate) cylinders: Vec<Cylinder>,
    /// Base and rod markers of the cylinders.
    pub(crate) cylinder_markers: Vec<[usize; 2]>,
    pub(crate) gravity_m_per_s2: Vector3<f64>,
    pub(crate) conventions: Conventions,
    pub(crate) joint_rows: usize,
    pub(crate) modal_count: usize,
    pub(crate) coordinate_count: usize,
}

impl System {
    /// Builds the system of a machine; `reduced` has the flexible bodies in the file's order, in
    /// the variant that belongs to the payload.
    ///
    /// # Errors
    /// If an attachment leads nowhere, or a body's constants are unusable.
    pub fn new(file: &MachineFile, reduced: &[ReducedBody], payload_kg: f64) -> Result<Self, SystemError> {
        let mut system = Self {
            bodies: Vec::new(),
            payload: None,
            markers: Vec::new(),
            marker_frames: Vec::new(),
            joints: Vec::new(),
            cylinders: Vec::new(),
            cylinder_markers: Vec::new(),
            gravity_m_per_s2: Vector3::from(file.gravity_m_per_s2),
            conventions: file.conventions,
            joint_rows: 0,
            modal_count: 0,
            coordinate_count: 0,
        };
        for spec in &file.bodies {
            let frame = match spec {
                BodySpec::Rigid(rigid) => rigid_frame(rigid),
                BodySpec::Flexible(flexible) => {
                    FloatingFrame::flexible(find_reduced(reduced, &flexible.name)?)?
                }
            };
            system.add_body(spec.name(), frame);
        }
        for spec in &file.joints {
            let from = system.add_marker(file, reduced, &spec.from)?;
            let to = system.add_marker(file, reduced, &spec.to)?;
            system.add_joint(&spec.name, spec.kind, from, to);
        }
        if payload_kg > 0.0 {
            let payload = file
                .payload
                .as_ref()
                .ok_or(SystemError::NoPayloadAttachment(payload_kg))?;
            let at = system.add_marker(file, reduced, &payload.at)?;
            system.add_payload(payload_kg, at);
        }
        for spec in &file.cylinders {
            let base = system.add_marker(file, reduced, &spec.base)?;
            let rod = system.add_marker(file, reduced, &spec.rod)?;
            system.cylinders.push(Cylinder::new(spec));
            system.cylinder_markers.push([base, rod]);
        }
        system.find_touching_rows();
        Ok(system)
    }

    fn add_body(&mut self, name: &str, frame: FloatingFrame) {
        let modes = frame.mode_count();
        self.bodies.push(BodyEntry {
            name: name.to_owned(),
            frame,
            first_q: self.coordinate_count,
            first_modal: self.modal_count,
            rows: Vec::new(),
            first_coupling: 0,
        });
        self.coordinate_count += 7 + modes;
        self.modal_count += modes;
    }

    fn add_joint(&mut self, name: &str, kind: JointKind, from: usize, to: usize) {
        if needs_frames(kind) {
            self.marker_frames[from] = true;
            self.marker_frames[to] = true;
        }
        self.joints.push(Joint {
            name: name.to_owned(),
            kind,
            from,
            to,
            first_row: self.joint_rows,
        });
        self.joint_rows += row_count(kind);
    }

    fn add_payload(&mut self, mass_kg: f64, at: usize) {
        let first_frame = 6 * self.bodies.len();
        self.payload = Some(PayloadMass {
            mass_kg,
            first_q: self.coordinate_count,
            first_frame,
        });
        self.coordinate_count += 3;
        self.markers.push(Marker::Payload);
        self.marker_frames.push(false);
        let mass = self.markers.len() - 1;
        self.add_joint("payload", JointKind::Spherical, at, mass);
    }

    fn add_marker(
        &mut self,
        file: &MachineFile,
        reduced: &[ReducedBody],
        at: &Attachment,
    ) -> Result<usize, SystemError> {
        let marker = if at.body == "ground" {
            let point = at.point_m.ok_or_else(|| SystemError::IncompleteAttachment {
                body: at.body.clone(),
                needs: "point_m",
            })?;
            Marker::Ground(Vector3::from(point))
        } else {
            let body = file
                .bodies
                .iter()
                .position(|b| b.name() == at.body)
                .ok_or_else(|| SystemError::UnknownBody(at.body.clone()))?;
            Marker::Body(match &file.bodies[body] {
                BodySpec::Rigid(_) => {
                    let point = at.point_m.ok_or_else(|| SystemError::IncompleteAttachment {
                        body: at.body.clone(),
                        needs: "point_m",
                    })?;
                    BodyMarker {
                        body,
                        position_m: Vector3::from(point),
                        translation: Vec::new(),
                        rotation: Vec::new(),
                    }
                }
                BodySpec::Flexible(_) => self.interface_marker(body, find_reduced(reduced, &at.body)?, at)?,
            })
        };
        self.markers.push(marker);
        self.marker_frames.push(false);
        Ok(self.markers.len() - 1)
    }

    fn interface_marker(
        &self,
        body: usize,
        reduced: &ReducedBody,
        at: &Attachment,
    ) -> Result<BodyMarker, SystemError> {
        let name = at
            .interface
            .as_ref()
            .ok_or_else(|| SystemError::IncompleteAttachment {
                body: at.body.clone(),
                needs: "interface",
            })?;
        let interface = reduced
            .interfaces
            .iter()
            .find(|i| &i.name == name)
            .ok_or_else(|| SystemError::UnknownInterface {
                body: at.body.clone(),
                interface: name.clone(),
            })?;
        let frame = &self.bodies[body].frame;
        Ok(BodyMarker {
            body,
            position_m: interface.position_m,
            translation: frame.map_columns(&interface.translation),
            rotation: frame.map_columns(&interface.rotation),
        })
    }

    /// Finds which rows touch which body, so that the elimination of modes skips the rest.
    fn find_touching_rows(&mut self) {
        let body_of = |marker: usize| match &self.markers[marker] {
            Marker::Body(m) => Some(m.body),
            Marker::Ground(_) | Marker::Payload => None,
        };
        let mut touching = vec![Vec::new(); self.bodies.len()];
        for joint in &self.joints {
            for row in joint.first_row..joint.first_row + row_count(joint.kind) {
                for body in [body_of(joint.from), body_of(joint.to)].into_iter().flatten() {
                    touching[body].push(row);
                }
            }
        }
        for (k, markers) in self.cylinder_markers.iter().enumerate() {
            for body in markers.iter().filter_map(|&m| body_of(m)) {
                touching[body].push(self.joint_rows + k);
            }
        }
        let mut first_coupling = 0;
        for (body, mut rows) in self.bodies.iter_mut().zip(touching) {
            rows.sort_unstable();
            rows.dedup();
            body.first_coupling = first_coupling;
            first_coupling += body.frame.mode_count() * (6 + rows.len());
            body.rows = rows;
        }
    }

    /// Number of columns of the frames: 6 per body, 3 for the payload.
    #[must_use]
    pub fn frame_count(&self) -> usize {
        6 * self.bodies.len() + if self.payload.is_some() { 3 } else { 0 }
    }

    /// Joint rows and cylinder rows.
    #[must_use]
    pub fn row_count(&self) -> usize {
        self.joint_rows + self.cylinders.len()
    }

    /// Cylinders, in the machine's order.
    #[must_use]
    pub fn cylinders(&self) -> &[Cylinder] {
        &self.cylinders
    }

    /// Number of a body by name.
    #[must_use]
    pub fn body_index(&self, name: &str) -> Option<usize> {
        self.bodies.iter().position(|b| b.name == name)
    }

    /// Body by number.
    #[must_use]
    pub fn body(&self, index: usize) -> &FloatingFrame {
        &self.bodies[index].frame
    }

    /// Whether gravity's moment uses the deformed centre of mass.
    pub(crate) fn deformed_gravity(&self) -> bool {
        matches!(self.conventions.gravity_moment, GravityMoment::Deformed)
    }

    /// The same system with another payload mass, kg; only for systems that carry a payload.
    #[must_use]
    pub fn with_payload_mass(&self, mass_kg: f64) -> Self {
        let mut system = self.clone();
        if let Some(payload) = &mut system.payload {
            payload.mass_kg = mass_kg;
        }
        system
    }

    /// A state at rest at the origin, with room for everything.
    #[must_use]
    pub fn new_state(&self) -> State {
        let n = self.coordinate_count;
        let mut q = vec![0.0; n];
        for body in &self.bodies {
            q[body.first_q + 3] = 1.0;
        }
        State {
            q,
            v: vec![0.0; n],
            a: vec![0.0; n],
            algorithmic: vec![0.0; n],
            multipliers: vec![0.0; self.joint_rows],
            pressures_pa: self
                .cylinders
                .iter()
                .map(|c| [c.spec().initial_pressure_pa; 2])
                .collect(),
            pressure_rates_pa_per_s: vec![[0.0; 2]; self.cylinders.len()],
        }
    }

    /// Scratch memory for this system.
    #[must_use]
    pub fn new_workspace(&self) -> Workspace {
        let (frames, rows, modes) = (self.frame_count(), self.row_count(), self.modal_count);
        let order = frames + rows;
        Workspace {
            bodies: self.bodies.iter().map(|b| b.frame.new_motion()).collect(),
            markers: vec![MarkerMotion::default(); self.markers.len()],
            cylinders: vec![CylinderMotion::default(); self.cylinders.len()],
            rows: Rows {
                frame: vec![0.0; rows * frames],
                modal: vec![0.0; rows * modes],
                frame_count: frames,
                modal_count: modes,
            },
            residual_frame: vec![0.0; frames],
            residual_modal: vec![0.0; modes],
            residual_rows: vec![0.0; rows],
            lock_forces_n: vec![0.0; self.cylinders.len()],
            delta_frame: vec![0.0; frames],
            delta_modal: vec![0.0; modes],
            delta_multipliers: vec![0.0; rows],
            velocity_frame: vec![0.0; frames],
            lu: DenseLu::new(order),
            right: vec![0.0; order],
            coupling: vec![
                0.0;
                self.bodies
                    .iter()
                    .map(|b| b.frame.mode_count() * (6 + b.rows.len()))
                    .sum()
            ],
            modal_pivots: vec![0.0; modes],
            local: vec![0.0; order * order],
        }
    }
}

fn find_reduced<'a>(reduced: &'a [ReducedBody], name: &str) -> Result<&'a ReducedBody, SystemError> {
    reduced
        .iter()
        .find(|r| r.name == name)
        .ok_or_else(|| SystemError::NotReduced(name.to_owned()))
}

fn rigid_frame(spec: &RigidBodySpec) -> FloatingFrame {
    let [xx, yy, zz, xy, xz, yz] = spec.inertia_kg_m2;
    let inertia = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
    FloatingFrame::rigid(spec.mass_kg, Vector3::from(spec.centre_of_mass_m), inertia)
}
