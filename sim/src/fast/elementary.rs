//! Elementary functions that give the same bits on every machine and in every lane.
//!
//! The C library's `sin`, `exp` and `tanh` differ between platforms; these use only operations that
//! IEEE 754 rounds correctly. Coefficients: Remez polynomials of FreeBSD's msun (`k_sin.c`,
//! `k_cos.c`) on [−π/4, π/4], Taylor's series for the exponential on [−ln 2/2, ln 2/2].

use super::lane::{Lane, ROUND_TO_INTEGER};

/// π/2 in three parts, the first two with 33 significant bits, so that their products with a small
/// integer are exact.
const HALF_PI: [f64; 3] = [
    1.570_796_326_734_125_6,
    6.077_100_506_303_966e-11,
    2.022_266_248_795_951e-21,
];
/// ln 2 in two parts, the first with 32 significant bits.
const LN_2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];

/// Sine and cosine, within 2 ulp for |x| < 10⁴.
#[inline(always)]
pub(super) fn sin_cos<L: Lane>(x: L) -> (L, L) {
    let round = L::splat(ROUND_TO_INTEGER);
    let n = (x * L::splat(std::f64::consts::FRAC_2_PI) + round) - round;
    let r = ((x - n * L::splat(HALF_PI[0])) - n * L::splat(HALF_PI[1])) - n * L::splat(HALF_PI[2]);
    let z = r * r;
    let s = L::splat(1.589_690_995_211_55e-10);
    let s = s * z + L::splat(-2.505_076_025_340_686_3e-8);
    let s = s * z + L::splat(2.755_731_370_707_006_8e-6);
    let s = s * z + L::splat(-1.984_126_982_985_795e-4);
    let s = s * z + L::splat(8.333_333_333_322_49e-3);
    let s = s * z + L::splat(-1.666_666_666_666_663_2e-1);
    let sine = r + r * z * s;
    let c = L::splat(-1.135_964_755_778_819_5e-11);
    let c = c * z + L::splat(2.087_572_321_298_175e-9);
    let c = c * z + L::splat(-2.755_731_435_139_066_3e-7);
    let c = c * z + L::splat(2.480_158_728_947_673e-5);
    let c = c * z + L::splat(-1.388_888_888_887_411e-3);
    let c = c * z + L::splat(4.166_666_666_666_66e-2);
    let cosine = L::splat(1.0) - (L::splat(0.5) * z - z * z * c);
    // Quadrant m = n mod 4 as −1, 0, 1 or ±2: the odd ones swap, the far ones turn the sign.
    let quarter = L::splat(0.25);
    let m = n - L::splat(4.0) * ((n * quarter + round) - round);
    let odd = (m * m - L::splat(1.0)).abs(); // 0 for odd, 1 or 3 for even
    let half = L::splat(0.5);
    let s_raw = cosine.where_less(odd, half, sine);
    let c_raw = sine.where_less(odd, half, cosine);
    // sin: negative for m = −1, ±2; cos: negative for m = 1, ±2.
    let far = m.abs() - L::splat(1.5); // positive for ±2
    let sin_sign = L::splat(-1.0).where_less(m, -half, L::splat(1.0));
    let sin_sign = L::splat(-1.0).where_less(L::splat(0.0), far, sin_sign);
    let cos_sign = L::splat(-1.0).where_less(half, m, L::splat(1.0));
    let cos_sign = L::splat(-1.0).where_less(L::splat(0.0), far, cos_sign);
    (s_raw * sin_sign, c_raw * cos_sign)
}

/// Exponential for |x| < 700, relative error below 1e-15.
#[inline(always)]
pub(super) fn exp<L: Lane>(x: L) -> L {
    let round = L::splat(ROUND_TO_INTEGER);
    let biased = x * L::splat(std::f64::consts::LOG2_E) + round;
    let n = biased - round;
    let r = (x - n * L::splat(LN_2[0])) - n * L::splat(LN_2[1]);
    // Taylor's series to r¹³, in pairs (Estrin's scheme): in a row of thirteen each waits for the last.
    let c = |factorial: f64| L::splat(1.0 / factorial);
    let r2 = r * r;
    let r4 = r2 * r2;
    let r8 = r4 * r4;
    let p01 = c(1.0) + r;
    let p23 = c(2.0) + c(6.0) * r;
    let p45 = c(24.0) + c(120.0) * r;
    let p67 = c(720.0) + c(5_040.0) * r;
    let p89 = c(40_320.0) + c(362_880.0) * r;
    let p1011 = c(3_628_800.0) + c(39_916_800.0) * r;
    let p1213 = c(479_001_600.0) + c(6_227_020_800.0) * r;
    let low = (p01 + p23 * r2) + (p45 + p67 * r2) * r4;
    let high = (p89 + p1011 * r2) + p1213 * r4;
    let p = low + high * r8;
    p * biased.exp2_biased()
}

/// Hyperbolic tangent; absolute error below 1e-15.
#[inline(always)]
pub(super) fn tanh<L: Lane>(x: L) -> L {
    // Beyond 20 the result is 1 to the last bit. A NaN must stay one: subtracting 0·x keeps it.
    let limit = L::splat(20.0);
    let size = x.abs();
    let size = limit.where_less(limit, size, size);
    let e = exp(size + size);
    let one = L::splat(1.0);
    (one - (one + one) / (e + one)).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agree_with_msun_to_rounding() {
        for i in -4000..=4000 {
            let x = f64::from(i) * 0.003_7;
            let (s, c) = sin_cos(x);
            assert!((s - libm::sin(x)).abs() < 4e-16, "sin {x}: {s}");
            assert!((c - libm::cos(x)).abs() < 4e-16, "cos {x}: {c}");
            assert!((exp(x) / libm::exp(x) - 1.0).abs() < 4e-15, "exp {x}");
            assert!((tanh(x) - libm::tanh(x)).abs() < 1e-15, "tanh {x}");
        }
        assert!((tanh(1e9) - 1.0).abs() < 1e-15 && (tanh(-1e9) + 1.0).abs() < 1e-15);
    }

    #[test]
    fn a_nan_stays_a_nan() {
        let (s, c) = sin_cos(f64::NAN);
        assert!(s.is_nan() && c.is_nan() && exp(f64::NAN).is_nan() && tanh(f64::NAN).is_nan());
    }
}
