//! The best map of a window whose coefficients follow slow signals: linear in the window, polynomial
//! in the actuators' lengths.
//!
//! ```text
//! y = Σ_t m_t(u) (W_t x + b_t),   m_t(u) = Π_c u_c^e(t, c),   u_c = clamp((s_c − centre_c) / half_range_c, −1, 1)
//! ```
//!
//! x is the scaled window, s_c the length of cylinder c at its end. A machine that stands at some
//! angle answers almost linearly to what its valve and oil did within the last window, and how it
//! answers changes with the angle, which the lengths tell: a system that is linear with varying
//! parameters. All coefficients follow from one least-squares problem,
//!
//! ```text
//! minimise Σ_w |y_w − Σ_t m_t (W_t (x_w − x̄) + b_t)|² + N μ Σ_t |W_t|²
//! ```
//!
//! in f64: windows of smooth signals are nearly collinear, and the coefficients that use what little
//! they differ by are large. Degree and ridge μ are those with the smallest error on the validation runs.
//!
//! The normal matrix consists of the blocks `Σ_w u^(e(t) + e(t')) x xᵀ`, so there are only as many of them as
//! sums of exponents. Ordered by degree, the Cholesky factor of a smaller degree is the leading
//! part of that of the largest, so one factorisation per ridge serves all degrees.

use crate::cholesky;
use crate::evaluate::metrics::quantile;
use crate::least_squares::TargetRows;
use crate::scaling::Scaling;
use crate::window::{Series, Windows};
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, Mat, Par};
use hydroflex_openapi::model::Schedule;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// How much a fit may take.
#[derive(Debug, Clone)]
pub struct Effort {
    /// Largest total degree in the slow signals.
    pub degree: u32,
    /// Most unknowns per target; their cube is the time of the fit.
    pub unknowns: usize,
    /// Ridges tried, relative to the mean square of a scaled channel: powers of ten.
    pub ridges: std::ops::RangeInclusive<i32>,
    /// The smallest ridges that the normal equations can be solved with are tried, so many and one after the other; absent:
    /// all, at once, each with its own copy of the normal matrix.
    pub tried: Option<usize>,
}

impl Effort {
    /// Of a map whose coefficients follow the lengths.
    pub const LENGTHS: Self = Self {
        degree: 4,
        unknowns: 2600,
        ridges: -15..=-3,
        tried: None,
    };
}

/// Fewest samples of the window that the products see when unknowns have to be saved.
const FEWEST_PRODUCT_STEPS: usize = 12;
/// Most multiply-adds spent on a normal matrix; beyond, windows are left out evenly.
const MAX_PRODUCTS: f64 = 6e11;
/// Windows gathered at once.
const BLOCK: usize = 512;
/// Range in which the coefficients follow the slow signals, over the training range: a little beyond it the
/// polynomials hold, far beyond they do not, and the coefficients stay what they are at the edge.
pub const RANGE_FACTOR: f64 = 1.3;
/// Part of the validation windows that choose degree and ridge. In the others something rare may
/// happen (an end stop, cavitation) that no such map follows, and whose errors would decide instead.
pub(crate) const JUDGED_PART: f64 = 0.9;

/// Fitted map.
#[derive(Debug, Clone, PartialEq)]
pub struct ScheduledMap {
    /// Slow signals and exponents.
    pub schedule: Schedule,
    /// Targets.
    pub targets: usize,
    /// Row (term · targets + target) holds the coefficients of a window: terms × targets × values.
    pub weight: Vec<f64>,
    /// Row by row as `weight`.
    pub bias: Vec<f64>,
    /// μ.
    pub ridge: f64,
}

/// No coefficients could be found: the inputs are not finite or constant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the normal equations of the windows cannot be solved with any ridge")]
pub struct NormalEquationsError;

/// One part of the runs: scaled inputs, windows, scaled targets.
#[derive(Debug, Clone, Copy)]
pub struct Sample<'a> {
    /// Scaled inputs.
    pub series: &'a Series,
    /// Windows.
    pub windows: &'a Windows,
    /// Scaled targets.
    pub targets: &'a TargetRows,
    /// Indices of the windows that take part; absent: all.
    pub only: Option<&'a [usize]>,
    /// A slow signal more, in units of its range, by the index of the window; absent: none.
    pub estimates: Option<&'a [f64]>,
}

/// Position of the first value of an input in a window that the products use, and the exponents.
struct Term {
    exponents: Vec<u32>,
    /// First window value that takes part.
    first: usize,
    /// First unknown.
    offset: usize,
}

impl ScheduledMap {
    /// Fits to `train`, chooses degree and ridge by `judge`. `scheduling` are the positions of the slow
    /// signals among the inputs; without any the map is linear. `noise` is the covariance of what disturbs the windows
    /// of `train`, which are clean: the fit is that of infinitely many disturbed copies. Those of `judge` are disturbed
    /// already. (What the noise does to the slow signals themselves is left out: it is far below their range.)
    ///
    /// # Errors
    /// The inputs are not finite or constant.
    pub fn fit(
        train: Sample<'_>,
        judge: Sample<'_>,
        scaling: &Scaling,
        scheduling: &[usize],
        noise: Option<&Mat<f64>>,
        effort: &Effort,
    ) -> Result<Self, NormalEquationsError> {
        let schedule = ranges(train.series, scaling, scheduling);
        let steps = train.windows.steps;
        let signals = scheduling.len() + usize::from(train.estimates.is_some());
        let terms = terms(signals, steps, train.series.width, effort);
        let exponents: Vec<Vec<u32>> = terms.iter().map(|t| t.exponents.clone()).collect();
        let schedule = Schedule {
            exponents,
            ..schedule
        };
        let normal = Normal::gather(&train, scaling, &schedule, &terms, noise);
        let candidates = normal.candidates(effort);
        let errors = normal.errors(&candidates, &judge, scaling, &schedule);
        let best = errors
            .iter()
            .enumerate()
            .filter(|(_, error)| error.is_finite())
            .min_by(|a, b| a.1.total_cmp(b.1))
            .map(|(index, _)| &candidates[index])
            .ok_or(NormalEquationsError)?;
        Ok(normal.map(best, &schedule))
    }

    /// Scaled targets of a scaled window. `estimate`: the slow signal more of [`Sample::estimates`].
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn apply(&self, scaling: &Scaling, window: &[f32], estimate: Option<f64>, out: &mut [f64]) {
        let size = window.len();
        let last = &window[size - scaling.len()..];
        out.fill(0.0);
        let factors = factors(
            &self.schedule,
            |input| scaling.unscale(input, f64::from(last[input])),
            estimate,
        );
        for (term, factor) in factors.iter().enumerate() {
            for (t, slot) in out.iter_mut().enumerate() {
                let row = term * self.targets + t;
                let sum: f64 = self.weight[row * size..(row + 1) * size]
                    .iter()
                    .zip(window)
                    .map(|(w, &x)| w * f64::from(x))
                    .sum();
                *slot += factor * (sum + self.bias[row]);
            }
        }
    }
}

/// m_t(u) of every term, from the slow signals in their units.
#[must_use]
pub fn factors(schedule: &Schedule, value: impl Fn(usize) -> f64, estimate: Option<f64>) -> Vec<f64> {
    let u = normalised(schedule, value, estimate);
    schedule
        .exponents
        .iter()
        .map(|exponents| monomial(&u, exponents))
        .collect()
}

fn normalised(schedule: &Schedule, value: impl Fn(usize) -> f64, estimate: Option<f64>) -> Vec<f64> {
    schedule
        .inputs
        .iter()
        .zip(schedule.centre.iter().zip(&schedule.half_range))
        .map(|(&input, (centre, half))| (value(input) - centre) / half)
        .chain(estimate)
        .map(|u| u.clamp(-1.0, 1.0))
        .collect()
}

fn monomial(u: &[f64], exponents: &[u32]) -> f64 {
    u.iter()
        .zip(exponents)
        .map(|(u, &e)| u.powi(i32::try_from(e).unwrap_or(i32::MAX)))
        .product()
}

/// Centre and half range of the slow signals; no exponents yet.
fn ranges(series: &Series, scaling: &Scaling, scheduling: &[usize]) -> Schedule {
    let range = |&input: &usize| {
        let (low, high) = series.values[input..]
            .iter()
            .step_by(series.width)
            .map(|&v| scaling.unscale(input, f64::from(v)))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            });
        let half = 0.5 * RANGE_FACTOR * (high - low);
        (0.5 * (high + low), if half > 0.0 { half } else { 1.0 })
    };
    let (centre, half_range) = scheduling.iter().map(range).unzip();
    Schedule {
        inputs: scheduling.to_vec(),
        centre,
        half_range,
        exponents: Vec::new(),
    }
}

/// All exponents of `channels` signals with a total of `degree`.
fn of_degree(channels: usize, degree: u32) -> Vec<Vec<u32>> {
    if channels == 0 {
        return if degree == 0 { vec![Vec::new()] } else { Vec::new() };
    }
    (0..=degree)
        .flat_map(|first| {
            of_degree(channels - 1, degree - first)
                .into_iter()
                .map(move |mut rest| {
                    rest.insert(0, first);
                    rest
                })
        })
        .collect()
}

/// Terms by ascending degree; the largest degree that `effort` allows, products over the
/// latest samples only where the whole window would be too many.
fn terms(scheduling: usize, steps: usize, width: usize, effort: &Effort) -> Vec<Term> {
    let size = steps * width;
    for degree in (0..=effort.degree).rev() {
        let exponents: Vec<Vec<u32>> = (0..=degree).flat_map(|d| of_degree(scheduling, d)).collect();
        let products = exponents.len() - 1;
        if degree > 0 && products == 0 {
            continue;
        }
        let room = effort.unknowns.saturating_sub(size + 1);
        let product_steps = room
            .checked_div(products)
            .map_or(steps, |share| (share.saturating_sub(1) / width).min(steps));
        if degree > 0 && product_steps < FEWEST_PRODUCT_STEPS.min(steps) {
            continue;
        }
        // Half a window for a fourth power is worth less than a whole one for a third.
        if degree > 2 && product_steps < steps {
            continue;
        }
        let mut offset = 0;
        return exponents
            .into_iter()
            .enumerate()
            .map(|(position, exponents)| {
                let first = if position == 0 {
                    0
                } else {
                    (steps - product_steps) * width
                };
                let term = Term {
                    exponents,
                    first,
                    offset,
                };
                offset += size - first + 1;
                term
            })
            .collect();
    }
    Vec::new()
}

/// Normal equations, lower triangle filled. Unknowns of a term: its bias, then its coefficients.
struct Normal<'a> {
    terms: &'a [Term],
    /// Values of a window.
    size: usize,
    mean: Vec<f64>,
    matrix: Mat<f64>,
    right: Mat<f64>,
}

/// Coefficients of one degree and ridge: unknowns × targets; shorter for smaller degrees.
struct Candidate {
    ridge: f64,
    terms: usize,
    unknowns: Mat<f64>,
}

impl<'a> Normal<'a> {
    fn gather(
        train: &Sample<'_>,
        scaling: &Scaling,
        schedule: &Schedule,
        terms: &'a [Term],
        noise: Option<&Mat<f64>>,
    ) -> Self {
        let size = train.windows.steps * train.series.width;
        let mut sums: BTreeMap<Vec<u32>, Mat<f64>> = BTreeMap::new();
        for a in terms {
            for b in terms {
                let sum = add(&a.exponents, &b.exponents);
                sums.entry(sum).or_insert_with(|| Mat::zeros(size + 1, size + 1));
            }
        }
        let chosen = thinned(train, size, sums.len());
        let mean = mean_window(train, &chosen);
        let targets = train.targets.width;
        let mut right: Vec<Mat<f64>> = terms.iter().map(|_| Mat::zeros(size + 1, targets)).collect();
        for block in chosen.chunks(BLOCK) {
            let gathered = Gathered::new(train, block, &mean, scaling, schedule);
            sums.par_iter_mut()
                .for_each(|(exponents, sum)| gathered.add_second(exponents, sum));
            right
                .par_iter_mut()
                .zip(terms)
                .for_each(|(sum, term)| gathered.add_cross(&term.exponents, sum));
        }
        if let Some(noise) = noise {
            // E[m mʹ (x + n)(x + n)ᵀ] = E[m mʹ x xᵀ] + E[m mʹ] E[n nᵀ]; the first entry is the sum of m mʹ.
            for sum in sums.values_mut() {
                let weight = sum[(0, 0)];
                for j in 0..size {
                    for i in j..size {
                        sum[(1 + i, 1 + j)] += weight * noise[(i, j)];
                    }
                }
            }
        }
        let unknowns = terms.last().map_or(0, |t| t.offset + size - t.first + 1);
        let count = chosen.len() as f64;
        let mut normal = Self {
            terms,
            size,
            mean,
            matrix: Mat::zeros(unknowns, unknowns),
            right: Mat::zeros(unknowns, targets),
        };
        for (row_term, b) in terms.iter().zip(&right) {
            for (row, from) in normal.rows_of(row_term) {
                for t in 0..targets {
                    normal.right[(row, t)] = b[(from, t)] / count;
                }
            }
            for column_term in terms {
                if column_term.offset > row_term.offset {
                    break;
                }
                let sum = &sums[&add(&row_term.exponents, &column_term.exponents)];
                for (column, j) in normal.rows_of(column_term) {
                    for (row, i) in normal.rows_of(row_term) {
                        if row >= column {
                            let value = if i >= j { sum[(i, j)] } else { sum[(j, i)] };
                            normal.matrix[(row, column)] = value / count;
                        }
                    }
                }
            }
        }
        normal
    }

    /// (unknown, row of the sums): 0 is the bias, 1 + k is window value k.
    fn rows_of(&self, term: &Term) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (first, offset, size) = (term.first, term.offset, self.size);
        std::iter::once((offset, 0)).chain((first..size).map(move |k| (offset + 1 + k - first, 1 + k)))
    }

    /// Solutions for every ridge and degree.
    fn candidates(&self, effort: &Effort) -> Vec<Candidate> {
        let of_ridge = |exponent: i32| {
            let ridge = 10.0_f64.powi(exponent);
            let factor = self.factor(ridge)?;
            Some(self.solve(&factor, ridge))
        };
        let exponents: Vec<i32> = effort.ridges.clone().collect();
        let found: Vec<Vec<Candidate>> = match effort.tried {
            None => exponents.par_iter().filter_map(|&e| of_ridge(e)).collect(),
            Some(tried) => exponents.into_iter().filter_map(of_ridge).take(tried).collect(),
        };
        found.into_iter().flatten().collect()
    }

    /// Cholesky factor with ridge; absent where rounding made the matrix indefinite.
    fn factor(&self, ridge: f64) -> Option<Mat<f64>> {
        let mut matrix = self.matrix.clone();
        for term in self.terms {
            for (row, from) in self.rows_of(term) {
                if from > 0 {
                    matrix[(row, row)] += ridge;
                }
            }
        }
        cholesky::factor(matrix)
    }

    /// One solution per degree from the factor of the largest.
    fn solve(&self, factor: &Mat<f64>, ridge: f64) -> Vec<Candidate> {
        let mut forward = self.right.clone();
        solve_lower_triangular_in_place(factor.as_ref(), forward.as_mut(), Par::Seq);
        let degree = |term: &Term| term.exponents.iter().sum::<u32>();
        let mut candidates = Vec::new();
        for (position, term) in self.terms.iter().enumerate() {
            let next = self.terms.get(position + 1);
            if next.is_some_and(|next| degree(next) == degree(term)) {
                continue;
            }
            let count = next.map_or(factor.nrows(), |next| next.offset);
            let mut unknowns = forward.as_ref().subrows(0, count).to_owned();
            let leading = factor.as_ref().submatrix(0, 0, count, count);
            solve_upper_triangular_in_place(leading.transpose(), unknowns.as_mut(), Par::Seq);
            candidates.push(Candidate {
                ridge,
                terms: position + 1,
                unknowns,
            });
        }
        candidates
    }

    /// Error of each candidate on `judge`: the sum over targets of the quantile [`JUDGED_PART`] of the
    /// absolute error.
    fn errors(
        &self,
        candidates: &[Candidate],
        judge: &Sample<'_>,
        scaling: &Scaling,
        schedule: &Schedule,
    ) -> Vec<f64> {
        let all = thinned(judge, self.size, candidates.len());
        let targets = judge.targets.width;
        let mut errors = vec![vec![Vec::with_capacity(all.len()); targets]; candidates.len()];
        for block in all.chunks(BLOCK) {
            let gathered = Gathered::new(judge, block, &self.mean, scaling, schedule);
            errors
                .par_iter_mut()
                .zip(candidates)
                .for_each(|(errors, candidate)| {
                    for (t, errors) in errors.iter_mut().enumerate() {
                        let mut estimate = vec![0.0; block.len()];
                        for term in &self.terms[..candidate.terms] {
                            let count = self.size - term.first;
                            let unknowns = candidate.unknowns.as_ref().col(t);
                            let tail = gathered.windows.as_ref().subrows(1 + term.first, count);
                            let linear = tail.transpose() * unknowns.subrows(term.offset + 1, count);
                            for (w, slot) in estimate.iter_mut().enumerate() {
                                let factor = monomial(&gathered.u[w], &term.exponents);
                                *slot += factor * (linear[w] + unknowns[term.offset]);
                            }
                        }
                        let error = |(w, e): (usize, &f64)| (e - gathered.targets[(w, t)]).abs();
                        errors.extend(estimate.iter().enumerate().map(error));
                    }
                });
        }
        errors
            .par_iter_mut()
            .map(|errors| {
                errors
                    .iter_mut()
                    .map(|errors| {
                        if errors.iter().all(|e| e.is_finite()) {
                            quantile(errors, JUDGED_PART)
                        } else {
                            f64::INFINITY
                        }
                    })
                    .sum()
            })
            .collect()
    }

    fn map(&self, candidate: &Candidate, schedule: &Schedule) -> ScheduledMap {
        let targets = candidate.unknowns.ncols();
        let terms = &self.terms[..candidate.terms];
        let mut weight = vec![0.0; terms.len() * targets * self.size];
        let mut bias = vec![0.0; terms.len() * targets];
        for (position, term) in terms.iter().enumerate() {
            for t in 0..targets {
                let row = position * targets + t;
                let weights = &mut weight[row * self.size..(row + 1) * self.size];
                bias[row] = candidate.unknowns[(term.offset, t)];
                let inputs = weights[term.first..].iter_mut().zip(&self.mean[term.first..]);
                for (k, (weight, mean)) in inputs.enumerate() {
                    *weight = candidate.unknowns[(term.offset + 1 + k, t)];
                    bias[row] -= *weight * mean;
                }
            }
        }
        ScheduledMap {
            schedule: Schedule {
                exponents: schedule.exponents[..candidate.terms].to_vec(),
                ..schedule.clone()
            },
            targets,
            weight,
            bias,
            ridge: candidate.ridge,
        }
    }
}

fn add(a: &[u32], b: &[u32]) -> Vec<u32> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}

/// Windows that take part: all, or evenly spread ones where all would take too long.
fn thinned(sample: &Sample<'_>, size: usize, products: usize) -> Vec<usize> {
    let windows = sample.only.map_or(sample.windows.len(), <[usize]>::len);
    let work = windows as f64 * (size * size) as f64 * products as f64 / 2.0;
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "at least 1, and small"
    )]
    let stride = (work / MAX_PRODUCTS).ceil().max(1.0) as usize;
    let evenly = (0..windows).step_by(stride);
    match sample.only {
        Some(only) => evenly.map(|place| only[place]).collect(),
        None => evenly.collect(),
    }
}

fn mean_window(sample: &Sample<'_>, chosen: &[usize]) -> Vec<f64> {
    let size = sample.windows.steps * sample.series.width;
    let mut mean = vec![0.0; size];
    for &index in chosen {
        let window = sample
            .series
            .window(sample.windows.first_row(index), sample.windows.steps);
        for (m, &x) in mean.iter_mut().zip(window) {
            *m += f64::from(x);
        }
    }
    for mean in &mut mean {
        *mean /= chosen.len().max(1) as f64;
    }
    mean
}

/// A block of windows in f64.
struct Gathered {
    /// (1, x − x̄) by column.
    windows: Mat<f64>,
    /// Slow signals of each window.
    u: Vec<Vec<f64>>,
    /// Row by row.
    targets: Mat<f64>,
}

impl Gathered {
    fn new(
        sample: &Sample<'_>,
        block: &[usize],
        mean: &[f64],
        scaling: &Scaling,
        schedule: &Schedule,
    ) -> Self {
        let steps = sample.windows.steps;
        let mut windows = Mat::<f64>::zeros(mean.len() + 1, block.len());
        let mut targets = Mat::<f64>::zeros(block.len(), sample.targets.width);
        let mut u = Vec::with_capacity(block.len());
        for (column, &index) in block.iter().enumerate() {
            let first = sample.windows.first_row(index);
            let row = first + steps - 1;
            let slots = windows.col_as_slice_mut(column);
            slots[0] = 1.0;
            for ((slot, &x), m) in slots[1..]
                .iter_mut()
                .zip(sample.series.window(first, steps))
                .zip(mean)
            {
                *slot = f64::from(x) - m;
            }
            for (t, &y) in sample.targets.row(row).iter().enumerate() {
                targets[(column, t)] = y;
            }
            let last = sample.series.row(row);
            u.push(normalised(
                schedule,
                |input| scaling.unscale(input, f64::from(last[input])),
                sample.estimates.map(|estimates| estimates[index]),
            ));
        }
        Self { windows, u, targets }
    }

    /// The windows, each times its monomial.
    fn weighted(&self, exponents: &[u32]) -> Mat<f64> {
        let mut weighted = self.windows.clone();
        for (column, u) in self.u.iter().enumerate() {
            let factor = monomial(u, exponents);
            weighted
                .col_as_slice_mut(column)
                .iter_mut()
                .for_each(|x| *x *= factor);
        }
        weighted
    }

    fn add_second(&self, exponents: &[u32], sum: &mut Mat<f64>) {
        triangular::matmul(
            sum.as_mut(),
            BlockStructure::TriangularLower,
            Accum::Add,
            self.weighted(exponents).as_ref(),
            BlockStructure::Rectangular,
            self.windows.as_ref().transpose(),
            BlockStructure::Rectangular,
            1.0,
            Par::Seq,
        );
    }

    fn add_cross(&self, exponents: &[u32], sum: &mut Mat<f64>) {
        faer::linalg::matmul::matmul(
            sum.as_mut(),
            Accum::Add,
            self.weighted(exponents).as_ref(),
            self.targets.as_ref(),
            1.0,
            Par::Seq,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runs::{RunSamples, Runs};
    use hydroflex_openapi::channel::{Channel, ChannelRole};
    use hydroflex_openapi::job::WindowCut;

    const STEPS: usize = 4;

    /// A length that drifts and a rough signal; the target is what `law` makes of the length at the end
    /// of a window and of the window's rough values.
    struct Case {
        series: Series,
        windows: Windows,
        targets: TargetRows,
        scaling: Scaling,
    }

    fn case(seed: u64, law: impl Fn(f64, &[f64]) -> f64) -> Case {
        let mut state = seed;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 23) - 1.0
        };
        let channel = |name: &str| Channel {
            name: name.to_owned(),
            unit: "m".to_owned(),
            quantity: String::new(),
            frame: None,
            role: ChannelRole::Sensor,
        };
        let runs = Runs {
            channels: vec![channel("length_lift_m"), channel("rough")],
            sample_time_s: 0.005,
            runs: (0..20)
                .map(|run_id| {
                    let start = 1.0 + 0.2 * random();
                    let slope = 0.002 * random();
                    let length = (0..60).map(|k| start + slope * f64::from(k)).collect();
                    let rough = (0..60).map(|_| random()).collect();
                    RunSamples {
                        run_id,
                        columns: vec![length, rough],
                    }
                })
                .collect(),
        };
        let scaling = Scaling::fit(&runs);
        let series = Series::new(&runs, &scaling);
        let windows = Windows::new(&series.run_rows, STEPS, WindowCut::Overlapping);
        let mut values = vec![0.0; series.rows()];
        for index in 0..windows.len() {
            let (first, row) = (windows.first_row(index), windows.last_row(index));
            // From the f32 values, so that the law is exact in what the fit sees.
            let value = |r: usize, c: usize| scaling.unscale(c, f64::from(series.row(r)[c]));
            let rough: Vec<f64> = (first..=row).map(|r| value(r, 1)).collect();
            values[row] = law(value(row, 0), &rough);
        }
        Case {
            series,
            windows,
            targets: TargetRows { width: 1, values },
            scaling,
        }
    }

    fn sample(case: &Case) -> Sample<'_> {
        Sample {
            series: &case.series,
            windows: &case.windows,
            targets: &case.targets,
            only: None,
            estimates: None,
        }
    }

    fn largest_error(map: &ScheduledMap, case: &Case) -> f64 {
        let mut estimate = [0.0];
        (0..case.windows.len())
            .map(|index| {
                let window = case.series.window(case.windows.first_row(index), STEPS);
                map.apply(&case.scaling, window, None, &mut estimate);
                (estimate[0] - case.targets.row(case.windows.last_row(index))[0]).abs()
            })
            .fold(0.0, f64::max)
    }

    #[test]
    fn coefficients_that_follow_the_length_are_found() {
        let law = |s: f64, x: &[f64]| {
            let u = s - 1.0;
            0.3 + x[3] - 0.5 * x[1] + 2.0 * u * x[2] + 8.0 * u * u * (x[0] - 1.0)
        };
        let train = case(1, law);
        let fit = |scheduling: &[usize]| {
            let sample = sample(&train);
            ScheduledMap::fit(sample, sample, &train.scaling, scheduling, None, &Effort::LENGTHS).unwrap()
        };
        let map = fit(&[0]);
        assert!(map.schedule.exponents.len() >= 3, "{:?}", map.schedule.exponents);
        // Targets of size one, a normal matrix in f64.
        assert!(
            largest_error(&map, &train) < 1e-6,
            "{}",
            largest_error(&map, &train)
        );
        let constant = fit(&[]);
        assert_eq!(constant.schedule.exponents, [Vec::<u32>::new()]);
        assert!(largest_error(&constant, &train) > 0.05);
    }

    #[test]
    fn terms_are_ordered_by_degree_and_stay_within_their_number() {
        for (scheduling, steps, width) in [(1, 60, 5), (1, 100, 5), (2, 100, 10), (0, 100, 5), (2, 20, 2)] {
            let terms = terms(scheduling, steps, width, &Effort::LENGTHS);
            let degrees: Vec<u32> = terms.iter().map(|t| t.exponents.iter().sum()).collect();
            assert!(degrees.is_sorted(), "{degrees:?}");
            let last = terms.last().unwrap();
            assert!(last.offset + steps * width - last.first < Effort::LENGTHS.unknowns);
            assert_eq!(terms[0].first, 0, "the linear part sees the whole window");
            assert_eq!(scheduling == 0, terms.len() == 1);
        }
    }
}
