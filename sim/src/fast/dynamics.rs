//! Right-hand side of the minimal-coordinate equations (`sim/theory/minimal_coordinates.md`, §2).

use super::constants::{Constants, Cylinder};
use super::elementary::{exp, sin_cos, tanh};
use super::lane::Lane;
use super::sums::sums;
use hydroflex_openapi::machine::{EndStopSpec, FrictionSpec};

/// State: angle θ, modal coordinates z, their rates, pressures.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point<L, const N: usize> {
    /// θ, rad.
    pub(super) theta: L,
    /// z, m √kg.
    pub(super) z: [L; N],
    /// ω, rad/s.
    pub(super) omega: L,
    /// v = dz/dt.
    pub(super) v: [L; N],
    /// Piston side, rod side, Pa.
    pub(super) p: [L; 2],
}

impl<L: Lane, const N: usize> Point<L, N> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let zero = L::splat(0.0);
        Self {
            theta: zero,
            z: [zero; N],
            omega: zero,
            v: [zero; N],
            p: [zero; 2],
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

/// Accelerations, pressure rates, and what the Jacobian and the recorder need of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rates<L, const N: usize> {
    /// α = dω/dt.
    pub(super) alpha: L,
    /// dv/dt.
    pub(super) a: [L; N],
    /// Pressure rates as if every chamber were filled, Pa/s.
    pub(super) p_raw: [L; 2],
    /// Pressure rates, Pa/s.
    pub(super) p: [L; 2],
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
    /// ∂length/∂z.
    pub(super) j: [L; N],
    /// Θ(z).
    pub(super) inertia: L,
    /// h(z).
    pub(super) h: [L; N],
    /// Unit vector along the cylinder, body frame.
    pub(super) n: [L; 3],
    /// Cylinder base relative to the pivot, body frame.
    pub(super) base: [L; 2],
    /// Gravity, body frame.
    pub(super) gravity: [L; 2],
    /// First moment that gravity acts on.
    pub(super) moment: [L; 2],
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

impl<L: Lane, const N: usize> Rates<L, N> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            alpha: o,
            a: [o; N],
            p_raw: [o; 2],
            p: [o; 2],
            length: o,
            speed: o,
            cylinder_force: o,
            force: o,
            jt: o,
            j: [o; N],
            inertia: o,
            h: [o; N],
            n: [o; 3],
            base: [o; 2],
            gravity: [o; 2],
            moment: [o; 2],
            stiffness: [o; 2],
            leak: [o; 2],
            gain: [o; 2],
            damping: o,
            spring: o,
        }
    }
}

/// Evaluates the right-hand side at `y` with the valve opened by `opening`.
#[inline(always)]
pub(super) fn evaluate<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    y: &Point<L, N>,
    opening: L,
    regime: &Regime<L>,
    r: &mut Rates<L, N>,
) {
    let count = L::trip(N, c.used);
    let k = |x: f64| L::splat(x);
    let (sine, cosine) = sin_cos(y.theta);
    let turn = |v: [f64; 2]| {
        [
            cosine * k(v[0]) + sine * k(v[1]),
            cosine * k(v[1]) - sine * k(v[0]),
        ]
    };
    r.base = turn(c.base_m);
    r.gravity = turn(c.gravity_m_per_s2);
    let [gx, gy] = r.gravity;

    // Geometry of the cylinder
    let shift = sums(count, |i| {
        [
            y.z[i] * k(c.rod[0][i]),
            y.z[i] * k(c.rod[1][i]),
            y.z[i] * k(c.rod[2][i]),
        ]
    });
    let rod = [shift[0] + k(c.rod_m[0]), shift[1] + k(c.rod_m[1])];
    let d = [rod[0] - r.base[0], rod[1] - r.base[1], shift[2] + k(c.rod_m[2])];
    r.length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let reciprocal = k(1.0) / r.length;
    let n = [d[0] * reciprocal, d[1] * reciprocal, d[2] * reciprocal];
    r.n = n;
    r.jt = rod[0] * n[1] - rod[1] * n[0];
    for i in 0..count {
        r.j[i] = n[0] * k(c.rod[0][i]) + n[1] * k(c.rod[1][i]) + n[2] * k(c.rod[2][i]);
    }
    let [stretch, cz, cv, sx, sy] = sums(count, |i| {
        [
            r.j[i] * y.v[i],
            y.z[i] * k(c.c[i]),
            y.v[i] * k(c.c[i]),
            y.z[i] * k(c.moment[0][i]),
            y.z[i] * k(c.moment[1][i]),
        ]
    });
    r.speed = r.jt * y.omega + stretch;
    r.moment = [sx + k(c.moment_kg_m[0]), sy + k(c.moment_kg_m[1])];

    hydraulics(&c.cylinder, y, opening, regime, r);

    // Modal forces without the couplings of the rotation
    let omega2 = y.omega * y.omega;
    for i in 0..count {
        r.h[i] = k(c.h0[i]);
        r.a[i] = gx * k(c.weight[0][i]) + gy * k(c.weight[1][i]) + k(c.weight_axial[i])
            - r.force * r.j[i]
            - y.z[i] * k(c.w2[i])
            - y.v[i] * k(c.d[i])
            + omega2 * k(c.c[i]);
    }
    let (bzz, bzv) = products(c, y, omega2, r);
    r.inertia = k(c.inertia_kg_m2) + (cz + cz) + bzz;
    let coriolis = (y.omega + y.omega) * (cv + bzv);
    let torque = r.moment[0] * gy - r.moment[1] * gx - r.force * r.jt - coriolis;

    // Θ α + h·a = torque, h α + a = q
    let [hq, hh] = sums(count, |i| [r.h[i] * r.a[i], r.h[i] * r.h[i]]);
    r.alpha = (torque - hq) / (r.inertia - hh);
    for i in 0..count {
        r.a[i] -= r.h[i] * r.alpha;
    }
}

/// Inertia products of the coupled modes: adds to h and to the modal forces, returns zᵀBz and vᵀBz.
#[inline(always)]
fn products<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    y: &Point<L, N>,
    omega2: L,
    r: &mut Rates<L, N>,
) -> (L, L) {
    let coupled = L::trip(A, c.coupled);
    let zero = L::splat(0.0);
    let mut bz = [zero; A];
    let mut cz = [zero; A];
    let mut cv = [zero; A];
    for j in 0..coupled {
        for i in 0..coupled {
            bz[i] += y.z[j] * L::splat(c.b[j][i]);
            cz[i] += y.z[j] * L::splat(c.cc[j][i]);
            cv[i] += y.v[j] * L::splat(c.cc[j][i]);
        }
    }
    let twice = y.omega + y.omega;
    for i in 0..coupled {
        r.h[i] -= cz[i];
        r.a[i] += twice * cv[i] + omega2 * bz[i];
    }
    let [bzz, bzv] = sums(coupled, |i| [y.z[i] * bz[i], y.v[i] * bz[i]]);
    (bzz, bzv)
}

/// Forces along the cylinder and pressure rates.
#[inline(always)]
fn hydraulics<L: Lane, const N: usize>(
    c: &Cylinder,
    y: &Point<L, N>,
    opening: L,
    regime: &Regime<L>,
    r: &mut Rates<L, N>,
) {
    let k = |x: f64| L::splat(x);
    let area = [k(c.area_m2[0]), k(c.area_m2[1])];
    r.cylinder_force = y.p[1] * area[1] - y.p[0] * area[0] + k(c.damping) * r.speed;
    let u = r.length - k(c.spring[3]);
    let cubic = k(c.spring[1]) * u * u;
    r.force = r.cylinder_force + k(c.spring[0]) * u + k(c.spring[2]) * r.speed + cubic * u;
    r.damping = k(c.damping + c.spring[2]);
    r.spring = k(c.spring[0]) + cubic + cubic + cubic;
    let (friction, slope) = friction(&c.friction, r.speed);
    r.force += friction;
    r.damping += slope;
    let stroke = r.length - k(c.closed_length_m);
    let left = k(c.stroke_m) - stroke;
    if let Some(stop) = &c.stop {
        end_stop(stop, -stroke, -r.speed, k(-1.0), r);
        end_stop(stop, -left, r.speed, k(1.0), r);
    }
    let chamber = [stroke, left];
    let swept = [-(area[0] * r.speed), area[1] * r.speed];
    for i in 0..2 {
        // A chamber whose piston has left the barrel keeps a hundredth of the hose.
        let least = k(0.01 * c.compliance_m3_per_pa[i]);
        let compliance = k(c.compliance_m3_per_pa[i]) + k(c.compliance_slope_m2_per_pa[i]) * chamber[i];
        let compliance = least.where_less(compliance, least, compliance);
        let stiffness = k(1.0) / compliance;
        let drop = regime.line_pa[i] - y.p[i];
        let root = drop.abs().sqrt();
        r.gain[i] = (k(c.flow) * root).copysign(drop);
        // The slope of the root is infinite at zero drop; the cap is in the Jacobian only.
        r.leak[i] = opening * k(0.5 * c.flow) / root.max(k(30.0));
        r.p_raw[i] = stiffness * (swept[i] + opening * r.gain[i]);
        r.p[i] = r.p_raw[i] * regime.filled[i];
        r.stiffness[i] = stiffness * regime.filled[i];
    }
}

/// Depth over which the damping of a stop grows to its full value, m; the force is continuous.
const STOP_DAMPING_DEPTH_M: f64 = 1e-4;

/// Adds one end stop: `k depth + d min(1, depth/δ) (depth rate)`, never pulling; `sign` −1 at the
/// inner stop, which pushes the eyes apart.
#[inline(always)]
fn end_stop<L: Lane, const N: usize>(stop: &EndStopSpec, depth: L, rate: L, sign: L, r: &mut Rates<L, N>) {
    let k = |x: f64| L::splat(x);
    let (zero, one) = (k(0.0), k(1.0));
    let share = depth * k(1.0 / STOP_DAMPING_DEPTH_M);
    let ramp = k(stop.damping_n_s_per_m / STOP_DAMPING_DEPTH_M) * rate;
    let ramp = ramp.where_less(share, one, zero);
    let share = share.where_less(share, one, one);
    let damping = k(stop.damping_n_s_per_m) * share;
    let push = k(stop.stiffness_n_per_m) * depth + damping * rate;
    // Both conditions in one number: the smaller of depth and push must be positive.
    let contact = depth.where_less(depth, push, push);
    let stiffness = k(stop.stiffness_n_per_m) + ramp;
    r.force += (sign * push).where_less(zero, contact, zero);
    r.damping += damping.where_less(zero, contact, zero);
    r.spring += stiffness.where_less(zero, contact, zero);
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
