//! Dense layers in f32 without a tensor framework: packed weights, register blocks, no allocation.
//!
//! Weights are packed into panels of 16 outputs (`panel[input][16]`), so that one multiply-add
//! takes 16 weights that lie side by side. A block of R rows × P panels is summed in registers over
//! all inputs; then bias and activation follow while the values are still in cache. The same body
//! is compiled for AVX-512, AVX2 + FMA and the baseline, and chosen once per process.

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use crate::model::weights::LinearWeights;
use crate::network::elementwise::activate;
use hydroflex_openapi::model::Activation;

/// Outputs in a panel: one AVX-512 register, two AVX2 registers.
pub const LANES: usize = 16;

/// `f(W x + b)` with packed W.
#[derive(Debug, Clone, PartialEq)]
pub struct PackedLayer {
    inputs: usize,
    outputs: usize,
    panels: Vec<f32>,
    bias: Vec<f32>,
    activations: Vec<Activation>,
}

impl PackedLayer {
    /// Packs `map`.
    ///
    /// # Panics
    /// When weights and biases do not fit.
    #[must_use]
    pub fn new(map: &LinearWeights, activations: &[Activation]) -> Self {
        let outputs = map.bias.len();
        let inputs = map.weight.len() / outputs.max(1);
        assert_eq!(map.weight.len(), outputs * inputs, "weights fit biases");
        let panel_count = outputs.div_ceil(LANES);
        let mut panels = vec![0.0; panel_count * inputs * LANES];
        for (output, row) in map.weight.chunks(inputs.max(1)).enumerate() {
            let panel = &mut panels[output / LANES * inputs * LANES..];
            for (input, &weight) in row.iter().enumerate() {
                panel[input * LANES + output % LANES] = weight;
            }
        }
        let mut bias = map.bias.clone();
        bias.resize(panel_count * LANES, 0.0);
        Self {
            inputs,
            outputs,
            panels,
            bias,
            activations: activations.to_vec(),
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
            Level::Portable => self.blocks::<4, 1, 1, false>(x, stride, rows, out),
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    fn forward_avx512(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        self.blocks::<8, 2, 4, true>(x, stride, rows, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn forward_avx2(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        self.blocks::<6, 1, 4, true>(x, stride, rows, out);
    }

    /// Blocks of R rows × P panels, then single rows × S panels.
    #[inline(always)]
    fn blocks<const R: usize, const P: usize, const S: usize, const FMA: bool>(
        &self,
        x: &[f32],
        stride: usize,
        rows: usize,
        out: &mut [f32],
    ) {
        let mut row = 0;
        while row + R <= rows {
            self.row_block::<R, P, FMA>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += R;
        }
        while row < rows {
            self.row_block::<1, S, FMA>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += 1;
        }
    }

    #[inline(always)]
    fn row_block<const R: usize, const P: usize, const FMA: bool>(
        &self,
        x: &[f32],
        stride: usize,
        out: &mut [f32],
    ) {
        let panel_count = self.bias.len() / LANES;
        let mut panel = 0;
        while panel + P <= panel_count {
            self.block::<R, P, FMA>(x, stride, panel, out);
            panel += P;
        }
        while panel < panel_count {
            self.block::<R, 1, FMA>(x, stride, panel, out);
            panel += 1;
        }
    }

    /// R rows × P panels from panel `panel`.
    #[inline(always)]
    fn block<const R: usize, const P: usize, const FMA: bool>(
        &self,
        x: &[f32],
        stride: usize,
        panel: usize,
        out: &mut [f32],
    ) {
        let size = self.inputs * LANES;
        let weights: [&[[f32; LANES]]; P] =
            std::array::from_fn(|p| as_lanes(&self.panels[(panel + p) * size..(panel + p + 1) * size]));
        let inputs: [&[f32]; R] = std::array::from_fn(|r| &x[r * stride..r * stride + self.inputs]);
        let mut sums = [[[0.0_f32; LANES]; P]; R];
        for i in 0..self.inputs {
            for r in 0..R {
                let value = inputs[r][i];
                for p in 0..P {
                    let w = &weights[p][i];
                    for lane in 0..LANES {
                        let sum = &mut sums[r][p][lane];
                        *sum = if FMA {
                            value.mul_add(w[lane], *sum)
                        } else {
                            *sum + value * w[lane]
                        };
                    }
                }
            }
        }
        for r in 0..R {
            for p in 0..P {
                let first = (panel + p) * LANES;
                let target = &mut out[r * self.padded() + first..][..LANES];
                let mut values = sums[r][p];
                for lane in 0..LANES {
                    values[lane] += self.bias[first + lane];
                }
                for &activation in &self.activations {
                    activate_panel(activation, &mut values);
                }
                target.copy_from_slice(&values);
            }
        }
    }
}

#[inline(always)]
fn activate_panel(activation: Activation, values: &mut [f32; LANES]) {
    // One match per panel, so that each arm is a vector loop.
    match activation {
        Activation::Tanh => values
            .iter_mut()
            .for_each(|v| *v = activate(Activation::Tanh, *v)),
        Activation::Sigmoid => values
            .iter_mut()
            .for_each(|v| *v = activate(Activation::Sigmoid, *v)),
        Activation::Relu => values
            .iter_mut()
            .for_each(|v| *v = activate(Activation::Relu, *v)),
        Activation::Elu => values.iter_mut().for_each(|v| *v = activate(Activation::Elu, *v)),
        Activation::Silu => values
            .iter_mut()
            .for_each(|v| *v = activate(Activation::Silu, *v)),
    }
}

fn as_lanes(values: &[f32]) -> &[[f32; LANES]] {
    values.as_chunks::<LANES>().0
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
    fn kernels_agree_with_each_other() {
        let layer = PackedLayer::new(&map(40, 90, 5), &[Activation::Silu]);
        let x = map(1, 90 * 9, 6).weight;
        let (mut chosen, mut portable) = (vec![0.0; 9 * 48], vec![0.0; 9 * 48]);
        layer.forward(&x, 90, 9, &mut chosen);
        layer.blocks::<4, 1, 1, false>(&x, 90, 9, &mut portable);
        for (a, b) in chosen.iter().zip(&portable) {
            assert!((a - b).abs() < 2e-5, "{a} {b}");
        }
    }
}
