//! Reads the channels from a state and its evaluation.

use hydroflex_openapi::machine::{MachineFile, SensorQuantity};
use nalgebra::DMatrix;

use super::channels::{Source, plan};
use crate::equilibrium::angle_about_z;
use crate::hydraulics::cylinder::Cylinder;
use crate::reduction::ReducedBody;
use crate::system::{State, System, Workspace};
use hydroflex_openapi::job::RunFlag;

/// How a channel is read.
#[derive(Debug, Clone)]
enum Reading {
    Valve(usize),
    Length(usize),
    Velocity(usize),
    Pressure(usize, usize),
    Force(usize),
    /// Body.
    Angle(usize),
    AngularVelocity(usize),
    AngularAcceleration(usize),
    /// Body, and the row of a linear map of its modal coordinates.
    Linear(usize, Vec<f64>),
    /// Body, and the six rows of stress (xx, yy, zz, yz, xz, xy).
    VonMises(usize, [Vec<f64>; 6]),
    /// A sensor that the machine's check should have refused.
    Absent,
}

/// Reads the channels of a machine.
#[derive(Debug, Clone)]
pub(crate) struct Recorder {
    readings: Vec<Reading>,
}

impl Recorder {
    pub(crate) fn new(file: &MachineFile, reduced: &[ReducedBody], system: &System) -> Self {
        let readings = plan(file)
            .into_iter()
            .map(|(_, source)| match source {
                Source::Valve(k) => Reading::Valve(k),
                Source::Length(k) => Reading::Length(k),
                Source::Velocity(k) => Reading::Velocity(k),
                Source::Pressure(k, side) => Reading::Pressure(k, side),
                Source::Force(k) => Reading::Force(k),
                Source::Angle(k) => angle_body(file, system, k).map_or(Reading::Absent, Reading::Angle),
                Source::AngularVelocity(k) => {
                    angle_body(file, system, k).map_or(Reading::Absent, Reading::AngularVelocity)
                }
                Source::AngularAcceleration(k) => {
                    angle_body(file, system, k).map_or(Reading::Absent, Reading::AngularAcceleration)
                }
                Source::Sensor(k, component) => {
                    sensor_reading(file, reduced, system, k, &component).unwrap_or(Reading::Absent)
                }
            })
            .collect();
        Self { readings }
    }

    /// Columns with room for all samples.
    pub(crate) fn new_columns(&self, samples: usize) -> Vec<Vec<f64>> {
        self.readings
            .iter()
            .map(|_| Vec::with_capacity(samples))
            .collect()
    }

    /// Appends one sample. The workspace holds the evaluation at this state.
    pub(crate) fn record(
        &self,
        system: &System,
        state: &State,
        ws: &Workspace,
        valves_ratio: impl Fn(usize) -> f64,
        columns: &mut [Vec<f64>],
    ) {
        for (reading, column) in self.readings.iter().zip(columns) {
            let value = match reading {
                Reading::Valve(k) => valves_ratio(*k),
                Reading::Length(k) => ws.cylinders[*k].length_m,
                Reading::Velocity(k) => ws.cylinders[*k].velocity_m_per_s,
                Reading::Pressure(k, side) => state.pressures_pa[*k][*side],
                Reading::Force(k) => system.cylinders()[*k]
                    .oil_force_n(state.pressures_pa[*k], ws.cylinders[*k].velocity_m_per_s),
                Reading::Angle(body) => {
                    let angle = angle_about_z(&ws.bodies[*body].rotation);
                    column.last().map_or(angle, |before| unwrap_angle(angle, *before))
                }
                Reading::AngularVelocity(body) => {
                    let motion = &ws.bodies[*body];
                    motion.rotation.row(2).tr_dot(&motion.omega_rad_per_s)
                }
                Reading::AngularAcceleration(body) => {
                    let motion = &ws.bodies[*body];
                    motion.rotation.row(2).tr_dot(&motion.alpha_rad_per_s2)
                }
                Reading::Linear(body, row) => dot(row, &ws.bodies[*body].eta),
                Reading::VonMises(body, rows) => {
                    let s: [f64; 6] = std::array::from_fn(|i| dot(&rows[i], &ws.bodies[*body].eta));
                    von_mises_pa(&s)
                }
                Reading::Absent => f64::NAN,
            };
            column.push(value);
        }
    }
}

/// Equivalent stress of (xx, yy, zz, yz, xz, xy), Pa.
#[must_use]
pub fn von_mises_pa(s: &[f64; 6]) -> f64 {
    let [xx, yy, zz, yz, xz, xy] = *s;
    let normal = (xx - yy).powi(2) + (yy - zz).powi(2) + (zz - xx).powi(2);
    (0.5 * normal + 3.0 * (yz * yz + xz * xz + xy * xy)).sqrt()
}

/// Nearest angle to `before` that equals `angle` up to full turns.
fn unwrap_angle(angle: f64, before: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle + turn * ((before - angle) / turn).round()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

fn angle_body(file: &MachineFile, system: &System, angle: usize) -> Option<usize> {
    system.body_index(&file.angles[angle].body)
}

fn sensor_reading(
    file: &MachineFile,
    reduced: &[ReducedBody],
    system: &System,
    sensor: usize,
    component: &str,
) -> Option<Reading> {
    let spec = &file.sensors[sensor];
    let body = system.body_index(&spec.body)?;
    let on_body = file.sensors[..sensor]
        .iter()
        .filter(|s| s.body == spec.body)
        .count();
    let node = reduced
        .iter()
        .find(|r| r.name == spec.body)?
        .sensor_nodes
        .get(on_body)?;
    let basis = system.body(body).basis();
    let row = |map: &DMatrix<f64>, i: usize| -> Vec<f64> { (map.row(i) * basis).iter().copied().collect() };
    let tensor = |name: &str| {
        ["xx", "yy", "zz", "yz", "xz", "xy"]
            .iter()
            .position(|c| *c == name)
    };
    match spec.quantity {
        SensorQuantity::Deflection => {
            let axis = ["x", "y", "z"].iter().position(|c| *c == component)?;
            let map = node.translation.row(axis) * basis;
            Some(Reading::Linear(body, map.iter().copied().collect()))
        }
        SensorQuantity::Strain => Some(Reading::Linear(body, row(&node.strain, tensor(component)?))),
        SensorQuantity::Stress if component == "von_mises" => Some(Reading::VonMises(
            body,
            std::array::from_fn(|i| row(&node.stress_pa, i)),
        )),
        SensorQuantity::Stress => Some(Reading::Linear(body, row(&node.stress_pa, tensor(component)?))),
    }
}

/// What a run met so far.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FlagSet(u8);

const FLAGS: [RunFlag; 5] = [
    RunFlag::StrokeCutoff,
    RunFlag::EndStop,
    RunFlag::Cavitation,
    RunFlag::BelowTankPressure,
    RunFlag::AboveSupplyPressure,
];

impl FlagSet {
    pub(crate) fn set(&mut self, flag: RunFlag) {
        if let Some(bit) = FLAGS.iter().position(|f| *f == flag) {
            self.0 |= 1 << bit;
        }
    }

    /// Looks at a cylinder at the end of a step.
    pub(crate) fn watch(&mut self, cylinder: &Cylinder, length_m: f64, pressures_pa: [f64; 2]) {
        let stroke = cylinder.stroke_m(length_m);
        if stroke < 0.0 || stroke > cylinder.spec().stroke_m {
            self.set(RunFlag::EndStop);
        }
        let valve = cylinder.valve();
        let vapour = cylinder.spec().fluid.vapour_pressure_pa.unwrap_or(0.0);
        for p in pressures_pa {
            if p <= vapour {
                self.set(RunFlag::Cavitation);
            }
            if p < valve.tank_pressure_pa {
                self.set(RunFlag::BelowTankPressure);
            }
            if p > valve.supply_pressure_pa {
                self.set(RunFlag::AboveSupplyPressure);
            }
        }
    }

    pub(crate) fn list(self) -> Vec<RunFlag> {
        FLAGS
            .iter()
            .enumerate()
            .filter(|(bit, _)| self.0 & (1 << bit) != 0)
            .map(|(_, flag)| *flag)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn von_mises_of_known_states() {
        assert!((von_mises_pa(&[3e6, 0.0, 0.0, 0.0, 0.0, 0.0]) - 3e6).abs() < 1e-6);
        assert!((von_mises_pa(&[0.0, 0.0, 0.0, 0.0, 0.0, 2e6]) - 2e6 * 3.0_f64.sqrt()).abs() < 1e-6);
        assert!(von_mises_pa(&[5e6, 5e6, 5e6, 0.0, 0.0, 0.0]) < 1e-6);
    }

    #[test]
    fn angles_run_on_through_half_a_turn() {
        assert!((unwrap_angle(-3.1, 3.1) - (std::f64::consts::TAU - 3.1)).abs() < 1e-12);
        assert!((unwrap_angle(0.4, 0.3) - 0.4).abs() < 1e-15);
    }

    #[test]
    fn flags_come_sorted_and_once() {
        let mut flags = FlagSet::default();
        flags.set(RunFlag::AboveSupplyPressure);
        flags.set(RunFlag::StrokeCutoff);
        flags.set(RunFlag::StrokeCutoff);
        assert_eq!(
            flags.list(),
            [RunFlag::StrokeCutoff, RunFlag::AboveSupplyPressure]
        );
    }
}
