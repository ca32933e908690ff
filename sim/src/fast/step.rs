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
    let (a, c) = (&method.a[stage], &method.c[stage]);
    let u = &w.increments[..stage];
    macro_rules! combine {
        ($from:expr, $get:expr) => {{
            let get = $get;
            let mut argument = $from;
            let mut carried = L::splat(0.0);
            for (j, u) in u.iter().enumerate() {
                let x: L = get(u);
                argument += x * L::splat(a[j]);
                carried += x * L::splat(c[j]);
            }
            (argument, carried * inverse_h)
        }};
    }
    let chained = stage >= method.chain;
    let (theta, rhs_theta) = combine!(y.theta, |u: &Point<L, N>| u.theta);
    let (omega, rhs_omega) = combine!(y.omega, |u: &Point<L, N>| u.omega);
    w.rhs.theta = rhs_theta;
    w.rhs.omega = rhs_omega;
    let previous = if chained { Some(&u[stage - 1]) } else { None };
    w.next.theta = previous.map_or(theta, |u| w.next.theta + u.theta);
    w.next.omega = previous.map_or(omega, |u| w.next.omega + u.omega);
    for i in 0..2 {
        let (p, rhs) = combine!(y.p[i], |u: &Point<L, N>| u.p[i]);
        w.rhs.p[i] = rhs;
        w.next.p[i] = previous.map_or(p, |u| w.next.p[i] + u.p[i]);
    }
    blocks(
        a,
        c,
        u,
        count,
        inverse_h,
        |u| &u.z,
        &y.z,
        chained,
        &mut w.next.z,
        &mut w.rhs.z,
    );
    blocks(
        a,
        c,
        u,
        count,
        inverse_h,
        |u| &u.v,
        &y.v,
        chained,
        &mut w.next.v,
        &mut w.rhs.v,
    );
}

/// The same for an array of modes, four at a time.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inlined piece of one loop")]
fn blocks<L: Lane, const N: usize>(
    a: &[f64; STAGES],
    c: &[f64; STAGES],
    u: &[Point<L, N>],
    count: usize,
    inverse_h: L,
    get: impl Fn(&Point<L, N>) -> &[L; N],
    from: &[L; N],
    chained: bool,
    argument: &mut [L; N],
    carried: &mut [L; N],
) {
    let zero = L::splat(0.0);
    let whole = count - count % 4;
    let mut start = 0;
    while start < whole {
        let mut sum_a = [zero; 4];
        let mut sum_c = [zero; 4];
        for i in 0..4 {
            sum_a[i] = from[start + i];
        }
        for (j, u) in u.iter().enumerate() {
            let x = get(u);
            for i in 0..4 {
                sum_a[i] += x[start + i] * L::splat(a[j]);
                sum_c[i] += x[start + i] * L::splat(c[j]);
            }
        }
        for i in 0..4 {
            argument[start + i] = if chained {
                argument[start + i] + get(&u[u.len() - 1])[start + i]
            } else {
                sum_a[i]
            };
            carried[start + i] = sum_c[i] * inverse_h;
        }
        start += 4;
    }
    for i in whole..count {
        let mut sum_a = from[i];
        let mut sum_c = zero;
        for (j, u) in u.iter().enumerate() {
            let x = get(u)[i];
            sum_a += x * L::splat(a[j]);
            sum_c += x * L::splat(c[j]);
        }
        argument[i] = if chained {
            argument[i] + get(&u[u.len() - 1])[i]
        } else {
            sum_a
        };
        carried[i] = sum_c * inverse_h;
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
