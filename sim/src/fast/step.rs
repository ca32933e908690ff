//! One Rosenbrock step of all lanes.

use super::constants::Constants;
use super::dynamics::{Heading, LARGEST_TURN_RAD, PerMode, Point, Rates, Regime, evaluate};
use super::lane::{Coefficient, Lane};
use super::solve::{Factors, factor, solve};
use super::sums::sums;
use super::tableau::{STAGES, Tableau};

/// Scratch of a step; may be dirty.
#[derive(Debug, Clone)]
pub(super) struct StepBuffer<L, const A: usize, const B: usize, const Q: usize> {
    /// Right-hand side at the start of the step.
    pub(super) start: Rates<L, A, B, Q>,
    /// Right-hand side at the last stage.
    pub(super) end: Rates<L, A, B, Q>,
    /// State after the step.
    pub(super) next: Point<L, A, B, Q>,
    /// dω/dt at the end of the step, from the dense output: the right-hand side there would show the
    /// small errors of the stiff modes multiplied by their stiffness.
    pub(super) alpha: L,
    /// Squared error estimate over tolerance-free scales.
    pub(super) error2: L,
    /// Lowest and highest rod speed among the stages, m/s.
    pub(super) speed_range: [L; 2],
    factors: Factors<L, A, B, Q>,
    increments: [Point<L, A, B, Q>; STAGES],
    rhs: Point<L, A, B, Q>,
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> StepBuffer<L, A, B, Q> {
    /// Zero everywhere.
    pub(super) fn new() -> Self {
        Self {
            start: Rates::zero(),
            end: Rates::zero(),
            next: Point::zero(),
            alpha: L::splat(0.0),
            error2: L::splat(0.0),
            speed_range: [L::splat(0.0); 2],
            factors: Factors::zero(),
            increments: [Point::zero(); STAGES],
            rhs: Point::zero(),
        }
    }
}

/// Steps from `y` by `h`: fills `next`, `error2`, and the rates at both ends.
#[inline(always)]
pub(super) fn step<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    method: &Tableau,
    y: &Point<L, A, B, Q>,
    h: L,
    regime: &Regime<L>,
    w: &mut StepBuffer<L, A, B, Q>,
) {
    let heading = Heading::new(y.theta);
    evaluate::<true, _, _, A, B, Q>(c, y, &heading, regime.opening, regime, &mut w.start);
    factor(c, y, &w.start, h * L::splat(method.gamma), &mut w.factors);
    let inverse_h = L::splat(1.0) / h;
    let slopes = &w.start.slopes;
    let drift = [
        h * regime.opening_per_s * slopes.gain[0] * slopes.stiffness[0],
        h * regime.opening_per_s * slopes.gain[1] * slopes.stiffness[1],
    ];
    w.next = *y;
    w.speed_range = [w.start.speed; 2];
    for stage in 0..method.stages {
        // Otherwise the compiler broadcasts all constants once, before the loop over the steps, and keeps the
        // hundreds of packs on the stack, where they drive the state out of the first-level cache.
        let c = std::hint::black_box(c);
        gather(c, method, stage, y, inverse_h, w);
        let at = if stage == 0 {
            &w.start
        } else {
            let opening = regime.opening + L::splat(method.time[stage]) * h * regime.opening_per_s;
            evaluate::<false, _, _, A, B, Q>(c, &w.next, &heading, opening, regime, &mut w.end);
            let [low, high] = w.speed_range;
            let speed = w.end.speed;
            w.speed_range = [
                speed.where_less(speed, low, low),
                speed.where_less(high, speed, high),
            ];
            &w.end
        };
        w.rhs.theta += w.next.omega;
        w.rhs.omega += at.alpha;
        w.rhs.lag += at.lag;
        for i in 0..2 {
            w.rhs.p[i] += at.p[i] + L::splat(method.d[stage]) * drift[i];
        }
        plus(c, &mut w.rhs.z, &w.next.v);
        plus(c, &mut w.rhs.v, &at.a);
        solve(c, &w.factors, &w.start, &w.rhs, &mut w.increments[stage]);
    }
    let last = &w.increments[method.stages - 1];
    w.next.theta += last.theta;
    w.next.omega += last.omega;
    w.next.lag += last.lag;
    for i in 0..2 {
        w.next.p[i] += last.p[i];
    }
    plus(c, &mut w.next.z, &last.z);
    plus(c, &mut w.next.v, &last.v);
    let mut change = w.next.omega - y.omega;
    for (u, slope) in w.increments[..method.stages].iter().zip(&method.slope) {
        change -= u.omega * L::splat(*slope);
    }
    w.alpha = change * inverse_h;
    let turn = (w.next.theta - y.theta).abs();
    // Not a number is not less either.
    w.error2 = error2(c, w).where_less(turn, L::splat(LARGEST_TURN_RAD), L::splat(f64::INFINITY));
}

/// Adds `b` to `a`.
#[inline(always)]
fn plus<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    a: &mut PerMode<L, A, B, Q>,
    b: &PerMode<L, A, B, Q>,
) {
    for i in 0..L::trip(A, c.coupled.used) {
        a.coupled[i] += b.coupled[i];
    }
    for i in 0..L::trip(B, c.plain.used) {
        a.plain[i] += b.plain[i];
    }
    for i in 0..L::trip(Q, c.follower.used) {
        a.follower[i] += b.follower[i];
    }
}

/// Argument of the stage into `next`, Σ c/h u into `rhs`.
#[inline(always)]
fn gather<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    method: &Tableau,
    stage: usize,
    y: &Point<L, A, B, Q>,
    inverse_h: L,
    w: &mut StepBuffer<L, A, B, Q>,
) {
    let (next, rhs) = (&mut w.next, &mut w.rhs);
    let u = &w.increments[..stage];
    let weights = Weights {
        a: &method.a[stage],
        c: &method.c[stage],
        chained: stage >= method.chain,
        inverse_h,
    };
    let scalars = |p: &Point<L, A, B, Q>| [p.theta, p.omega, p.p[0], p.p[1]];
    let (argument, carried) = weights.block(u, scalars(y), scalars(next), |u, k| match k {
        0 => u.theta,
        1 => u.omega,
        2 => u.p[0],
        _ => u.p[1],
    });
    [next.theta, next.omega, next.p[0], next.p[1]] = argument;
    [rhs.theta, rhs.omega, rhs.p[0], rhs.p[1]] = carried;
    let ([argument], [carried]) = weights.block(u, [y.lag], [next.lag], |u, _| u.lag);
    (next.lag, rhs.lag) = (argument, carried);
    macro_rules! array {
        ($q:ident, $kind:ident, $size:ident) => {
            weights.array(
                L::trip($size, c.$kind.used),
                u,
                &y.$q.$kind,
                &mut next.$q.$kind,
                &mut rhs.$q.$kind,
                |u| &u.$q.$kind,
            );
        };
    }
    array!(z, coupled, A);
    array!(v, coupled, A);
    array!(z, plain, B);
    array!(v, plain, B);
    array!(z, follower, Q);
    array!(v, follower, Q);
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
    /// Arguments and carried sums of `K` numbers.
    #[inline(always)]
    fn block<U, const K: usize>(
        &self,
        u: &[U],
        from: [L; K],
        previous: [L; K],
        get: impl Fn(&U, usize) -> L,
    ) -> ([L; K], [L; K]) {
        let mut argument = from;
        let mut carried = [L::splat(0.0); K];
        if let (true, Some(last)) = (self.chained, u.last()) {
            for (j, u) in u.iter().enumerate() {
                let c = L::splat(self.c[j]);
                for k in 0..K {
                    carried[k] += get(u, k) * c;
                }
            }
            for k in 0..K {
                argument[k] = previous[k] + get(last, k);
            }
        } else {
            for (j, u) in u.iter().enumerate() {
                let (a, c) = (L::splat(self.a[j]), L::splat(self.c[j]));
                for k in 0..K {
                    let x = get(u, k);
                    argument[k] += x * a;
                    carried[k] += x * c;
                }
            }
        }
        for carried in &mut carried {
            *carried = *carried * self.inverse_h;
        }
        (argument, carried)
    }

    /// The same for the first `count` of an array, four at a time.
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
        macro_rules! block {
            ($start:expr, $size:literal) => {
                let start = $start;
                let take = |x: &[L; N]| -> [L; $size] { std::array::from_fn(|k| x[start + k]) };
                let (a, c) = self.block(u, take(from), take(argument), |u, k| get(u)[start + k]);
                for k in 0..$size {
                    argument[start + k] = a[k];
                    carried[start + k] = c[k];
                }
            };
        }
        let whole = count - count % 4;
        let mut at = 0;
        while at < whole {
            block!(at, 4);
            at += 4;
        }
        match count % 4 {
            0 => {}
            1 => {
                block!(whole, 1);
            }
            2 => {
                block!(whole, 2);
            }
            _ => {
                block!(whole, 3);
            }
        }
    }
}

/// Σ (error / scale)² over pressures, rod travel, rod speed and strain energy.
#[inline(always)]
fn error2<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    w: &StepBuffer<L, A, B, Q>,
) -> L {
    let q = |x: K| x.pack();
    // The last increment of a stiffly accurate method is the difference to the embedded one.
    let u = &w.increments[w.increments.len() - 1];
    let j = w.factors.lengths();
    let a = sums!(L::trip(A, c.coupled.used), |i| {
        let (z, v) = (u.z.coupled[i], u.v.coupled[i]);
        [j.coupled[i] * z, j.coupled[i] * v, z * z * q(c.coupled.w2[i])]
    });
    let b = sums!(L::trip(B, c.plain.used), |i| {
        let (z, v) = (u.z.plain[i], u.v.plain[i]);
        [j.plain[i] * z, j.plain[i] * v, z * z * q(c.plain.w2[i])]
    });
    let [follower] = sums!(L::trip(Q, c.follower.used), |i| {
        let z = u.z.follower[i];
        [z * z * q(c.follower.w2[i])]
    });
    let jt = w.start.jt;
    let travel = (a[0] + b[0] + jt * u.theta) * q(c.scale.per_m);
    let speed = (a[1] + b[1] + jt * u.omega) * q(c.scale.per_m_per_s);
    let turn = jt * u.theta * q(c.scale.per_m);
    let spin = jt * u.omega * q(c.scale.per_m_per_s);
    let p = [u.p[0] * q(c.scale.per_pa), u.p[1] * q(c.scale.per_pa)];
    (a[2] + b[2] + follower) * q(c.scale.per_j)
        + (travel * travel + speed * speed)
        + (turn * turn + spin * spin)
        + (p[0] * p[0] + p[1] * p[1])
}
