//! Activation functions over slices, written so that the compiler turns them into vector code.
//!
//! Each loop is compiled twice, for the baseline and for AVX2 + FMA, and chosen at run time. The
//! exponential is a degree-6 polynomial after range reduction (error below 2 ulp), which the scalar
//! library function would not let the compiler vectorise.

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use hydroflex_openapi::model::Activation;

/// Below this e^x is 0 in f32 and above its negative ∞; the reduction stays exact between.
const EXP_LIMIT: f32 = 87.0;

/// e^x for |x| ≤ 87, clamped outside.
#[inline(always)]
#[must_use]
pub fn exp(x: f32) -> f32 {
    // x = k ln 2 + r, |r| ≤ ln 2 / 2; ln 2 in two parts so that k ln 2 is exact.
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Adding and subtracting 1.5·2²³ rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-EXP_LIMIT, EXP_LIMIT);
    let shifted = x * LOG2_E + ROUND;
    let k = shifted - ROUND;
    let r = x - k * LN2_HIGH - k * LN2_LOW;
    let mut p = 1.987_569_1e-4_f32;
    p = p * r + 1.398_199_9e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_5e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 0.5;
    let p = p * r * r + r + 1.0;
    // 2^k through the exponent bits: the low bits of `shifted` are k.
    let two_to_k = f32::from_bits((shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127)) << 23);
    p * two_to_k
}

/// 1 / (1 + e⁻ˣ).
#[inline(always)]
#[must_use]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// tanh x = 1 − 2 / (e²ˣ + 1), and its Taylor polynomial near 0 where that loses digits.
#[inline(always)]
#[must_use]
pub fn tanh(x: f32) -> f32 {
    let large = 1.0 - 2.0 / (exp(2.0 * x.clamp(-20.0, 20.0)) + 1.0);
    let s = x * x;
    // x − x³/3 + 2x⁵/15 − 17x⁷/315 + 62x⁹/2835, next term below 2e-8 x for |x| < 0.3.
    let small =
        x * (1.0 + s * (-0.333_333_34 + s * (0.133_333_34 + s * (-0.053_968_254 + s * 0.021_869_488))));
    if s < 0.09 { small } else { large }
}

/// x for x > 0, eˣ − 1 otherwise.
#[inline(always)]
#[must_use]
pub fn elu(x: f32) -> f32 {
    // eˣ − 1 loses digits near 0: x + x²/2 + x³/6 + x⁴/24 + x⁵/120 there, next term below 4e-8 x.
    let small = x * (1.0 + x * (0.5 + x * (0.166_666_67 + x * (0.041_666_668 + x * 0.008_333_334))));
    let large = exp(x.min(0.0)) - 1.0;
    if x > 0.0 {
        x
    } else if x > -0.12 {
        small
    } else {
        large
    }
}

/// The activation of one value.
#[inline(always)]
#[must_use]
pub fn activate(activation: Activation, x: f32) -> f32 {
    match activation {
        Activation::Tanh => tanh(x),
        Activation::Sigmoid => sigmoid(x),
        Activation::Relu => x.max(0.0),
        Activation::Elu => elu(x),
        Activation::Silu => x * sigmoid(x),
    }
}

#[inline(always)]
fn apply_generic(activation: Activation, values: &mut [f32]) {
    match activation {
        Activation::Tanh => values.iter_mut().for_each(|v| *v = tanh(*v)),
        Activation::Sigmoid => values.iter_mut().for_each(|v| *v = sigmoid(*v)),
        Activation::Relu => values.iter_mut().for_each(|v| *v = v.max(0.0)),
        Activation::Elu => values.iter_mut().for_each(|v| *v = elu(*v)),
        Activation::Silu => values.iter_mut().for_each(|v| *v *= sigmoid(*v)),
    }
}

/// `grad ·= f'`, from the saved value: the output for T, S, R, E (whose derivative follows from
/// it), the input for SiLU.
#[inline(always)]
fn chain_generic(activation: Activation, saved: &[f32], grad: &mut [f32]) {
    let pairs = grad.iter_mut().zip(saved);
    match activation {
        Activation::Tanh => pairs.for_each(|(g, y)| *g *= 1.0 - y * y),
        Activation::Sigmoid => pairs.for_each(|(g, y)| *g *= y * (1.0 - y)),
        Activation::Relu => pairs.for_each(|(g, y)| *g = if *y > 0.0 { *g } else { 0.0 }),
        Activation::Elu => pairs.for_each(|(g, y)| *g *= if *y > 0.0 { 1.0 } else { y + 1.0 }),
        Activation::Silu => pairs.for_each(|(g, z)| {
            let s = sigmoid(*z);
            *g *= s * (1.0 + z * (1.0 - s));
        }),
    }
}

/// Whether the derivative of `activation` is taken from its input rather than its output.
#[must_use]
pub fn saves_input(activation: Activation) -> bool {
    activation == Activation::Silu
}

/// Compiles a loop for the baseline and for AVX2 + FMA, and chooses at run time.
macro_rules! vectorised {
    ($(#[$doc:meta])* $name:ident, $generic:ident, ($($arg:ident: $ty:ty),*)) => {
        $(#[$doc])*
        pub fn $name($($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn wide($($arg: $ty),*) {
                    $generic($($arg),*);
                }
                if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                    #[allow(unsafe_code, reason = "the features were just detected")]
                    // SAFETY: `wide` needs only AVX2 and FMA, which this processor has.
                    unsafe {
                        wide($($arg),*);
                    }
                    return;
                }
            }
            $generic($($arg),*);
        }
    };
}
pub(crate) use vectorised;

vectorised!(
    /// Applies `activation` to every value.
    apply, apply_generic, (activation: Activation, values: &mut [f32])
);
vectorised!(
    /// Multiplies `grad` by the derivative of `activation`; see [`saves_input`] for `saved`.
    chain, chain_generic, (activation: Activation, saved: &[f32], grad: &mut [f32])
);

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Activation; 5] = [
        Activation::Tanh,
        Activation::Sigmoid,
        Activation::Relu,
        Activation::Elu,
        Activation::Silu,
    ];

    fn exact(activation: Activation, x: f64) -> f64 {
        match activation {
            Activation::Tanh => x.tanh(),
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            Activation::Relu => x.max(0.0),
            Activation::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp_m1()
                }
            }
            Activation::Silu => x / (1.0 + (-x).exp()),
        }
    }

    #[test]
    fn activations_agree_with_the_library_in_f64() {
        for activation in ALL {
            for i in -4000..=4000 {
                let x = i as f32 * 0.005;
                let mut value = [x];
                apply(activation, &mut value);
                let truth = exact(activation, f64::from(x));
                // A few f32 roundings (6e-8) of intermediate values of size one, more for larger outputs.
                let tolerance = 4e-7 * truth.abs().max(0.3);
                assert!(
                    (f64::from(value[0]) - truth).abs() < tolerance,
                    "{activation:?}({x}) = {}",
                    value[0]
                );
            }
        }
    }

    #[test]
    fn extreme_inputs_stay_finite() {
        for activation in ALL {
            let mut values = [-1e30_f32, -200.0, 200.0, 1e30];
            apply(activation, &mut values);
            assert!(values.iter().all(|v| v.is_finite()), "{activation:?}: {values:?}");
        }
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        for activation in ALL {
            for i in -60..60 {
                let x = f64::from(i) * 0.1 + 0.03;
                let h = 1e-6;
                let slope = (exact(activation, x + h) - exact(activation, x - h)) / (2.0 * h);
                let mut saved = [x as f32];
                if !saves_input(activation) {
                    apply(activation, &mut saved);
                }
                let mut grad = [1.0_f32];
                chain(activation, &saved, &mut grad);
                // f32 values of size one, finite difference good to 1e-9.
                assert!(
                    (f64::from(grad[0]) - slope).abs() < 2e-6,
                    "{activation:?} at {x}: {} {slope}",
                    grad[0]
                );
            }
        }
    }
}
