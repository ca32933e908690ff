//! Pose, loops and equilibrium of the tree (theory note §9).

use hydroflex_openapi::machine::{BodySpec, MachineFile};

use super::model::{Mount, TreeModel};
use super::motion::Motion;
use super::step::Point;
use crate::equilibrium::{EquilibriumError, holding_pressures};
use crate::system::DenseLu;

/// Iterations of the loop closure and of the equilibrium.
const ITERATIONS_MOST: usize = 60;
/// Largest turn of one iteration from a rough pose, rad.
const TURN_MOST_RAD: f64 = 0.5;
/// Largest gap of an assembled machine, m.
const GAP_MOST_M: f64 = 1e-9;
/// Perturbation of the coordinates for the static stiffness.
const PERTURBATION: f64 = 1e-6;

impl TreeModel {
    /// Finds the equilibrium at the given angles (as run tables give them), with the pressures that hold it.
    pub(super) fn rest(
        &self,
        file: &MachineFile,
        angles_rad: &[f64],
        motion: &mut Motion,
    ) -> Result<Point, EquilibriumError> {
        let locked_m = self.assemble(file, angles_rad, motion)?;
        let n = self.free;
        let lines = self.cylinders.len();
        let mut u = motion.y[..n].to_vec();
        let still = vec![0.0; n];
        let mut lock_n = vec![0.0; lines];
        let open: Vec<f64> = (0..lines)
            .map(|k| {
                let cylinder = &self.system.cylinders()[k];
                cylinder.oil_force_n([cylinder.spec().initial_pressure_pa; 2], 0.0)
            })
            .collect();
        let parallel = |k: usize, m: &Motion| {
            self.system.cylinders()[k]
                .parallel_force(m.lines[k].length_m, 0.0)
                .force_n
        };
        let mut lu = DenseLu::new(n + lines);
        let mut last = f64::INFINITY;
        for iteration in 0..ITERATIONS_MOST {
            if !self.evaluate_motion(&u, &still, &still, motion) {
                return Err(self.open_loop(motion));
            }
            let forces: Vec<f64> = (0..lines)
                .map(|k| open[k] + lock_n[k] + parallel(k, motion))
                .collect();
            self.residual(|k| forces[k], motion);
            let mut right: Vec<f64> = motion.residual[..n].iter().map(|r| -r).collect();
            right.extend((0..lines).map(|k| locked_m[k] - motion.lines[k].length_m));
            // The stiffness hardly changes on the way: convergence stays fast with that of the first two poses.
            if iteration < 2 && !self.static_matrix(&u, &forces, &right, &mut lu, motion) {
                return Err(EquilibriumError::NotHeld);
            }
            lu.solve(&mut right);
            let increment = right[..n].iter().fold(0.0_f64, |most, x| most.max(x.abs()));
            if !right.iter().all(|x| x.is_finite()) || increment > 10.0 {
                return Err(EquilibriumError::NotHeld);
            }
            for (u, d) in u.iter_mut().zip(&right) {
                *u += d;
            }
            for (lock, d) in lock_n.iter_mut().zip(&right[n..]) {
                *lock += d;
            }
            if increment < 1e-15 || (increment < 1e-12 && increment > 0.3 * last) {
                let mut point = Point::new(self);
                point.set_u(&u);
                for (k, lock) in lock_n.iter().enumerate() {
                    let held = holding_pressures(&self.system.cylinders()[k], *lock);
                    point.set_pressure(k, 0, held[0]);
                    point.set_pressure(k, 1, held[1]);
                }
                return Ok(point);
            }
            last = increment;
        }
        Err(EquilibriumError::NotConverged {
            iterations: ITERATIONS_MOST,
            increment: last,
        })
    }

    /// Eye-to-eye lengths of the cylinders of the undeformed machine at the given angles, m.
    ///
    /// # Errors
    /// If a loop does not close.
    pub fn start_lengths_m(
        &self,
        file: &MachineFile,
        angles_rad: &[f64],
    ) -> Result<Vec<f64>, EquilibriumError> {
        self.assemble(file, angles_rad, &mut self.new_motion())
    }

    /// `[∂r/∂u, Jᵀ; J, 0]`, factored. False where it is singular.
    fn static_matrix(
        &self,
        u: &[f64],
        forces: &[f64],
        negative: &[f64],
        lu: &mut DenseLu,
        m: &mut Motion,
    ) -> bool {
        let n = self.free;
        let order = n + self.cylinders.len();
        let still = vec![0.0; n];
        let mut row = vec![0.0; self.all];
        lu.values.fill(0.0);
        for k in 0..self.cylinders.len() {
            self.line_row(k, &mut row, m);
            for j in 0..n {
                lu.values[(n + k) * order + j] = row[j];
                lu.values[j * order + n + k] = row[j];
            }
        }
        let mut moved = u.to_vec();
        for j in 0..n {
            moved[j] += PERTURBATION;
            if !self.evaluate_motion(&moved, &still, &still, m) {
                return false;
            }
            self.residual(|k| forces[k], m);
            for i in 0..n {
                lu.values[i * order + j] = (m.residual[i] + negative[i]) / PERTURBATION;
            }
            moved[j] = u[j];
        }
        lu.factorise()
    }

    /// Undeformed pose at the given angles; returns the cylinders' lengths, m.
    fn assemble(
        &self,
        file: &MachineFile,
        angles_rad: &[f64],
        m: &mut Motion,
    ) -> Result<Vec<f64>, EquilibriumError> {
        if angles_rad.len() != file.angles.len() {
            return Err(EquilibriumError::AngleCount {
                given: angles_rad.len(),
                expected: file.angles.len(),
            });
        }
        m.y.fill(0.0);
        m.v.fill(0.0);
        m.a.fill(0.0);
        for (spec, body) in file.bodies.iter().zip(&self.bodies) {
            let Mount::Turns(place) = body.mount else { continue };
            if let BodySpec::Rigid(rigid) = spec {
                m.y[place] = rigid.start_angle_deg.to_radians();
            }
            if let Some(angle) = file.angles.iter().position(|a| a.body == spec.name()) {
                let minus = file.angles[angle].minus.as_ref();
                let other = minus.and_then(|name| file.angles.iter().position(|a| &a.name == name));
                m.y[place] = angles_rad[angle] - other.map_or(0.0, |k| angles_rad[k]);
            }
        }
        let u = m.y[..self.free].to_vec();
        let still = vec![0.0; self.free];
        self.close_from_rough(&u, m)?;
        if !self.evaluate_motion(&u, &still, &still, m) {
            return Err(self.open_loop(m));
        }
        Ok(m.lines.iter().map(|line| line.length_m).collect())
    }

    /// Closes the loops from a rough pose, with limited turns.
    fn close_from_rough(&self, u: &[f64], m: &mut Motion) -> Result<(), EquilibriumError> {
        if self.loops.is_empty() {
            return Ok(());
        }
        self.place(u, m);
        for _ in 0..ITERATIONS_MOST {
            if self.gap_m(m) < GAP_MOST_M {
                return Ok(());
            }
            if !(self.factor_loops(m) && self.step_loops(m, TURN_MOST_RAD)) {
                break;
            }
            self.place(u, m);
        }
        Err(self.open_loop(m))
    }

    fn open_loop(&self, m: &Motion) -> EquilibriumError {
        let gap = |k: usize| {
            let [from, to] = self.loops[k];
            (m.points[to].position - m.points[from].position).amax()
        };
        let worst = (0..self.loops.len()).max_by(|&a, &b| gap(a).total_cmp(&gap(b)));
        EquilibriumError::LoopOpen {
            joint: worst.map_or_else(String::new, |k| self.loop_names[k].clone()),
            gap_m: worst.map_or(0.0, gap),
        }
    }
}
