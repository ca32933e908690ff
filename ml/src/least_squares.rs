//! The best linear map of a window, from exact second moments.
//!
//! ```text
//! minimise Σ_w |y_w − W x_w − b|² + μ λ_max N |W|²
//! W = Cᵀ V (Λ + μ λ_max)⁻¹ Vᵀ,   Σ_xx = V Λ Vᵀ,   C = Σ_xy
//! ```
//!
//! x_w is the window (steps · inputs scaled values), y_w the target at its end. Neighbouring
//! windows share all but one row, so the moments follow from those of the first row by a
//! recursion along the diagonal instead of from W n² products:
//!
//! ```text
//! S(a+1, b+1) = S(a, b) − x(r₀+a) x(r₀+b)ᵀ + x(r₀+a+m) x(r₀+b+m)ᵀ      (a run with m windows from row r₀)
//! ```
//!
//! The ridge μ is the one with the smallest error on the validation runs. The same spectrum
//! whitens the windows for the network (see [`Spectrum::whitening`]).

use crate::window::{Series, Windows};
use faer::diag::Diag;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::evd::{ComputeEigenvectors, self_adjoint_evd, self_adjoint_evd_scratch};
use faer::{Mat, Par, Spec};

/// Scaled targets in f64, row by row as the [`Series`] they belong to.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetRows {
    /// Targets per row.
    pub width: usize,
    /// Row-major values.
    pub values: Vec<f64>,
}

impl TargetRows {
    /// One row.
    #[must_use]
    pub fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.width..(row + 1) * self.width]
    }
}

/// Means and covariances of windows and of the targets at their ends.
#[derive(Debug, Clone)]
pub struct WindowMoments {
    /// Number of windows.
    pub count: f64,
    /// Mean window.
    pub mean: Vec<f64>,
    /// Covariance of the window's values; symmetric, lower triangle filled.
    pub covariance: Mat<f64>,
    /// Covariance of window value (row) and target (column).
    pub cross: Mat<f64>,
    /// Mean of each target.
    pub target_mean: Vec<f64>,
    /// Variance of each target.
    pub target_variance: Vec<f64>,
}

impl WindowMoments {
    /// Moments of all `windows`.
    ///
    /// # Panics
    /// When there is no window.
    #[must_use]
    pub fn gather(series: &Series, windows: &Windows, targets: &TargetRows) -> Self {
        assert!(!windows.is_empty(), "moments of no window");
        let size = windows.steps * series.width;
        let count = windows.len() as f64;
        let mut second = if windows.stride() == 1 {
            hankel_second_moment(series, windows)
        } else {
            direct_second_moment(series, windows)
        };
        let mut mean = vec![0.0; size];
        let mut cross = Mat::<f64>::zeros(size, targets.width);
        let mut target_mean = vec![0.0; targets.width];
        let mut target_square = vec![0.0; targets.width];
        for index in 0..windows.len() {
            let first = windows.first_row(index);
            let window = series.window(first, windows.steps);
            let target = targets.row(first + windows.steps - 1);
            for (m, &x) in mean.iter_mut().zip(window) {
                *m += f64::from(x);
            }
            for (t, &y) in target.iter().enumerate() {
                target_mean[t] += y;
                target_square[t] += y * y;
                for (c, &x) in cross.col_as_slice_mut(t).iter_mut().zip(window) {
                    *c += f64::from(x) * y;
                }
            }
        }
        for mean in mean.iter_mut().chain(&mut target_mean) {
            *mean /= count;
        }
        for j in 0..size {
            for i in j..size {
                second[(i, j)] = second[(i, j)] / count - mean[i] * mean[j];
            }
        }
        for t in 0..targets.width {
            for i in 0..size {
                cross[(i, t)] = cross[(i, t)] / count - mean[i] * target_mean[t];
            }
        }
        let target_variance = target_square
            .iter()
            .zip(&target_mean)
            .map(|(s, m)| (s / count - m * m).max(0.0))
            .collect();
        Self {
            count,
            mean,
            covariance: second,
            cross,
            target_mean,
            target_variance,
        }
    }

    /// Adds the covariance of noise in the windows, independent of the windows and the targets.
    pub fn add_noise(&mut self, covariance: &Mat<f64>) {
        let size = self.mean.len();
        for j in 0..size {
            for i in j..size {
                self.covariance[(i, j)] += covariance[(i, j)];
            }
        }
    }

    /// Mean squared error of `map` for each target on these windows.
    #[must_use]
    pub fn mean_squared_error(&self, map: &LinearMap) -> Vec<f64> {
        let size = self.mean.len();
        (0..self.target_mean.len())
            .map(|t| {
                let w = map.row(t);
                // w'Σw from the lower triangle.
                let mut quadratic = 0.0;
                for j in 0..size {
                    let column = self.covariance.col_as_slice(j);
                    let below: f64 = (j + 1..size).map(|i| column[i] * w[i]).sum();
                    quadratic += w[j] * (column[j] * w[j] + 2.0 * below);
                }
                let linear: f64 = self.cross.col_as_slice(t).iter().zip(w).map(|(c, w)| c * w).sum();
                let bias = self.target_mean[t] - map.bias[t] - dot(w, &self.mean);
                (self.target_variance[t] - 2.0 * linear + quadratic).max(0.0) + bias * bias
            })
            .collect()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Σ_w x_w x_wᵀ (lower triangle) by the recursion along the diagonal.
fn hankel_second_moment(series: &Series, windows: &Windows) -> Mat<f64> {
    let c = series.width;
    let steps = windows.steps;
    let size = steps * c;
    let mut s = Mat::<f64>::zeros(size, size);
    let mut rows: Vec<f64> = Vec::new();
    for (first, count) in windows.spans() {
        rows.clear();
        rows.extend(
            series
                .window(first, count + steps - 1)
                .iter()
                .map(|&x| f64::from(x)),
        );
        // The first c columns of this run's sum, kept apart: the recursion needs them per run
        // only through their sum, so they go straight into `s`.
        for w in 0..count {
            let window = &rows[w * c..w * c + size];
            for j in 0..c {
                let x = window[j];
                for (slot, v) in s.col_as_slice_mut(j)[j..].iter_mut().zip(&window[j..]) {
                    *slot += v * x;
                }
            }
        }
    }
    // Columns of step a+1 from those of step a. Column (a, j) holds rows (b, i) with b ≥ a.
    for a in 0..steps - 1 {
        for j in 0..c {
            // The upper part inside the diagonal block is not stored; it is symmetric.
            let length = size - (a + 1) * c;
            let mut next: Vec<f64> = (0..length)
                .map(|k| {
                    let (i, column) = (a * c + k, a * c + j);
                    if i >= column {
                        s[(i, column)]
                    } else {
                        s[(column, i)]
                    }
                })
                .collect();
            for (first, count) in windows.spans() {
                let leaving = f64::from(series.values[(first + a) * c + j]);
                let entering = f64::from(series.values[(first + a + count) * c + j]);
                let out = &series.values[(first + a) * c..(first + a) * c + length];
                let into = &series.values[(first + a + count) * c..(first + a + count) * c + length];
                for ((slot, &o), &i) in next.iter_mut().zip(out).zip(into) {
                    *slot += entering * f64::from(i) - leaving * f64::from(o);
                }
            }
            let column = (a + 1) * c + j;
            s.col_as_slice_mut(column)[column..].copy_from_slice(&next[j..]);
        }
    }
    s
}

/// Σ_w x_w x_wᵀ (lower triangle) window by window.
fn direct_second_moment(series: &Series, windows: &Windows) -> Mat<f64> {
    let size = windows.steps * series.width;
    let mut s = Mat::<f64>::zeros(size, size);
    for index in 0..windows.len() {
        let window = series.window(windows.first_row(index), windows.steps);
        for j in 0..size {
            let x = f64::from(window[j]);
            for (slot, &v) in s.col_as_slice_mut(j)[j..].iter_mut().zip(&window[j..]) {
                *slot += f64::from(v) * x;
            }
        }
    }
    s
}

/// A linear map of a scaled window to scaled targets.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearMap {
    /// targets × window values, row-major.
    pub weight: Vec<f64>,
    /// One per target.
    pub bias: Vec<f64>,
    /// μ, relative to the largest eigenvalue.
    pub ridge: f64,
}

impl LinearMap {
    /// Weights of one target.
    #[must_use]
    pub fn row(&self, target: usize) -> &[f64] {
        let size = self.weight.len() / self.bias.len();
        &self.weight[target * size..(target + 1) * size]
    }

    /// Applies the map to a scaled window.
    pub fn apply(&self, window: &[f32], out: &mut [f64]) {
        for (t, slot) in out.iter_mut().enumerate() {
            *slot = self.bias[t]
                + self
                    .row(t)
                    .iter()
                    .zip(window)
                    .map(|(w, &x)| w * f64::from(x))
                    .sum::<f64>();
        }
    }
}

/// Eigenvalues (ascending) and eigenvectors (columns) of the windows' covariance.
#[derive(Debug, Clone)]
pub struct Spectrum {
    /// Eigenvalues, ascending.
    pub values: Vec<f64>,
    /// Eigenvectors, one per column.
    pub vectors: Mat<f64>,
}

/// The eigenvalue iteration did not converge; inputs are not finite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the eigenvalues of the windows' covariance did not converge")]
pub struct SpectrumError;

/// Rounding of an f32 sum of products, relative to the norm of its weights: a map whose weights
/// are so large that this matters is worse in f32 than its exact error says.
const F32_ROUNDING: f64 = 1e-7;

impl Spectrum {
    /// Decomposes the covariance, on one thread so that the result does not depend on their number.
    ///
    /// # Errors
    /// No convergence.
    pub fn new(moments: &WindowMoments) -> Result<Self, SpectrumError> {
        let size = moments.mean.len();
        let mut vectors = Mat::<f64>::zeros(size, size);
        let mut values = Diag::<f64>::zeros(size);
        let scratch =
            self_adjoint_evd_scratch::<f64>(size, ComputeEigenvectors::Yes, Par::Seq, Spec::default());
        self_adjoint_evd(
            moments.covariance.as_ref(),
            values.as_mut(),
            Some(vectors.as_mut()),
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(scratch)),
            Spec::default(),
        )
        .map_err(|_| SpectrumError)?;
        Ok(Self {
            values: (0..size).map(|i| values[i]).collect(),
            vectors,
        })
    }

    fn largest(&self) -> f64 {
        self.values.last().copied().unwrap_or(0.0).max(f64::MIN_POSITIVE)
    }

    /// The ridge solution for relative ridge `ridge`.
    #[must_use]
    pub fn ridge_map(&self, moments: &WindowMoments, ridge: f64) -> LinearMap {
        let size = self.values.len();
        let targets = moments.target_mean.len();
        let shift = ridge * self.largest();
        let projected = self.vectors.transpose() * &moments.cross;
        let mut weight = vec![0.0; targets * size];
        let mut bias = vec![0.0; targets];
        for t in 0..targets {
            let row = &mut weight[t * size..(t + 1) * size];
            for k in 0..size {
                let factor = projected[(k, t)] / (self.values[k].max(0.0) + shift);
                for (w, v) in row.iter_mut().zip(self.vectors.col_as_slice(k)) {
                    *w += factor * v;
                }
            }
            bias[t] = moments.target_mean[t] - dot(row, &moments.mean);
        }
        LinearMap { weight, bias, ridge }
    }

    /// The ridge solution with the smallest error on `judge`, f32 rounding included.
    #[must_use]
    pub fn best_map(&self, moments: &WindowMoments, judge: &WindowMoments) -> LinearMap {
        let mut best: Option<(f64, LinearMap)> = None;
        for exponent in -13..=-2 {
            let map = self.ridge_map(moments, 10.0_f64.powi(exponent));
            let error: f64 = judge.mean_squared_error(&map).iter().sum();
            let rounding = F32_ROUNDING * F32_ROUNDING * dot(&map.weight, &map.weight);
            let score = error + rounding;
            if best.as_ref().is_none_or(|(least, _)| score < *least) {
                best = Some((score, map));
            }
        }
        best.map_or_else(|| self.ridge_map(moments, 1e-2), |(_, map)| map)
    }

    /// Directions that whiten a window: `components` rows of `size` values, the k-th being
    /// v_k / √(λ_k + floor λ_max), largest eigenvalue first, for all λ_k > `cut` λ_max.
    #[must_use]
    pub fn whitening(&self, cut: f64, floor: f64) -> Vec<Vec<f64>> {
        let largest = self.largest();
        (0..self.values.len())
            .rev()
            .take_while(|&k| self.values[k] > cut * largest)
            .map(|k| {
                let scale = (self.values[k] + floor * largest).sqrt().recip();
                self.vectors.col_as_slice(k).iter().map(|v| v * scale).collect()
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hydroflex_openapi::job::WindowCut;

    /// Two runs of a smooth and a rough channel.
    fn series() -> Series {
        let run_rows = vec![0, 23, 40];
        let mut state = 1_u32;
        let mut values = Vec::new();
        for row in 0..40 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            values.push((f64::from(row) * 0.3).sin() as f32);
            values.push(f32::from((state >> 16) as u16) / 65536.0 - 0.3);
        }
        Series {
            width: 2,
            values,
            run_rows,
        }
    }

    #[test]
    fn the_recursion_equals_the_direct_sum() {
        let series = series();
        let windows = Windows::new(&series.run_rows, 4, WindowCut::Overlapping);
        let fast = hankel_second_moment(&series, &windows);
        let direct = direct_second_moment(&series, &windows);
        for j in 0..8 {
            for i in j..8 {
                // Both are sums of 34 terms of size one in f64.
                assert!((fast[(i, j)] - direct[(i, j)]).abs() < 1e-12, "({i}, {j})");
            }
        }
    }

    #[test]
    fn a_linear_target_is_found_exactly() {
        let series = series();
        let windows = Windows::new(&series.run_rows, 3, WindowCut::Overlapping);
        let truth = [0.5, -1.0, 0.0, 2.0, 0.25, -0.75];
        let mut values = vec![0.0; 40];
        for w in 0..windows.len() {
            let window = series.window(windows.first_row(w), 3);
            values[windows.last_row(w)] = 3.0
                + truth
                    .iter()
                    .zip(window)
                    .map(|(a, &b)| a * f64::from(b))
                    .sum::<f64>();
        }
        let targets = TargetRows { width: 1, values };
        let moments = WindowMoments::gather(&series, &windows, &targets);
        let map = Spectrum::new(&moments).unwrap().best_map(&moments, &moments);
        let mut estimate = [0.0];
        for w in 0..windows.len() {
            map.apply(series.window(windows.first_row(w), 3), &mut estimate);
            let expected = targets.row(windows.last_row(w))[0];
            // The smallest ridge tried is 1e-13; a sine and its shifts are collinear up to 1e-2.
            assert!(
                (estimate[0] - expected).abs() < 1e-6,
                "{} {expected}",
                estimate[0]
            );
        }
        let mse = moments.mean_squared_error(&map)[0];
        assert!(mse < 1e-12, "{mse}");
    }

    #[test]
    fn whitened_windows_have_unit_variance() {
        let series = series();
        let windows = Windows::new(&series.run_rows, 3, WindowCut::Overlapping);
        let targets = TargetRows {
            width: 1,
            values: vec![0.0; 40],
        };
        let moments = WindowMoments::gather(&series, &windows, &targets);
        let rows = Spectrum::new(&moments).unwrap().whitening(1e-9, 0.0);
        for row in &rows {
            let mut sum = 0.0;
            for w in 0..windows.len() {
                let window = series.window(windows.first_row(w), 3);
                let z: f64 = row
                    .iter()
                    .zip(window)
                    .zip(&moments.mean)
                    .map(|((a, &x), m)| a * (f64::from(x) - m))
                    .sum();
                sum += z * z;
            }
            // Small eigenvalues carry the rounding of the covariance, 1e-16 over 1e-9.
            assert!((sum / moments.count - 1.0).abs() < 1e-5);
        }
    }
}
