//! Checks of a machine file that need no mesh: numbers, names, references.

use super::error::{MachineError, Problem};
use super::text::MachineText;
use hydroflex_openapi::machine::{
    AngleSpec, Attachment, BodySpec, Boundary, CylinderSpec, DampingSpec, FlexibleBodySpec, FrictionSpec,
    MACHINE_FORMAT, MachineFile, MaterialSpec, RigidBodySpec, Selection, SensorQuantity, SensorSpec,
};
use nalgebra::{Matrix3, Vector3};
use std::collections::BTreeSet;

/// Ranges outside of which a number is a mistake of units rather than a machine.
mod plausible {
    pub(super) const LENGTH_M: (f64, f64) = (1e-4, 200.0);
    pub(super) const COORDINATE_M: (f64, f64) = (-200.0, 200.0);
    pub(super) const YOUNGS_MODULUS_PA: (f64, f64) = (1e6, 2e12);
    pub(super) const DENSITY_KG_PER_M3: (f64, f64) = (10.0, 30_000.0);
    pub(super) const PRESSURE_PA: (f64, f64) = (1e3, 3e8);
    pub(super) const BULK_MODULUS_PA: (f64, f64) = (1e6, 1e13);
    pub(super) const DIAMETER_M: (f64, f64) = (1e-3, 5.0);
    pub(super) const FLOW_COEFFICIENT: (f64, f64) = (1e-12, 1e-3);
    pub(super) const DAMPING_N_S_PER_M: (f64, f64) = (0.0, 1e9);
    pub(super) const STIFFNESS: (f64, f64) = (0.0, 1e12);
    pub(super) const FORCE_N: (f64, f64) = (0.0, 1e8);
    pub(super) const VELOCITY_M_PER_S: (f64, f64) = (1e-9, 10.0);
    pub(super) const MASS_KG: (f64, f64) = (0.0, 1e6);
}

const MAX_NORMAL_MODES: usize = 200;

type Checked = Result<(), MachineError>;

/// Checks the whole file.
pub(super) fn check(text: &MachineText<'_>, file: &MachineFile) -> Checked {
    Checker { text, file }.all()
}

/// Numbers of a material: key, value, allowed range, unit.
pub(crate) fn material_numbers(
    material: &MaterialSpec,
) -> [(&'static str, f64, (f64, f64), &'static str); 3] {
    [
        (
            "youngs_modulus_pa",
            material.youngs_modulus_pa,
            plausible::YOUNGS_MODULUS_PA,
            "Pa",
        ),
        ("poisson_ratio", material.poisson_ratio, (-0.99, 0.499), ""),
        (
            "density_kg_per_m3",
            material.density_kg_per_m3,
            plausible::DENSITY_KG_PER_M3,
            "kg/m³",
        ),
    ]
}

struct Checker<'a> {
    text: &'a MachineText<'a>,
    file: &'a MachineFile,
}

impl Checker<'_> {
    fn all(&self) -> Checked {
        let file = self.file;
        if file.format != MACHINE_FORMAT {
            let problem = Problem::Format {
                found: file.format,
                supported: MACHINE_FORMAT,
            };
            return Err(self.text.refuse("format", problem));
        }
        self.name("name", &file.name, '-')?;
        for (i, g) in file.gravity_m_per_s2.iter().enumerate() {
            self.range(&format!("gravity_m_per_s2[{i}]"), *g, (-100.0, 100.0), "m/s²")?;
        }
        self.statics()?;
        self.bodies()?;
        self.joints()?;
        self.cylinders()?;
        self.angles()?;
        if let Some(payload) = &file.payload {
            self.attachment("payload.at", &payload.at)?;
            self.ascending("payload.range_kg", payload.range_kg, plausible::MASS_KG, "kg")?;
        }
        self.sensors()
    }

    fn statics(&self) -> Checked {
        let Some(statics) = &self.file.conventions.statics else {
            return Ok(());
        };
        let at = "conventions.statics";
        self.range(
            &format!("{at}.load_steps"),
            f64::from(statics.load_steps),
            (1.0, 1000.0),
            "steps",
        )?;
        self.range(
            &format!("{at}.relative_tolerance"),
            statics.relative_tolerance,
            (1e-12, 1e-2),
            "of the first residual",
        )?;
        if let Some(ground) = &statics.ground_body {
            let at = format!("{at}.ground_body");
            self.range(&format!("{at}.mass_kg"), ground.mass_kg, plausible::MASS_KG, "kg")?;
            for (i, x) in ground.centre_of_mass_m.iter().enumerate() {
                let key = format!("{at}.centre_of_mass_m[{i}]");
                self.range(&key, *x, plausible::COORDINATE_M, "m")?;
            }
        }
        Ok(())
    }

    fn bodies(&self) -> Checked {
        let bodies = &self.file.bodies;
        if bodies.is_empty() {
            return Err(self.text.refuse("body", Problem::Missing { what: "body" }));
        }
        self.unique("body", bodies.iter().map(BodySpec::name))?;
        for (i, body) in bodies.iter().enumerate() {
            let at = format!("body[{i}]");
            if body.name() == "ground" {
                let name = "ground".to_owned();
                return Err(self
                    .text
                    .refuse(format!("{at}.name"), Problem::DuplicateName { name }));
            }
            match body {
                BodySpec::Flexible(body) => self.flexible(&at, body)?,
                BodySpec::Rigid(body) => self.rigid(&at, body)?,
            }
        }
        Ok(())
    }

    fn flexible(&self, at: &str, body: &FlexibleBodySpec) -> Checked {
        let key = |name: &str| format!("{at}.{name}");
        for (name, value, range, unit) in material_numbers(&body.material) {
            self.range(&key(&format!("material.{name}")), value, range, unit)?;
        }
        self.range(
            &key("normal_modes"),
            body.normal_modes as f64,
            (0.0, MAX_NORMAL_MODES as f64),
            "",
        )?;
        match body.damping {
            DampingSpec::Rayleigh {
                mass_factor_per_s,
                stiffness_factor_s,
            } => {
                self.range(
                    &key("damping.mass_factor_per_s"),
                    mass_factor_per_s,
                    (0.0, 1e4),
                    "1/s",
                )?;
                self.range(
                    &key("damping.stiffness_factor_s"),
                    stiffness_factor_s,
                    (0.0, 1.0),
                    "s",
                )?;
            }
            DampingSpec::Modal { damping_ratio } => {
                self.range(&key("damping.damping_ratio"), damping_ratio, (0.0, 10.0), "")?;
            }
        }
        let Some(first) = body.interfaces.first() else {
            let problem = Problem::Missing { what: "interface" };
            return Err(self.text.refuse(key("interface"), problem));
        };
        if first.boundary != Boundary::Always {
            return Err(self
                .text
                .refuse(key("interface[0].boundary"), Problem::FirstInterface));
        }
        self.unique(&key("interface"), body.interfaces.iter().map(|i| i.name.as_str()))?;
        for (i, interface) in body.interfaces.iter().enumerate() {
            if let Selection::Cylinder {
                axis_start_m,
                axis_end_m,
                radius_m,
                tolerance_m,
            } = &interface.select
            {
                let at = key(&format!("interface[{i}].select.cylinder"));
                self.point(&format!("{at}.axis_start_m"), axis_start_m)?;
                self.point(&format!("{at}.axis_end_m"), axis_end_m)?;
                self.range(&format!("{at}.radius_m"), *radius_m, plausible::LENGTH_M, "m")?;
                self.range(&format!("{at}.tolerance_m"), *tolerance_m, (1e-9, *radius_m), "m")?;
                let axis = Vector3::from(*axis_end_m) - Vector3::from(*axis_start_m);
                if axis.norm() < plausible::LENGTH_M.0 {
                    return Err(self.text.refuse(format!("{at}.axis_end_m"), Problem::NoAxis));
                }
            }
        }
        Ok(())
    }

    fn rigid(&self, at: &str, body: &RigidBodySpec) -> Checked {
        self.range(&format!("{at}.mass_kg"), body.mass_kg, (1e-6, 1e6), "kg")?;
        self.point(&format!("{at}.centre_of_mass_m"), &body.centre_of_mass_m)?;
        let [xx, yy, zz, xy, xz, yz] = body.inertia_kg_m2;
        let key = format!("{at}.inertia_kg_m2");
        if !body.inertia_kg_m2.iter().all(|x| x.is_finite()) {
            return Err(self.text.refuse(key, Problem::Inertia));
        }
        let moments = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz).symmetric_eigenvalues();
        // moments given to a few digits may miss the triangle inequality of a flat body by rounding
        let (largest, sum) = (moments.max(), moments.sum());
        if moments.min() <= 0.0 || largest > 1.001 * (sum - largest) {
            return Err(self.text.refuse(key, Problem::Inertia));
        }
        self.range(
            &format!("{at}.start_angle_deg"),
            body.start_angle_deg,
            (-360.0, 360.0),
            "°",
        )
    }

    fn joints(&self) -> Checked {
        let joints = &self.file.joints;
        self.unique("joint", joints.iter().map(|joint| joint.name.as_str()))?;
        for (i, joint) in joints.iter().enumerate() {
            self.attachment(&format!("joint[{i}].from"), &joint.from)?;
            self.attachment(&format!("joint[{i}].to"), &joint.to)?;
            if joint.from.body == joint.to.body {
                let body = joint.to.body.clone();
                return Err(self
                    .text
                    .refuse(format!("joint[{i}].to.body"), Problem::SameBody { body }));
            }
        }
        let mut held = BTreeSet::from(["ground"]);
        for _ in 0..self.file.bodies.len() {
            for joint in joints {
                let (from, to) = (joint.from.body.as_str(), joint.to.body.as_str());
                if held.contains(from) || held.contains(to) {
                    held.extend([from, to]);
                }
            }
        }
        for (i, body) in self.file.bodies.iter().enumerate() {
            if !held.contains(body.name()) {
                let body = body.name().to_owned();
                return Err(self
                    .text
                    .refuse(format!("body[{i}]"), Problem::Unconnected { body }));
            }
        }
        Ok(())
    }

    fn cylinders(&self) -> Checked {
        let cylinders = &self.file.cylinders;
        self.unique("cylinder", cylinders.iter().map(|c| c.name.as_str()))?;
        for (i, cylinder) in cylinders.iter().enumerate() {
            let at = format!("cylinder[{i}]");
            self.attachment(&format!("{at}.base"), &cylinder.base)?;
            self.attachment(&format!("{at}.rod"), &cylinder.rod)?;
            if cylinder.base.body == cylinder.rod.body {
                let body = cylinder.rod.body.clone();
                return Err(self
                    .text
                    .refuse(format!("{at}.rod.body"), Problem::SameBody { body }));
            }
            self.cylinder_size(&at, cylinder)?;
            self.hydraulics(&at, cylinder)?;
            self.cylinder_forces(&at, cylinder)?;
        }
        Ok(())
    }

    fn cylinder_size(&self, at: &str, c: &CylinderSpec) -> Checked {
        let key = |name: &str| format!("{at}.{name}");
        self.range(&key("closed_length_m"), c.closed_length_m, (0.01, 100.0), "m")?;
        self.range(&key("stroke_m"), c.stroke_m, (1e-3, 100.0), "m")?;
        self.range(
            &key("piston_diameter_m"),
            c.piston_diameter_m,
            plausible::DIAMETER_M,
            "m",
        )?;
        self.range(
            &key("rod_diameter_m"),
            c.rod_diameter_m,
            plausible::DIAMETER_M,
            "m",
        )?;
        if c.stroke_m >= c.closed_length_m {
            return Err(self.text.refuse(
                key("stroke_m"),
                Problem::Contradiction {
                    value: c.stroke_m,
                    other_key: "closed_length_m",
                    other: c.closed_length_m,
                    rule: "the rod must fit into the closed cylinder",
                },
            ));
        }
        if c.rod_diameter_m >= c.piston_diameter_m {
            return Err(self.text.refuse(
                key("rod_diameter_m"),
                Problem::Contradiction {
                    value: c.rod_diameter_m,
                    other_key: "piston_diameter_m",
                    other: c.piston_diameter_m,
                    rule: "the rod must be thinner than the piston",
                },
            ));
        }
        if let Some(range) = c.start_length_m {
            let stroke = (c.closed_length_m, c.closed_length_m + c.stroke_m);
            self.ascending(&key("start_length_m"), range, stroke, "m")?;
        }
        if let Some(cutoff) = c.stroke_cutoff {
            let range = [cutoff.min_length_m, cutoff.max_length_m];
            self.ascending(&key("stroke_cutoff"), range, (0.0, 200.0), "m")?;
        }
        Ok(())
    }

    fn hydraulics(&self, at: &str, c: &CylinderSpec) -> Checked {
        let key = |name: &str| format!("{at}.{name}");
        self.range(&key("hose.diameter_m"), c.hose.diameter_m, (1e-4, 1.0), "m")?;
        self.range(&key("hose.length_m"), c.hose.length_m, (1e-3, 1000.0), "m")?;
        let bulk = plausible::BULK_MODULUS_PA;
        let fluid = &c.fluid;
        self.range(
            &key("fluid.bulk_modulus_oil_pa"),
            fluid.bulk_modulus_oil_pa,
            bulk,
            "Pa",
        )?;
        self.range(
            &key("fluid.bulk_modulus_cylinder_pa"),
            fluid.bulk_modulus_cylinder_pa,
            bulk,
            "Pa",
        )?;
        self.range(
            &key("fluid.bulk_modulus_hose_pa"),
            fluid.bulk_modulus_hose_pa,
            bulk,
            "Pa",
        )?;
        let valve = &c.valve;
        let pressure = plausible::PRESSURE_PA;
        self.range(
            &key("valve.supply_pressure_pa"),
            valve.supply_pressure_pa,
            pressure,
            "Pa",
        )?;
        self.range(
            &key("valve.tank_pressure_pa"),
            valve.tank_pressure_pa,
            pressure,
            "Pa",
        )?;
        self.range(&key("initial_pressure_pa"), c.initial_pressure_pa, pressure, "Pa")?;
        self.range(
            &key("valve.flow_coefficient_m3_per_s_per_sqrt_pa"),
            valve.flow_coefficient_m3_per_s_per_sqrt_pa,
            plausible::FLOW_COEFFICIENT,
            "m³/(s √Pa)",
        )?;
        if valve.tank_pressure_pa >= valve.supply_pressure_pa {
            return Err(self.text.refuse(
                key("valve.tank_pressure_pa"),
                Problem::Contradiction {
                    value: valve.tank_pressure_pa,
                    other_key: "supply_pressure_pa",
                    other: valve.supply_pressure_pa,
                    rule: "the pump must deliver above tank pressure",
                },
            ));
        }
        if let Some(vapour) = fluid.vapour_pressure_pa {
            self.range(
                &key("fluid.vapour_pressure_pa"),
                vapour,
                (0.0, valve.tank_pressure_pa),
                "Pa",
            )?;
        }
        Ok(())
    }

    fn cylinder_forces(&self, at: &str, c: &CylinderSpec) -> Checked {
        let key = |name: &str| format!("{at}.{name}");
        let (damping, stiffness) = (plausible::DAMPING_N_S_PER_M, plausible::STIFFNESS);
        let (force, velocity) = (plausible::FORCE_N, plausible::VELOCITY_M_PER_S);
        self.range(&key("damping_n_s_per_m"), c.damping_n_s_per_m, damping, "N s/m")?;
        match c.friction {
            FrictionSpec::None => {}
            FrictionSpec::BrownMcphee {
                coulomb_n,
                static_n,
                viscous_n_s_per_m,
                transition_velocity_m_per_s,
            } => {
                self.range(&key("friction.coulomb_n"), coulomb_n, force, "N")?;
                self.range(&key("friction.static_n"), static_n, (coulomb_n, force.1), "N")?;
                self.range(
                    &key("friction.viscous_n_s_per_m"),
                    viscous_n_s_per_m,
                    damping,
                    "N s/m",
                )?;
                let key = key("friction.transition_velocity_m_per_s");
                self.range(&key, transition_velocity_m_per_s, velocity, "m/s")?;
            }
            FrictionSpec::Stribeck {
                dynamic_n,
                static_offset_n,
                decay_velocity_m_per_s,
                regularisation_velocity_m_per_s,
            } => {
                self.range(&key("friction.dynamic_n"), dynamic_n, force, "N")?;
                self.range(&key("friction.static_offset_n"), static_offset_n, force, "N")?;
                let decay = key("friction.decay_velocity_m_per_s");
                self.range(&decay, decay_velocity_m_per_s, velocity, "m/s")?;
                let regularisation = key("friction.regularisation_velocity_m_per_s");
                self.range(&regularisation, regularisation_velocity_m_per_s, velocity, "m/s")?;
            }
        }
        if let Some(spring) = c.parallel_spring {
            let at = key("parallel_spring");
            self.range(
                &format!("{at}.stiffness_n_per_m"),
                spring.stiffness_n_per_m,
                stiffness,
                "N/m",
            )?;
            self.range(
                &format!("{at}.cubic_stiffness_n_per_m3"),
                spring.cubic_stiffness_n_per_m3,
                stiffness,
                "N/m³",
            )?;
            self.range(
                &format!("{at}.damping_n_s_per_m"),
                spring.damping_n_s_per_m,
                damping,
                "N s/m",
            )?;
            self.range(
                &format!("{at}.free_length_m"),
                spring.free_length_m,
                (0.0, 200.0),
                "m",
            )?;
        }
        if let Some(stop) = c.end_stop {
            self.range(
                &key("end_stop.stiffness_n_per_m"),
                stop.stiffness_n_per_m,
                (1.0, stiffness.1),
                "N/m",
            )?;
            self.range(
                &key("end_stop.damping_n_s_per_m"),
                stop.damping_n_s_per_m,
                damping,
                "N s/m",
            )?;
        }
        Ok(())
    }

    fn angles(&self) -> Checked {
        let angles = &self.file.angles;
        if angles.is_empty() {
            return Err(self.text.refuse("angle", Problem::Missing { what: "[[angle]]" }));
        }
        self.unique("angle", angles.iter().map(|angle| angle.name.as_str()))?;
        for (i, angle) in angles.iter().enumerate() {
            let at = format!("angle[{i}]");
            self.known_body(&format!("{at}.body"), &angle.body)?;
            self.ascending(&format!("{at}.range_deg"), angle.range_deg, (-360.0, 360.0), "°")?;
            if let Some(minus) = &angle.minus
                && !angles[..i].iter().any(|other| other.name == *minus)
            {
                return Err(self.unknown(
                    &format!("{at}.minus"),
                    "earlier angle",
                    minus,
                    angles[..i].iter().map(|a: &AngleSpec| a.name.as_str()),
                ));
            }
            for (k, other) in angle.instead.iter().enumerate() {
                let at = format!("{at}.instead[{k}]");
                if !angles[..i].iter().any(|earlier| earlier.name == other.angle) {
                    let names = angles[..i].iter().map(|a: &AngleSpec| a.name.as_str());
                    return Err(self.unknown(&format!("{at}.angle"), "earlier angle", &other.angle, names));
                }
                self.ascending(
                    &format!("{at}.between_deg"),
                    other.between_deg,
                    (-360.0, 360.0),
                    "°",
                )?;
                self.ascending(&format!("{at}.range_deg"), other.range_deg, (-360.0, 360.0), "°")?;
            }
        }
        Ok(())
    }

    fn sensors(&self) -> Checked {
        let mut seen = BTreeSet::new();
        for (i, sensor) in self.file.sensors.iter().enumerate() {
            let at = format!("sensor[{i}]");
            self.name(&format!("{at}.name"), &sensor.name, '_')?;
            let flexible = self.flexible_bodies();
            if !flexible.iter().any(|body| body.name == sensor.body) {
                let names = flexible.iter().map(|body| body.name.as_str());
                return Err(self.unknown(&format!("{at}.body"), "flexible body", &sensor.body, names));
            }
            self.point(&format!("{at}.near_m"), &sensor.near_m)?;
            self.range(&format!("{at}.within_m"), sensor.within_m, (1e-9, 10.0), "m")?;
            if sensor.components.is_empty() {
                let problem = Problem::Missing { what: "component" };
                return Err(self.text.refuse(format!("{at}.components"), problem));
            }
            for (j, component) in sensor.components.iter().enumerate() {
                let key = format!("{at}.components[{j}]");
                let allowed = components(sensor);
                if !allowed.contains(&component.as_str()) {
                    return Err(self.unknown(&key, "component", component, allowed.iter().copied()));
                }
                // the quantity's number in declaration order keeps equal names of two quantities apart
                if !seen.insert((sensor.name.as_str(), sensor.quantity as u8, component.as_str())) {
                    let name = format!("{} {component}", sensor.name);
                    return Err(self.text.refuse(key, Problem::DuplicateName { name }));
                }
            }
        }
        Ok(())
    }

    fn flexible_bodies(&self) -> Vec<&FlexibleBodySpec> {
        self.file
            .bodies
            .iter()
            .filter_map(|body| match body {
                BodySpec::Flexible(body) => Some(body),
                BodySpec::Rigid(_) => None,
            })
            .collect()
    }

    fn attachment(&self, at: &str, attachment: &Attachment) -> Checked {
        let refuse = |wanted| {
            Err(self.text.refuse(
                at,
                Problem::Attachment {
                    body: attachment.body.clone(),
                    wanted,
                },
            ))
        };
        let flexible = self.flexible_bodies();
        if let Some(body) = flexible.iter().find(|body| body.name == attachment.body) {
            let Some(interface) = &attachment.interface else {
                return refuse("`interface = \"…\"`: it is flexible");
            };
            if attachment.point_m.is_some() {
                return refuse("its interface alone, without `point_m`");
            }
            let names = body.interfaces.iter().map(|i| i.name.as_str());
            return if names.clone().any(|name| name == interface) {
                Ok(())
            } else {
                Err(self.unknown(&format!("{at}.interface"), "interface", interface, names))
            };
        }
        if attachment.body != "ground" {
            self.known_body(&format!("{at}.body"), &attachment.body)?;
        }
        match (&attachment.interface, &attachment.point_m) {
            (None, Some(point)) => self.point(&format!("{at}.point_m"), point),
            (None, None) => refuse("`point_m = [x, y, z]`: it is rigid"),
            (Some(_), _) => refuse("`point_m` alone: a rigid body has no interfaces"),
        }
    }

    fn known_body(&self, key: &str, name: &str) -> Checked {
        let names = self.file.bodies.iter().map(BodySpec::name);
        if names.clone().any(|body| body == name) {
            Ok(())
        } else {
            Err(self.unknown(key, "body", name, names))
        }
    }

    fn unknown<'n>(
        &self,
        key: &str,
        kind: &'static str,
        name: &str,
        known: impl Iterator<Item = &'n str>,
    ) -> MachineError {
        self.text.refuse(
            key,
            Problem::UnknownName {
                kind,
                name: name.to_owned(),
                known: known.map(str::to_owned).collect(),
            },
        )
    }

    fn unique<'n>(&self, key: &str, names: impl Iterator<Item = &'n str>) -> Checked {
        let mut seen = BTreeSet::new();
        for (i, name) in names.enumerate() {
            let key = format!("{key}[{i}].name");
            self.name(&key, name, '_')?;
            if !seen.insert(name) {
                let name = name.to_owned();
                return Err(self.text.refuse(key, Problem::DuplicateName { name }));
            }
        }
        Ok(())
    }

    fn name(&self, key: &str, name: &str, separator: char) -> Checked {
        let good = name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.len() <= 60
            && name
                .chars()
                .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == separator);
        if good {
            return Ok(());
        }
        let name = name.to_owned();
        Err(self.text.refuse(key, Problem::BadName { name, separator }))
    }

    fn point(&self, key: &str, point: &[f64; 3]) -> Checked {
        for (i, x) in point.iter().enumerate() {
            self.range(&format!("{key}[{i}]"), *x, plausible::COORDINATE_M, "m")?;
        }
        Ok(())
    }

    fn ascending(&self, key: &str, [low, high]: [f64; 2], range: (f64, f64), unit: &'static str) -> Checked {
        self.range(key, low, range, unit)?;
        self.range(key, high, range, unit)?;
        if low > high {
            return Err(self.text.refuse(key, Problem::Descending { low, high }));
        }
        Ok(())
    }

    fn range(&self, key: &str, value: f64, (low, high): (f64, f64), unit: &'static str) -> Checked {
        if (low..=high).contains(&value) {
            return Ok(());
        }
        let problem = Problem::OutOfRange {
            value,
            low,
            high,
            unit,
        };
        Err(self.text.refuse(key, problem))
    }
}

fn components(sensor: &SensorSpec) -> &'static [&'static str] {
    match sensor.quantity {
        SensorQuantity::Deflection => &["x", "y", "z"],
        SensorQuantity::Strain => &["xx", "yy", "zz", "yz", "xz", "xy"],
        SensorQuantity::Stress => &["xx", "yy", "zz", "yz", "xz", "xy", "von_mises"],
    }
}
