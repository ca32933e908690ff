//! Kinematics and residual of the tree: positions outward, forces inward, loops closed on the way.
//!
//! ```text
//! y = [u; w]     u free, w the angles that the loops determine
//! g(u, w) = 0    ẇ = −G_w⁻¹ G_u u̇    ẅ = −G_w⁻¹ (G_u ü + Ġ ẏ)
//! r_u = ρ_u + G_uᵀ λ,  G_wᵀ λ = −ρ_w    ρ: residual of the open tree
//! ```

use nalgebra::Vector2;

use super::model::{Mount, PlanarMarker, TreeModel, cross, quarter};
use crate::system::DenseLu;

/// Gap at which a loop counts as closed, m: rounding of positions in metres.
const GAP_CLOSED_M: f64 = 1e-14;
/// Iterations of a loop's closure within a step, from the last known angles.
const CLOSURE_ITERATIONS: usize = 12;

/// Motion of a point.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PointMotion {
    /// Position, velocity, acceleration in the body frame, m, m/s, m/s².
    local: [Vector2<f64>; 3],
    /// Relative to the body's origin, global axes, m.
    pub(super) arm: Vector2<f64>,
    /// Global position, m.
    pub(super) position: Vector2<f64>,
    pub(super) velocity: Vector2<f64>,
    pub(super) acceleration: Vector2<f64>,
}

/// Motion of a body.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FrameMotion {
    pub(super) angle: f64,
    pub(super) omega: f64,
    pub(super) alpha: f64,
    pub(super) cos: f64,
    pub(super) sin: f64,
    pub(super) origin: Vector2<f64>,
    pub(super) velocity: Vector2<f64>,
    pub(super) acceleration: Vector2<f64>,
}

impl FrameMotion {
    fn out(&self, v: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.cos * v.x - self.sin * v.y, self.sin * v.x + self.cos * v.y)
    }

    fn back(&self, v: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.cos * v.x + self.sin * v.y, self.cos * v.y - self.sin * v.x)
    }
}

/// Force and moment about a body's origin.
#[derive(Debug, Clone, Copy, Default)]
struct Wrench {
    force: Vector2<f64>,
    moment: f64,
}

/// Eye-to-eye line of a cylinder.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Line {
    pub(super) length_m: f64,
    pub(super) velocity_m_per_s: f64,
    /// In-plane part of the unit vector from base to rod.
    direction: Vector2<f64>,
}

/// Scratch memory of evaluations; holds the last one.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    /// All coordinates, velocities and accelerations.
    pub(super) y: Vec<f64>,
    pub(super) v: Vec<f64>,
    pub(super) a: Vec<f64>,
    pub(super) frames: Vec<FrameMotion>,
    pub(super) points: Vec<PointMotion>,
    pub(super) lines: Vec<Line>,
    wrenches: Vec<Wrench>,
    /// Rows of the loops over all coordinates, and the factors of their last columns.
    loop_rows: Vec<f64>,
    loop_lu: DenseLu,
    loop_side: Vec<f64>,
    /// Residual over all coordinates; the first ones are the free ones'.
    pub(super) residual: Vec<f64>,
    modal: Vec<f64>,
}

impl TreeModel {
    pub(super) fn new_motion(&self) -> Motion {
        let most = self
            .bodies
            .iter()
            .map(super::model::PlanarBody::modes)
            .max()
            .unwrap_or(0);
        Motion {
            y: vec![0.0; self.all],
            v: vec![0.0; self.all],
            a: vec![0.0; self.all],
            frames: vec![FrameMotion::default(); self.bodies.len()],
            points: vec![PointMotion::default(); self.markers.len()],
            lines: vec![Line::default(); self.cylinders.len()],
            wrenches: vec![Wrench::default(); self.bodies.len()],
            loop_rows: vec![0.0; 2 * self.loops.len() * self.all],
            loop_lu: self.new_loop_solver(),
            loop_side: vec![0.0; 2 * self.loops.len()],
            residual: vec![0.0; self.all],
            modal: vec![0.0; 2 * most],
        }
    }

    /// Evaluates the motion for given free coordinates, velocities and accelerations. False where a loop does not close.
    pub(super) fn evaluate_motion(&self, u: &[f64], v: &[f64], a: &[f64], m: &mut Motion) -> bool {
        m.y[..self.free].copy_from_slice(u);
        m.v[..self.free].copy_from_slice(v);
        m.a[..self.free].copy_from_slice(a);
        self.deform(m);
        if !self.close(m) {
            return false;
        }
        if !self.loops.is_empty() {
            // Rates of the loops' angles from what the gaps would do without them.
            m.v[self.free..].fill(0.0);
            self.velocities(m);
            self.gaps(m, |p| p.velocity);
            m.loop_lu.solve(&mut m.loop_side);
            for (v, gap) in m.v[self.free..].iter_mut().zip(&m.loop_side) {
                *v = -gap;
            }
        }
        self.velocities(m);
        if !self.loops.is_empty() {
            m.a[self.free..].fill(0.0);
            self.accelerations(m);
            self.gaps(m, |p| p.acceleration);
            m.loop_lu.solve(&mut m.loop_side);
            for (a, gap) in m.a[self.free..].iter_mut().zip(&m.loop_side) {
                *a = -gap;
            }
        }
        self.accelerations(m);
        for (line, &[base, rod]) in m.lines.iter_mut().zip(&self.cylinders) {
            let (from, to) = (&m.points[base], &m.points[rod]);
            let in_plane = to.position - from.position;
            let out_of_plane = self.markers[rod].z_m - self.markers[base].z_m;
            line.length_m = (in_plane.norm_squared() + out_of_plane * out_of_plane).sqrt();
            line.direction = in_plane / line.length_m;
            line.velocity_m_per_s = line.direction.dot(&(to.velocity - from.velocity));
        }
        true
    }

    /// Positions of the markers in their bodies, with rates.
    fn deform(&self, m: &mut Motion) {
        for (marker, point) in self.markers.iter().zip(&mut m.points) {
            point.local = [marker.point_m, Vector2::zeros(), Vector2::zeros()];
            let Some(body) = marker.body else {
                point.position = marker.point_m;
                continue;
            };
            let first = self.bodies[body].first;
            let n = marker.x.len();
            for (level, values) in [&m.y, &m.v, &m.a].into_iter().enumerate() {
                let eta = &values[first..first + n];
                let (mut x, mut y) = (0.0, 0.0);
                for ((px, py), e) in marker.x.iter().zip(&marker.y).zip(eta) {
                    x += px * e;
                    y += py * e;
                }
                point.local[level] += Vector2::new(x, y);
            }
        }
    }

    /// Small rotation of a marker against its body.
    fn turn(&self, marker: &PlanarMarker, values: &[f64]) -> f64 {
        let first = marker.body.map_or(0, |b| self.bodies[b].first);
        marker.turn.iter().zip(&values[first..]).map(|(t, e)| t * e).sum()
    }

    /// An angle-like quantity of a body: its own coordinate, or what its weld gives it.
    fn follow(&self, body: usize, values: &[f64], of_frame: impl Fn(usize) -> f64) -> f64 {
        let b = &self.bodies[body];
        match b.mount {
            Mount::Turns(k) => values[k],
            Mount::Welded => {
                let on = &self.markers[b.on];
                on.body.map_or(0.0, of_frame) + self.turn(on, values)
                    - self.turn(&self.markers[b.own], values)
            }
        }
    }

    /// Positions for given free coordinates and the loops' angles as they are.
    pub(super) fn place(&self, u: &[f64], m: &mut Motion) {
        m.y[..self.free].copy_from_slice(u);
        self.deform(m);
        self.positions(m);
    }

    fn positions(&self, m: &mut Motion) {
        for &body in &self.order {
            let angle = self.follow(body, &m.y, |b| m.frames[b].angle);
            let (sin, cos) = libm::sincos(angle);
            let frame = &mut m.frames[body];
            (frame.angle, frame.sin, frame.cos) = (angle, sin, cos);
            let b = &self.bodies[body];
            let on = &self.markers[b.on];
            let at = match on.body {
                None => on.point_m,
                Some(parent) => m.frames[parent].origin + m.frames[parent].out(&m.points[b.on].local[0]),
            };
            let arm = m.frames[body].out(&m.points[b.own].local[0]);
            m.frames[body].origin = at - arm;
        }
        for (marker, point) in self.markers.iter().zip(&mut m.points) {
            if let Some(body) = marker.body {
                let frame = &m.frames[body];
                point.arm = frame.out(&point.local[0]);
                point.position = frame.origin + point.arm;
            }
        }
    }

    fn velocities(&self, m: &mut Motion) {
        let of_point = |frame: &FrameMotion, point: &PointMotion| {
            quarter(&point.arm) * frame.omega + frame.out(&point.local[1])
        };
        for &body in &self.order {
            m.frames[body].omega = self.follow(body, &m.v, |b| m.frames[b].omega);
            let b = &self.bodies[body];
            let at = match self.markers[b.on].body {
                None => Vector2::zeros(),
                Some(parent) => {
                    let frame = &m.frames[parent];
                    frame.velocity + of_point(frame, &m.points[b.on])
                }
            };
            m.frames[body].velocity = at - of_point(&m.frames[body], &m.points[b.own]);
        }
        for (marker, point) in self.markers.iter().zip(&mut m.points) {
            if let Some(body) = marker.body {
                let frame = &m.frames[body];
                point.velocity = frame.velocity + of_point(frame, point);
            }
        }
    }

    fn accelerations(&self, m: &mut Motion) {
        let of_point = |frame: &FrameMotion, point: &PointMotion| {
            quarter(&point.arm) * frame.alpha - point.arm * (frame.omega * frame.omega)
                + quarter(&frame.out(&point.local[1])) * (2.0 * frame.omega)
                + frame.out(&point.local[2])
        };
        for &body in &self.order {
            m.frames[body].alpha = self.follow(body, &m.a, |b| m.frames[b].alpha);
            let b = &self.bodies[body];
            let at = match self.markers[b.on].body {
                None => Vector2::zeros(),
                Some(parent) => {
                    let frame = &m.frames[parent];
                    frame.acceleration + of_point(frame, &m.points[b.on])
                }
            };
            m.frames[body].acceleration = at - of_point(&m.frames[body], &m.points[b.own]);
        }
        for (marker, point) in self.markers.iter().zip(&mut m.points) {
            if let Some(body) = marker.body {
                let frame = &m.frames[body];
                point.acceleration = frame.acceleration + of_point(frame, point);
            }
        }
    }

    fn gaps(&self, m: &mut Motion, of: impl Fn(&PointMotion) -> Vector2<f64>) {
        for (k, &[from, to]) in self.loops.iter().enumerate() {
            let gap = of(&m.points[to]) - of(&m.points[from]);
            m.loop_side[2 * k] = gap.x;
            m.loop_side[2 * k + 1] = gap.y;
        }
    }

    /// Largest gap of the loops at the last positions, m.
    pub(super) fn gap_m(&self, m: &Motion) -> f64 {
        let gap = |&[from, to]: &[usize; 2]| (m.points[to].position - m.points[from].position).amax();
        self.loops.iter().map(gap).fold(0.0, f64::max)
    }

    /// Closes the loops by Newton's method in their angles, from those of the last evaluation.
    pub(super) fn close(&self, m: &mut Motion) -> bool {
        let mut before = f64::INFINITY;
        for _ in 0..CLOSURE_ITERATIONS {
            self.positions(m);
            if self.loops.is_empty() {
                return true;
            }
            if !self.factor_loops(m) {
                return false;
            }
            let gap = self.gap_m(m);
            // A gap that stopped falling this close to rounding is rounding.
            if gap < GAP_CLOSED_M || (gap < 1e-12 && gap > 0.3 * before) {
                return true;
            }
            if !gap.is_finite() || !self.step_loops(m, f64::INFINITY) {
                return false;
            }
            before = gap;
        }
        false
    }

    /// One Newton correction of the loops' angles, of at most `limit` rad. False where it is not finite.
    pub(super) fn step_loops(&self, m: &mut Motion, limit: f64) -> bool {
        self.gaps(m, |p| p.position);
        m.loop_lu.solve(&mut m.loop_side);
        let largest = m.loop_side.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
        if !largest.is_finite() {
            return false;
        }
        let part = (limit / largest.max(1e-300)).min(1.0);
        for (y, gap) in m.y[self.free..].iter_mut().zip(&m.loop_side) {
            *y -= part * gap;
        }
        true
    }

    /// Rows of the loops, and the factors of the columns of their own angles. False where these are singular.
    pub(super) fn factor_loops(&self, m: &mut Motion) -> bool {
        let (all, free) = (self.all, self.free);
        let mut rows = std::mem::take(&mut m.loop_rows);
        for (k, &[from, to]) in self.loops.iter().enumerate() {
            for axis in 0..2 {
                let direction = Vector2::ith(axis, 1.0);
                let row = &mut rows[(2 * k + axis) * all..][..all];
                Self::start_row(row, m);
                self.push(to, &direction, row, m);
                self.push(from, &-direction, row, m);
                self.gather(row, m);
            }
        }
        let order = all - free;
        for i in 0..order {
            for j in 0..order {
                m.loop_lu.values[i * order + j] = rows[i * all + free + j];
            }
        }
        m.loop_rows = rows;
        m.loop_lu.factorise()
    }

    fn start_row(row: &mut [f64], m: &mut Motion) {
        row.fill(0.0);
        m.wrenches.fill(Wrench::default());
    }

    /// Lets a force act at a marker.
    fn push(&self, marker: usize, force: &Vector2<f64>, row: &mut [f64], m: &mut Motion) {
        let at = &self.markers[marker];
        let Some(body) = at.body else { return };
        let wrench = &mut m.wrenches[body];
        wrench.force += force;
        wrench.moment += cross(&m.points[marker].arm, force);
        let local = m.frames[body].back(force);
        let first = self.bodies[body].first;
        for ((r, x), y) in row[first..].iter_mut().zip(&at.x).zip(&at.y) {
            *r += x * local.x + y * local.y;
        }
    }

    /// Lets a moment act at a marker.
    fn twist(&self, marker: usize, moment: f64, row: &mut [f64], m: &mut Motion) {
        let at = &self.markers[marker];
        let Some(body) = at.body else { return };
        m.wrenches[body].moment += moment;
        let first = self.bodies[body].first;
        for (r, t) in row[first..].iter_mut().zip(&at.turn) {
            *r += t * moment;
        }
    }

    /// Carries the wrenches from the ends of the tree to the ground; each joint leaves its share in the row.
    fn gather(&self, row: &mut [f64], m: &mut Motion) {
        for &body in self.order.iter().rev() {
            let b = &self.bodies[body];
            let Wrench { force, moment } = m.wrenches[body];
            let about_joint = moment - cross(&m.points[b.own].arm, &force);
            // The joint holds the body back: minus the force at its own marker, plus it on the other.
            let local = m.frames[body].back(&force);
            let own = &self.markers[b.own];
            for ((r, x), y) in row[b.first..].iter_mut().zip(&own.x).zip(&own.y) {
                *r -= x * local.x + y * local.y;
            }
            self.push(b.on, &force, row, m);
            match b.mount {
                Mount::Turns(k) => row[k] += about_joint,
                Mount::Welded => {
                    for (r, t) in row[b.first..].iter_mut().zip(&own.turn) {
                        *r -= t * about_joint;
                    }
                    self.twist(b.on, about_joint, row, m);
                }
            }
        }
    }

    /// Takes a row over all coordinates to the free ones: the loops' forces cancel its last entries.
    fn condense(&self, row: &mut [f64], m: &mut Motion) {
        if self.loops.is_empty() {
            return;
        }
        let (free_part, tied) = row.split_at_mut(self.free);
        m.loop_lu.solve_transposed(tied);
        for (k, lambda) in tied.iter().enumerate() {
            let loop_row = &m.loop_rows[k * self.all..][..self.free];
            for (r, g) in free_part.iter_mut().zip(loop_row) {
                *r -= lambda * g;
            }
        }
    }

    /// ∂L/∂u of a cylinder at the last evaluation; `row` is over all coordinates, its first entries are the free ones'.
    pub(super) fn line_row(&self, cylinder: usize, row: &mut [f64], m: &mut Motion) {
        let [base, rod] = self.cylinders[cylinder];
        let direction = m.lines[cylinder].direction;
        Self::start_row(row, m);
        self.push(rod, &direction, row, m);
        self.push(base, &-direction, row, m);
        self.gather(row, m);
        self.condense(row, m);
    }

    /// Residual `M ü − f` in the free coordinates with the given forces along the cylinders (tension positive),
    /// at the last evaluated motion: in the first entries of `m.residual`.
    pub(super) fn residual(&self, forces_n: impl Fn(usize) -> f64, m: &mut Motion) {
        let mut row = std::mem::take(&mut m.residual);
        Self::start_row(&mut row, m);
        for k in 0..self.bodies.len() {
            self.add_body(k, &mut row, m);
        }
        if let Some(at) = self.payload {
            let force = (m.points[at].acceleration - self.gravity_m_per_s2) * self.payload_kg;
            self.push(at, &force, &mut row, m);
        }
        for (k, &[base, rod]) in self.cylinders.iter().enumerate() {
            let force = m.lines[k].direction * forces_n(k);
            self.push(rod, &force, &mut row, m);
            self.push(base, &-force, &mut row, m);
        }
        self.gather(&mut row, m);
        self.condense(&mut row, m);
        m.residual = row;
    }

    /// Inertia, elastic forces and weight of a body (theory note §3, in the plane).
    fn add_body(&self, body: usize, row: &mut [f64], m: &mut Motion) {
        let b = &self.bodies[body];
        let n = b.modes();
        let frame = m.frames[body];
        let (w, alpha) = (frame.omega, frame.alpha);
        let range = b.first..b.first + n;
        let (eta, rate, acceleration) = (&m.y[range.clone()], &m.v[range.clone()], &m.a[range.clone()]);
        // (c + B η) and h, by rows: both are linear in η.
        let (first, second) = m.modal.split_at_mut(n);
        first.copy_from_slice(&b.c);
        second[..n].copy_from_slice(&b.h0);
        for (j, e) in eta.iter().enumerate() {
            let (bm, cm) = (&b.b[j * n..(j + 1) * n], &b.cc[j * n..(j + 1) * n]);
            for k in 0..n {
                first[k] += e * bm[k];
                second[k] -= e * cm[k];
            }
        }
        let (growth, h) = (&*first, &second[..n]);
        let (mut s, mut s1, mut s2) = (b.first_moment_kg_m, Vector2::zeros(), Vector2::zeros());
        let (mut inertia, mut inertia_rate, mut from_modes) = (b.inertia_kg_m2, 0.0, 0.0);
        for k in 0..n {
            let c = Vector2::new(b.cx[k], b.cy[k]);
            s += c * eta[k];
            s1 += c * rate[k];
            s2 += c * acceleration[k];
            inertia += eta[k] * (growth[k] + b.c[k]);
            inertia_rate += 2.0 * rate[k] * growth[k];
            from_modes += h[k] * acceleration[k];
        }
        let at = frame.back(&(frame.acceleration - self.gravity_m_per_s2));
        let local = quarter(&s) * alpha - s * (w * w) + quarter(&s1) * (2.0 * w) + s2;
        let wrench = &mut m.wrenches[body];
        wrench.force += (frame.acceleration - self.gravity_m_per_s2) * b.mass_kg + frame.out(&local);
        wrench.moment += cross(&s, &at) + inertia * alpha + from_modes + inertia_rate * w;
        if !self.deformed_gravity {
            // Exudyn's convention: the weight's moment is that of the undeformed body.
            let g = frame.back(&self.gravity_m_per_s2);
            wrench.moment += cross(&(s - b.first_moment_kg_m), &g);
        }
        let row = &mut row[range];
        for k in 0..n {
            row[k] += b.cx[k] * at.x + b.cy[k] * at.y + h[k] * alpha + acceleration[k] - w * w * growth[k]
                + b.w2[k] * eta[k]
                + b.damping[k] * rate[k];
        }
        // Coriolis terms of the modes: −2 ω Σ_j η̇_j c_jk.
        for (j, r) in rate.iter().enumerate() {
            let factor = 2.0 * w * r;
            for (k, c) in b.cc[j * n..(j + 1) * n].iter().enumerate() {
                row[k] -= factor * c;
            }
        }
    }

    /// Mass matrix of the free coordinates at the last evaluated motion, row by row.
    pub(super) fn mass(&self, out: &mut [f64], rows: &mut [Vec<f64>; 3], m: &mut Motion) {
        let free = self.free;
        out.fill(0.0);
        for body in 0..self.bodies.len() {
            for (axis, row) in rows.iter_mut().enumerate() {
                Self::start_row(row, m);
                match axis {
                    2 => m.wrenches[body].moment = 1.0,
                    _ => m.wrenches[body].force = Vector2::ith(axis, 1.0),
                }
                self.gather(row, m);
                self.condense(row, m);
            }
            let b = &self.bodies[body];
            let n = b.modes();
            let frame = m.frames[body];
            let eta = &m.y[b.first..b.first + n];
            let (mut s, mut inertia) = (b.first_moment_kg_m, b.inertia_kg_m2);
            for k in 0..n {
                s += Vector2::new(b.cx[k], b.cy[k]) * eta[k];
                let growth: f64 = (0..n).map(|j| eta[j] * b.b[j * n + k]).sum();
                inertia += eta[k] * (2.0 * b.c[k] + growth);
            }
            let q = quarter(&frame.out(&s));
            let [jx, jy, jt] = &*rows;
            for i in 0..free {
                let px = b.mass_kg * jx[i] + q.x * jt[i];
                let py = b.mass_kg * jy[i] + q.y * jt[i];
                let pt = q.x * jx[i] + q.y * jy[i] + inertia * jt[i];
                for (j, o) in out[i * free..i * free + free].iter_mut().enumerate() {
                    *o += px * jx[j] + py * jy[j] + pt * jt[j];
                }
            }
            for k in 0..n {
                let place = b.first + k;
                let c = frame.out(&Vector2::new(b.cx[k], b.cy[k]));
                let h = b.h0[k] - (0..n).map(|j| eta[j] * b.cc[j * n + k]).sum::<f64>();
                for i in 0..free {
                    let x = c.x * jx[i] + c.y * jy[i] + h * jt[i];
                    out[place * free + i] += x;
                    out[i * free + place] += x;
                }
                out[place * free + place] += 1.0;
            }
        }
        if let Some(at) = self.payload {
            for axis in 0..2 {
                let row = &mut rows[axis];
                Self::start_row(row, m);
                self.push(at, &Vector2::ith(axis, 1.0), row, m);
                self.gather(row, m);
                self.condense(row, m);
            }
            let [jx, jy, _] = &*rows;
            for i in 0..free {
                let (px, py) = (self.payload_kg * jx[i], self.payload_kg * jy[i]);
                for (j, o) in out[i * free..i * free + free].iter_mut().enumerate() {
                    *o += px * jx[j] + py * jy[j];
                }
            }
        }
    }
}
