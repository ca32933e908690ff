//! The static start of published runs: Newton's method that ends where Exudyn's static solver ends.
//!
//! A loosely converged start is visible in what follows (a first acceleration of 0.03 rad/s² instead of zero), so a run that
//! is to equal a published one has to stop at the same iterate. That takes the same unknowns (Euler parameters and
//! multipliers), the same norm over them and the same Jacobian: stiffness of the modes, tangents of the cylinders' forces
//! and of gravity, and constraint rows, without the derivative of the constraint forces (theory note §9 and §10.4; found by
//! inverting what `MainSolverStatic.GetSystemJacobian` of Exudyn 1.13.6 returns).

use hydroflex_openapi::machine::LooseStatics;
use nalgebra::{DMatrix, DVector, Matrix3, Vector3, Vector4, Vector6};

use crate::body::marker::{BodyMarker, Marker};
use crate::body::rotation::{rate_map, rotation_matrix};
use crate::equilibrium::EquilibriumError;
use crate::joint::RowSink;
use crate::system::{DenseLu, Level, Oil, State, System, Workspace};

/// Residual below which a load step ends whatever it was at first, N and N m.
const ABSOLUTE_TOLERANCE: f64 = 1e-10;
/// Iterations of a load step.
const ITERATIONS_MOST: usize = 25;

/// When a load step ends.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Stopping {
    relative_tolerance: f64,
    /// Residual that others are measured by.
    first: f64,
}

impl Stopping {
    /// At least one iteration is made: a residual that starts at rest counts as twice the absolute tolerance.
    fn new(relative_tolerance: f64, residual: f64) -> Self {
        let first = if residual <= ABSOLUTE_TOLERANCE {
            2.0 * ABSOLUTE_TOLERANCE
        } else {
            residual
        };
        Self {
            relative_tolerance,
            first,
        }
    }

    /// Whether the residual after an iteration (from 1) is the last. One that grows in the first iteration becomes
    /// the measure.
    fn is_met(&mut self, iteration: usize, residual: f64) -> bool {
        if iteration == 1 && residual > self.first {
            self.first = residual;
        }
        residual / self.first <= self.relative_tolerance || residual <= ABSOLUTE_TOLERANCE
    }
}

/// Force and moment about the origin that a unit multiplier of every row puts on the ground.
struct GroundRows<'a> {
    markers: &'a [Marker],
    rows: &'a mut [Vector6<f64>],
}

impl RowSink for GroundRows<'_> {
    fn add_point(&mut self, row: usize, marker: usize, direction: &Vector3<f64>) {
        if let Marker::Ground(point) = &self.markers[marker] {
            self.rows[row] += wrench(point, direction);
        }
    }

    fn add_rotation(&mut self, row: usize, marker: usize, direction: &Vector3<f64>) {
        if let Marker::Ground(_) = &self.markers[marker] {
            self.rows[row] += join(&Vector3::zeros(), direction);
        }
    }

    fn set_residual(&mut self, _: usize, _: f64) {}
}

fn join(force: &Vector3<f64>, moment: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(force.x, force.y, force.z, moment.x, moment.y, moment.z)
}

fn wrench(point: &Vector3<f64>, force: &Vector3<f64>) -> Vector6<f64> {
    join(force, &point.cross(force))
}

/// Scratch memory and constants of one static start.
pub(crate) struct LooseNewton<'a> {
    system: &'a System,
    settings: LooseStatics,
    locked_m: &'a [f64],
    /// Per body, from forces on generalised modes to forces on the modes of the basis as it stands: B⁻ᵀ.
    to_basis: Vec<DMatrix<f64>>,
    /// Coordinates as in the state, then multipliers of joints and locks, then those of the Euler parameters.
    residual: Vec<f64>,
    /// Multipliers of all rows, then of the Euler parameters.
    multipliers: Vec<f64>,
    jacobian: DenseLu,
    /// What holds the ground's body: force and moment, N and N m.
    weld: Vector6<f64>,
    ground_residual: Vector6<f64>,
    /// Derivatives of the force on the ground, one column per unknown.
    ground_tangent: Vec<Vector6<f64>>,
}

impl<'a> LooseNewton<'a> {
    /// Cylinders are locked at the given lengths.
    pub(crate) fn new(system: &'a System, settings: LooseStatics, locked_m: &'a [f64]) -> Self {
        let order = system.coordinate_count + system.row_count() + system.bodies.len();
        let inverse = |basis: &DMatrix<f64>| {
            let square = basis.transpose();
            // the basis diagonalises a positive definite pair: it has an inverse
            square.clone().try_inverse().unwrap_or(square)
        };
        Self {
            system,
            settings,
            locked_m,
            to_basis: system.bodies.iter().map(|b| inverse(b.frame.basis())).collect(),
            residual: vec![0.0; order],
            multipliers: vec![0.0; order - system.coordinate_count],
            jacobian: DenseLu::new(order),
            weld: Vector6::zeros(),
            ground_residual: Vector6::zeros(),
            ground_tangent: vec![Vector6::zeros(); order],
        }
    }

    /// Moves the state from its undeformed pose to the last iterate; the locks' forces are left in the workspace.
    /// Returns the number of iterations.
    pub(crate) fn solve(mut self, state: &mut State, ws: &mut Workspace) -> Result<usize, EquilibriumError> {
        let mut total = 0;
        for load_step in 1..=self.settings.load_steps {
            let load = f64::from(load_step) / f64::from(self.settings.load_steps);
            self.multipliers.fill(0.0);
            self.weld = Vector6::zeros();
            let mut residual = self.evaluate(load, state, ws);
            let mut stopping = Stopping::new(self.settings.relative_tolerance, residual);
            let mut iteration = 0;
            loop {
                if iteration == ITERATIONS_MOST || !residual.is_finite() {
                    return Err(EquilibriumError::LooseNotConverged {
                        load_step,
                        iterations: iteration,
                        residual,
                    });
                }
                iteration += 1;
                self.iterate(load, state, ws)?;
                residual = self.evaluate(load, state, ws);
                if stopping.is_met(iteration, residual) {
                    break;
                }
            }
            total += iteration;
        }
        let (joints, locks) = self.multipliers[..self.system.row_count()].split_at(self.system.joint_rows);
        state.multipliers.copy_from_slice(joints);
        ws.lock_forces_n.copy_from_slice(locks);
        self.system.evaluate(state, Oil::Given, Level::Position, ws);
        Ok(total)
    }

    /// Residual at the state, and its norm.
    fn evaluate(&mut self, load: f64, state: &State, ws: &mut Workspace) -> f64 {
        let system = self.system;
        let (coordinates, rows) = (system.coordinate_count, system.row_count());
        system.evaluate_motion(state, ws);
        let mut factors = self.multipliers[..rows].to_vec();
        for (k, (cylinder, motion)) in system.cylinders.iter().zip(&mut ws.cylinders).enumerate() {
            motion.force = cylinder.force(motion.length_m, 0.0, state.pressures_pa[k]);
            factors[system.joint_rows + k] += motion.force.force_n;
            self.residual[coordinates + system.joint_rows + k] = motion.length_m - self.locked_m[k];
        }
        self.residual[coordinates..coordinates + system.joint_rows]
            .copy_from_slice(&ws.residual_rows[..system.joint_rows]);
        let gravity = system.gravity_m_per_s2 * load;
        let mut squares = 0.0;
        for (k, (entry, motion)) in system.bodies.iter().zip(&ws.bodies).enumerate() {
            let n = entry.frame.mode_count();
            let (mut frame, mut modal) = ([0.0; 6], DVector::zeros(n));
            let deformed = system.deformed_gravity();
            entry
                .frame
                .subtract_gravity(motion, &gravity, deformed, &mut frame, modal.as_mut_slice());
            for mode in 0..n {
                modal[mode] += entry.frame.stiffness[mode] * motion.eta[mode];
            }
            for (row, factor) in factors.iter().enumerate() {
                let columns = &ws.rows.frame(row)[6 * k..6 * k + 6];
                frame.iter_mut().zip(columns).for_each(|(r, x)| *r += factor * x);
                let columns = &ws.rows.modal(row)[entry.first_modal..entry.first_modal + n];
                modal.iter_mut().zip(columns).for_each(|(r, x)| *r += factor * x);
            }
            let theta = euler_parameters(state, entry.first_q);
            let turning = rate_map(&theta).tr_mul(&Vector3::from_column_slice(&frame[3..]))
                + theta * (2.0 * self.multipliers[rows + k]);
            let out = &mut self.residual[entry.first_q..entry.first_q + 7 + n];
            out[..3].copy_from_slice(&frame[..3]);
            out[3..7].copy_from_slice(turning.as_slice());
            out[7..].copy_from_slice(modal.as_slice());
            squares += out[..7].iter().map(|x| x * x).sum::<f64>();
            squares += (&self.to_basis[k] * modal).norm_squared();
            self.residual[coordinates + rows + k] = theta.norm_squared() - 1.0;
        }
        if let Some(payload) = &system.payload {
            let mut force = -payload.mass_kg * gravity;
            for (row, factor) in factors.iter().enumerate() {
                let columns = &ws.rows.frame(row)[payload.first_frame..payload.first_frame + 3];
                force += Vector3::from_column_slice(columns) * *factor;
            }
            self.residual[payload.first_q..payload.first_q + 3].copy_from_slice(force.as_slice());
            squares += force.norm_squared();
        }
        squares += self.residual[coordinates..].iter().map(|x| x * x).sum::<f64>();
        if let Some(ground) = &self.settings.ground_body {
            self.ground_residual = self.weld
                - wrench(
                    &Vector3::from(ground.centre_of_mass_m),
                    &(ground.mass_kg * gravity),
                );
            for (row, factor) in self.ground_rows(ws).iter().zip(&factors) {
                self.ground_residual += row * *factor;
            }
            // Euler parameters at rest in the origin see twice the moment.
            squares += self.ground_residual.fixed_rows::<3>(0).norm_squared()
                + 4.0 * self.ground_residual.fixed_rows::<3>(3).norm_squared();
        }
        squares.sqrt()
    }

    fn ground_rows(&self, ws: &Workspace) -> Vec<Vector6<f64>> {
        let mut rows = vec![Vector6::zeros(); self.system.row_count()];
        let mut sink = GroundRows {
            markers: &self.system.markers,
            rows: &mut rows,
        };
        for joint in &self.system.joints {
            joint.write_rows(&ws.markers[joint.from], &ws.markers[joint.to], &mut sink);
        }
        for (k, &[base, rod]) in self.system.cylinder_markers.iter().enumerate() {
            let line = (ws.markers[rod].position_m - ws.markers[base].position_m).normalize();
            let row = self.system.joint_rows + k;
            sink.add_point(row, rod, &line);
            sink.add_point(row, base, &-line);
        }
        rows
    }

    /// One step of Newton's method from the last evaluation.
    fn iterate(&mut self, load: f64, state: &mut State, ws: &Workspace) -> Result<(), EquilibriumError> {
        let (coordinates, rows) = (self.system.coordinate_count, self.system.row_count());
        self.fill_jacobian(load, state, ws);
        if !self.jacobian.factorise() {
            return Err(EquilibriumError::NotHeld);
        }
        let mut step: Vec<f64> = self.residual.iter().map(|x| -x).collect();
        self.jacobian.solve(&mut step);
        for (q, delta) in state.q.iter_mut().zip(&step) {
            *q += delta;
        }
        for (multiplier, delta) in self.multipliers.iter_mut().zip(&step[coordinates..]) {
            *multiplier += delta;
        }
        if self.settings.ground_body.is_some() {
            // The ground's body does not move: its weld takes what the linear system says.
            let mut taken = self.ground_residual;
            for (row, column) in self.ground_rows(ws).iter().zip(coordinates..coordinates + rows) {
                self.ground_tangent[column] = *row;
            }
            for (column, delta) in self.ground_tangent.iter().zip(&step) {
                taken += column * *delta;
            }
            self.weld -= taken;
        }
        Ok(())
    }

    fn fill_jacobian(&mut self, load: f64, state: &State, ws: &Workspace) {
        let system = self.system;
        let (coordinates, rows) = (system.coordinate_count, system.row_count());
        let order = self.residual.len();
        self.jacobian.values.fill(0.0);
        self.ground_tangent.fill(Vector6::zeros());
        let values = &mut self.jacobian.values;
        for (k, entry) in system.bodies.iter().enumerate() {
            let n = entry.frame.mode_count();
            let theta = euler_parameters(state, entry.first_q);
            let map = rate_map(&theta);
            for mode in 0..n {
                let place = entry.first_q + 7 + mode;
                values[place * order + place] = entry.frame.stiffness[mode];
            }
            let mut border = |row: usize, column: usize, x: f64| {
                values[row * order + column] = x;
                values[column * order + row] = x;
            };
            for row in 0..rows {
                let frame = &ws.rows.frame(row)[6 * k..6 * k + 6];
                let turning = map.tr_mul(&Vector3::from_column_slice(&frame[3..]));
                let modal = &ws.rows.modal(row)[entry.first_modal..entry.first_modal + n];
                for (i, x) in frame[..3].iter().chain(turning.iter()).chain(modal).enumerate() {
                    border(coordinates + row, entry.first_q + i, *x);
                }
            }
            for i in 0..4 {
                border(coordinates + rows + k, entry.first_q + 3 + i, 2.0 * theta[i]);
            }
        }
        if let Some(payload) = &system.payload {
            for row in 0..rows {
                for i in 0..3 {
                    let x = ws.rows.frame(row)[payload.first_frame + i];
                    values[(coordinates + row) * order + payload.first_q + i] = x;
                    values[(payload.first_q + i) * order + coordinates + row] = x;
                }
            }
        }
        self.add_gravity_tangent(load, state, ws);
        for cylinder in 0..system.cylinders.len() {
            self.add_cylinder_tangent(cylinder, state, ws);
        }
    }

    /// Derivative of gravity's moment and modal forces with respect to the Euler parameters.
    fn add_gravity_tangent(&mut self, load: f64, state: &State, ws: &Workspace) {
        let system = self.system;
        let order = self.residual.len();
        let gravity = system.gravity_m_per_s2 * load;
        let deformed = system.deformed_gravity();
        for (entry, motion) in system.bodies.iter().zip(&ws.bodies) {
            let theta = euler_parameters(state, entry.first_q);
            let map = rate_map(&theta);
            let mut modal = vec![0.0; entry.frame.mode_count()];
            let rows = |gravity: &Vector3<f64>, modal: &mut [f64]| {
                let mut frame = [0.0; 6];
                entry
                    .frame
                    .subtract_gravity(motion, gravity, deformed, &mut frame, modal);
                Vector3::from_column_slice(&frame[3..])
            };
            let moment = rows(&gravity, &mut modal);
            for parameter in 0..4 {
                let along = Direction::new(3 + parameter, &theta);
                let turned = motion.rotation * along.rotation.tr_mul(&gravity);
                modal.fill(0.0);
                let moment_change = rows(&turned, &mut modal);
                let turning = map.tr_mul(&moment_change) + rate_map(&along.parameters).tr_mul(&moment);
                let column = entry.first_q + 3 + parameter;
                for (i, x) in turning.iter().chain(&modal).enumerate() {
                    self.jacobian.values[(entry.first_q + 3 + i) * order + column] += x;
                }
            }
        }
    }

    /// Derivative of a cylinder's generalised force with respect to all coordinates of the bodies at its ends.
    fn add_cylinder_tangent(&mut self, cylinder: usize, state: &State, ws: &Workspace) {
        let system = self.system;
        let order = self.residual.len();
        let [base, rod] = system.cylinder_markers[cylinder];
        let ends = [(base, -1.0), (rod, 1.0)];
        let motion = &ws.cylinders[cylinder];
        let line = (ws.markers[rod].position_m - ws.markers[base].position_m) / motion.length_m;
        let body_of = |marker: usize| match &system.markers[marker] {
            Marker::Body(on) => Some(on),
            Marker::Ground(_) | Marker::Payload => None,
        };
        let mut bodies: Vec<usize> = ends
            .iter()
            .filter_map(|e| body_of(e.0))
            .map(|on| on.body)
            .collect();
        bodies.dedup();
        for body in bodies {
            let entry = &system.bodies[body];
            let theta = euler_parameters(state, entry.first_q);
            for local in 0..7 + entry.frame.mode_count() {
                let column = entry.first_q + local;
                let along = Direction::new(local, &theta);
                let moved: Vector3<f64> = ends
                    .iter()
                    .filter_map(|&(marker, sign)| Some((marker, sign, body_of(marker)?)))
                    .filter(|(_, _, on)| on.body == body)
                    .map(|(marker, sign, on)| {
                        let turned = along.rotation * ws.markers[marker].local_m;
                        sign * (along.shift + turned + ws.bodies[body].rotation * along.strain(on))
                    })
                    .sum();
                let stretch = line.dot(&moved);
                let change = line * (motion.force.by_length * stretch)
                    + (moved - line * stretch) * (motion.force.force_n / motion.length_m);
                for (marker, sign) in ends {
                    if let Marker::Ground(point) = &system.markers[marker] {
                        self.ground_tangent[column] += wrench(point, &(sign * change));
                    }
                    let Some(on) = body_of(marker) else { continue };
                    let (out, at) = (&system.bodies[on.body], &ws.markers[marker]);
                    let rotation = &ws.bodies[on.body].rotation;
                    let pull = line * (sign * motion.force.force_n);
                    let force = rotation.tr_mul(&pull);
                    let mut force_change = rotation.tr_mul(&(sign * change));
                    let mut moment_change = Vector3::zeros();
                    let mut turning = Vector4::zeros();
                    if on.body == body {
                        force_change += along.rotation.tr_mul(&pull);
                        moment_change = along.strain(on).cross(&force);
                        turning = rate_map(&along.parameters).tr_mul(&at.local_m.cross(&force));
                    }
                    moment_change += at.local_m.cross(&force_change);
                    turning += rate_map(&euler_parameters(state, out.first_q)).tr_mul(&moment_change);
                    let mut add = |row: usize, x: f64| {
                        self.jacobian.values[(out.first_q + row) * order + column] += x;
                    };
                    for i in 0..3 {
                        add(i, sign * change[i]);
                    }
                    for i in 0..4 {
                        add(3 + i, turning[i]);
                    }
                    for (mode, psi) in on.translation.iter().enumerate() {
                        add(7 + mode, psi.dot(&force_change));
                    }
                }
            }
        }
    }
}

fn euler_parameters(state: &State, first_q: usize) -> Vector4<f64> {
    Vector4::from_column_slice(&state.q[first_q + 3..first_q + 7])
}

/// Unit change of one coordinate of a body.
struct Direction {
    shift: Vector3<f64>,
    parameters: Vector4<f64>,
    /// Derivative of the rotation matrix, also along θ itself: unfinished iterations leave the unit sphere.
    rotation: Matrix3<f64>,
    mode: Option<usize>,
}

impl Direction {
    fn new(local: usize, theta: &Vector4<f64>) -> Self {
        let mut direction = Self {
            shift: Vector3::zeros(),
            parameters: Vector4::zeros(),
            rotation: Matrix3::zeros(),
            mode: local.checked_sub(7),
        };
        if local < 3 {
            direction.shift[local] = 1.0;
        } else if local < 7 {
            direction.parameters[local - 3] = 1.0;
            // The rotation matrix is quadratic, so that a central difference is its derivative.
            direction.rotation = 0.5
                * (rotation_matrix(&(theta + direction.parameters))
                    - rotation_matrix(&(theta - direction.parameters)));
        }
        direction
    }

    /// Change of a marker's position in the body frame.
    fn strain(&self, on: &BodyMarker) -> Vector3<f64> {
        self.mode
            .and_then(|mode| on.translation.get(mode).copied())
            .unwrap_or_else(Vector3::zeros)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::equilibrium::{equilibrium, general_start};
    use crate::testing::{closed_crane, linkage, random_state};
    use hydroflex_openapi::machine::GravityMoment;

    #[test]
    fn the_tangent_is_the_derivative_of_the_residual_where_no_multiplier_pulls() {
        let mut system = linkage();
        system.conventions.gravity_moment = GravityMoment::Undeformed;
        let settings = LooseStatics {
            load_steps: 1,
            relative_tolerance: 1e-6,
            ground_body: None,
        };
        let locked = vec![1.0; system.cylinders.len()];
        let mut newton = LooseNewton::new(&system, settings, &locked);
        let mut ws = system.new_workspace();
        let mut state = random_state(&system, 3);
        newton.evaluate(0.7, &state, &mut ws);
        newton.fill_jacobian(0.7, &state, &ws);
        let (order, h) = (newton.residual.len(), 1e-6);
        let scale = newton.jacobian.values.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        for column in 0..system.coordinate_count {
            let mut at = |delta: f64| {
                let before = state.q[column];
                state.q[column] += delta;
                newton.evaluate(0.7, &state, &mut ws);
                state.q[column] = before;
                newton.residual.clone()
            };
            let (above, below) = (at(h), at(-h));
            // Rows of forces: also along θ itself, off the unit sphere.
            for row in 0..system.coordinate_count {
                let difference = (above[row] - below[row]) / (2.0 * h);
                let tangent = newton.jacobian.values[row * order + column];
                // Rounding of 1e-16/h and a third derivative times h².
                assert!(
                    (difference - tangent).abs() < 1e-8 * scale,
                    "{row} {column}: {difference} {tangent}"
                );
            }
        }
    }

    #[test]
    fn a_tight_tolerance_ends_at_the_equilibrium_and_a_loose_one_before() {
        let (mut file, reduced) = closed_crane();
        file.conventions.gravity_moment = GravityMoment::Undeformed;
        let mut distance = |relative_tolerance: f64| {
            file.conventions.statics = Some(LooseStatics {
                load_steps: 2,
                relative_tolerance,
                ground_body: None,
            });
            let system = System::new(&file, &reduced, 50.0).unwrap();
            let mut ws = system.new_workspace();
            let exact = equilibrium(&system, &file, &[0.3, 0.1], &mut ws).unwrap();
            let found = general_start(&system, &file, &[0.3, 0.1], &mut ws).unwrap();
            let pairs = found.state.q.iter().zip(&exact.state.q);
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let (tight, loose) = (distance(1e-11), distance(1e-2));
        // Metres, Euler parameters and modal coordinates.
        assert!(tight < 1e-9, "{tight:e}");
        assert!(loose > 10.0 * tight.max(1e-12), "{loose:e} {tight:e}");
    }

    #[test]
    fn a_load_step_ends_at_the_first_residual_within_the_tolerance() {
        let mut stopping = Stopping::new(1e-3, 200.0);
        assert!(!stopping.is_met(1, 0.21));
        assert!(stopping.is_met(2, 0.2));
    }

    #[test]
    fn a_residual_that_grows_at_first_becomes_the_measure_and_later_growth_does_not() {
        let mut stopping = Stopping::new(1e-3, 1.0);
        assert!(!stopping.is_met(1, 50.0));
        assert!(!stopping.is_met(2, 1000.0));
        assert!(!stopping.is_met(3, 0.051));
        assert!(stopping.is_met(4, 0.05));
    }

    #[test]
    fn a_machine_at_rest_makes_one_iteration_and_ends_by_the_absolute_tolerance() {
        let mut stopping = Stopping::new(1e-7, 0.0);
        assert!((stopping.first - 2.0 * ABSOLUTE_TOLERANCE).abs() < 1e-25);
        assert!(stopping.is_met(1, 0.9 * ABSOLUTE_TOLERANCE));
    }
}
