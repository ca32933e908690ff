//! One Rosenbrock step in the free coordinates.
//!
//! The equations are taken as a differential-algebraic system of index 1, so that no mass matrix is inverted:
//!
//! ```text
//! u̇ = v,   v̇ = a,   0 = r(u, v, a, p),   ṗ = P(u, v, p, U(t))
//! ```
//!
//! A stage has the increments of u, a and p eliminated by hand (s = γ h, J = ∂L/∂u, one per cylinder):
//!
//! ```text
//! (M + s D + s² K + Σ κ J Jᵀ) δv = −s r + s M (a + c_v) − s² K (v + c_u) − s Σ J (pressures' share)
//! ```

use super::model::TreeModel;
use super::motion::Motion;
use crate::fast::tableau::{RODAS5P, STAGES};
use crate::hydraulics::chamber::ChamberRate;
use crate::system::DenseLu;

/// Perturbation of angles and rates for the stiffness of loads and the gyroscopic terms.
const PERTURBATION: f64 = 1e-6;

/// Valve signal of a cylinder over a step: linear, of one sign.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Signal {
    /// At the start of the step.
    pub(super) ratio: f64,
    /// Its rate, 1/s.
    pub(super) per_s: f64,
    /// Whether it feeds the piston side.
    pub(super) extends: bool,
    /// Chambers at their lowest pressure, held there.
    pub(super) empty: [bool; 2],
}

/// State: `[u, v, p, a]`, pressures by cylinder. The accelerations a follow from the others.
#[derive(Debug, Clone)]
pub(super) struct Point {
    pub(super) values: Vec<f64>,
    free: usize,
}

impl Point {
    pub(super) fn new(model: &TreeModel) -> Self {
        Self {
            values: vec![0.0; 3 * model.free + 2 * model.cylinders.len()],
            free: model.free,
        }
    }

    pub(super) fn u(&self) -> &[f64] {
        &self.values[..self.free]
    }

    pub(super) fn v(&self) -> &[f64] {
        &self.values[self.free..2 * self.free]
    }

    pub(super) fn a(&self) -> &[f64] {
        &self.values[self.values.len() - self.free..]
    }

    pub(super) fn pressures(&self, cylinder: usize) -> [f64; 2] {
        let at = 2 * self.free + 2 * cylinder;
        [self.values[at], self.values[at + 1]]
    }

    pub(super) fn set_pressure(&mut self, cylinder: usize, side: usize, pressure_pa: f64) {
        self.values[2 * self.free + 2 * cylinder + side] = pressure_pa;
    }

    pub(super) fn set_u(&mut self, u: &[f64]) {
        self.values[..self.free].copy_from_slice(u);
    }
}

/// Derivatives of one cylinder at the start of a step.
#[derive(Debug, Clone, Default)]
struct Tangent {
    /// J over the free coordinates (the rest is scratch).
    row: Vec<f64>,
    by_length: f64,
    by_velocity: f64,
    /// Σ_c area_c g_c (s P_L + P_v).
    oil: f64,
    /// g_c = 1/(1/s − P_p).
    gain: [f64; 2],
    /// P_L, P_v and h U̇ ∂P/∂U of the chambers.
    by_stroke: [f64; 2],
    by_rate: [f64; 2],
    drift: [f64; 2],
    /// Signed areas: −A₁, +A₂.
    area_m2: [f64; 2],
}

/// Scratch memory of a step.
#[derive(Debug, Clone)]
pub(super) struct Stepper {
    pub(super) motion: Motion,
    /// State after the step.
    pub(super) next: Point,
    /// Squared error estimate over typical ranges.
    pub(super) error2: f64,
    /// Raw pressure rates at the start and the end of the step.
    pub(super) rates: [Vec<[f64; 2]>; 2],
    increments: Vec<Vec<f64>>,
    carried: Vec<f64>,
    tangents: Vec<Tangent>,
    mass: Vec<f64>,
    mass_rows: [Vec<f64>; 3],
    /// Columns of the loads' stiffness and of the gyroscopic matrix for the free angles.
    geometric: Vec<Vec<f64>>,
    gyroscopic: Vec<Vec<f64>>,
    lu: DenseLu,
    right: Vec<f64>,
    scratch: Vec<f64>,
    forces_n: Vec<f64>,
}

impl Stepper {
    pub(super) fn new(model: &TreeModel) -> Self {
        let (n, count) = (model.free, model.cylinders.len());
        let point = Point::new(model);
        Self {
            motion: model.new_motion(),
            error2: 0.0,
            rates: [vec![[0.0; 2]; count], vec![[0.0; 2]; count]],
            increments: vec![vec![0.0; point.values.len()]; STAGES],
            carried: vec![0.0; point.values.len()],
            next: point,
            tangents: vec![
                Tangent {
                    row: vec![0.0; model.all],
                    ..Tangent::default()
                };
                count
            ],
            mass: vec![0.0; n * n],
            mass_rows: std::array::from_fn(|_| vec![0.0; model.all]),
            geometric: vec![vec![0.0; n]; model.free_angles],
            gyroscopic: vec![vec![0.0; n]; model.free_angles],
            lu: DenseLu::new(n),
            right: vec![0.0; n],
            scratch: vec![0.0; n],
            forces_n: vec![0.0; count],
        }
    }

    /// Steps from `y` by `h`. False where a loop does not close or a matrix is singular.
    pub(super) fn step(&mut self, model: &TreeModel, y: &Point, h: f64, signals: &[Signal]) -> bool {
        let s = RODAS5P.gamma * h;
        if !model.evaluate_motion(y.u(), y.v(), y.a(), &mut self.motion) {
            return false;
        }
        self.tangents(model, y, h, s, signals);
        if !self.factorise(model, y, s) {
            return false;
        }
        self.next.values.copy_from_slice(&y.values);
        for stage in 0..RODAS5P.stages {
            if !self.stage(model, y, h, s, signals, stage) {
                return false;
            }
        }
        let last = &self.increments[RODAS5P.stages - 1];
        for (x, d) in self.next.values.iter_mut().zip(last) {
            *x += d;
        }
        self.error2 = self.estimate(model);
        true
    }

    fn chambers(
        model: &TreeModel,
        cylinder: usize,
        signal: &Signal,
        at_s: f64,
        motion: &Motion,
        pressures: [f64; 2],
    ) -> [ChamberRate; 2] {
        let spec = &model.system.cylinders()[cylinder];
        let line = &motion.lines[cylinder];
        let x = spec.stroke_m(line.length_m);
        let ratio = signal.ratio + signal.per_s * at_s;
        let of = |chamber: &crate::hydraulics::chamber::Chamber, p| {
            chamber.rate_and_slopes(spec.valve(), ratio, signal.extends, x, line.velocity_m_per_s, p)
        };
        [of(&spec.piston, pressures[0]), of(&spec.rod, pressures[1])]
    }

    fn tangents(&mut self, model: &TreeModel, y: &Point, h: f64, s: f64, signals: &[Signal]) {
        for (k, tangent) in self.tangents.iter_mut().enumerate() {
            model.line_row(k, &mut tangent.row, &mut self.motion);
            let spec = &model.system.cylinders()[k];
            let line = self.motion.lines[k];
            let force = spec.force(line.length_m, line.velocity_m_per_s, y.pressures(k));
            (tangent.by_length, tangent.by_velocity) = (force.by_length, force.by_velocity);
            self.forces_n[k] = force.force_n;
            tangent.area_m2 = [-spec.piston.area_m2, spec.rod.area_m2];
            tangent.oil = 0.0;
            let rates = Self::chambers(model, k, &signals[k], 0.0, &self.motion, y.pressures(k));
            for (c, rate) in rates.iter().enumerate() {
                self.rates[0][k][c] = rate.rate_pa_per_s;
                if signals[k].empty[c] {
                    tangent.gain[c] = s;
                    (tangent.by_stroke[c], tangent.by_rate[c], tangent.drift[c]) = (0.0, 0.0, 0.0);
                    continue;
                }
                tangent.gain[c] = 1.0 / (1.0 / s - rate.by_pressure);
                tangent.by_stroke[c] = rate.by_stroke;
                tangent.by_rate[c] = rate.by_velocity;
                tangent.drift[c] = h * signals[k].per_s * rate.by_valve;
                tangent.oil += tangent.area_m2[c] * tangent.gain[c] * (s * rate.by_stroke + rate.by_velocity);
            }
        }
    }

    /// Assembles and factors the matrix of the stages at the start of the step.
    fn factorise(&mut self, model: &TreeModel, y: &Point, s: f64) -> bool {
        let (n, angles) = (model.free, model.free_angles);
        model.mass(&mut self.mass, &mut self.mass_rows, &mut self.motion);
        if !self.loads(model, y) {
            return false;
        }
        let values = &mut self.lu.values;
        values.copy_from_slice(&self.mass);
        for body in &model.bodies {
            for k in 0..body.modes() {
                let at = body.first + k;
                values[at * n + at] += s * body.damping[k] + s * s * body.w2[k];
            }
        }
        for j in 0..angles {
            for i in 0..n {
                values[i * n + j] += s * self.gyroscopic[j][i] + s * s * self.geometric[j][i];
                if i >= angles {
                    // The stiffness of loads is symmetric but for the weight of moving masses.
                    values[j * n + i] += s * s * self.geometric[j][i];
                }
            }
        }
        for tangent in &self.tangents {
            let factor = s * s * tangent.by_length + s * tangent.by_velocity + s * tangent.oil;
            for i in 0..n {
                let x = factor * tangent.row[i];
                for (v, j) in values[i * n..(i + 1) * n].iter_mut().zip(&tangent.row[..n]) {
                    *v += x * j;
                }
            }
        }
        self.lu.factorise()
    }

    /// Derivatives of the residual with respect to angles and their rates, the cylinders' forces held.
    fn loads(&mut self, model: &TreeModel, y: &Point) -> bool {
        let n = model.free;
        let mut moved = std::mem::take(&mut self.scratch);
        let forces = |k: usize| self.forces_n[k];
        model.residual(forces, &mut self.motion);
        self.right.copy_from_slice(&self.motion.residual[..n]);
        let mut closed = true;
        for j in 0..model.free_angles {
            moved.copy_from_slice(y.u());
            moved[j] += PERTURBATION;
            closed &= model.evaluate_motion(&moved, y.v(), y.a(), &mut self.motion);
            model.residual(forces, &mut self.motion);
            for i in 0..n {
                self.geometric[j][i] = (self.motion.residual[i] - self.right[i]) / PERTURBATION;
            }
            moved.copy_from_slice(y.v());
            moved[j] += PERTURBATION;
            closed &= model.evaluate_motion(y.u(), &moved, y.a(), &mut self.motion);
            model.residual(forces, &mut self.motion);
            for i in 0..n {
                self.gyroscopic[j][i] = (self.motion.residual[i] - self.right[i]) / PERTURBATION;
            }
        }
        self.scratch = moved;
        closed
    }

    fn stage(
        &mut self,
        model: &TreeModel,
        y: &Point,
        h: f64,
        s: f64,
        signals: &[Signal],
        stage: usize,
    ) -> bool {
        let n = model.free;
        self.combine(y, h, stage);
        let next = &self.next;
        if !model.evaluate_motion(next.u(), next.v(), next.a(), &mut self.motion) {
            return false;
        }
        let at_s = RODAS5P.time[stage] * h;
        let mut increment = std::mem::take(&mut self.increments[stage]);
        // c_u, c_v, c_p; from here on ry = v + c_u, rv = a + c_v.
        for i in 0..n {
            self.carried[i] += next.v()[i];
            self.carried[n + i] += next.a()[i];
        }
        for (k, signal) in signals.iter().enumerate() {
            let rates = Self::chambers(model, k, signal, at_s, &self.motion, next.pressures(k));
            let spec = &model.system.cylinders()[k];
            let line = self.motion.lines[k];
            self.forces_n[k] = spec
                .force(line.length_m, line.velocity_m_per_s, next.pressures(k))
                .force_n;
            for c in 0..2 {
                self.rates[1][k][c] = rates[c].rate_pa_per_s;
                let at = 2 * n + 2 * k + c;
                self.carried[at] += if signal.empty[c] {
                    0.0
                } else {
                    rates[c].rate_pa_per_s + RODAS5P.d[stage] * self.tangents[k].drift[c]
                };
            }
        }
        let forces = &self.forces_n;
        model.residual(|k| forces[k], &mut self.motion);
        let (ry, rest) = self.carried.split_at(n);
        let rv = &rest[..n];
        for i in 0..n {
            let along: f64 = self.mass[i * n..(i + 1) * n]
                .iter()
                .zip(rv)
                .map(|(m, x)| m * x)
                .sum();
            self.right[i] = s * (along - self.motion.residual[i]);
        }
        for body in &model.bodies {
            for k in 0..body.modes() {
                let at = body.first + k;
                self.right[at] -= s * s * body.w2[k] * ry[at];
            }
        }
        for (j, column) in self.geometric.iter().enumerate() {
            for i in 0..n {
                self.right[i] -= s * s * column[i] * ry[j];
                if i >= model.free_angles {
                    self.right[j] -= s * s * column[i] * ry[i];
                }
            }
        }
        for (k, tangent) in self.tangents.iter().enumerate() {
            let travel: f64 = tangent.row[..n].iter().zip(ry).map(|(j, x)| j * x).sum();
            let mut force = s * tangent.by_length * travel;
            for c in 0..2 {
                let rp = self.carried[2 * n + 2 * k + c];
                force += tangent.area_m2[c] * tangent.gain[c] * (rp + s * tangent.by_stroke[c] * travel);
            }
            for (r, j) in self.right.iter_mut().zip(&tangent.row[..n]) {
                *r -= s * force * j;
            }
        }
        self.lu.solve(&mut self.right);
        for i in 0..n {
            let dv = self.right[i];
            increment[i] = s * (ry[i] + dv);
            increment[n + i] = dv;
            let last = increment.len() - n;
            increment[last + i] = dv / s - rv[i];
        }
        for (k, tangent) in self.tangents.iter().enumerate() {
            let (mut travel, mut speed) = (0.0, 0.0);
            for i in 0..n {
                travel += tangent.row[i] * increment[i];
                speed += tangent.row[i] * self.right[i];
            }
            for c in 0..2 {
                let at = 2 * n + 2 * k + c;
                increment[at] = tangent.gain[c]
                    * (self.carried[at] + tangent.by_stroke[c] * travel + tangent.by_rate[c] * speed);
            }
        }
        self.increments[stage] = increment;
        true
    }

    /// Argument of the stage into `next`, Σ c/h of the increments into `carried`.
    fn combine(&mut self, y: &Point, h: f64, stage: usize) {
        let (a, c) = (&RODAS5P.a[stage], &RODAS5P.c[stage]);
        let differential = y.values.len() - y.free;
        self.carried.fill(0.0);
        for (u, c) in self.increments[..stage].iter().zip(c) {
            let c = c / h;
            for (x, u) in self.carried[..differential].iter_mut().zip(u) {
                *x += c * u;
            }
        }
        if stage >= RODAS5P.chain {
            for (x, u) in self.next.values.iter_mut().zip(&self.increments[stage - 1]) {
                *x += u;
            }
            return;
        }
        self.next.values.copy_from_slice(&y.values);
        for (u, a) in self.increments[..stage].iter().zip(a) {
            for (x, u) in self.next.values.iter_mut().zip(u) {
                *x += a * u;
            }
        }
    }

    /// Σ (error / range)² over pressures, cylinder travel and speed, and strain energy.
    fn estimate(&self, model: &TreeModel) -> f64 {
        let n = model.free;
        let error = &self.increments[RODAS5P.stages - 1];
        let mut sum = 0.0;
        for (k, (tangent, scale)) in self.tangents.iter().zip(&model.scales).enumerate() {
            let (mut travel, mut speed) = (0.0, 0.0);
            for i in 0..n {
                travel += tangent.row[i] * error[i];
                speed += tangent.row[i] * error[n + i];
            }
            sum += (travel / scale.travel_m).powi(2) + (speed / scale.speed_m_per_s).powi(2);
            for c in 0..2 {
                sum += (error[2 * n + 2 * k + c] / scale.pressure_pa).powi(2);
            }
        }
        for body in &model.bodies {
            for k in 0..body.modes() {
                let e = error[body.first + k];
                sum += body.w2[k] * e * e / model.energy_j;
            }
        }
        sum
    }
}
