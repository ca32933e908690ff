//! What there is to know about a machine before it moves: for `hydroflex machine show`.

use crate::fe::InterfaceNodes;
use crate::linearise::Actuation;
use crate::machine::FlexibleBody;
use crate::reduction::{ClampedModel, ReducedBody, ReductionError, free_free_hz};
use crate::simulator::{Simulator, SimulatorError};
use hydroflex_openapi::machine::{
    BodySpec, Boundary, CylinderSpec, FlexibleBodySpec, MachineFile, PayloadSpec,
};
use nalgebra::{DMatrix, Matrix3, Vector3};
use serde::Serialize;

/// Points over the range of angles at which the equilibrium is shown.
const EQUILIBRIUM_POINTS: usize = 7;

/// Free-free frequencies shown.
const FREE_FREE_COUNT: usize = 6;

/// Frequencies of the full model shown beside the reduced ones.
const FULL_COUNT: usize = 4;

/// Why a machine cannot be summarised.
#[derive(Debug, thiserror::Error)]
pub enum SummaryError {
    /// A body cannot be reduced.
    #[error(transparent)]
    Reduction(#[from] ReductionError),
    /// The simulator cannot be built.
    #[error(transparent)]
    Simulator(#[from] SimulatorError),
}

/// A machine in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MachineSummary {
    /// Name.
    pub name: String,
    /// Description.
    pub description: String,
    /// Content hash of description, meshes and code, hexadecimal.
    pub content_hash: String,
    /// Bodies in the file's order.
    pub bodies: Vec<BodySummary>,
    /// Names of the angles, as the rows of `equilibria` give them.
    pub angle_names: Vec<String>,
    /// Names of the cylinders, as the rows of `equilibria` give them.
    pub cylinder_names: Vec<String>,
    /// Equilibria over the range of angles, for payloads from none to the largest.
    pub equilibria: Vec<EquilibriumRow>,
    /// Small motions in the middle of the range, valves shut, for the same payloads.
    pub small_motions: Vec<SmallMotionsRow>,
}

/// Small motions about a configuration at rest, with the oil that the shut valves hold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SmallMotionsRow {
    /// Payload.
    pub payload_kg: f64,
    /// Angles as a run table gives them.
    pub angles_deg: Vec<f64>,
    /// Decay of the slowest damped motions, 1/s.
    pub decay_per_s: Vec<f64>,
    /// Their frequencies, 0 where they do not oscillate.
    pub frequency_hz: Vec<f64>,
    /// Time in which the slowest of them has decayed to a hundredth: SLIDE's window from eigenvalues.
    pub window_s: Option<f64>,
    /// Why there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

/// A body in numbers; body frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BodySummary {
    /// Name.
    pub name: String,
    /// Mass.
    pub mass_kg: f64,
    /// Centre of mass.
    pub centre_of_mass_m: [f64; 3],
    /// Inertia about the centre of mass, by rows.
    pub inertia_kg_m2: [[f64; 3]; 3],
    /// What only a flexible body has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flexible: Option<FlexibleSummary>,
}

/// The flexible side of a body.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FlexibleSummary {
    /// Material.
    pub material: String,
    /// Element type.
    pub element_kind: String,
    /// Mesh nodes.
    pub node_count: usize,
    /// Mesh elements.
    pub element_count: usize,
    /// Interfaces in the file's order.
    pub interfaces: Vec<InterfaceSummary>,
    /// First elastic frequencies of the free body, full model.
    pub free_free_hz: Vec<f64>,
    /// The mode bases: without payload, and with it where that makes a difference.
    pub bases: Vec<BasisSummary>,
}

/// An interface.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InterfaceSummary {
    /// Name.
    pub name: String,
    /// Nodes.
    pub node_count: usize,
    /// Marker point.
    pub position_m: [f64; 3],
    /// When it is a boundary of the basis: `always`, `with_payload` or `never`.
    pub boundary: String,
}

/// A mode basis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BasisSummary {
    /// Whether it is that of runs with payload.
    pub with_payload: bool,
    /// Boundary interfaces; the first carries the frame.
    pub boundaries: Vec<String>,
    /// Modes.
    pub mode_count: usize,
    /// Clamped-interface frequencies of the normal modes.
    pub fixed_interface_hz: Vec<f64>,
    /// Frequencies of the reduced body with its first interface clamped.
    pub reduced_hz: Vec<f64>,
    /// The same of the full model, as many as the reduction is meant to keep: what it lost. Empty
    /// if the first interface alone does not hold the body.
    pub full_hz: Vec<f64>,
    /// Static deflections of the other interfaces under loads at them, reduced and full: what the reduction lost.
    /// Empty where `full_hz` is.
    pub deflections: Vec<DeflectionSummary>,
}

/// How far an interface gives way in the direction of a force on it, first interface held. The force is spread over the
/// interface's nodes by their marker weights, the deflection is their weighted mean.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeflectionSummary {
    /// Interface.
    pub interface: String,
    /// Per newton along x, y and z of the body frame, full model.
    pub full_m_per_n: [f64; 3],
    /// The same of the reduced body: smaller, as a basis can only stiffen.
    pub reduced_m_per_n: [f64; 3],
    /// Part of the full deflection that the reduction lost, along x, y and z.
    pub lost_ratio: [f64; 3],
}

/// A configuration at rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EquilibriumRow {
    /// Payload.
    pub payload_kg: f64,
    /// Angles as a run table gives them.
    pub angles_deg: Vec<f64>,
    /// Eye-to-eye lengths of the cylinders.
    pub lengths_m: Vec<f64>,
    /// Forces of the oil, tension positive.
    pub forces_n: Vec<f64>,
    /// Pressures on the piston side.
    pub pressures_piston_pa: Vec<f64>,
    /// Pressures on the rod side.
    pub pressures_rod_pa: Vec<f64>,
    /// Whether every pressure lies between tank and supply.
    pub within_supply: bool,
    /// Why there is no equilibrium here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

/// Summarises a machine: reduces its bodies and solves its equilibria.
///
/// # Errors
/// If a body cannot be reduced.
pub fn summarise(simulator: &Simulator) -> Result<MachineSummary, SummaryError> {
    let machine = simulator.machine();
    let file = machine.file();
    let mut flexible = machine.flexible_bodies().iter().enumerate();
    let mut bodies = Vec::new();
    for body in &file.bodies {
        bodies.push(match body {
            BodySpec::Rigid(body) => {
                let [xx, yy, zz, xy, xz, yz] = body.inertia_kg_m2;
                BodySummary {
                    name: body.name.clone(),
                    mass_kg: body.mass_kg,
                    centre_of_mass_m: body.centre_of_mass_m,
                    inertia_kg_m2: [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
                    flexible: None,
                }
            }
            BodySpec::Flexible(spec) => {
                let Some((i, body)) = flexible.next() else {
                    continue;
                };
                flexible_summary(simulator, i, spec, body)?
            }
        });
    }
    Ok(MachineSummary {
        name: file.name.clone(),
        description: file.description.clone(),
        content_hash: hex::encode(machine.content_hash()),
        bodies,
        angle_names: file.angles.iter().map(|a| a.name.clone()).collect(),
        cylinder_names: file.cylinders.iter().map(|c| c.name.clone()).collect(),
        equilibria: equilibria(simulator),
        small_motions: payloads_kg(file)
            .into_iter()
            .map(|payload_kg| small_motions(simulator, payload_kg))
            .collect(),
    })
}

fn flexible_summary(
    simulator: &Simulator,
    index: usize,
    spec: &FlexibleBodySpec,
    body: &FlexibleBody,
) -> Result<BodySummary, SummaryError> {
    let without = &simulator.reduced(false)?[index];
    let model = body.model(false);
    let (stiffness, mass) = (model.stiffness(), model.mass());
    let mut is_fixed = vec![false; body.mesh.node_count()];
    for node in &body.interfaces[0].nodes {
        is_fixed[*node as usize] = true;
    }
    let full = match ClampedModel::new(&stiffness, &mass, &is_fixed) {
        // parts that only their other interfaces hold, as the published tilt boom has
        Err(ReductionError::SingularStiffness { .. }) => None,
        model => Some(full_model(&model?, &body.interfaces)?),
    };
    let mut bases = vec![basis(without, false, full.as_ref())];
    if body.boundary_with_payload != body.boundary_without_payload {
        bases.push(basis(&simulator.reduced(true)?[index], true, full.as_ref()));
    }
    // the free body's first bending lies a few times above the clamped one
    let scale_hz = 3.0 * without.report.fixed_interface_hz.first().unwrap_or(&30.0);
    let com = without.centre_of_mass_m;
    let about_origin = without.inertia_origin_kg_m2;
    let steiner = Matrix3::from_diagonal_element(com.norm_squared()) - com * com.transpose();
    let inertia = about_origin - steiner * without.mass_kg;
    Ok(BodySummary {
        name: body.name.clone(),
        mass_kg: without.mass_kg,
        centre_of_mass_m: com.into(),
        inertia_kg_m2: std::array::from_fn(|r| std::array::from_fn(|c| inertia[(r, c)])),
        flexible: Some(FlexibleSummary {
            material: spec.material.name.clone(),
            element_kind: body.mesh.elements().kind_name().to_owned(),
            node_count: body.mesh.node_count(),
            element_count: body.mesh.elements().len(),
            interfaces: spec
                .interfaces
                .iter()
                .zip(&body.interfaces)
                .map(|(spec, nodes)| InterfaceSummary {
                    name: spec.name.clone(),
                    node_count: nodes.nodes.len(),
                    position_m: Vector3::into(nodes.weighted_mean_m(&body.mesh)),
                    boundary: match spec.boundary {
                        Boundary::Always => "always",
                        Boundary::WithPayload => "with_payload",
                        Boundary::Never => "never",
                    }
                    .to_owned(),
                })
                .collect(),
            free_free_hz: free_free_hz(&stiffness, &mass, scale_hz, FREE_FREE_COUNT)?,
            bases,
        }),
    })
}

/// What the full model says with its first interface held.
struct FullModel {
    lowest_hz: Vec<f64>,
    /// Of every interface after the first.
    compliances_m_per_n: Vec<[f64; 3]>,
}

fn full_model(model: &ClampedModel<'_>, interfaces: &[InterfaceNodes]) -> Result<FullModel, ReductionError> {
    let others = &interfaces[1..];
    let mut loads_n = DMatrix::zeros(model.node_count() * 3, 3 * others.len());
    for (k, interface) in others.iter().enumerate() {
        for (node, weight) in interface.nodes.iter().zip(&interface.weights) {
            for c in 0..3 {
                loads_n[(3 * *node as usize + c, 3 * k + c)] = *weight;
            }
        }
    }
    let deflections_m = model.deflections_m(&loads_n);
    let compliance = |column: usize| loads_n.column(column).dot(&deflections_m.column(column));
    Ok(FullModel {
        lowest_hz: model.lowest_hz(FULL_COUNT)?,
        compliances_m_per_n: (0..others.len())
            .map(|k| std::array::from_fn(|c| compliance(3 * k + c)))
            .collect(),
    })
}

/// Deflections of the reduced body beside those of the full model.
fn deflections(body: &ReducedBody, full: &FullModel) -> Vec<DeflectionSummary> {
    let Some(stiffness) = body.stiffness_modal.clone().cholesky() else {
        return Vec::new();
    };
    let others = body.interfaces[1..].iter().zip(&full.compliances_m_per_n);
    others
        .map(|(interface, full_m_per_n)| {
            let shape = interface.translation.transpose();
            let compliance = interface.translation.clone() * stiffness.solve(&shape);
            let reduced_m_per_n: [f64; 3] = std::array::from_fn(|c| compliance[(c, c)]);
            DeflectionSummary {
                interface: interface.name.clone(),
                full_m_per_n: *full_m_per_n,
                reduced_m_per_n,
                lost_ratio: std::array::from_fn(|c| 1.0 - reduced_m_per_n[c] / full_m_per_n[c]),
            }
        })
        .collect()
}

fn basis(body: &ReducedBody, with_payload: bool, full: Option<&FullModel>) -> BasisSummary {
    BasisSummary {
        with_payload,
        boundaries: body.report.boundary_names.clone(),
        mode_count: body.mode_count(),
        fixed_interface_hz: body.report.fixed_interface_hz.clone(),
        reduced_hz: generalised_hz(&body.stiffness_modal, &body.mass_modal),
        full_hz: full.map_or_else(Vec::new, |full| full.lowest_hz.clone()),
        deflections: full.map_or_else(Vec::new, |full| deflections(body, full)),
    }
}

/// Frequencies of `K v = ω² M v`, ascending, Hz; empty if M is not positive definite.
fn generalised_hz(stiffness: &DMatrix<f64>, mass: &DMatrix<f64>) -> Vec<f64> {
    let solve = || {
        let l = mass.clone().cholesky()?.l();
        let half = l.solve_lower_triangular(stiffness)?;
        let c = l.solve_lower_triangular(&half.transpose())?;
        Some(((&c + c.transpose()) * 0.5).symmetric_eigenvalues())
    };
    let mut hz: Vec<f64> = solve().map_or_else(Vec::new, |w2| {
        w2.iter()
            .map(|w2| w2.max(0.0).sqrt() / (2.0 * std::f64::consts::PI))
            .collect()
    });
    hz.sort_by(f64::total_cmp);
    hz
}

/// Smallest, middle and largest payload.
#[must_use]
pub fn payloads_kg(file: &MachineFile) -> Vec<f64> {
    match &file.payload {
        Some(PayloadSpec { range_kg, .. }) => {
            vec![range_kg[0], 0.5 * (range_kg[0] + range_kg[1]), range_kg[1]]
        }
        None => vec![0.0],
    }
}

/// Damped motions shown.
const SMALL_MOTIONS_COUNT: usize = 5;
/// Amplitude to which a motion counts as decayed, as in the SLIDE paper.
const DECAYED: f64 = 0.01;

/// SLIDE's window from eigenvalues, s: time in which the slowest damped motion in the middle of the range has decayed to a
/// hundredth, valves shut. None where there is no equilibrium, or a motion does not decay.
#[must_use]
pub fn eigenvalue_window_s(simulator: &Simulator, payload_kg: f64) -> Option<f64> {
    small_motions(simulator, payload_kg).window_s
}

fn small_motions(simulator: &Simulator, payload_kg: f64) -> SmallMotionsRow {
    let file = simulator.machine().file();
    let angles_deg: Vec<f64> = file
        .angles
        .iter()
        .map(|a| 0.5 * (a.range_deg[0] + a.range_deg[1]))
        .collect();
    let angles_rad: Vec<f64> = angles_deg.iter().map(|a| a.to_radians()).collect();
    let shut = Actuation::Oil {
        valves_ratio: vec![0.0; file.cylinders.len()],
    };
    let mut row = SmallMotionsRow {
        payload_kg,
        angles_deg,
        decay_per_s: Vec::new(),
        frequency_hz: Vec::new(),
        window_s: None,
        failure: None,
    };
    match simulator.linearise(payload_kg, &angles_rad, &shut) {
        Ok(found) => {
            // One of every pair.
            let slowest = found
                .eigenvalues_per_s
                .iter()
                .filter(|s| s.im >= 0.0)
                .take(SMALL_MOTIONS_COUNT);
            for s in slowest {
                row.decay_per_s.push(-s.re);
                row.frequency_hz.push(s.im / std::f64::consts::TAU);
            }
            row.window_s = found.settling_time_s(DECAYED);
        }
        Err(failure) => row.failure = Some(failure.to_string()),
    }
    row
}

fn equilibria(simulator: &Simulator) -> Vec<EquilibriumRow> {
    let file = simulator.machine().file();
    let mut rows = Vec::new();
    for payload_kg in payloads_kg(file) {
        for point in 0..EQUILIBRIUM_POINTS {
            let part = point as f64 / (EQUILIBRIUM_POINTS - 1) as f64;
            let angles_deg: Vec<f64> = file
                .angles
                .iter()
                .map(|a| a.range_deg[0] + part * (a.range_deg[1] - a.range_deg[0]))
                .collect();
            rows.push(equilibrium_row(simulator, payload_kg, angles_deg));
        }
    }
    rows
}

fn equilibrium_row(simulator: &Simulator, payload_kg: f64, angles_deg: Vec<f64>) -> EquilibriumRow {
    let cylinders = &simulator.machine().file().cylinders;
    let angles_rad: Vec<f64> = angles_deg.iter().map(|a| a.to_radians()).collect();
    match simulator.equilibrium(payload_kg, &angles_rad) {
        Ok(rest) => EquilibriumRow {
            payload_kg,
            angles_deg,
            lengths_m: rest.lengths_m,
            forces_n: cylinders
                .iter()
                .zip(&rest.pressures_pa)
                .map(|(c, p)| oil_force_n(c, *p))
                .collect(),
            pressures_piston_pa: rest.pressures_pa.iter().map(|p| p[0]).collect(),
            pressures_rod_pa: rest.pressures_pa.iter().map(|p| p[1]).collect(),
            within_supply: cylinders.iter().zip(&rest.pressures_pa).all(|(c, p)| {
                let range = c.valve.tank_pressure_pa..=c.valve.supply_pressure_pa;
                p.iter().all(|p| range.contains(p))
            }),
            failure: None,
        },
        Err(error) => EquilibriumRow {
            payload_kg,
            angles_deg,
            lengths_m: Vec::new(),
            forces_n: Vec::new(),
            pressures_piston_pa: Vec::new(),
            pressures_rod_pa: Vec::new(),
            within_supply: false,
            failure: Some(error.to_string()),
        },
    }
}

/// `−p₀ A₀ + p₁ A₁`, tension positive, N.
fn oil_force_n(cylinder: &CylinderSpec, [piston_pa, rod_pa]: [f64; 2]) -> f64 {
    let disc = |diameter_m: f64| 0.25 * std::f64::consts::PI * diameter_m * diameter_m;
    let piston_m2 = disc(cylinder.piston_diameter_m);
    let ring_m2 = piston_m2 - disc(cylinder.rod_diameter_m);
    rod_pa * ring_m2 - piston_pa * piston_m2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine::Machine;

    #[test]
    fn the_built_in_boom_rests_within_its_supply_over_the_whole_range() {
        let machine = Machine::load("lift-boom", &[]).unwrap();
        let simulator = Simulator::new(machine).unwrap();
        let rows = equilibria(&simulator);
        assert_eq!(rows.len(), 3 * EQUILIBRIUM_POINTS);
        for row in &rows {
            assert_eq!(row.failure, None);
            assert!(row.within_supply, "{row:?}");
            let (shortest, longest) = (0.820, 0.820 + 0.535);
            assert!((shortest..longest).contains(&row.lengths_m[0]), "{row:?}");
        }
        // a basis can only stiffen; an interface that is a boundary loses what its own nodes give way
        let summary = summarise(&simulator).unwrap();
        let flexible = summary.bodies[0].flexible.as_ref().unwrap();
        for basis in &flexible.bases {
            assert_eq!(basis.deflections.len(), flexible.interfaces.len() - 1);
            for row in &basis.deflections {
                let most = if basis.boundaries.contains(&row.interface) {
                    0.06
                } else {
                    1.0
                };
                assert!(
                    row.lost_ratio.iter().all(|lost| (-1e-9..most).contains(lost)),
                    "{row:?}"
                );
            }
        }
        let lost_y = |basis: &BasisSummary| {
            let row = basis.deflections.iter().find(|row| row.interface == "payload");
            row.unwrap().lost_ratio[1]
        };
        assert!(lost_y(&flexible.bases[1]) < lost_y(&flexible.bases[0]));
        // the boom swings on its oil, slower with more payload, and every motion decays
        let light = small_motions(&simulator, 0.0);
        let heavy = small_motions(&simulator, 200.0);
        for row in [&light, &heavy] {
            assert_eq!(row.failure, None);
            assert!(row.decay_per_s.iter().all(|decay| *decay > 0.0), "{row:?}");
        }
        assert!(heavy.window_s.unwrap() > light.window_s.unwrap());
        // more payload, more pressure
        let piston = |row: &EquilibriumRow| row.pressures_piston_pa[0];
        for (light, heavy) in rows.iter().zip(&rows[EQUILIBRIUM_POINTS..]) {
            assert!(piston(heavy) > piston(light));
        }
    }
}
