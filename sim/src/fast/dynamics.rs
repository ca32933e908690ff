//! Right-hand side of the minimal-coordinate equations (`sim/theory/minimal_coordinates.md`, §2).

use super::constants::{Constants, Cylinder, ModeSet};
use super::elementary::{exp, sin_cos, tanh};
use super::lane::{Coefficient, Lane};
use super::sums::sums;
use hydroflex_openapi::machine::{EndStopSpec, FrictionSpec};

/// A number per mode, by what the modes take part in.
#[derive(Debug, Clone, Copy)]
pub(super) struct PerMode<L, const A: usize, const B: usize, const Q: usize> {
    /// Coupled modes.
    pub(super) coupled: [L; A],
    /// Plain modes.
    pub(super) plain: [L; B],
    /// Followers.
    pub(super) follower: [L; Q],
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> PerMode<L, A, B, Q> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            coupled: [o; A],
            plain: [o; B],
            follower: [o; Q],
        }
    }
}

/// State: angle θ, modal coordinates z, their rates, pressures, lagged force.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point<L, const A: usize, const B: usize, const Q: usize> {
    /// θ, rad.
    pub(super) theta: L,
    /// ω, rad/s.
    pub(super) omega: L,
    /// Piston side, rod side, Pa.
    pub(super) p: [L; 2],
    /// Force along the cylinder with the lag of the modes that have no state, N.
    pub(super) lag: L,
    /// z, m √kg.
    pub(super) z: PerMode<L, A, B, Q>,
    /// v = dz/dt.
    pub(super) v: PerMode<L, A, B, Q>,
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> Point<L, A, B, Q> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let zero = L::splat(0.0);
        Self {
            theta: zero,
            omega: zero,
            p: [zero; 2],
            lag: zero,
            z: PerMode::zero(),
            v: PerMode::zero(),
        }
    }
}

/// What the valve and the constraints of a step are; constant in a step but for the opening.
#[derive(Debug, Clone, Copy)]
pub(super) struct Regime<L> {
    /// Magnitude of the opening at the start of the step.
    pub(super) opening: L,
    /// Its rate, 1/s.
    pub(super) opening_per_s: L,
    /// Pressure of the line to which each chamber is connected, Pa.
    pub(super) line_pa: [L; 2],
    /// 1, or 0 for a chamber that stays at vapour pressure.
    pub(super) filled: [L; 2],
}

/// Accelerations, pressure rates, and what the recorder needs of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rates<L, const A: usize, const B: usize, const Q: usize> {
    /// α = dω/dt.
    pub(super) alpha: L,
    /// dv/dt.
    pub(super) a: PerMode<L, A, B, Q>,
    /// Pressure rates as if every chamber were filled, Pa/s.
    pub(super) p_raw: [L; 2],
    /// Pressure rates, Pa/s.
    pub(super) p: [L; 2],
    /// Rate of the lagged force, N/s.
    pub(super) lag: L,
    /// Eye-to-eye length, m.
    pub(super) length: L,
    /// Its rate, m/s.
    pub(super) speed: L,
    /// Force of oil and viscous damping, tension positive, N.
    pub(super) cylinder_force: L,
    /// Sum of all forces along the cylinder, tension positive, N.
    pub(super) force: L,
    /// ∂length/∂θ.
    pub(super) jt: L,
    /// Θ(z); filled with the slopes.
    pub(super) inertia: L,
    /// h(z) of coupled modes.
    pub(super) h: [L; A],
    /// h(z) of plain modes.
    pub(super) h_plain: [L; B],
    /// h(z) of followers.
    pub(super) h_follower: [L; Q],
    /// Unit vector along the cylinder, body frame.
    pub(super) n: [L; 3],
    /// Cylinder base relative to the pivot, body frame.
    pub(super) base: [L; 2],
    /// Gravity, body frame.
    pub(super) gravity: [L; 2],
    /// First moment that gravity acts on.
    pub(super) moment: [L; 2],
    /// What only the linearisation needs.
    pub(super) slopes: Slopes<L>,
}

/// Derivatives of forces and flows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slopes<L> {
    /// 1 / chamber compliance, Pa/m³, 0 for a chamber at vapour pressure.
    pub(super) stiffness: [L; 2],
    /// −∂flow/∂pressure, m³/(s Pa).
    pub(super) leak: [L; 2],
    /// ∂flow/∂opening.
    pub(super) gain: [L; 2],
    /// ∂force/∂speed at fixed pressures, N s/m.
    pub(super) damping: L,
    /// ∂force/∂length at fixed pressures, N/m.
    pub(super) spring: L,
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> Rates<L, A, B, Q> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            alpha: o,
            a: PerMode::zero(),
            p_raw: [o; 2],
            p: [o; 2],
            lag: o,
            length: o,
            speed: o,
            cylinder_force: o,
            force: o,
            jt: o,
            inertia: o,
            h: [o; A],
            h_plain: [o; B],
            h_follower: [o; Q],
            n: [o; 3],
            base: [o; 2],
            gravity: [o; 2],
            moment: [o; 2],
            slopes: Slopes {
                stiffness: [o; 2],
                leak: [o; 2],
                gain: [o; 2],
                damping: o,
                spring: o,
            },
        }
    }
}

/// Direction of the body frame, from which later ones of the same step are turned.
#[derive(Debug, Clone, Copy)]
pub(super) struct Heading<L> {
    theta: L,
    sine: L,
    cosine: L,
}

/// Largest turn of the body within a step, rad: beyond it [`Heading::turned`] loses digits.
pub(super) const LARGEST_TURN_RAD: f64 = 0.2;

impl<L: Lane> Heading<L> {
    /// Of any angle.
    #[inline(always)]
    pub(super) fn new(theta: L) -> Self {
        let (sine, cosine) = sin_cos(theta);
        Self { theta, sine, cosine }
    }

    /// Of an angle close by: Taylor series of the difference, within 1e-12 for 0.2 rad.
    #[inline(always)]
    fn turned(&self, theta: L) -> Self {
        let k = |x: f64| L::splat(x);
        let x = theta - self.theta;
        let x2 = x * x;
        let s = x * (k(1.0) + x2 * (k(-1.0 / 6.0) + x2 * (k(1.0 / 120.0) + x2 * k(-1.0 / 5040.0))));
        let c = x2 * (k(-0.5) + x2 * (k(1.0 / 24.0) + x2 * (k(-1.0 / 720.0) + x2 * k(1.0 / 40320.0))));
        Self {
            theta,
            sine: self.sine + (self.sine * c + self.cosine * s),
            cosine: self.cosine + (self.cosine * c - self.sine * s),
        }
    }

    /// A vector of the global frame in the body frame.
    #[inline(always)]
    fn body(&self, v: [f64; 2]) -> [L; 2] {
        let k = |x: f64| L::splat(x);
        [
            self.cosine * k(v[0]) + self.sine * k(v[1]),
            self.cosine * k(v[1]) - self.sine * k(v[0]),
        ]
    }
}

/// Evaluates the right-hand side at `y` with the valve opened by `opening`; `heading` is that of the
/// step. `SLOPES` fills [`Rates::slopes`] too.
#[inline(always)]
pub(super) fn evaluate<
    const SLOPES: bool,
    L: Lane,
    K: Coefficient<L>,
    const A: usize,
    const B: usize,
    const Q: usize,
>(
    c: &Constants<K, A, B, Q>,
    y: &Point<L, A, B, Q>,
    heading: &Heading<L>,
    opening: L,
    regime: &Regime<L>,
    r: &mut Rates<L, A, B, Q>,
) {
    let k = |x: f64| L::splat(x);
    let q = |x: K| x.pack();
    let heading = heading.turned(y.theta);
    r.base = heading.body(c.base_m);
    r.gravity = heading.body(c.gravity_m_per_s2);
    let [gx, gy] = r.gravity;

    // Geometry of the cylinder
    let (z, v, set) = (&y.z.coupled, &y.v.coupled, &c.coupled);
    let coupled = sums!(L::trip(A, set.used), |i| {
        let [x, y, axial] = [q(set.rod[0][i]), q(set.rod[1][i]), q(set.rod[2][i])];
        [
            z[i] * x,
            z[i] * y,
            z[i] * axial,
            v[i] * x,
            v[i] * y,
            v[i] * axial,
            z[i] * q(set.moment[0][i]),
            z[i] * q(set.moment[1][i]),
            z[i] * q(c.hub_change[i]),
            v[i] * q(c.c[i]),
        ]
    });
    let (z, v, set) = (&y.z.plain, &y.v.plain, &c.plain);
    let plain = sums!(L::trip(B, set.used), |i| {
        let [x, y, axial] = [q(set.rod[0][i]), q(set.rod[1][i]), q(set.rod[2][i])];
        [
            z[i] * x,
            z[i] * y,
            z[i] * axial,
            v[i] * x,
            v[i] * y,
            v[i] * axial,
            z[i] * q(set.moment[0][i]),
            z[i] * q(set.moment[1][i]),
        ]
    });
    let rod = [
        (coupled[0] + plain[0]) + k(c.rod_m[0]),
        (coupled[1] + plain[1]) + k(c.rod_m[1]),
        (coupled[2] + plain[2]) + k(c.rod_m[2]),
    ];
    let d = [rod[0] - r.base[0], rod[1] - r.base[1], rod[2]];
    r.length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let reciprocal = k(1.0) / r.length;
    let n = [d[0] * reciprocal, d[1] * reciprocal, d[2] * reciprocal];
    r.n = n;
    r.jt = rod[0] * n[1] - rod[1] * n[0];
    let stretch =
        n[0] * (coupled[3] + plain[3]) + n[1] * (coupled[4] + plain[4]) + n[2] * (coupled[5] + plain[5]);
    r.speed = r.jt * y.omega + stretch;
    r.moment = [
        (coupled[6] + plain[6]) + q(c.moment_kg_m[0]),
        (coupled[7] + plain[7]) + q(c.moment_kg_m[1]),
    ];
    let (gz, cv) = (coupled[8], coupled[9]);

    hydraulics::<SLOPES, _, A, B, Q>(&c.cylinder, y, opening, regime, r);
    r.lag = (r.force - y.lag) * q(c.lag_per_s);

    // Modal forces without the couplings of the rotation
    let push = [r.force * n[0], r.force * n[1], r.force * n[2]];
    let omega2 = y.omega * y.omega;
    loads(
        &c.coupled,
        [gx, gy],
        push,
        &y.z.coupled,
        &y.v.coupled,
        &mut r.a.coupled,
    );
    loads(&c.plain, [gx, gy], push, &y.z.plain, &y.v.plain, &mut r.a.plain);
    loads(
        &c.follower,
        [gx, gy],
        push,
        &y.z.follower,
        &y.v.follower,
        &mut r.a.follower,
    );
    let (curvature, bzv) = products(c, y, omega2, r);
    let hub = q(c.hub_kg_m2) + (gz + gz) + curvature;
    let coriolis = (y.omega + y.omega) * (cv + bzv);
    let torque = r.moment[0] * gy - r.moment[1] * gx - r.force * r.jt - coriolis;

    // Θ α + h·a = torque, h α + a = q
    let [hq] = sums!(L::trip(A, c.coupled.used), |i| [r.h[i] * r.a.coupled[i]]);
    let [plain_hq] = sums!(L::trip(B, c.plain.used), |i| [r.h_plain[i] * r.a.plain[i]]);
    if SLOPES {
        let [hh] = sums!(L::trip(A, c.coupled.used), |i| [r.h[i] * r.h[i]]);
        let [plain_hh] = sums!(L::trip(B, c.plain.used), |i| [r.h_plain[i] * r.h_plain[i]]);
        r.inertia = hub + (hh + plain_hh);
    }
    r.alpha = (torque - (hq + plain_hq)) / hub;
    for i in 0..L::trip(A, c.coupled.used) {
        r.a.coupled[i] -= r.h[i] * r.alpha;
    }
    for i in 0..L::trip(B, c.plain.used) {
        r.a.plain[i] -= r.h_plain[i] * r.alpha;
    }
    for i in 0..L::trip(Q, c.follower.used) {
        r.a.follower[i] -= r.h_follower[i] * r.alpha;
    }
}

/// Weight, cylinder force along `push`, elastic and damping forces of modes.
#[inline(always)]
fn loads<L: Lane, K: Coefficient<L>, const N: usize>(
    set: &ModeSet<K, N>,
    gravity: [L; 2],
    push: [L; 3],
    z: &[L; N],
    v: &[L; N],
    a: &mut [L; N],
) {
    let q = |x: K| x.pack();
    for i in 0..L::trip(N, set.used) {
        let weight =
            gravity[0] * q(set.weight[0][i]) + gravity[1] * q(set.weight[1][i]) + q(set.weight_axial[i]);
        let force = push[0] * q(set.rod[0][i]) + push[1] * q(set.rod[1][i]) + push[2] * q(set.rod[2][i]);
        a[i] = (weight - force) - (z[i] * q(set.w2[i]) + v[i] * q(set.d[i]));
    }
}

/// C z and C v for modes of another kind, z and v those of the coupled ones.
#[inline(always)]
fn rows<L: Lane, K: Coefficient<L>, const A: usize, const N: usize>(
    matrix: &[[K; N]; A],
    columns: usize,
    count: usize,
    z: &[L; A],
    v: &[L; A],
) -> ([L; N], [L; N]) {
    let mut cz = [L::splat(0.0); N];
    let mut cv = [L::splat(0.0); N];
    for j in 0..columns {
        for i in 0..count {
            cz[i] += z[j] * matrix[j][i].pack();
            cv[i] += v[j] * matrix[j][i].pack();
        }
    }
    (cz, cv)
}

/// Inertia products with the coupled modes: sets h, adds to the modal forces, returns zᵀGz and vᵀBz.
#[inline(always)]
fn products<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    y: &Point<L, A, B, Q>,
    omega2: L,
    r: &mut Rates<L, A, B, Q>,
) -> (L, L) {
    let count = L::trip(A, c.coupled.used);
    let zero = L::splat(0.0);
    let (z, v) = (&y.z.coupled, &y.v.coupled);
    let mut bz = [zero; A];
    let mut cz = [zero; A];
    let mut cv = [zero; A];
    let mut gz = [zero; A];
    for j in 0..count {
        for i in 0..count {
            bz[i] += z[j] * c.b[j][i].pack();
            cz[i] += z[j] * c.cc[j][i].pack();
            cv[i] += v[j] * c.cc[j][i].pack();
            gz[i] += z[j] * c.hub_curvature[j][i].pack();
        }
    }
    let twice = y.omega + y.omega;
    for i in 0..count {
        r.h[i] = c.coupled.h0[i].pack() - cz[i];
        r.a.coupled[i] += twice * cv[i] + omega2 * (c.c[i].pack() + bz[i]);
    }
    let (cz, cv) = rows(&c.plain_cc, count, L::trip(B, c.plain.used), z, v);
    for i in 0..L::trip(B, c.plain.used) {
        r.h_plain[i] = c.plain.h0[i].pack() - cz[i];
        r.a.plain[i] += twice * cv[i] + omega2 * c.plain_c[i].pack();
    }
    let (cz, cv) = rows(&c.follower_cc, count, L::trip(Q, c.follower.used), z, v);
    for i in 0..L::trip(Q, c.follower.used) {
        r.h_follower[i] = c.follower.h0[i].pack() - cz[i];
        r.a.follower[i] += twice * cv[i] + omega2 * c.follower_c[i].pack();
    }
    let [curvature, bzv] = sums!(count, |i| [z[i] * gz[i], v[i] * bz[i]]);
    (curvature, bzv)
}

/// Forces along the cylinder and pressure rates.
#[inline(always)]
fn hydraulics<const SLOPES: bool, L: Lane, const A: usize, const B: usize, const Q: usize>(
    c: &Cylinder,
    y: &Point<L, A, B, Q>,
    opening: L,
    regime: &Regime<L>,
    r: &mut Rates<L, A, B, Q>,
) {
    let k = |x: f64| L::splat(x);
    let area = [k(c.area_m2[0]), k(c.area_m2[1])];
    r.cylinder_force = y.p[1] * area[1] - y.p[0] * area[0] + k(c.damping) * r.speed;
    let u = r.length - k(c.spring[3]);
    let cubic = k(c.spring[1]) * u * u;
    r.force = r.cylinder_force + k(c.spring[0]) * u + k(c.spring[2]) * r.speed + cubic * u;
    let (friction, slope) = friction(&c.friction, r.speed);
    r.force += friction;
    let mut damping = k(c.damping + c.spring[2]) + slope;
    let mut spring = k(c.spring[0]) + cubic + cubic + cubic;
    let stroke = r.length - k(c.closed_length_m);
    let left = k(c.stroke_m) - stroke;
    if let Some(stop) = &c.stop {
        for (depth, rate, sign) in [(-stroke, -r.speed, -1.0), (-left, r.speed, 1.0)] {
            let contact = end_stop(stop, depth, rate, k(sign));
            r.force += contact.force;
            damping += contact.damping;
            spring += contact.spring;
        }
    }
    // One division for both chambers. One whose piston has left the barrel keeps a hundredth of the hose.
    let compliance = |i: usize, chamber: L| {
        let least = k(0.01 * c.compliance_m3_per_pa[i]);
        let compliance = k(c.compliance_m3_per_pa[i]) + k(c.compliance_slope_m2_per_pa[i]) * chamber;
        least.where_less(compliance, least, compliance)
    };
    let compliance = [compliance(0, stroke), compliance(1, left)];
    let both = k(1.0) / (compliance[0] * compliance[1]);
    let stiffness = [compliance[1] * both, compliance[0] * both];
    let swept = [-(area[0] * r.speed), area[1] * r.speed];
    for i in 0..2 {
        let drop = regime.line_pa[i] - y.p[i];
        let root = drop.abs().sqrt();
        let gain = (k(c.flow) * root).copysign(drop);
        r.p_raw[i] = stiffness[i] * (swept[i] + opening * gain);
        r.p[i] = r.p_raw[i] * regime.filled[i];
        if SLOPES {
            r.slopes.gain[i] = gain;
            // The slope of the root is infinite at zero drop; the cap is in the Jacobian only.
            r.slopes.leak[i] = opening * k(0.5 * c.flow) / root.max(k(30.0));
            r.slopes.stiffness[i] = stiffness[i] * regime.filled[i];
        }
    }
    if SLOPES {
        r.slopes.damping = damping;
        r.slopes.spring = spring;
    }
}

/// Depth over which the damping of a stop grows to its full value, m; the force is continuous.
const STOP_DAMPING_DEPTH_M: f64 = 1e-4;

/// Force of an end stop along the cylinder, and its slopes over speed and length.
struct Contact<L> {
    force: L,
    damping: L,
    spring: L,
}

/// One end stop: `k depth + d min(1, depth/δ) (depth rate)`, never pulling; `sign` −1 at the inner
/// stop, which pushes the eyes apart.
#[inline(always)]
fn end_stop<L: Lane>(stop: &EndStopSpec, depth: L, rate: L, sign: L) -> Contact<L> {
    let k = |x: f64| L::splat(x);
    let (zero, one) = (k(0.0), k(1.0));
    let share = depth * k(1.0 / STOP_DAMPING_DEPTH_M);
    let ramp = k(stop.damping_n_s_per_m / STOP_DAMPING_DEPTH_M) * rate;
    let ramp = ramp.where_less(share, one, zero);
    let share = share.where_less(share, one, one);
    let damping = k(stop.damping_n_s_per_m) * share;
    let push = k(stop.stiffness_n_per_m) * depth + damping * rate;
    // Both conditions in one number: the smaller of depth and push must be positive.
    let touching = depth.where_less(depth, push, push);
    let stiffness = k(stop.stiffness_n_per_m) + ramp;
    Contact {
        force: (sign * push).where_less(zero, touching, zero),
        damping: damping.where_less(zero, touching, zero),
        spring: stiffness.where_less(zero, touching, zero),
    }
}

/// Friction force (tension positive) and its slope over speed (theory note §8).
#[inline(always)]
fn friction<L: Lane>(law: &FrictionSpec, speed: L) -> (L, L) {
    let k = |x: f64| L::splat(x);
    match *law {
        FrictionSpec::None => (k(0.0), k(0.0)),
        FrictionSpec::BrownMcphee {
            coulomb_n,
            static_n,
            viscous_n_s_per_m,
            transition_velocity_m_per_s,
        } => {
            let x = speed * k(1.0 / transition_velocity_m_per_s);
            let t = tanh(x * k(4.0));
            let bend = k(0.25) * x * x + k(0.75);
            let inverse = k(1.0) / bend;
            let square = inverse * inverse;
            let peak = k(static_n - coulomb_n);
            let force = k(coulomb_n) * t + peak * x * square + k(viscous_n_s_per_m) * speed;
            // d/dx [x / b²] = (b − x b' 2)/b³ with b' = x/2
            let slope = k(4.0 * coulomb_n) * (k(1.0) - t * t) + peak * (bend - x * x) * square * inverse;
            (
                force,
                slope * k(1.0 / transition_velocity_m_per_s) + k(viscous_n_s_per_m),
            )
        }
        FrictionSpec::Stribeck {
            dynamic_n,
            static_offset_n,
            decay_velocity_m_per_s,
            regularisation_velocity_m_per_s,
        } => {
            let size = speed.abs();
            let width = k(regularisation_velocity_m_per_s);
            let decay = k(1.0 / decay_velocity_m_per_s);
            let beyond = (size - width) * decay;
            // exp is used where `beyond` is positive only; its argument is kept in range.
            let clipped = k(0.0).max(beyond);
            let clipped = clipped.where_less(clipped, k(600.0), k(600.0));
            let drop = k(static_offset_n) * exp(-clipped);
            let outside = (k(dynamic_n) + drop).copysign(speed);
            let steep = k((dynamic_n + static_offset_n) / regularisation_velocity_m_per_s);
            let inside = steep * speed;
            (
                inside.where_less(size, width, outside),
                steep.where_less(size, width, -(drop * decay)),
            )
        }
    }
}
