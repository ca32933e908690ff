//! The skip connection in f64: coefficients that follow slow signals, see [`crate::scheduled`].
//!
//! Rows of the map are packed into panels of eight, as [`super::kernel`] does in f32; four partial
//! sums per panel hide the latency of the multiply-adds. f64 because the coefficients are large
//! and act on small differences of neighbouring samples; the samples themselves are the scaled f32 values that
//! the network takes, as in training.

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use super::kernel::{Level, level};
use crate::model::weights::SkipWeights;
use hydroflex_openapi::model::{ScaledChannel, Schedule};

/// Outputs in a panel: one AVX-512 register of f64.
const LANES: usize = 8;
/// Partial sums.
const PARTS: usize = 4;
/// Windows at once.
const ROWS: usize = 3;

/// A packed skip connection.
#[derive(Debug, Clone, PartialEq)]
pub struct SkipKernel {
    inputs: usize,
    targets: usize,
    panels: Vec<[f64; LANES]>,
    bias: Vec<f64>,
    slow: Vec<SlowSignal>,
    /// Terms × slow signals.
    exponents: Vec<Vec<i32>>,
}

/// u = clamp(gain · scaled + shift, −1, 1) of one value of the window.
#[derive(Debug, Clone, PartialEq)]
struct SlowSignal {
    position: usize,
    gain: f64,
    shift: f64,
}

impl SkipKernel {
    /// Packs a map; without a schedule it is one term with constant coefficients.
    ///
    /// # Panics
    /// When weights and biases do not fit.
    #[must_use]
    pub fn new(
        map: &SkipWeights,
        schedule: Option<&Schedule>,
        channels: &[ScaledChannel],
        targets: usize,
    ) -> Self {
        let outputs = map.bias.len();
        let inputs = map.weight.len() / outputs.max(1);
        assert_eq!(map.weight.len(), outputs * inputs, "weights fit biases");
        let mut panels = vec![[0.0; LANES]; outputs.div_ceil(LANES) * inputs];
        for (output, row) in map.weight.chunks(inputs.max(1)).enumerate() {
            for (input, &weight) in row.iter().enumerate() {
                panels[output / LANES * inputs + input][output % LANES] = weight;
            }
        }
        let mut bias = map.bias.clone();
        bias.resize(outputs.div_ceil(LANES) * LANES, 0.0);
        let slow = schedule.map_or_else(Vec::new, |schedule| {
            schedule
                .inputs
                .iter()
                .zip(schedule.centre.iter().zip(&schedule.half_range))
                .map(|(&input, (centre, half_range))| SlowSignal {
                    position: inputs - channels.len() + input,
                    gain: channels[input].scale / half_range,
                    shift: (channels[input].offset - centre) / half_range,
                })
                .collect()
        });
        let exponents = schedule.map_or_else(
            || vec![Vec::new()],
            |schedule| {
                let power = |&e: &u32| i32::try_from(e).unwrap_or(i32::MAX);
                schedule
                    .exponents
                    .iter()
                    .map(|e| e.iter().map(power).collect())
                    .collect()
            },
        );
        Self {
            inputs,
            targets,
            panels,
            bias,
            slow,
            exponents,
        }
    }

    /// Values of scratch memory per window.
    #[must_use]
    pub fn padded(&self) -> usize {
        self.bias.len()
    }

    /// Adds the map of `rows` scaled windows that begin `stride` values apart to `out`, one row of
    /// scaled targets per window. `scratch` holds [`Self::padded`] values per window.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn add(&self, x: &[f32], stride: usize, rows: usize, scratch: &mut [f64], out: &mut [f32]) {
        if rows == 0 {
            return;
        }
        assert!(
            x.len() >= (rows - 1) * stride + self.inputs,
            "inputs of {rows} rows"
        );
        assert!(scratch.len() >= rows * self.padded(), "scratch of {rows} rows");
        match level() {
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns `Avx512` only where AVX-512F, AVX2 and FMA were detected.
            Level::Avx512 => unsafe { self.forward_avx512(x, stride, rows, scratch) },
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns `Avx2` only where AVX2 and FMA were detected.
            Level::Avx2 => unsafe { self.forward_avx2(x, stride, rows, scratch) },
            Level::Portable => self.forward::<false>(x, stride, rows, scratch),
        }
        for row in 0..rows {
            let window = &x[row * stride..];
            let sums = &scratch[row * self.padded()..];
            for (t, slot) in out[row * self.targets..(row + 1) * self.targets]
                .iter_mut()
                .enumerate()
            {
                let mut total = f64::from(*slot);
                for (term, exponents) in self.exponents.iter().enumerate() {
                    total += self.factor(window, exponents) * sums[term * self.targets + t];
                }
                #[allow(clippy::cast_possible_truncation, reason = "scaled estimates are f32")]
                {
                    *slot = total as f32;
                }
            }
        }
    }

    /// m_t of a window.
    fn factor(&self, window: &[f32], exponents: &[i32]) -> f64 {
        let power = |(slow, &exponent): (&SlowSignal, &i32)| {
            let u = slow.gain * f64::from(window[slow.position]) + slow.shift;
            u.clamp(-1.0, 1.0).powi(exponent)
        };
        self.slow.iter().zip(exponents).map(power).product()
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    fn forward_avx512(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f64]) {
        self.forward::<true>(x, stride, rows, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn forward_avx2(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f64]) {
        self.forward::<true>(x, stride, rows, out);
    }

    #[inline(always)]
    fn forward<const FMA: bool>(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f64]) {
        let mut row = 0;
        while row + ROWS <= rows {
            self.rows::<ROWS, FMA>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += ROWS;
        }
        while row < rows {
            self.rows::<1, FMA>(&x[row * stride..], stride, &mut out[row * self.padded()..]);
            row += 1;
        }
    }

    /// R windows. Every sum is made of the same parts in the same order whatever R is.
    #[inline(always)]
    fn rows<const R: usize, const FMA: bool>(&self, x: &[f32], stride: usize, out: &mut [f64]) {
        let windows: [&[f32]; R] = std::array::from_fn(|r| &x[r * stride..r * stride + self.inputs]);
        for (panel, weights) in self.panels.chunks(self.inputs.max(1)).enumerate() {
            let mut sums = [[[0.0_f64; LANES]; R]; PARTS];
            let whole = self.inputs - self.inputs % PARTS;
            for first in (0..whole).step_by(PARTS) {
                for part in 0..PARTS {
                    let w = &weights[first + part];
                    for r in 0..R {
                        multiply_add::<FMA>(&mut sums[part][r], f64::from(windows[r][first + part]), w);
                    }
                }
            }
            for i in whole..self.inputs {
                for r in 0..R {
                    multiply_add::<FMA>(&mut sums[0][r], f64::from(windows[r][i]), &weights[i]);
                }
            }
            for r in 0..R {
                let first = panel * LANES;
                let slots = &mut out[r * self.padded() + first..][..LANES];
                for (lane, slot) in slots.iter_mut().enumerate() {
                    let total = (sums[0][r][lane] + sums[1][r][lane]) + (sums[2][r][lane] + sums[3][r][lane]);
                    *slot = total + self.bias[first + lane];
                }
            }
        }
    }
}

#[inline(always)]
fn multiply_add<const FMA: bool>(sums: &mut [f64; LANES], value: f64, weights: &[f64; LANES]) {
    for (sum, weight) in sums.iter_mut().zip(weights) {
        *sum = if FMA {
            value.mul_add(*weight, *sum)
        } else {
            *sum + value * weight
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(offset: f64, scale: f64) -> ScaledChannel {
        ScaledChannel {
            name: String::new(),
            unit: String::new(),
            offset,
            scale,
        }
    }

    #[test]
    fn it_agrees_with_the_definition_beyond_the_range_too() {
        // 11 samples of two channels, three terms, two targets; the slow signal is channel 1.
        let (size, targets) = (22, 2);
        let value = |i: usize| ((i * 2_654_435_761) % 1000) as f64 / 500.0 - 1.0;
        let map = SkipWeights {
            weight: (0..6 * size).map(value).collect(),
            bias: (900..906).map(value).collect(),
        };
        let schedule = Schedule {
            inputs: vec![1],
            centre: vec![0.5],
            half_range: vec![0.8],
            exponents: vec![vec![0], vec![1], vec![2]],
        };
        let channels = [channel(0.0, 1.0), channel(0.3, 1.5)];
        let kernel = SkipKernel::new(&map, Some(&schedule), &channels, targets);
        let x: Vec<f32> = (300..300 + 7 * 2 + size).map(|i| value(i) as f32).collect();
        let rows = 8;
        let mut scratch = vec![0.0; rows * kernel.padded()];
        let mut out = vec![1.0; rows * targets];
        kernel.add(&x, 2, rows, &mut scratch, &mut out);
        let mut clamped = 0;
        for row in 0..rows {
            let window = &x[row * 2..row * 2 + size];
            let length = 0.3 + 1.5 * f64::from(window[size - 1]);
            let u = (length - 0.5) / 0.8;
            clamped += usize::from(u.abs() > 1.0);
            let u = u.clamp(-1.0, 1.0);
            for t in 0..targets {
                let expected: f64 = (0..3)
                    .map(|term| {
                        let r = term * targets + t;
                        let linear: f64 = (0..size)
                            .map(|i| map.weight[r * size + i] * f64::from(window[i]))
                            .sum();
                        u.powi(i32::try_from(term).unwrap()) * (linear + map.bias[r])
                    })
                    .sum::<f64>()
                    + 1.0;
                // A sum in f64, rounded to f32; it is below ten.
                assert!(
                    (f64::from(out[row * targets + t]) - expected).abs() < 1e-6,
                    "row {row}"
                );
            }
        }
        assert!(clamped > 0, "the test should leave the range");
    }
}
