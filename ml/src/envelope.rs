//! The region of inputs that a model knows: unusual motions, and relations between the sensors.
//!
//! A window's projection has two parts. Its leading principal components tell motions unlike the training's. The
//! *relations* tell sensors that contradict each other: for every channel c and every slow shape p_j over the window
//! (orthonormal polynomials, j = 0 … 3) what the channel shows beyond what the others say of it,
//!
//! ```text
//! r_cj = p_jᵀ (x_c − E[x_c | x_others]) / √steps,   E[x_c | x_others] = x̄_c + Σ_co (Σ_oo + ν λ_max)⁻¹ (x_others − x̄_others)
//! ```
//!
//! in units of the channel's standard deviation: r_c0 is its mean over the window, r_c1 its slope. A sensor that is
//! stuck while the machine moves, two swapped channels, or another payload break a relation; a machine that honestly
//! stands still does not. A linear relation is enough and holds farther from the training runs than a polynomial or a
//! network of random features did (tried on the published boom).

use crate::cholesky;
use crate::evaluate::metrics::quantile;
use crate::least_squares::{Spectrum, WindowMoments};
use crate::model::weights::LinearWeights;
use crate::predict::group_squares;
use crate::predict::kernel::PackedLayer;
use crate::window::{Series, Windows};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Mat, Par};
use hydroflex_openapi::model::EnvelopeGroup;
use rayon::prelude::*;

/// Shapes per channel: mean, slope, and two bends. More shapes see noise-like commands that move nothing.
const SHAPES: usize = 4;
/// ν, relative to the largest eigenvalue of the windows' covariance.
const RELATION_RIDGE: f64 = 1e-8;
/// Leading directions have at least this part of the largest variance.
const LEADING_CUT: f64 = 1e-2;
/// Part of the windows of honest runs within each limit, before the limit is widened …
const QUANTILE: f64 = 0.9992;
/// … by this factor (1.1 of the coordinate), for what a few runs did not show.
const ROOM: f64 = 1.21;

/// Projection of a scaled window and the groups of its rows; no limits yet.
#[must_use]
#[allow(clippy::cast_possible_truncation, reason = "projections are f32")]
pub fn projection(
    moments: &WindowMoments,
    spectrum: &Spectrum,
    width: usize,
) -> (LinearWeights, Vec<EnvelopeGroup>) {
    let leading = spectrum.whitening(LEADING_CUT, 0.0);
    let relations = relations(moments, spectrum, width);
    let mut groups = Vec::with_capacity(1 + relations.len());
    let group = |components| EnvelopeGroup {
        components,
        limit: f64::MAX,
    };
    if !leading.is_empty() {
        groups.push(group(leading.len()));
    }
    groups.extend(relations.iter().map(|_| group(1)));
    let rows: Vec<Vec<f64>> = leading.into_iter().chain(relations).collect();
    let bias = |row: &Vec<f64>| -row.iter().zip(&moments.mean).map(|(p, m)| p * m).sum::<f64>() as f32;
    let map = LinearWeights {
        bias: rows.iter().map(bias).collect(),
        weight: rows.iter().flatten().map(|&v| v as f32).collect(),
    };
    (map, groups)
}

/// Rows r_cj, channel by channel; none where there is only one channel.
fn relations(moments: &WindowMoments, spectrum: &Spectrum, width: usize) -> Vec<Vec<f64>> {
    let size = moments.mean.len();
    let steps = size / width.max(1);
    if width < 2 {
        return Vec::new();
    }
    let shapes = shapes(steps);
    let largest = spectrum.values.last().copied().unwrap_or(1.0);
    let ridge = RELATION_RIDGE * largest.max(f64::MIN_POSITIVE);
    let covariance = |i: usize, j: usize| moments.covariance[(i.max(j), i.min(j))];
    (0..width)
        .into_par_iter()
        .flat_map_iter(|channel| {
            let own: Vec<usize> = (channel..size).step_by(width).collect();
            let others: Vec<usize> = (0..size).filter(|i| i % width != channel).collect();
            let matrix = Mat::from_fn(others.len(), others.len(), |i, j| {
                covariance(others[i], others[j]) + if i == j { ridge } else { 0.0 }
            });
            let right = Mat::from_fn(others.len(), shapes.len(), |i, j| {
                let products = own
                    .iter()
                    .zip(&shapes[j])
                    .map(|(&k, p)| covariance(others[i], k) * p);
                products.sum::<f64>()
            });
            // Indefinite by rounding: no relation, and nothing is flagged by it.
            let solution = solve(matrix, right);
            let scale = (steps as f64).sqrt().recip();
            let row = |j: usize| {
                let mut row = vec![0.0; size];
                if let Some(solution) = &solution {
                    for (&k, p) in own.iter().zip(&shapes[j]) {
                        row[k] = scale * p;
                    }
                    for (i, &k) in others.iter().enumerate() {
                        row[k] = -scale * solution[(i, j)];
                    }
                }
                row
            };
            (0..shapes.len()).map(row).collect::<Vec<_>>()
        })
        .collect()
}

/// `matrix⁻¹ right` of a positive definite matrix, on one thread so that the result does not depend on their number.
fn solve(matrix: Mat<f64>, mut right: Mat<f64>) -> Option<Mat<f64>> {
    let matrix = cholesky::factor(matrix)?;
    solve_lower_triangular_in_place(matrix.as_ref(), right.as_mut(), Par::Seq);
    solve_upper_triangular_in_place(matrix.as_ref().transpose(), right.as_mut(), Par::Seq);
    Some(right)
}

/// Orthonormal polynomials over `steps` samples, ascending degree.
fn shapes(steps: usize) -> Vec<Vec<f64>> {
    let mut shapes: Vec<Vec<f64>> = Vec::new();
    for degree in 0..SHAPES.min(steps) {
        let mut shape: Vec<f64> = (0..steps)
            .map(|k| {
                let t = 2.0 * (k as f64 + 0.5) / steps as f64 - 1.0;
                t.powi(i32::try_from(degree).unwrap_or(0))
            })
            .collect();
        for before in &shapes {
            let part: f64 = shape.iter().zip(before).map(|(a, b)| a * b).sum();
            for (a, b) in shape.iter_mut().zip(before) {
                *a -= part * b;
            }
        }
        let norm = shape.iter().map(|a| a * a).sum::<f64>().sqrt();
        for a in &mut shape {
            *a /= norm;
        }
        shapes.push(shape);
    }
    shapes
}

/// Limits that all but rare windows of each of `honest` keep: runs of different kinds count for themselves, the
/// widest limit holds.
pub fn set_limits(groups: &mut [EnvelopeGroup], map: &LinearWeights, honest: &[(&Series, &Windows)]) {
    let projection = PackedLayer::new(map, &[]);
    let mut out = vec![0.0; projection.padded()];
    let mut limits = vec![0.0_f64; groups.len()];
    for (series, windows) in honest {
        let mut squares = vec![Vec::with_capacity(windows.len()); groups.len()];
        for index in 0..windows.len() {
            let window = series.window(windows.first_row(index), windows.steps);
            projection.forward(window, window.len(), 1, &mut out);
            for (all, square) in squares.iter_mut().zip(group_squares(groups, &out)) {
                all.push(square);
            }
        }
        for (limit, squares) in limits.iter_mut().zip(&mut squares) {
            *limit = limit.max(ROOM * quantile(squares, QUANTILE));
        }
    }
    for (group, limit) in groups.iter_mut().zip(limits) {
        group.limit = limit;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::least_squares::TargetRows;
    use hydroflex_openapi::job::WindowCut;

    const STEPS: usize = 12;
    const ROWS: usize = 400;

    /// A position, its velocity, and an unrelated signal, over several runs; the last run stands still.
    fn series(seed: u64) -> Series {
        let mut state = seed;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 23) - 1.0
        };
        let mut values = Vec::new();
        for run in 0..8 {
            let (mut x, mut v, mut other) = (random(), 0.0, 0.0);
            for _ in 0..ROWS {
                if run < 7 {
                    v += 0.1 * (random() - v);
                    other += 0.1 * (random() - other);
                }
                x += 0.1 * v;
                values.extend([x as f32, (5.0 * v) as f32, (3.0 * other) as f32]);
            }
        }
        Series {
            width: 3,
            values,
            run_rows: (0..=8).map(|run| run * ROWS).collect(),
        }
    }

    fn windows(series: &Series) -> Windows {
        Windows::new(&series.run_rows, STEPS, WindowCut::Overlapping)
    }

    fn outside(series: &Series, map: &LinearWeights, groups: &[EnvelopeGroup]) -> Vec<bool> {
        let projection = PackedLayer::new(map, &[]);
        let mut out = vec![0.0; projection.padded()];
        let windows = windows(series);
        (0..windows.len())
            .map(|index| {
                let window = series.window(windows.first_row(index), STEPS);
                projection.forward(window, window.len(), 1, &mut out);
                let inside = group_squares(groups, &out)
                    .zip(groups)
                    .all(|(square, group)| square <= group.limit);
                !inside
            })
            .collect()
    }

    #[test]
    fn a_sensor_that_is_stuck_while_the_machine_moves_is_outside_and_honest_rest_is_not() {
        let train = series(1);
        let windows = windows(&train);
        let targets = TargetRows {
            width: 1,
            values: vec![0.0; train.rows()],
        };
        let moments = WindowMoments::gather(&train, &windows, &targets);
        let spectrum = Spectrum::new(&moments).unwrap();
        let (map, mut groups) = projection(&moments, &spectrum, 3);
        let honest = series(2);
        set_limits(&mut groups, &map, &[(&honest, &super::tests::windows(&honest))]);
        let unseen = series(3);
        let flags = outside(&unseen, &map, &groups);
        let alarms = flags.iter().filter(|&&f| f).count();
        assert!(
            alarms * 50 < flags.len(),
            "{alarms} false alarms of {}",
            flags.len()
        );
        let rest = &flags[7 * (ROWS - STEPS + 1)..];
        assert!(!rest.contains(&true), "rest is honest");
        for (channel, swap) in [(0, None), (1, None), (0, Some(1))] {
            let mut faulty = unseen.clone();
            for row in faulty.values.chunks_mut(3).take(7 * ROWS) {
                match swap {
                    Some(other) => row.swap(channel, other),
                    None => row[channel] = unseen.values[channel],
                }
            }
            let flags = outside(&faulty, &map, &groups);
            let moving = &flags[..7 * (ROWS - STEPS + 1)];
            let found = moving.iter().filter(|&&f| f).count();
            assert!(
                found * 10 > moving.len() * 7,
                "channel {channel}, swapped with {swap:?}: {found} of {}",
                moving.len()
            );
        }
    }

    #[test]
    fn shapes_are_orthonormal() {
        let shapes = shapes(60);
        for (i, a) in shapes.iter().enumerate() {
            for (j, b) in shapes.iter().enumerate() {
                let product: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-12);
            }
        }
        assert_eq!(super::shapes(2).len(), 2);
    }
}
