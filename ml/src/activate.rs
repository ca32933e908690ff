//! Activations of a vector, to the accuracy of f32.

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use crate::simd::{Level, Simd, dispatch};
use hydroflex_openapi::model::Activation;

/// Activates values in place, with the instructions of `level`; `values` holds whole vectors of 16.
pub(crate) fn apply(level: Level, activation: Activation, values: &mut [f32]) {
    dispatch!(level, Slice::apply(activation: Activation, values: &mut [f32]));
}

struct Slice;

impl Slice {
    #[inline(always)]
    unsafe fn apply<S: Simd>(activation: Activation, values: &mut [f32]) {
        activate::<S>(activation, values);
    }
}

/// Activates values in place; `values` holds whole vectors.
///
/// # Safety
/// As for [`Simd`].
#[inline(always)]
pub(crate) unsafe fn activate<S: Simd>(activation: Activation, values: &mut [f32]) {
    // A closure would not be compiled for the instructions of the function that it ends up in.
    macro_rules! each {
        ($x:ident => $f:expr) => {
            for vector in values.chunks_exact_mut(S::LANES) {
                let $x = S::load(vector.as_ptr());
                S::store(vector.as_mut_ptr(), $f);
            }
        };
    }
    // One match per slice, so that each arm is a vector loop.
    match activation {
        Activation::Tanh => each!(x => tanh::<S>(x)),
        Activation::Sigmoid => each!(x => sigmoid::<S>(x)),
        Activation::Relu => each!(x => S::max(S::splat(0.0), x)),
        Activation::Elu => each!(x => elu::<S>(x)),
        Activation::Silu => each!(x => silu::<S>(x)),
    }
}

#[inline(always)]
unsafe fn clamp<S: Simd>(x: S::F, low: f32, high: f32) -> S::F {
    S::min(S::splat(high), S::max(S::splat(low), x))
}

/// `x p + c`.
#[inline(always)]
unsafe fn horner<S: Simd>(x: S::F, p: S::F, c: f32) -> S::F {
    S::fma(x, p, S::splat(c))
}

/// tanh as an odd rational function (the coefficients are Eigen's), which costs half of what an
/// exponential does. Absolute error below 3e-7; training uses the same one.
#[inline(always)]
unsafe fn tanh<S: Simd>(x: S::F) -> S::F {
    // From here on tanh is 1 in f32.
    const LARGE: f32 = 7.905_311;
    let x = clamp::<S>(x, -LARGE, LARGE);
    let s = S::mul(x, x);
    let mut p = horner::<S>(s, S::splat(-2.760_768_5e-16), 2.000_188e-13);
    p = horner::<S>(s, p, -8.604_672e-11);
    p = horner::<S>(s, p, 5.122_297_1e-8);
    p = horner::<S>(s, p, 1.485_722_36e-5);
    p = horner::<S>(s, p, 6.372_619_3e-4);
    p = horner::<S>(s, p, 4.893_524_6e-3);
    let mut q = horner::<S>(s, S::splat(1.198_258_4e-6), 1.185_347_1e-4);
    q = horner::<S>(s, q, 2.268_434_6e-3);
    q = horner::<S>(s, q, 4.893_525e-3);
    S::div(S::mul(x, p), q)
}

/// 1 / (1 + e⁻ˣ) = ½ + ½ tanh ½x.
#[inline(always)]
unsafe fn sigmoid<S: Simd>(x: S::F) -> S::F {
    let half = S::splat(0.5);
    S::fma(half, tanh::<S>(S::mul(half, x)), half)
}

/// e^x = 2^k e^r for −87 ≤ x ≤ 87: 2^k and e^r − 1, whose leading digits are not lost near 0.
#[inline(always)]
unsafe fn exp_parts<S: Simd>(x: S::F) -> (S::F, S::F) {
    // ln 2 in two parts, so that k ln 2 is exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Adding and subtracting 1.5·2²³ rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let shifted = S::fma(x, S::splat(std::f32::consts::LOG2_E), S::splat(ROUND));
    let k = S::add(shifted, S::splat(-ROUND));
    let r = S::fma(k, S::splat(-LN2_LOW), S::fma(k, S::splat(-LN2_HIGH), x));
    let mut p = horner::<S>(r, S::splat(1.987_569_1e-4), 1.398_199_9e-3);
    p = horner::<S>(r, p, 8.333_452e-3);
    p = horner::<S>(r, p, 4.166_579_5e-2);
    p = horner::<S>(r, p, 1.666_666_5e-1);
    p = horner::<S>(r, p, 0.5);
    (S::pow2(shifted), S::fma(S::mul(r, r), p, r))
}

/// x for x > 0, eˣ − 1 otherwise.
#[inline(always)]
unsafe fn elu<S: Simd>(x: S::F) -> S::F {
    // Below −17 e^x is less than half a last digit of 1; above 0 the second part is 0.
    let (two_to_k, expm1) = exp_parts::<S>(clamp::<S>(x, -17.0, 0.0));
    let negative = S::fma(two_to_k, expm1, S::add(two_to_k, S::splat(-1.0)));
    S::add(S::max(S::splat(0.0), x), negative)
}

/// x / (1 + e⁻ˣ). The exponential, because the small values of tanh's form would be multiplied by x.
#[inline(always)]
unsafe fn silu<S: Simd>(x: S::F) -> S::F {
    let minus = S::mul(S::splat(-1.0), x);
    let (two_to_k, expm1) = exp_parts::<S>(clamp::<S>(minus, -87.0, 87.0));
    S::div(x, S::add(S::splat(1.0), S::fma(two_to_k, expm1, two_to_k)))
}
