//! Which machines have minimal coordinates, and their constants.

use super::constants::{Constants, Cylinder, Scale};
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

    /// Constants of the step loop for a payload, padded to `N` modes of which `A` have inertia
    /// products. `None` if the modes do not fit.
    pub(super) fn constants<const N: usize, const A: usize>(&self, modes: &Modes) -> Option<Constants<N, A>> {
        self.ordered_constants(modes, &self.order(modes))
    }

    /// The same for a given order of the modes.
    pub(super) fn ordered_constants<const N: usize, const A: usize>(
        &self,
        modes: &Modes,
        order: &Order,
    ) -> Option<Constants<N, A>> {
        let n = modes.w2.len();
        if n > N || order.coupled > A {
            return None;
        }
        let phi = DMatrix::from_fn(n, n, |i, j| modes.phi[(i, order.columns[j])]);
        let m = if self.payload.is_some() {
            modes.payload_kg
        } else {
            0.0
        };
        let (at, rows) = self
            .payload
            .clone()
            .unwrap_or_else(|| (Vector3::zeros(), Matrix3xX::zeros(n)));
        let row = |index: usize| rows.row(index) * &phi;
        let (px, py) = (row(0), row(1));
        let plane = |m: &Matrix3xX<f64>, index: usize| m.row(index) * &phi;
        let pad = |x: &dyn Fn(usize) -> f64| {
            let mut out = [0.0; N];
            for (k, out) in out.iter_mut().enumerate().take(n) {
                *out = x(k);
            }
            out
        };
        let (h0, c) = (&self.h0 * &phi, &self.c * &phi);
        let weight = [0, 1, 2].map(|i| plane(&self.first_moment, i) + row(i) * m);
        let moment = [0, 1].map(|i| {
            if self.deformed_moment {
                weight[i].clone()
            } else {
                row(i) * m
            }
        });
        let rod = [0, 1, 2].map(|i| plane(&self.rod, i));
        let b = phi.transpose() * &self.b * &phi + (px.transpose() * &px + py.transpose() * &py) * m;
        let cc = phi.transpose() * &self.cc * &phi + (py.transpose() * &px - px.transpose() * &py) * (-m);
        let square = |m: &DMatrix<f64>| {
            let mut out = [[0.0; A]; A];
            for (j, column) in out.iter_mut().enumerate().take(order.coupled) {
                for (i, x) in column.iter_mut().enumerate().take(order.coupled) {
                    *x = m[(i, j)];
                }
            }
            out
        };
        Some(Constants {
            used: n,
            coupled: order.coupled,
            inertia_kg_m2: self.inertia_kg_m2 + m * (at.x * at.x + at.y * at.y),
            h0: pad(&|k| h0[k] + m * (at.x * py[k] - at.y * px[k])),
            c: pad(&|k| c[k] + m * (at.x * px[k] + at.y * py[k])),
            b: square(&b),
            cc: square(&cc),
            w2: pad(&|k| modes.w2[order.columns[k]]),
            d: pad(&|k| modes.damping[order.columns[k]]),
            rod: [0, 1, 2].map(|i| pad(&|k| rod[i][k])),
            rod_m: self.rod_m.into(),
            weight: [0, 1].map(|i| pad(&|k| weight[i][k])),
            weight_axial: pad(&|k| weight[2][k] * self.gravity_m_per_s2[2]),
            moment_kg_m: [
                self.centre_moment_kg_m.x + m * at.x,
                self.centre_moment_kg_m.y + m * at.y,
            ],
            moment: [0, 1].map(|i| pad(&|k| moment[i][k])),
            sensors: self
                .sensors
                .rows
                .iter()
                .map(|s| {
                    let s = s * &phi;
                    pad(&|k| s[k])
                })
                .collect(),
            readouts: self.sensors.readouts.clone(),
            base_m: self.base_m,
            gravity_m_per_s2: [self.gravity_m_per_s2[0], self.gravity_m_per_s2[1]],
            cylinder: self.cylinder.clone(),
            scale: self.scale(modes),
        })
    }

    /// Ranges that a run typically covers: pressures between tank and supply, the rod's speed with
    /// the valve open, a tenth of a second of it, and the energy of a body under the full force.
    fn scale(&self, modes: &Modes) -> Scale {
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

    /// Modes by how far the machine's forces deflect them. Those of at least a five-hundredth of
    /// the largest have inertia products; the others change Θ and h by less than the products of
    /// their tiny amplitude (§3 of the theory page has the estimate, a test the proof).
    pub(super) fn order(&self, modes: &Modes) -> Order {
        let c = &self.cylinder;
        let force_n = (c.supply_pa - c.tank_pa).max(1.0) * c.area_m2[0];
        let g = Vector3::from(self.gravity_m_per_s2).norm();
        let rod = &self.rod * &modes.phi;
        let weight = &self.first_moment * &modes.phi;
        let amplitude: Vec<f64> = (0..modes.w2.len())
            .map(|k| {
                let push = force_n * rod[(0, k)].abs().max(rod[(1, k)].abs());
                let pull = g * weight[(0, k)].abs().max(weight[(1, k)].abs());
                (push + pull) / modes.w2[k]
            })
            .collect();
        let mut columns: Vec<usize> = (0..amplitude.len()).collect();
        columns.sort_by(|&i, &j| amplitude[j].total_cmp(&amplitude[i]).then(i.cmp(&j)));
        let largest = columns.first().map_or(0.0, |&k| amplitude[k]);
        let coupled = columns
            .iter()
            .take_while(|&&k| amplitude[k] >= COUPLED * largest)
            .count();
        Order { columns, coupled }
    }
}

/// Smallest amplitude, over the largest, of a mode with inertia products.
const COUPLED: f64 = 2e-3;

/// Order of the modes in the step loop.
#[derive(Debug, Clone)]
pub(super) struct Order {
    /// Columns of the mode matrix.
    pub(super) columns: Vec<usize>,
    /// How many of the first have inertia products.
    pub(super) coupled: usize,
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
