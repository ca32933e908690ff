//! The linear system of a Rosenbrock stage in O(n): an arrow matrix and a rank-one update
//! (`sim/theory/minimal_coordinates.md`, §4).

use super::constants::Constants;
use super::dynamics::{Point, Rates};
use super::lane::Lane;
use super::sums::sums;

/// Factors of one step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Factors<L, const N: usize> {
    /// s = γ step.
    s: L,
    /// −∂torque/∂θ without the cylinder's rank-one part.
    k_tt: L,
    /// −∂torque/∂z = −∂q/∂θ of coupled modes, likewise.
    k_tz: [L; N],
    /// s w².
    s_w2: [L; N],
    /// s/(1 + s d + s² w²).
    inverse: [L; N],
    /// Off-diagonal over diagonal of the arrow.
    ratio: [L; N],
    /// s / Schur complement of θ.
    schur: L,
    /// s S⁻¹ J, θ.
    gt: L,
    /// s S⁻¹ J, z.
    g: [L; N],
    /// J · s S⁻¹ J.
    jg: L,
    /// D* + s K*: weight of J·u in the rank-one update.
    weight: L,
    /// s D* J̇_θ: weight of u_ω in it.
    weight_t: L,
    /// 1/(1 + row · s S⁻¹ J).
    update: L,
    /// D* J̇_θ.
    d_star_jd: L,
    /// K*: stiffness of the cylinder with its oil.
    k_star: L,
    /// J̇_θ = ∂speed/∂θ.
    jd: L,
    /// κ = s/(1 + s E ∂Q/∂p).
    kappa: [L; 2],
    /// ∂ṗ/∂length.
    e_length: [L; 2],
    /// ∂ṗ/∂speed.
    e_speed: [L; 2],
    /// Areas, m².
    area: [L; 2],
    /// s/(1 + s/lag).
    lag: L,
}

impl<L: Lane, const N: usize> Factors<L, N> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            s: o,
            k_tt: o,
            k_tz: [o; N],
            s_w2: [o; N],
            inverse: [o; N],
            ratio: [o; N],
            schur: o,
            gt: o,
            g: [o; N],
            jg: o,
            weight: o,
            weight_t: o,
            update: o,
            d_star_jd: o,
            k_star: o,
            jd: o,
            kappa: [o; 2],
            e_length: [o; 2],
            e_speed: [o; 2],
            area: [o; 2],
            lag: o,
        }
    }
}

/// Linearises at `y`, where the right-hand side is `r`, for s = γ step.
#[inline(always)]
pub(super) fn factor<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    y: &Point<L, N>,
    r: &Rates<L, N>,
    s: L,
    f: &mut Factors<L, N>,
) {
    let count = L::trip(N, c.used);
    let k = |x: f64| L::splat(x);
    let one = k(1.0);
    let s2 = s * s;
    let reciprocal = one / r.length;
    // dn/dθ: the base turns backwards in the body frame.
    let dn = [
        (-r.base[1] - r.n[0] * r.jt) * reciprocal,
        (r.base[0] - r.n[1] * r.jt) * reciprocal,
        -(r.n[2] * r.jt) * reciprocal,
    ];
    // dJt/dθ = (p·b − Jt²)/L with p = b + L n
    let pb = (r.base[0] * r.base[0] + r.base[1] * r.base[1])
        + r.length * (r.n[0] * r.base[0] + r.n[1] * r.base[1]);
    let djt = (pb - r.jt * r.jt) * reciprocal;
    let [gx, gy] = r.gravity;
    f.s = s;
    f.k_tt = r.moment[0] * gx + r.moment[1] * gy + r.force * djt;
    let coupled = L::trip(A, c.coupled);
    let mut dj = [k(0.0); A];
    for i in 0..coupled {
        dj[i] = dn[0] * k(c.rod[0][i]) + dn[1] * k(c.rod[1][i]) + dn[2] * k(c.rod[2][i]);
        f.k_tz[i] = gx * k(c.weight[1][i]) - gy * k(c.weight[0][i]) + r.force * dj[i];
    }
    let [stretch] = sums(coupled, |i| [dj[i] * y.v[i]]);
    f.jd = djt * y.omega + stretch;
    let mut off = r.h;
    for i in 0..coupled {
        off[i] += s2 * f.k_tz[i];
    }
    for i in 0..count {
        f.s_w2[i] = s * k(c.w2[i]);
        let inverse = one / (one + s * (k(c.d[i]) + f.s_w2[i]));
        f.ratio[i] = off[i] * inverse;
        f.inverse[i] = s * inverse;
    }
    let [fill] = sums(count, |i| [off[i] * f.ratio[i]]);
    f.schur = s / (r.inertia + s2 * f.k_tt - fill);

    // Pressures by hand: u = κ (r ∓ E A δspeed + e δlength)
    f.area = [k(c.cylinder.area_m2[0]), k(c.cylinder.area_m2[1])];
    let slope = &c.cylinder.compliance_slope_m2_per_pa;
    for i in 0..2 {
        f.kappa[i] = s / (one + s * r.leak[i] * r.stiffness[i]);
    }
    f.e_speed = [-(r.stiffness[0] * f.area[0]), r.stiffness[1] * f.area[1]];
    f.e_length = [
        -(r.p[0] * r.stiffness[0] * k(slope[0])),
        r.p[1] * r.stiffness[1] * k(slope[1]),
    ];
    let to_force = [-(f.area[0] * f.kappa[0]), f.area[1] * f.kappa[1]];
    let d_star = r.damping + to_force[0] * f.e_speed[0] + to_force[1] * f.e_speed[1];
    f.k_star = r.spring + to_force[0] * f.e_length[0] + to_force[1] * f.e_length[1];
    f.d_star_jd = d_star * f.jd;
    f.weight = d_star + s * f.k_star;
    f.weight_t = s * f.d_star_jd;
    f.lag = s / (one + s * k(c.lag_per_s));

    (f.gt, f.g) = arrow(c, f, r.jt, &r.j);
    let [jg] = sums(count, |i| [r.j[i] * f.g[i]]);
    f.jg = r.jt * f.gt + jg;
    f.update = one / (one + f.weight * f.jg + f.weight_t * f.gt);
}

/// Solves the arrow part alone, for s times the right-hand side.
#[inline(always)]
fn arrow<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    f: &Factors<L, N>,
    bt: L,
    b: &[L; N],
) -> (L, [L; N]) {
    let count = L::trip(N, c.used);
    let [below] = sums(count, |i| [f.ratio[i] * b[i]]);
    let xt = (bt - below) * f.schur;
    let mut x = [L::splat(0.0); N];
    for i in 0..count {
        x[i] = f.inverse[i] * b[i] - f.ratio[i] * xt;
    }
    (xt, x)
}

/// Solves (1/s − Jacobian) u = rhs. `r0` holds the step's linearisation point; θ and z of `rhs` and
/// `u` are positions, ω and v rates.
#[inline(always)]
pub(super) fn solve<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    f: &Factors<L, N>,
    r0: &Rates<L, N>,
    rhs: &Point<L, N>,
    u: &mut Point<L, N>,
) {
    let count = L::trip(N, c.used);
    let coupled = L::trip(A, c.coupled);
    let s = f.s;
    let [rho, hv] = sums(count, |i| [r0.j[i] * rhs.z[i], r0.h[i] * rhs.v[i]]);
    let [kz] = sums(coupled, |i| [f.k_tz[i] * rhs.z[i]]);
    let rho = r0.jt * rhs.theta + rho;
    let from_pressure = f.area[1] * f.kappa[1] * rhs.p[1] - f.area[0] * f.kappa[0] * rhs.p[0];
    let known = from_pressure + s * (f.d_star_jd * rhs.theta + f.k_star * rho);
    let bt = r0.inertia * rhs.omega + hv - s * (f.k_tt * rhs.theta + kz) - known * r0.jt;
    let mut b = [L::splat(0.0); N];
    for i in 0..count {
        b[i] = r0.h[i] * rhs.omega + rhs.v[i] - f.s_w2[i] * rhs.z[i] - known * r0.j[i];
    }
    let turned = s * rhs.theta;
    for i in 0..coupled {
        b[i] -= f.k_tz[i] * turned;
    }
    let (xt, x) = arrow(c, f, bt, &b);
    let [jx] = sums(count, |i| [r0.j[i] * x[i]]);
    let jx = r0.jt * xt + jx;
    let pull = (f.weight * jx + f.weight_t * xt) * f.update;
    u.omega = xt - pull * f.gt;
    for i in 0..count {
        u.v[i] = x[i] - pull * f.g[i];
        u.z[i] = s * (u.v[i] + rhs.z[i]);
    }
    u.theta = s * (u.omega + rhs.theta);
    let ju = jx - pull * f.jg;
    let d_length = s * (ju + rho);
    let d_speed = ju + f.jd * u.theta;
    for i in 0..2 {
        u.p[i] = f.kappa[i] * (rhs.p[i] + f.e_speed[i] * d_speed + f.e_length[i] * d_length);
    }
    let d_force = r0.damping * d_speed + r0.spring * d_length + f.area[1] * u.p[1] - f.area[0] * u.p[0];
    u.lag = f.lag * (rhs.lag + d_force * L::splat(c.lag_per_s));
}
