//! One Rosenbrock step of all lanes.

use super::constants::Constants;
use super::dynamics::{Point, Rates, Regime, evaluate};
use super::lane::Lane;
use super::solve::{Factors, factor, solve};
use super::sums::sums;
use super::tableau::{STAGES, Tableau};

/// Scratch of a step; may be dirty.
#[derive(Debug, Clone)]
pub(super) struct StepBuffer<L, const N: usize> {
    /// Right-hand side at the start of the step.
    pub(super) start: Rates<L, N>,
    /// Right-hand side at the last stage.
    pub(super) end: Rates<L, N>,
    /// State after the step.
    pub(super) next: Point<L, N>,
    /// dω/dt at the end of the step, from the dense output: the right-hand side there would show the
    /// small errors of the stiff modes multiplied by their stiffness.
    pub(super) alpha: L,
    /// Squared error estimate over tolerance-free scales.
    pub(super) error2: L,
    factors: Factors<L, N>,
    increments: [Point<L, N>; STAGES],
    rhs: Point<L, N>,
}

impl<L: Lane, const N: usize> StepBuffer<L, N> {
    /// Zero everywhere.
    pub(super) fn new() -> Self {
        Self {
            start: Rates::zero(),
            end: Rates::zero(),
            next: Point::zero(),
            alpha: L::splat(0.0),
            error2: L::splat(0.0),
            factors: Factors::zero(),
            increments: [Point::zero(); STAGES],
            rhs: Point::zero(),
        }
    }
}

/// Steps from `y` by `h`: fills `next`, `error2`, and the rates at both ends.
#[inline(always)]
pub(super) fn step<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    method: &Tableau,
    y: &Point<L, N>,
    h: L,
    regime: &Regime<L>,
    w: &mut StepBuffer<L, N>,
) {
    let count = L::trip(N, c.used);
    evaluate(c, y, regime.opening, regime, &mut w.start);
    factor(c, y, &w.start, h * L::splat(method.gamma), &mut w.factors);
    let inverse_h = L::splat(1.0) / h;
    let drift = [
        h * regime.opening_per_s * w.start.gain[0] * w.start.stiffness[0],
        h * regime.opening_per_s * w.start.gain[1] * w.start.stiffness[1],
    ];
    w.next = *y;
    for stage in 0..method.stages {
        gather(method, stage, count, y, inverse_h, w);
        let at = if stage == 0 {
            &w.start
        } else {
            let opening = regime.opening + L::splat(method.time[stage]) * h * regime.opening_per_s;
            evaluate(c, &w.next, opening, regime, &mut w.end);
            &w.end
        };
        w.rhs.theta += w.next.omega;
        w.rhs.omega += at.alpha;
        w.rhs.lag += at.lag;
        for i in 0..count {
            w.rhs.z[i] += w.next.v[i];
            w.rhs.v[i] += at.a[i];
        }
        for i in 0..2 {
            w.rhs.p[i] += at.p[i] + L::splat(method.d[stage]) * drift[i];
        }
        solve(c, &w.factors, &w.start, &w.rhs, &mut w.increments[stage]);
    }
    let last = w.increments[method.stages - 1];
    add(count, &mut w.next, &last);
    let mut change = w.next.omega - y.omega;
    for (u, slope) in w.increments[..method.stages].iter().zip(&method.slope) {
        change -= u.omega * L::splat(*slope);
    }
    w.alpha = change * inverse_h;
    w.error2 = error2(c, &w.end, &last);
}

/// Argument of the stage into `next`, Σ c/h u into `rhs`.
#[inline(always)]
fn gather<L: Lane, const N: usize>(
    method: &Tableau,
    stage: usize,
    count: usize,
    y: &Point<L, N>,
    inverse_h: L,
    w: &mut StepBuffer<L, N>,
) {
    let (next, rhs) = (&mut w.next, &mut w.rhs);
    let u = &w.increments[..stage];
    let weights = Weights {
        a: &method.a[stage],
        c: &method.c[stage],
        chained: stage >= method.chain,
        inverse_h,
    };
    macro_rules! one {
        ($($field:tt)+) => {
            (next.$($field)+, rhs.$($field)+) =
                weights.one(u, y.$($field)+, next.$($field)+, |u: &Point<L, N>| u.$($field)+);
        };
    }
    one!(theta);
    one!(omega);
    one!(lag);
    one!(p[0]);
    one!(p[1]);
    weights.array(count, u, &y.z, &mut next.z, &mut rhs.z, |u| &u.z);
    weights.array(count, u, &y.v, &mut next.v, &mut rhs.v, |u| &u.v);
}

/// Coefficients of one stage.
struct Weights<'a, L> {
    a: &'a [f64; STAGES],
    c: &'a [f64; STAGES],
    /// The argument is the previous one plus the previous increment.
    chained: bool,
    inverse_h: L,
}

impl<L: Lane> Weights<'_, L> {
    /// Argument and carried sum of one number.
    #[inline(always)]
    fn one<U>(&self, u: &[U], from: L, previous: L, get: impl Fn(&U) -> L) -> (L, L) {
        let mut argument = from;
        let mut carried = L::splat(0.0);
        for (j, u) in u.iter().enumerate() {
            let x = get(u);
            carried += x * L::splat(self.c[j]);
            if !self.chained {
                argument += x * L::splat(self.a[j]);
            }
        }
        if let (true, Some(last)) = (self.chained, u.last()) {
            argument = previous + get(last);
        }
        (argument, carried * self.inverse_h)
    }

    /// The same for an array over modes, four at a time.
    #[inline(always)]
    fn array<U, const N: usize>(
        &self,
        count: usize,
        u: &[U],
        from: &[L; N],
        argument: &mut [L; N],
        carried: &mut [L; N],
        get: impl Fn(&U) -> &[L; N],
    ) {
        let zero = L::splat(0.0);
        let whole = count - count % 4;
        let mut start = 0;
        while start < whole {
            let mut sum_c = [zero; 4];
            if let (true, Some(last)) = (self.chained, u.last()) {
                for (j, u) in u.iter().enumerate() {
                    for i in 0..4 {
                        sum_c[i] += get(u)[start + i] * L::splat(self.c[j]);
                    }
                }
                for i in 0..4 {
                    argument[start + i] += get(last)[start + i];
                }
            } else {
                let mut sum_a = [zero; 4];
                for i in 0..4 {
                    sum_a[i] = from[start + i];
                }
                for (j, u) in u.iter().enumerate() {
                    for i in 0..4 {
                        let x = get(u)[start + i];
                        sum_c[i] += x * L::splat(self.c[j]);
                        sum_a[i] += x * L::splat(self.a[j]);
                    }
                }
                for i in 0..4 {
                    argument[start + i] = sum_a[i];
                }
            }
            for i in 0..4 {
                carried[start + i] = sum_c[i] * self.inverse_h;
            }
            start += 4;
        }
        for i in whole..count {
            (argument[i], carried[i]) = self.one(u, from[i], argument[i], |u| get(u)[i]);
        }
    }
}

#[inline(always)]
fn add<L: Lane, const N: usize>(count: usize, y: &mut Point<L, N>, u: &Point<L, N>) {
    y.theta += u.theta;
    y.omega += u.omega;
    for i in 0..count {
        y.z[i] += u.z[i];
        y.v[i] += u.v[i];
    }
    for i in 0..2 {
        y.p[i] += u.p[i];
    }
    y.lag += u.lag;
}

/// Σ (error / scale)² over pressures, rod travel, rod speed and strain energy.
#[inline(always)]
fn error2<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    r: &Rates<L, N>,
    u: &Point<L, N>,
) -> L {
    let count = L::trip(N, c.used);
    let k = |x: f64| L::splat(x);
    let [jz, jv, energy] = sums(count, |i| {
        [r.j[i] * u.z[i], r.j[i] * u.v[i], u.z[i] * u.z[i] * k(c.w2[i])]
    });
    let travel = (jz + r.jt * u.theta) * k(c.scale.per_m);
    let speed = (jv + r.jt * u.omega) * k(c.scale.per_m_per_s);
    let turn = r.jt * u.theta * k(c.scale.per_m);
    let spin = r.jt * u.omega * k(c.scale.per_m_per_s);
    let p = [u.p[0] * k(c.scale.per_pa), u.p[1] * k(c.scale.per_pa)];
    energy * k(c.scale.per_j)
        + (travel * travel + speed * speed)
        + (turn * turn + spin * spin)
        + (p[0] * p[0] + p[1] * p[1])
}
