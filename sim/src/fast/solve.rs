//! The linear system of a Rosenbrock stage in O(n): an arrow matrix and a rank-one update
//! (`sim/theory/minimal_coordinates.md`, §4).

use super::constants::{Constants, ModeSet};
use super::dynamics::{PerMode, Point, Rates};
use super::lane::{Coefficient, Lane};
use super::sums::sums;

/// Factors of one step, with s = γ step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Factors<L, const A: usize, const B: usize, const Q: usize> {
    s: L,
    s2: L,
    /// −∂torque/∂θ without the cylinder's rank-one part.
    k_tt: L,
    /// −∂torque/∂z = −∂q/∂θ of coupled modes, likewise.
    k_tz: [L; A],
    /// J = ∂length/∂z.
    j: PerMode<L, A, B, Q>,
    /// Reciprocal diagonal 1/(1 + s d + s² w²).
    inverse: PerMode<L, A, B, Q>,
    /// Off-diagonal over diagonal of the arrow, and J over diagonal, of modes that act back.
    ratio: ([L; A], [L; B]),
    j_inverse: ([L; A], [L; B]),
    /// Σ ratio·h, ratio·k, ratio·J; J/diagonal·h, ·k, ·J.
    ratio_h: L,
    ratio_k: L,
    ratio_j: L,
    j_h: L,
    j_k: L,
    j_j: L,
    /// 1 / Schur complement of θ.
    schur: L,
    /// θ of S⁻¹ J, and J · S⁻¹ J.
    gt: L,
    jg: L,
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
    /// 1/(1/s + 1/lag).
    lag: L,
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> Factors<L, A, B, Q> {
    /// Zero everywhere.
    pub(super) fn zero() -> Self {
        let o = L::splat(0.0);
        Self {
            s: o,
            s2: o,
            k_tt: o,
            k_tz: [o; A],
            j: PerMode::zero(),
            inverse: PerMode::zero(),
            ratio: ([o; A], [o; B]),
            j_inverse: ([o; A], [o; B]),
            ratio_h: o,
            ratio_k: o,
            ratio_j: o,
            j_h: o,
            j_k: o,
            j_j: o,
            schur: o,
            gt: o,
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

impl<L, const A: usize, const B: usize, const Q: usize> Factors<L, A, B, Q> {
    /// J = ∂length/∂z.
    pub(super) fn lengths(&self) -> &PerMode<L, A, B, Q> {
        &self.j
    }
}

/// Linearises at `y`, where the right-hand side is `r`, for s = γ step.
#[inline(always)]
pub(super) fn factor<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    y: &Point<L, A, B, Q>,
    r: &Rates<L, A, B, Q>,
    s: L,
    f: &mut Factors<L, A, B, Q>,
) {
    let k = |x: f64| L::splat(x);
    let q = |x: K| x.pack();
    let one = k(1.0);
    let s2 = s * s;
    (f.s, f.s2) = (s, s2);
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
    f.k_tt = r.moment[0] * gx + r.moment[1] * gy + r.force * djt;
    diagonal(&c.coupled, s, s2, r.n, &mut f.j.coupled, &mut f.inverse.coupled);
    diagonal(&c.plain, s, s2, r.n, &mut f.j.plain, &mut f.inverse.plain);
    diagonal(
        &c.follower,
        s,
        s2,
        r.n,
        &mut f.j.follower,
        &mut f.inverse.follower,
    );

    // Coupled modes, whose weight and cylinder force turn with θ
    let coupled = L::trip(A, c.coupled.used);
    let set = &c.coupled;
    let mut dj = [k(0.0); A];
    let mut off = [k(0.0); A];
    for i in 0..coupled {
        dj[i] = dn[0] * q(set.rod[0][i]) + dn[1] * q(set.rod[1][i]) + dn[2] * q(set.rod[2][i]);
        f.k_tz[i] = gx * q(set.weight[1][i]) - gy * q(set.weight[0][i]) + r.force * dj[i];
        off[i] = r.h[i] + s2 * f.k_tz[i];
        f.ratio.0[i] = off[i] * f.inverse.coupled[i];
        f.j_inverse.0[i] = f.j.coupled[i] * f.inverse.coupled[i];
    }
    let (ratio, j_inverse) = (&f.ratio.0, &f.j_inverse.0);
    let [stretch, fill, ratio_h, ratio_k, ratio_j, j_h, j_k, j_j] = sums!(coupled, |i| {
        [
            dj[i] * y.v.coupled[i],
            off[i] * ratio[i],
            ratio[i] * r.h[i],
            ratio[i] * f.k_tz[i],
            ratio[i] * f.j.coupled[i],
            j_inverse[i] * r.h[i],
            j_inverse[i] * f.k_tz[i],
            j_inverse[i] * f.j.coupled[i],
        ]
    });
    f.jd = djt * y.omega + stretch;

    let plain = L::trip(B, c.plain.used);
    for i in 0..plain {
        f.ratio.1[i] = r.h_plain[i] * f.inverse.plain[i];
        f.j_inverse.1[i] = f.j.plain[i] * f.inverse.plain[i];
    }
    let (ratio, j_inverse) = (&f.ratio.1, &f.j_inverse.1);
    let [plain_fill, plain_ratio_j, plain_j_h, plain_j_j] = sums!(plain, |i| {
        let h = r.h_plain[i];
        [
            h * ratio[i],
            ratio[i] * f.j.plain[i],
            j_inverse[i] * h,
            j_inverse[i] * f.j.plain[i],
        ]
    });
    f.ratio_h = ratio_h + plain_fill;
    f.ratio_k = ratio_k;
    f.ratio_j = ratio_j + plain_ratio_j;
    f.j_h = j_h + plain_j_h;
    f.j_k = j_k;
    f.j_j = j_j + plain_j_j;
    f.schur = one / (r.inertia + s2 * f.k_tt - (fill + plain_fill));

    // Pressures by hand: u = κ (r ∓ E A δspeed + e δlength)
    let slopes = &r.slopes;
    f.area = [k(c.cylinder.area_m2[0]), k(c.cylinder.area_m2[1])];
    let growth = &c.cylinder.compliance_slope_m2_per_pa;
    for i in 0..2 {
        f.kappa[i] = s / (one + s * slopes.leak[i] * slopes.stiffness[i]);
    }
    f.e_speed = [
        -(slopes.stiffness[0] * f.area[0]),
        slopes.stiffness[1] * f.area[1],
    ];
    f.e_length = [
        -(r.p[0] * slopes.stiffness[0] * k(growth[0])),
        r.p[1] * slopes.stiffness[1] * k(growth[1]),
    ];
    let to_force = [-(f.area[0] * f.kappa[0]), f.area[1] * f.kappa[1]];
    let d_star = slopes.damping + to_force[0] * f.e_speed[0] + to_force[1] * f.e_speed[1];
    f.k_star = slopes.spring + to_force[0] * f.e_length[0] + to_force[1] * f.e_length[1];
    f.d_star_jd = d_star * f.jd;
    f.weight = s * (d_star + s * f.k_star);
    f.weight_t = s2 * f.d_star_jd;
    f.lag = s / (one + s * c.lag_per_s.pack());

    f.gt = (r.jt - f.ratio_j) * f.schur;
    f.jg = (r.jt - f.ratio_j) * f.gt + f.j_j;
    f.update = one / (one + f.weight * f.jg + f.weight_t * f.gt);
}

/// J and the reciprocal diagonal of modes.
#[inline(always)]
fn diagonal<L: Lane, K: Coefficient<L>, const N: usize>(
    set: &ModeSet<K, N>,
    s: L,
    s2: L,
    n: [L; 3],
    j: &mut [L; N],
    inverse: &mut [L; N],
) {
    let k = |x: f64| L::splat(x);
    let q = |x: K| x.pack();
    for i in 0..L::trip(N, set.used) {
        j[i] = n[0] * q(set.rod[0][i]) + n[1] * q(set.rod[1][i]) + n[2] * q(set.rod[2][i]);
        inverse[i] = k(1.0) / (k(1.0) + s * q(set.d[i]) + s2 * q(set.w2[i]));
    }
}

/// Solves (1/s − Jacobian) u = rhs. `r0` holds the step's linearisation point; θ and z of `rhs` and
/// `u` are positions, ω and v rates.
#[inline(always)]
pub(super) fn solve<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    f: &Factors<L, A, B, Q>,
    r0: &Rates<L, A, B, Q>,
    rhs: &Point<L, A, B, Q>,
    u: &mut Point<L, A, B, Q>,
) {
    let (s, s2) = (f.s, f.s2);
    let coupled = L::trip(A, c.coupled.used);
    let plain = L::trip(B, c.plain.used);
    let follower = L::trip(Q, c.follower.used);
    // s r_v − s² w² r_z of every mode
    let own = |set_w2: K, z: L, v: L| s * v - s2 * (set_w2.pack() * z);
    let mut e = PerMode::<L, A, B, Q>::zero();
    for i in 0..coupled {
        e.coupled[i] = own(c.coupled.w2[i], rhs.z.coupled[i], rhs.v.coupled[i]);
    }
    for i in 0..plain {
        e.plain[i] = own(c.plain.w2[i], rhs.z.plain[i], rhs.v.plain[i]);
    }
    let a = sums!(coupled, |i| {
        [
            f.j.coupled[i] * rhs.z.coupled[i],
            r0.h[i] * rhs.v.coupled[i],
            f.ratio.0[i] * e.coupled[i],
            f.j_inverse.0[i] * e.coupled[i],
            f.k_tz[i] * rhs.z.coupled[i],
        ]
    });
    let b = sums!(plain, |i| {
        [
            f.j.plain[i] * rhs.z.plain[i],
            r0.h_plain[i] * rhs.v.plain[i],
            f.ratio.1[i] * e.plain[i],
            f.j_inverse.1[i] * e.plain[i],
        ]
    });
    let [rho, hv, ratio_e, j_e] = [a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]];
    let kz = a[4];

    let rho = r0.jt * rhs.theta + rho;
    let from_pressure = f.area[1] * f.kappa[1] * rhs.p[1] - f.area[0] * f.kappa[0] * rhs.p[0];
    let known = from_pressure + s * (f.d_star_jd * rhs.theta + f.k_star * rho);
    let push = s * known;
    let spin = s * rhs.omega;
    let turn = s2 * rhs.theta;
    // Arrow part, then the rank-one update
    let bt = s * (r0.inertia * rhs.omega + hv) - (f.k_tt * turn + s2 * kz) - push * r0.jt;
    let below = ratio_e + spin * f.ratio_h - turn * f.ratio_k - push * f.ratio_j;
    let xt = (bt - below) * f.schur;
    let jx = (r0.jt - f.ratio_j) * xt + (j_e + spin * f.j_h - turn * f.j_k - push * f.j_j);
    let pull = (f.weight * jx + f.weight_t * xt) * f.update;
    u.omega = xt - pull * f.gt;
    u.theta = s * (u.omega + rhs.theta);
    let spin = spin - u.omega;
    let turn = turn + s2 * u.omega;
    let push = push + pull;
    for i in 0..coupled {
        let b = e.coupled[i] + r0.h[i] * spin - f.k_tz[i] * turn - push * f.j.coupled[i];
        u.v.coupled[i] = f.inverse.coupled[i] * b;
        u.z.coupled[i] = s * (u.v.coupled[i] + rhs.z.coupled[i]);
    }
    for i in 0..plain {
        let b = e.plain[i] + r0.h_plain[i] * spin - push * f.j.plain[i];
        u.v.plain[i] = f.inverse.plain[i] * b;
        u.z.plain[i] = s * (u.v.plain[i] + rhs.z.plain[i]);
    }
    for i in 0..follower {
        let e = own(c.follower.w2[i], rhs.z.follower[i], rhs.v.follower[i]);
        let b = e + r0.h_follower[i] * spin - push * f.j.follower[i];
        u.v.follower[i] = f.inverse.follower[i] * b;
        u.z.follower[i] = s * (u.v.follower[i] + rhs.z.follower[i]);
    }
    let ju = jx - pull * f.jg;
    let d_length = s * (ju + rho);
    let d_speed = ju + f.jd * u.theta;
    for i in 0..2 {
        u.p[i] = f.kappa[i] * (rhs.p[i] + f.e_speed[i] * d_speed + f.e_length[i] * d_length);
    }
    let d_force =
        r0.slopes.damping * d_speed + r0.slopes.spring * d_length + (f.area[1] * u.p[1] - f.area[0] * u.p[0]);
    u.lag = f.lag * (rhs.lag + d_force * c.lag_per_s.pack());
}
