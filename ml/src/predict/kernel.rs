//! Dense layers in f32 without a tensor framework: packed weights, register blocks, no allocation.
//!
//! Weights are packed into panels of 16 outputs (`panel[input][16]`), so that one multiply-add
//! takes 16 weights that lie side by side. A block of R rows × P panels is summed in registers over
//! all inputs; then bias and activation follow while the values are still in cache. The same body
//! is compiled for AVX-512, AVX2 + FMA and the baseline, and chosen once per process; only the sums
//! are written with instructions of their own, because a compiler that keeps them in memory instead
//! of registers makes them thirty times slower.

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use crate::model::weights::LinearWeights;
use hydroflex_openapi::model::Activation;

/// Outputs in a panel: one AVX-512 register, two AVX2 registers.
pub const LANES: usize = 16;

/// Sixteen weights on a cache line of their own.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
struct Lanes([f32; LANES]);

/// `f(W x + b)` with packed W.
#[derive(Debug, Clone, PartialEq)]
pub struct PackedLayer {
    inputs: usize,
    outputs: usize,
    panels: Vec<Lanes>,
    bias: Vec<f32>,
    activations: Vec<Activation>,
    /// Outputs from here on skip the activation.
    activated: usize,
}

impl PackedLayer {
    /// Packs `map`, activated throughout.
    #[must_use]
    pub fn new(map: &LinearWeights, activations: &[Activation]) -> Self {
        Self::with_linear_tail(map, activations, &LinearWeights::default())
    }

    /// Packs `map` followed by the outputs of `tail`, which takes the same inputs and is left
    /// linear: the first layer and the skip connection in one pass over the window.
    ///
    /// # Panics
    /// When the two take another number of inputs.
    #[must_use]
    pub fn with_linear_tail(map: &LinearWeights, activations: &[Activation], tail: &LinearWeights) -> Self {
        let activated = map.bias.len();
        let outputs = activated + tail.bias.len();
        let inputs = (map.weight.len() + tail.weight.len()) / outputs;
        assert_eq!(map.weight.len(), activated * inputs, "weights fit biases");
        let panel_count = outputs.div_ceil(LANES);
        let mut panels = vec![Lanes([0.0; LANES]); panel_count * inputs];
        let rows = map
            .weight
            .chunks(inputs.max(1))
            .chain(tail.weight.chunks(inputs.max(1)));
        for (output, row) in rows.enumerate() {
            let panel = &mut panels[output / LANES * inputs..];
            for (lanes, &weight) in panel.iter_mut().zip(row) {
                lanes.0[output % LANES] = weight;
            }
        }
        let mut bias: Vec<f32> = map.bias.iter().chain(&tail.bias).copied().collect();
        bias.resize(panel_count * LANES, 0.0);
        Self {
            inputs,
            outputs,
            panels,
            bias,
            activations: activations.to_vec(),
            activated,
        }
    }

    /// Values in.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Values out, without padding.
    #[must_use]
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Values out, filled up to whole panels.
    #[must_use]
    pub fn padded(&self) -> usize {
        self.bias.len()
    }

    /// Output for `rows` inputs that begin `stride` values apart in `x`, written row by row with
    /// [`Self::padded`] values each. The padding is 0 before the activation.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn forward(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        if rows == 0 {
            return;
        }
        assert!(
            x.len() >= (rows - 1) * stride + self.inputs,
            "inputs of {rows} rows"
        );
        assert!(out.len() >= rows * self.padded(), "room for {rows} rows");
        match level() {
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns `Avx512` only where AVX-512F, AVX2 and FMA were detected.
            Level::Avx512 => unsafe { self.forward_avx512(x, stride, rows, out) },
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns `Avx2` only where AVX2 and FMA were detected.
            Level::Avx2 => unsafe { self.forward_avx2(x, stride, rows, out) },
            Level::Portable => self.blocks::<4, 1, 1, Portable>(x, stride, rows, out),
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    fn forward_avx512(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        self.blocks::<8, 2, 4, Avx512>(x, stride, rows, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn forward_avx2(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        self.blocks::<6, 1, 4, Avx2>(x, stride, rows, out);
    }

    /// Blocks of R rows × P panels, then single rows × S panels.
    #[inline(always)]
    fn blocks<const R: usize, const P: usize, const S: usize, I: Isa>(
        &self,
        x: &[f32],
        stride: usize,
        rows: usize,
        out: &mut [f32],
    ) {
        let mut row = 0;
        while row + R <= rows {
            self.row_block::<R, P, I>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += R;
        }
        while row < rows {
            self.row_block::<1, S, I>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += 1;
        }
    }

    #[inline(always)]
    fn row_block<const R: usize, const P: usize, I: Isa>(&self, x: &[f32], stride: usize, out: &mut [f32]) {
        let panel_count = self.bias.len() / LANES;
        let mut panel = 0;
        while panel + P <= panel_count {
            self.block::<R, P, I>(x, stride, panel, out);
            panel += P;
        }
        while panel < panel_count {
            self.block::<R, 1, I>(x, stride, panel, out);
            panel += 1;
        }
    }

    /// R rows × P panels from panel `panel`.
    #[inline(always)]
    fn block<const R: usize, const P: usize, I: Isa>(
        &self,
        x: &[f32],
        stride: usize,
        panel: usize,
        out: &mut [f32],
    ) {
        let size = self.inputs;
        let weights: [&[Lanes]; P] =
            std::array::from_fn(|p| &self.panels[(panel + p) * size..(panel + p + 1) * size]);
        let inputs: [&[f32]; R] = std::array::from_fn(|r| &x[r * stride..r * stride + size]);
        let sums = I::sums(inputs, weights, size);
        for r in 0..R {
            for p in 0..P {
                let first = (panel + p) * LANES;
                let target = &mut out[r * self.padded() + first..][..LANES];
                let mut values = sums[r][p];
                for lane in 0..LANES {
                    values[lane] += self.bias[first + lane];
                }
                for &activation in &self.activations {
                    self.activate_panel::<I>(activation, first, &mut values);
                }
                target.copy_from_slice(&values);
            }
        }
    }

    #[inline(always)]
    fn activate_panel<I: Isa>(&self, activation: Activation, first: usize, values: &mut [f32; LANES]) {
        let linear = *values;
        // One match per panel, so that each arm is a vector loop.
        match activation {
            Activation::Tanh => values.iter_mut().for_each(|v| *v = tanh::<I>(*v)),
            Activation::Sigmoid => values.iter_mut().for_each(|v| *v = sigmoid::<I>(*v)),
            Activation::Relu => values.iter_mut().for_each(|v| *v = v.max(0.0)),
            Activation::Elu => values.iter_mut().for_each(|v| *v = elu::<I>(*v)),
            Activation::Silu => values.iter_mut().for_each(|v| *v = silu::<I>(*v)),
        }
        if first + LANES > self.activated {
            let kept = self.activated.saturating_sub(first);
            values[kept..].copy_from_slice(&linear[kept..]);
        }
    }
}

/// `a b + c`, fused where the instruction exists: the library's fused form is slow elsewhere.
#[inline(always)]
fn fma<I: Isa>(a: f32, b: f32, c: f32) -> f32 {
    if I::FMA { a.mul_add(b, c) } else { a * b + c }
}

/// tanh as an odd rational function (the coefficients are Eigen's), which costs half of what an
/// exponential does. Absolute error below 3e-7; training uses another formula, as good.
#[inline(always)]
fn tanh<I: Isa>(x: f32) -> f32 {
    // From here on tanh is 1 in f32.
    const LARGE: f32 = 7.905_311;
    let x = x.clamp(-LARGE, LARGE);
    let s = x * x;
    let mut p = fma::<I>(s, -2.760_768_5e-16, 2.000_188e-13);
    p = fma::<I>(s, p, -8.604_672e-11);
    p = fma::<I>(s, p, 5.122_297_1e-8);
    p = fma::<I>(s, p, 1.485_722_36e-5);
    p = fma::<I>(s, p, 6.372_619_3e-4);
    p = fma::<I>(s, p, 4.893_524_6e-3);
    let mut q = fma::<I>(s, 1.198_258_4e-6, 1.185_347_1e-4);
    q = fma::<I>(s, q, 2.268_434_6e-3);
    q = fma::<I>(s, q, 4.893_525e-3);
    x * p / q
}

/// 1 / (1 + e⁻ˣ) = ½ + ½ tanh ½x.
#[inline(always)]
fn sigmoid<I: Isa>(x: f32) -> f32 {
    fma::<I>(0.5, tanh::<I>(0.5 * x), 0.5)
}

/// e^x = 2^k e^r for −87 ≤ x ≤ 87: 2^k and e^r − 1, whose leading digits are not lost near 0.
#[inline(always)]
fn exp_parts<I: Isa>(x: f32) -> (f32, f32) {
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    // ln 2 in two parts, so that k ln 2 is exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Adding and subtracting 1.5·2²³ rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let shifted = fma::<I>(x, LOG2_E, ROUND);
    let k = shifted - ROUND;
    let r = fma::<I>(k, -LN2_LOW, fma::<I>(k, -LN2_HIGH, x));
    let mut p = fma::<I>(r, 1.987_569_1e-4, 1.398_199_9e-3);
    p = fma::<I>(r, p, 8.333_452e-3);
    p = fma::<I>(r, p, 4.166_579_5e-2);
    p = fma::<I>(r, p, 1.666_666_5e-1);
    p = fma::<I>(r, p, 0.5);
    // The low bits of `shifted` are k.
    let two_to_k = f32::from_bits((shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127)) << 23);
    (two_to_k, fma::<I>(r * r, p, r))
}

/// x for x > 0, eˣ − 1 otherwise.
#[inline(always)]
fn elu<I: Isa>(x: f32) -> f32 {
    // Below −17 e^x is less than half a last digit of 1.
    let (two_to_k, expm1) = exp_parts::<I>(x.clamp(-17.0, 0.0));
    let negative = fma::<I>(two_to_k, expm1, two_to_k - 1.0);
    if x > 0.0 { x } else { negative }
}

/// x / (1 + e⁻ˣ). The exponential, because the small values of tanh's form would be multiplied by x.
#[inline(always)]
fn silu<I: Isa>(x: f32) -> f32 {
    let (two_to_k, expm1) = exp_parts::<I>((-x).clamp(-87.0, 87.0));
    x / (1.0 + fma::<I>(two_to_k, expm1, two_to_k))
}

/// Instructions that a kernel may use.
trait Isa {
    /// Whether multiplying and adding is one instruction.
    const FMA: bool;

    /// Σᵢ `inputs[r][i] · weights[p][i]` for every r and p, in the order of i.
    fn sums<const R: usize, const P: usize>(
        inputs: [&[f32]; R],
        weights: [&[Lanes]; P],
        count: usize,
    ) -> [[[f32; LANES]; P]; R];
}

/// The target's baseline.
struct Portable;

impl Isa for Portable {
    const FMA: bool = false;

    #[inline(always)]
    fn sums<const R: usize, const P: usize>(
        inputs: [&[f32]; R],
        weights: [&[Lanes]; P],
        count: usize,
    ) -> [[[f32; LANES]; P]; R] {
        let mut sums = [[[0.0_f32; LANES]; P]; R];
        for i in 0..count {
            for (inputs, sums) in inputs.iter().zip(&mut sums) {
                let value = inputs[i];
                for (weights, sums) in weights.iter().zip(sums) {
                    for (sum, w) in sums.iter_mut().zip(&weights[i].0) {
                        *sum += value * w;
                    }
                }
            }
        }
        sums
    }
}

#[cfg(target_arch = "x86_64")]
struct Avx512;

#[cfg(target_arch = "x86_64")]
impl Isa for Avx512 {
    const FMA: bool = true;

    #[inline(always)]
    fn sums<const R: usize, const P: usize>(
        inputs: [&[f32]; R],
        weights: [&[Lanes]; P],
        count: usize,
    ) -> [[[f32; LANES]; P]; R] {
        #[allow(unsafe_code, reason = "the features were detected")]
        // SAFETY: this type is named in `forward_avx512` alone, which runs where they were.
        unsafe {
            sums_avx512(inputs, weights, count)
        }
    }
}

#[cfg(target_arch = "x86_64")]
struct Avx2;

#[cfg(target_arch = "x86_64")]
impl Isa for Avx2 {
    const FMA: bool = true;

    #[inline(always)]
    fn sums<const R: usize, const P: usize>(
        inputs: [&[f32]; R],
        weights: [&[Lanes]; P],
        count: usize,
    ) -> [[[f32; LANES]; P]; R] {
        #[allow(unsafe_code, reason = "the features were detected")]
        // SAFETY: this type is named in `forward_avx2` alone, which runs where they were.
        unsafe {
            sums_avx2(inputs, weights, count)
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
fn sums_avx512<const R: usize, const P: usize>(
    inputs: [&[f32]; R],
    weights: [&[Lanes]; P],
    count: usize,
) -> [[[f32; LANES]; P]; R] {
    use std::arch::x86_64::{
        _mm512_fmadd_ps, _mm512_load_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_storeu_ps,
    };
    assert!(inputs.iter().all(|inputs| inputs.len() >= count));
    assert!(weights.iter().all(|weights| weights.len() >= count));
    let mut sums = [[_mm512_setzero_ps(); P]; R];
    for i in 0..count {
        let mut lanes = [_mm512_setzero_ps(); P];
        for p in 0..P {
            #[allow(unsafe_code, reason = "a bound check per load would double their cost")]
            // SAFETY: `i` is below `count`, which was compared with the lengths; lanes are aligned.
            unsafe {
                lanes[p] = _mm512_load_ps(weights[p].get_unchecked(i).0.as_ptr());
            }
        }
        for r in 0..R {
            #[allow(unsafe_code, reason = "a bound check per load would double their cost")]
            // SAFETY: `i` is below `count`, which was compared with the lengths.
            let value = _mm512_set1_ps(unsafe { *inputs[r].get_unchecked(i) });
            for p in 0..P {
                sums[r][p] = _mm512_fmadd_ps(value, lanes[p], sums[r][p]);
            }
        }
    }
    let mut out = [[[0.0; LANES]; P]; R];
    for r in 0..R {
        for p in 0..P {
            #[allow(unsafe_code, reason = "stores take pointers")]
            // SAFETY: the target holds sixteen values.
            unsafe {
                _mm512_storeu_ps(out[r][p].as_mut_ptr(), sums[r][p]);
            }
        }
    }
    out
}

#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx2,fma")]
fn sums_avx2<const R: usize, const P: usize>(
    inputs: [&[f32]; R],
    weights: [&[Lanes]; P],
    count: usize,
) -> [[[f32; LANES]; P]; R] {
    use std::arch::x86_64::{
        _mm256_fmadd_ps, _mm256_load_ps, _mm256_set1_ps, _mm256_setzero_ps, _mm256_storeu_ps,
    };
    assert!(inputs.iter().all(|inputs| inputs.len() >= count));
    assert!(weights.iter().all(|weights| weights.len() >= count));
    let mut sums = [[[_mm256_setzero_ps(); 2]; P]; R];
    for i in 0..count {
        let mut lanes = [[_mm256_setzero_ps(); 2]; P];
        for p in 0..P {
            #[allow(unsafe_code, reason = "a bound check per load would double their cost")]
            // SAFETY: `i` is below `count`, which was compared with the lengths; lanes are aligned.
            unsafe {
                let weights = weights[p].get_unchecked(i).0.as_ptr();
                lanes[p] = [_mm256_load_ps(weights), _mm256_load_ps(weights.add(8))];
            }
        }
        for r in 0..R {
            #[allow(unsafe_code, reason = "a bound check per load would double their cost")]
            // SAFETY: `i` is below `count`, which was compared with the lengths.
            let value = _mm256_set1_ps(unsafe { *inputs[r].get_unchecked(i) });
            for p in 0..P {
                for h in 0..2 {
                    sums[r][p][h] = _mm256_fmadd_ps(value, lanes[p][h], sums[r][p][h]);
                }
            }
        }
    }
    let mut out = [[[0.0; LANES]; P]; R];
    for r in 0..R {
        for p in 0..P {
            for h in 0..2 {
                #[allow(unsafe_code, reason = "stores take pointers")]
                // SAFETY: the target holds sixteen values, and 8 h is 0 or 8.
                unsafe {
                    _mm256_storeu_ps(out[r][p].as_mut_ptr().add(8 * h), sums[r][p][h]);
                }
            }
        }
    }
    out
}

/// Instruction sets with a kernel of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// AVX-512F.
    Avx512,
    /// AVX2 and FMA.
    Avx2,
    /// The target's baseline.
    Portable,
}

/// The kernel that this process uses.
#[must_use]
pub fn level() -> Level {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        if has!("avx512f") && has!("avx512vl") && has!("avx2") && has!("fma") {
            return Level::Avx512;
        }
        if has!("avx2") && has!("fma") {
            return Level::Avx2;
        }
    }
    Level::Portable
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(outputs: usize, inputs: usize, seed: u32) -> LinearWeights {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f32::from((state >> 16) as u16) / 32768.0 - 1.0
        };
        LinearWeights {
            weight: (0..outputs * inputs).map(|_| next()).collect(),
            bias: (0..outputs).map(|_| next()).collect(),
        }
    }

    #[test]
    fn every_shape_and_row_count_agrees_with_the_definition() {
        for (outputs, inputs) in [(1, 1), (3, 500), (16, 7), (17, 60), (60, 300), (256, 33)] {
            let weights = map(outputs, inputs, 3);
            let layer = PackedLayer::new(&weights, &[Activation::Tanh]);
            for rows in [1, 2, 7, 8, 13] {
                let x = map(1, rows * inputs + 2, 9).weight;
                let stride = if rows % 2 == 0 { inputs } else { 1 };
                let mut out = vec![0.0; rows * layer.padded()];
                layer.forward(&x, stride, rows, &mut out);
                for r in 0..rows {
                    for o in 0..outputs {
                        let z: f64 = (0..inputs)
                            .map(|i| f64::from(weights.weight[o * inputs + i]) * f64::from(x[r * stride + i]))
                            .sum::<f64>()
                            + f64::from(weights.bias[o]);
                        let found = f64::from(out[r * layer.padded() + o]);
                        // Up to 500 f32 products of size one: rounding 6e-8 · √500 · √500.
                        assert!(
                            (found - z.tanh()).abs() < 3e-5,
                            "{outputs}×{inputs}, row {r}: {found} {}",
                            z.tanh()
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn activations_agree_with_the_library_in_f64() {
        let truth = |activation: Activation, x: f64| match activation {
            Activation::Tanh => x.tanh(),
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            Activation::Relu => x.max(0.0),
            Activation::Elu => x.max(x.min(0.0).exp_m1()),
            Activation::Silu => x / (1.0 + (-x).exp()),
        };
        // The identity, so that the layer is its activation; both ways of multiplying and adding.
        let identity = LinearWeights {
            weight: (0..LANES * LANES)
                .map(|i| if i % (LANES + 1) == 0 { 1.0 } else { 0.0 })
                .collect(),
            bias: vec![0.0; LANES],
        };
        for activation in [
            Activation::Tanh,
            Activation::Sigmoid,
            Activation::Relu,
            Activation::Elu,
            Activation::Silu,
        ] {
            let layer = PackedLayer::new(&identity, &[activation]);
            let x: Vec<f32> = (-4000..4000)
                .map(|i| i as f32 * 0.005)
                .chain([-1e30, -200.0, -88.0, -1e-7, 1e-7, 88.0, 200.0, 1e30])
                .chain([0.0; 8])
                .collect();
            let rows = x.len() / LANES;
            let (mut chosen, mut portable) = (vec![0.0; x.len()], vec![0.0; x.len()]);
            layer.forward(&x, LANES, rows, &mut chosen);
            layer.blocks::<4, 1, 1, Portable>(&x, LANES, rows, &mut portable);
            for (place, x) in x.iter().enumerate() {
                let truth = truth(activation, f64::from(*x));
                for found in [chosen[place], portable[place]] {
                    // A few f32 roundings (6e-8) of values of size one, more for larger results.
                    let error = (f64::from(found) - truth).abs();
                    assert!(
                        error < 5e-7 * truth.abs().max(1.0),
                        "{activation:?}({x}) = {found}, not {truth}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_linear_tail_is_not_activated() {
        let (head, tail) = (map(20, 5, 1), map(3, 5, 2));
        let layer = PackedLayer::with_linear_tail(&head, &[Activation::Relu], &tail);
        let x = [-1.0, 0.5, 2.0, -0.25, 1.0];
        let mut out = vec![0.0; layer.padded()];
        layer.forward(&x, 5, 1, &mut out);
        for o in 0..3 {
            let z: f32 = tail.bias[o] + (0..5).map(|i| tail.weight[o * 5 + i] * x[i]).sum::<f32>();
            assert!((out[20 + o] - z).abs() < 1e-6);
        }
        assert!(out[..20].iter().all(|v| *v >= 0.0));
    }

    #[test]
    fn kernels_agree_with_each_other() {
        let layer = PackedLayer::new(&map(40, 90, 5), &[Activation::Silu]);
        let x = map(1, 90 * 9, 6).weight;
        let (mut chosen, mut portable) = (vec![0.0; 9 * 48], vec![0.0; 9 * 48]);
        layer.forward(&x, 90, 9, &mut chosen);
        #[cfg(target_arch = "x86_64")]
        if level() == Level::Avx512 {
            // What an older processor would use.
            let mut narrow = vec![0.0; 9 * 48];
            #[allow(unsafe_code, reason = "AVX-512 implies AVX2 and FMA here")]
            // SAFETY: `level` found both.
            unsafe {
                layer.forward_avx2(&x, 90, 9, &mut narrow);
            }
            assert_eq!(narrow, chosen, "the same fused sums in the same order");
        }
        layer.blocks::<4, 1, 1, Portable>(&x, 90, 9, &mut portable);
        for (a, b) in chosen.iter().zip(&portable) {
            assert!((a - b).abs() < 2e-5, "{a} {b}");
        }
    }
}
