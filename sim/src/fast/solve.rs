//! The linear system of a Rosenbrock stage in O(n): an arrow matrix and a rank-one update
//! (`sim/theory/minimal_coordinates.md`, §4).

use super::constants::Constants;
use super::dynamics::{Point, Rates};
use super::lane::Lane;
use super::sums::sums;

/// Factors of one step, with s = γ step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Factors<L, const N: usize> {
    s: L,
    /// −∂(torque, q)/∂(θ, z) without the cylinder's rank-one part: θθ and θz; zz is w².
    k_tt: L,
    k_tz: [L; N],
    /// Reciprocal diagonal 1/(1 + s d + s² w²).
    inverse: [L; N],
    /// Off-diagonal over diagonal.
    ratio: [L; N],
    /// 1 / Schur complement of θ.
    schur: L,
    /// S⁻¹ J.
    gt: L,
    g: [L; N],
    /// s (D* + s K*): weight of J·u in the update; s² D* J̇_θ: weight of u_ω.
    weight: L,
    weight_t: L,
    /// 1/(1 + row · S⁻¹J).
    update: L,
    /// D* dJ/dt, K*, and the pressures' share of the force.
    d_star_jd: L,
    k_star: L,
    jd: L,
    kappa: [L; 2],
    e_length: [L; 2],
    e_speed: [L; 2],
    area: [L; 2],
}

impl<L: Lane, const N: usize> Factors<L, N> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            s: o,
            k_tt: o,
            k_tz: [o; N],
            inverse: [o; N],
            ratio: [o; N],
            schur: o,
            gt: o,
            g: [o; N],
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
    for i in 0..count {
        let dj = dn[0] * k(c.rod[0][i]) + dn[1] * k(c.rod[1][i]) + dn[2] * k(c.rod[2][i]);
        f.k_tz[i] = gx * k(c.weight[1][i]) - gy * k(c.weight[0][i]) + r.force * dj;
        f.g[i] = dj; // borrowed until the solve below
    }
    let [stretch] = sums(count, |i| [f.g[i] * y.v[i]]);
    f.jd = djt * y.omega + stretch;
    let mut off = [k(0.0); N];
    for i in 0..count {
        f.inverse[i] = one / (one + s * k(c.d[i]) + s2 * k(c.w2[i]));
        off[i] = r.h[i] + s2 * f.k_tz[i];
        f.ratio[i] = off[i] * f.inverse[i];
    }
    let [fill] = sums(count, |i| [off[i] * f.ratio[i]]);
    f.schur = one / (r.inertia + s2 * f.k_tt - fill);

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
    f.weight = s * (d_star + s * f.k_star);
    f.weight_t = s2 * f.d_star_jd;

    let (gt, g) = arrow(c, f, r.jt, &r.j);
    f.gt = gt;
    f.g = g;
    let [jg] = sums(count, |i| [r.j[i] * g[i]]);
    f.update = one / (one + f.weight * (r.jt * gt + jg) + f.weight_t * gt);
}

/// Solves the arrow part alone.
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
    let k = |x: f64| L::splat(x);
    let s = f.s;
    let s2 = s * s;
    let [rho, hv, kz] = sums(count, |i| {
        [r0.j[i] * rhs.z[i], r0.h[i] * rhs.v[i], f.k_tz[i] * rhs.z[i]]
    });
    let rho = r0.jt * rhs.theta + rho;
    let from_pressure = f.area[1] * f.kappa[1] * rhs.p[1] - f.area[0] * f.kappa[0] * rhs.p[0];
    let known = from_pressure + s * (f.d_star_jd * rhs.theta + f.k_star * rho);
    let push = s * known;
    let bt = s * (r0.inertia * rhs.omega + hv) - s2 * (f.k_tt * rhs.theta + kz) - push * r0.jt;
    let mut b = [k(0.0); N];
    for i in 0..count {
        b[i] = s * (r0.h[i] * rhs.omega + rhs.v[i])
            - s2 * (k(c.w2[i]) * rhs.z[i] + f.k_tz[i] * rhs.theta)
            - push * r0.j[i];
    }
    let (xt, x) = arrow(c, f, bt, &b);
    let [jx] = sums(count, |i| [r0.j[i] * x[i]]);
    let pull = (f.weight * (r0.jt * xt + jx) + f.weight_t * xt) * f.update;
    u.omega = xt - pull * f.gt;
    for i in 0..count {
        u.v[i] = x[i] - pull * f.g[i];
        u.z[i] = s * (u.v[i] + rhs.z[i]);
    }
    u.theta = s * (u.omega + rhs.theta);
    let [ju] = sums(count, |i| [r0.j[i] * u.v[i]]);
    let ju = r0.jt * u.omega + ju;
    let d_length = s * (ju + rho);
    let d_speed = ju + f.jd * u.theta;
    for i in 0..2 {
        u.p[i] = f.kappa[i] * (rhs.p[i] + f.e_speed[i] * d_speed + f.e_length[i] * d_length);
    }
}
