//! Which machines have minimal coordinates, and their constants.

use super::constants::{Constants, Cylinder, ModeSet, Scale, SensorRow};
use super::eigen;
use super::record::Readout;
use crate::reduction::{ReducedBody, ReducedInterface};
use hydroflex_openapi::machine::{
    Attachment, BodySpec, GravityMoment, JointKind, MachineFile, SensorQuantity,
};
use nalgebra::{DMatrix, Matrix3xX, RowDVector, Vector3};

/// Most modes the step loop is built for.
pub const MOST_MODES: usize = 32;

/// Why a machine has no minimal planar coordinates here; the general path then runs it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotPlanar {
    /// More or fewer than one body, or a rigid one.
    #[error("it needs exactly one body, a flexible one, and the machine has {bodies} bodies")]
    Bodies {
        /// Bodies of the machine.
        bodies: usize,
    },
    /// Not one revolute joint to the ground.
    #[error("it needs exactly one joint, a revolute one between ground and body")]
    Joints,
    /// Not one cylinder between ground and body.
    #[error("it needs exactly one cylinder, between a point of the ground and an interface")]
    Cylinders,
    /// Not one angle, that of the body.
    #[error("it needs exactly one angle, that of the body")]
    Angles,
    /// The pivot interface moves in the floating frame.
    #[error("the pivot interface `{interface}` is not the one that carries the floating frame")]
    MovingPivot {
        /// Interface.
        interface: String,
    },
    /// An attachment of the machine is not an interface of the reduced body.
    #[error("the reduced body has no interface `{interface}`")]
    MissingInterface {
        /// Interface.
        interface: String,
    },
    /// The damping matrix is not diagonal in the modes of the body with this payload.
    #[error("the damping couples the modes of the body with its payload")]
    CoupledDamping,
    /// Too many modes.
    #[error("it is built for at most {most} modes, and the body has {modes}")]
    Modes {
        /// Modes of the body.
        modes: usize,
        /// Limit.
        most: usize,
    },
    /// The reduced mass matrix is not positive definite.
    #[error("the reduced mass matrix is not positive definite")]
    Mass,
}

/// A machine of one flexible body on a revolute joint to the ground, moved by one cylinder, in
/// minimal coordinates: angle, modes, pressures.
#[derive(Debug, Clone)]
pub struct PlanarModel {
    mass_modal: DMatrix<f64>,
    stiffness_modal: DMatrix<f64>,
    damping_modal: DMatrix<f64>,
    inertia_kg_m2: f64,
    /// Rows over the body's modal coordinates.
    h0: RowDVector<f64>,
    c: RowDVector<f64>,
    b: DMatrix<f64>,
    cc: DMatrix<f64>,
    rod: Matrix3xX<f64>,
    rod_m: Vector3<f64>,
    first_moment: Matrix3xX<f64>,
    centre_moment_kg_m: Vector3<f64>,
    /// Payload point relative to the pivot, and its mode rows.
    payload: Option<(Vector3<f64>, Matrix3xX<f64>)>,
    sensors: Sensors,
    base_m: [f64; 2],
    gravity_m_per_s2: [f64; 3],
    deformed_moment: bool,
    cylinder: Cylinder,
}

impl PlanarModel {
    /// Builds the model of `file` around its reduced body; `payload`: the body is the variant with
    /// the payload interface.
    ///
    /// # Errors
    /// [`NotPlanar`] says why the machine is outside what this path covers.
    pub fn new(file: &MachineFile, body: &ReducedBody, payload: bool) -> Result<Self, NotPlanar> {
        let [BodySpec::Flexible(flexible)] = file.bodies.as_slice() else {
            return Err(NotPlanar::Bodies {
                bodies: file.bodies.len(),
            });
        };
        let [joint] = file.joints.as_slice() else {
            return Err(NotPlanar::Joints);
        };
        let [cylinder] = file.cylinders.as_slice() else {
            return Err(NotPlanar::Cylinders);
        };
        match file.angles.as_slice() {
            [angle] if angle.body == flexible.name && angle.minus.is_none() => {}
            _ => return Err(NotPlanar::Angles),
        }
        if joint.kind != JointKind::Revolute {
            return Err(NotPlanar::Joints);
        }
        let (pivot_m, pivot) =
            ground_and_body(&joint.from, &joint.to, &flexible.name).ok_or(NotPlanar::Joints)?;
        let (base_m, rod) =
            ground_and_body(&cylinder.base, &cylinder.rod, &flexible.name).ok_or(NotPlanar::Cylinders)?;
        let pivot = interface(body, pivot)?;
        let rod = interface(body, rod)?;
        // The static modes are unit motions of an interface: 1e-9 of that is rounding.
        if pivot.translation.amax() > 1e-9 || pivot.rotation.amax() > 1e-9 {
            return Err(NotPlanar::MovingPivot {
                interface: pivot.name.clone(),
            });
        }
        let modes = body.mode_count();
        if modes > MOST_MODES {
            return Err(NotPlanar::Modes {
                modes,
                most: MOST_MODES,
            });
        }
        let payload = match (&file.payload, payload) {
            (Some(spec), true) => {
                let name = spec.at.interface.as_deref().unwrap_or_default();
                let at = interface(body, name)?;
                Some((at.position_m - pivot.position_m, at.translation.clone()))
            }
            _ => None,
        };
        let model = Self::assemble(file, body, pivot, rod, payload, pivot_m, base_m);
        // A payload changes the modes; whether damping stays diagonal shows with any of them.
        let probe = if model.payload.is_some() { 50.0 } else { 0.0 };
        model.modes(probe)?;
        Ok(model)
    }

    fn assemble(
        file: &MachineFile,
        body: &ReducedBody,
        pivot: &ReducedInterface,
        rod: &ReducedInterface,
        payload: Option<(Vector3<f64>, Matrix3xX<f64>)>,
        pivot_m: [f64; 3],
        base_m: [f64; 3],
    ) -> Self {
        let n = body.mode_count();
        let o = pivot.position_m;
        let centre = body.centre_of_mass_m * body.mass_kg;
        // About the pivot instead of the frame's origin (both in the plane of rotation).
        let inertia_kg_m2 = body.inertia_origin_kg_m2[(2, 2)] - 2.0 * (centre.x * o.x + centre.y * o.y)
            + body.mass_kg * (o.x * o.x + o.y * o.y);
        let h0 = RowDVector::from_fn(n, |_, k| {
            -body.c_xp[(2, k)] - (o.x * body.c_pt[(1, k)] - o.y * body.c_pt[(0, k)])
        });
        let c = RowDVector::from_fn(n, |_, k| {
            body.n_blocks[k][(2, 2)] - (o.x * body.c_pt[(0, k)] + o.y * body.c_pt[(1, k)])
        });
        let b = DMatrix::from_fn(n, n, |i, j| body.b_blocks[i * n + j][(2, 2)]);
        let cc = DMatrix::from_fn(n, n, |i, j| body.c_vectors[j * n + i].z);
        let mut rod_m = rod.position_m - o;
        rod_m.z += pivot_m[2] - base_m[2];
        Self {
            mass_modal: body.mass_modal.clone(),
            stiffness_modal: body.stiffness_modal.clone(),
            damping_modal: body.damping_modal.clone(),
            inertia_kg_m2,
            h0,
            c,
            b,
            cc,
            rod: rod.translation.clone(),
            rod_m,
            first_moment: body.c_pt.clone(),
            centre_moment_kg_m: centre - o * body.mass_kg,
            payload,
            sensors: Sensors::new(file, body),
            base_m: [base_m[0] - pivot_m[0], base_m[1] - pivot_m[1]],
            gravity_m_per_s2: file.gravity_m_per_s2,
            deformed_moment: file.conventions.gravity_moment == GravityMoment::Deformed,
            cylinder: Cylinder::new(&file.cylinders[0]),
        }
    }

    /// Number of modes.
    #[must_use]
    pub fn mode_count(&self) -> usize {
        self.mass_modal.nrows()
    }

    /// Channels of a trajectory: valve, length, velocity, two pressures, force, angle, angular
    /// velocity, angular acceleration, then the machine's sensors.
    #[must_use]
    pub fn channel_count(&self) -> usize {
        super::record::MACHINE_CHANNELS + self.sensors.readouts.len()
    }

    /// Whether the body has the payload interface.
    pub(super) fn carries_payload(&self) -> bool {
        self.payload.is_some()
    }

    /// The cylinder.
    pub(super) fn cylinder(&self) -> &Cylinder {
        &self.cylinder
    }

    /// Modes of the body with a payload.
    pub(super) fn modes(&self, payload_kg: f64) -> Result<Modes, NotPlanar> {
        let mut mass = self.mass_modal.clone();
        if let Some((_, rows)) = &self.payload {
            mass += rows.transpose() * rows * payload_kg;
        }
        let (values, phi) = eigen::generalised(&self.stiffness_modal, &mass).ok_or(NotPlanar::Mass)?;
        let damping = phi.transpose() * &self.damping_modal * &phi;
        for i in 0..values.len() {
            for j in 0..i {
                // Rounding of the congruence is 1e-13; a hundred thousand times that still changes
                // no result.
                let size = (damping[(i, i)] * damping[(j, j)]).abs().sqrt();
                if damping[(i, j)].abs().max(damping[(j, i)].abs()) > 1e-8 * size {
                    return Err(NotPlanar::CoupledDamping);
                }
            }
        }
        Ok(Modes {
            payload_kg,
            w2: values.iter().copied().collect(),
            damping: damping.diagonal().iter().copied().collect(),
            phi,
        })
    }

    /// Constants of the step loop for a payload, padded to the sizes given. `None` if the modes do
    /// not fit.
    pub(super) fn constants<const A: usize, const B: usize, const Q: usize>(
        &self,
        modes: &Modes,
        order: &Order,
    ) -> Option<Constants<f64, A, B, Q>> {
        if order.coupled.len() > A || order.plain.len() > B || order.followers.len() > Q {
            return None;
        }
        let phi = &modes.phi;
        let n = modes.w2.len();
        let m = if self.payload.is_some() {
            modes.payload_kg
        } else {
            0.0
        };
        let (at, rows) = self
            .payload
            .clone()
            .unwrap_or_else(|| (Vector3::zeros(), Matrix3xX::zeros(n)));
        let row = |index: usize| rows.row(index) * phi;
        let (px, py) = (row(0), row(1));
        let h0 = &self.h0 * phi + (&py * at.x - &px * at.y) * m;
        let c = &self.c * phi + (&px * at.x + &py * at.y) * m;
        let weight = [0, 1, 2].map(|i| self.first_moment.row(i) * phi + row(i) * m);
        let moment = [0, 1].map(|i| {
            if self.deformed_moment {
                weight[i].clone()
            } else {
                row(i) * m
            }
        });
        let parts = Parts {
            w2: &modes.w2,
            d: &modes.damping,
            h0,
            rod: [0, 1, 2].map(|i| self.rod.row(i) * phi),
            axial: &weight[2] * self.gravity_m_per_s2[2],
            weight,
            moment,
        };
        let b = phi.transpose() * &self.b * phi + (px.transpose() * &px + py.transpose() * &py) * m;
        let cc = phi.transpose() * &self.cc * phi + (py.transpose() * &px - px.transpose() * &py) * (-m);
        let square = |m: &DMatrix<f64>| columns(m, &order.coupled, &order.coupled);
        // With many modes Θ − |h|² is a small difference, of parts in 1e5: it is formed here from all
        // modes, since with some products left out it may come out negative in the step loop.
        let inertia_kg_m2 = self.inertia_kg_m2 + m * (at.x * at.x + at.y * at.y);
        let acting = order.coupled.iter().chain(&order.plain);
        let acting_h2: f64 = acting.map(|&k| parts.h0[k] * parts.h0[k]).sum();
        let hub_change = &c + &parts.h0 * &cc;
        let sensor = |row: &RowDVector<f64>| {
            let row = row * phi;
            SensorRow {
                coupled: padded(&order.coupled, |k| row[k]),
                plain: padded(&order.plain, |k| row[k]),
                follower: padded(&order.followers, |k| row[k]),
                lagging: parts.at_rest(&order.lagging, &row),
            }
        };
        Some(Constants {
            coupled: parts.set(&order.coupled),
            plain: parts.set(&order.plain),
            plain_c: padded(&order.plain, |k| c[k]),
            plain_cc: columns(&cc, &order.plain, &order.coupled),
            follower_c: padded(&order.followers, |k| c[k]),
            follower_cc: columns(&cc, &order.followers, &order.coupled),
            follower: parts.set(&order.followers),
            hub_kg_m2: inertia_kg_m2 - acting_h2,
            hub_change: padded(&order.coupled, |k| hub_change[k]),
            hub_curvature: square(&(&b - cc.transpose() * &cc)),
            c: padded(&order.coupled, |k| c[k]),
            b: square(&b),
            cc: square(&cc),
            lag_per_s: order.lagging.last().map_or(0.0, |_| 1.0 / modes.lag_s()),
            rod_m: self.rod_m.into(),
            moment_kg_m: [
                self.centre_moment_kg_m.x + m * at.x,
                self.centre_moment_kg_m.y + m * at.y,
            ],
            sensors: self.sensors.rows.iter().map(sensor).collect(),
            readouts: self.sensors.readouts.clone(),
            base_m: self.base_m,
            gravity_m_per_s2: [self.gravity_m_per_s2[0], self.gravity_m_per_s2[1]],
            cylinder: self.cylinder.clone(),
            scale: self.scale(modes),
        })
    }

    /// Ranges that a run typically covers: pressures between tank and supply, the rod's speed with
    /// the valve open, a tenth of a second of it, and the energy of a body under the full force.
    fn scale(&self, modes: &Modes) -> Scale<f64> {
        let c = &self.cylinder;
        let range_pa = (c.supply_pa - c.tank_pa).max(1.0);
        let force_n = range_pa * c.area_m2[0];
        let speed = (c.flow * range_pa.sqrt() / c.area_m2[0]).max(1e-6);
        let rod = &self.rod * &modes.phi;
        let flexibility: f64 = (0..modes.w2.len())
            .map(|k| (rod[(0, k)] * rod[(0, k)] + rod[(1, k)] * rod[(1, k)]) / modes.w2[k])
            .sum();
        Scale {
            per_pa: 1.0 / range_pa,
            per_m: 1.0 / (0.1 * speed),
            per_m_per_s: 1.0 / speed,
            per_j: 1.0 / (force_n * force_n * flexibility).max(f64::MIN_POSITIVE),
        }
    }

    /// Sorts the modes by what they take part in (§3 of the theory page has the estimates, tests the
    /// proof): each simplification changes results by a fraction of `tolerance`.
    pub(super) fn order(&self, modes: &Modes, tolerance: f64) -> Order {
        let c = &self.cylinder;
        let force_n = (c.supply_pa - c.tank_pa).max(1.0) * c.area_m2[0];
        let g = Vector3::from(self.gravity_m_per_s2).norm();
        let rod = &self.rod * &modes.phi;
        let weight = &self.first_moment * &modes.phi;
        let all: Vec<usize> = (0..modes.w2.len()).collect();
        let reach = |k: usize| libm::hypot(rod[(0, k)], rod[(1, k)]);
        let amplitude: Vec<f64> = all
            .iter()
            .map(|&k| {
                let push = force_n * rod[(0, k)].abs().max(rod[(1, k)].abs());
                let pull = g * weight[(0, k)].abs().max(weight[(1, k)].abs());
                (push + pull) / modes.w2[k]
            })
            .collect();
        let largest = amplitude.iter().fold(0.0, |a: f64, &b| a.max(b));
        let flexibility: f64 = all.iter().map(|&k| reach(k).powi(2) / modes.w2[k]).sum();
        let h0 = &self.h0 * &modes.phi;
        let acts_back = |k: usize| {
            let at_rod = reach(k).powi(2) / modes.w2[k] / flexibility;
            at_rod.max(h0[k] * h0[k] / self.inertia_kg_m2)
        };
        let rows: Vec<_> = self.sensors.rows.iter().map(|row| row * &modes.phi).collect();
        let seen = |k: usize| {
            let share = |row: &RowDVector<f64>| {
                let total: f64 = all.iter().map(|&j| row[j].abs() * amplitude[j]).sum();
                row[k].abs() * amplitude[k] / total.max(f64::MIN_POSITIVE)
            };
            rows.iter().map(share).fold(0.0, f64::max)
        };
        let lag_s = modes.lag_s();
        let lags = |k: usize| {
            let same_lag = (modes.damping[k] / modes.w2[k] - lag_s).abs() < 1e-6 * lag_s;
            same_lag && seen(k) * USUAL_RATE_PER_S.powi(2) / modes.w2[k] < LAGGING * tolerance
        };
        let coupled = if tolerance < 5e-4 { COUPLED } else { 5.0 * COUPLED };
        let mut order = Order::default();
        for k in all.iter().copied() {
            if acts_back(k) < FOLLOWING * tolerance {
                if lags(k) {
                    order.lagging.push(k);
                } else {
                    order.followers.push(k);
                }
            } else if amplitude[k] >= coupled * largest {
                order.coupled.push(k);
            } else {
                order.plain.push(k);
            }
        }
        order
    }
}

/// Smallest amplitude, over the largest, of a mode with inertia products.
const COUPLED: f64 = 2e-3;
/// Largest share in the flexibility of the rod end and in the inertia, over the tolerance, of a mode
/// that does not act back. Leaving out 1 % of the flexibility costs 2.5e-3 of range, so this costs a
/// twentieth of the tolerance.
const FOLLOWING: f64 = 0.2;
/// Largest error of a sensor, over the tolerance, for which a mode without inertia is good enough.
const LAGGING: f64 = 0.05;
/// Rate at which the forces on stiff modes usually change, 1/s: a vibration of 50 Hz.
const USUAL_RATE_PER_S: f64 = 300.0;

/// Modes by what they take part in, ascending frequency in each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Order {
    /// With inertia products.
    pub(super) coupled: Vec<usize>,
    /// Linear.
    pub(super) plain: Vec<usize>,
    /// Moved by the others, without acting back.
    pub(super) followers: Vec<usize>,
    /// The same, and so stiff that they follow the cylinder force with a first-order lag.
    pub(super) lagging: Vec<usize>,
}

/// `of` each of these modes, then zeros.
fn padded<const N: usize>(modes: &[usize], of: impl Fn(usize) -> f64) -> [f64; N] {
    let mut out = [0.0; N];
    for (out, &k) in out.iter_mut().zip(modes) {
        *out = of(k);
    }
    out
}

/// Columns `j` of a matrix, each with the rows `i`, padded.
fn columns<const N: usize, const A: usize>(m: &DMatrix<f64>, rows: &[usize], j: &[usize]) -> [[f64; N]; A] {
    let mut out = [[0.0; N]; A];
    for (column, &j) in out.iter_mut().zip(j) {
        *column = padded(rows, |i| m[(i, j)]);
    }
    out
}

/// What every mode has, in the order of the modes.
struct Parts<'a> {
    w2: &'a [f64],
    d: &'a [f64],
    h0: RowDVector<f64>,
    rod: [RowDVector<f64>; 3],
    weight: [RowDVector<f64>; 3],
    axial: RowDVector<f64>,
    moment: [RowDVector<f64>; 2],
}

impl Parts<'_> {
    fn set<const N: usize>(&self, modes: &[usize]) -> ModeSet<f64, N> {
        let of = |row: &RowDVector<f64>| padded(modes, |k| row[k]);
        ModeSet {
            used: modes.len(),
            w2: padded(modes, |k| self.w2[k]),
            d: padded(modes, |k| self.d[k]),
            h0: of(&self.h0),
            rod: [0, 1, 2].map(|i| of(&self.rod[i])),
            weight: [0, 1].map(|i| of(&self.weight[i])),
            weight_axial: of(&self.axial),
            moment: [0, 1].map(|i| of(&self.moment[i])),
        }
    }

    /// What a row reads of these modes at rest, z = (G·g − F Ψᵀn)/w²: per gravity x, y, 1, and force
    /// x, y, z.
    fn at_rest(&self, modes: &[usize], row: &RowDVector<f64>) -> [f64; 6] {
        let sum = |load: &RowDVector<f64>| modes.iter().map(|&k| row[k] * load[k] / self.w2[k]).sum::<f64>();
        let [x, y, z] = [0, 1, 2].map(|i| -sum(&self.rod[i]));
        [
            sum(&self.weight[0]),
            sum(&self.weight[1]),
            sum(&self.axial),
            x,
            y,
            z,
        ]
    }
}

/// Modes of the body with one payload.
#[derive(Debug, Clone)]
pub(super) struct Modes {
    pub(super) payload_kg: f64,
    w2: Vec<f64>,
    damping: Vec<f64>,
    /// Modal coordinates of the body per mode, ascending frequency.
    pub(super) phi: DMatrix<f64>,
}

impl Modes {
    /// Lag of a very stiff mode behind its load, d/w² of the stiffest one, s.
    fn lag_s(&self) -> f64 {
        match (self.damping.last(), self.w2.last()) {
            (Some(d), Some(w2)) => d / w2,
            _ => 0.0,
        }
    }
}

/// The ground's point and the body's interface of two attachments, whichever comes first.
fn ground_and_body<'a>(a: &'a Attachment, b: &'a Attachment, body: &str) -> Option<([f64; 3], &'a str)> {
    let (ground, other) = if a.body == "ground" { (a, b) } else { (b, a) };
    if ground.body != "ground" || other.body != body {
        return None;
    }
    Some((ground.point_m?, other.interface.as_deref()?))
}

fn interface<'a>(body: &'a ReducedBody, name: &str) -> Result<&'a ReducedInterface, NotPlanar> {
    body.interfaces
        .iter()
        .find(|i| i.name == name)
        .ok_or_else(|| NotPlanar::MissingInterface {
            interface: name.to_owned(),
        })
}

/// Rows over the modal coordinates, and how channels are read from them.
#[derive(Debug, Clone)]
struct Sensors {
    rows: Vec<RowDVector<f64>>,
    readouts: Vec<Readout>,
}

impl Sensors {
    /// One readout per component, in the order of the machine file.
    fn new(file: &MachineFile, body: &ReducedBody) -> Self {
        const TENSOR: [&str; 6] = ["xx", "yy", "zz", "yz", "xz", "xy"];
        let mut rows: Vec<RowDVector<f64>> = Vec::new();
        let mut readouts = Vec::new();
        for (sensor, node) in file.sensors.iter().zip(&body.sensor_nodes) {
            let axes = DMatrix::from_fn(3, body.mode_count(), |i, k| node.translation[(i, k)]);
            let (names, matrix): (&[&str], &DMatrix<f64>) = match sensor.quantity {
                SensorQuantity::Deflection => (&["x", "y", "z"], &axes),
                SensorQuantity::Strain => (&TENSOR, &node.strain),
                SensorQuantity::Stress => (&TENSOR, &node.stress_pa),
            };
            for component in &sensor.components {
                let first = rows.len();
                if component == "von_mises" {
                    rows.extend((0..matrix.nrows()).map(|i| matrix.row(i).clone_owned()));
                    readouts.push(Readout::VonMises { first });
                } else if let Some(i) = names.iter().position(|name| name == component) {
                    rows.push(matrix.row(i).clone_owned());
                    readouts.push(Readout::Row(first));
                }
            }
        }
        Self { rows, readouts }
    }
}
