//! 90 % intervals by split conformal prediction (Vovk et al.), in classes of amplitude.
//!
//! Within a class the half width is the ⌈0.9 (n + 1)⌉-th smallest absolute error of the windows that
//! calibrate. Errors grow with the estimate's distance from the mean, so a single width would cover
//! small amplitudes too often and large ones too rarely.

use hydroflex_openapi::model::IntervalTable;

/// Part of the true values inside, in tenths.
const LEVEL_TENTHS: usize = 9;
/// Classes of amplitude, of equal numbers of windows: at least three, and more where the windows fill them, because errors
/// also differ within a third …
const CLASSES: std::ops::RangeInclusive<usize> = 3..=12;
/// … which needs this many windows in each; neighbouring windows tell nearly the same.
const FILLED_CLASS: usize = 2000;
/// Fewest windows in a class.
const SMALLEST_CLASS: usize = 60;

/// Table for one target; absent when there are too few windows.
#[must_use]
pub fn fit(estimate: &[f64], reference: &[f64], centre: f64) -> Option<IntervalTable> {
    let mut pairs: Vec<(f64, f64)> = estimate
        .iter()
        .zip(reference)
        .map(|(e, r)| ((e - centre).abs(), (e - r).abs()))
        .collect();
    let classes = (pairs.len() / FILLED_CLASS)
        .clamp(*CLASSES.start(), *CLASSES.end())
        .min(pairs.len() / SMALLEST_CLASS);
    if classes == 0 {
        return None;
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut upper_edges = Vec::with_capacity(classes - 1);
    let mut half_widths = Vec::with_capacity(classes);
    for class in 0..classes {
        let (from, to) = (class * pairs.len() / classes, (class + 1) * pairs.len() / classes);
        let mut errors: Vec<f64> = pairs[from..to].iter().map(|p| p.1).collect();
        errors.sort_by(f64::total_cmp);
        half_widths.push(errors[rank(errors.len()) - 1]);
        if class + 1 < classes {
            upper_edges.push(pairs[to - 1].0);
        }
    }
    Some(IntervalTable {
        centre,
        upper_edges,
        half_widths,
    })
}

/// ⌈0.9 (n + 1)⌉, at most n. In integers: a product that is whole must not be rounded up to the next.
fn rank(errors: usize) -> usize {
    (LEVEL_TENTHS * (errors + 1)).div_ceil(10).min(errors)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rank_is_exact_where_the_product_is_whole() {
        assert_eq!([1, 9, 10, 19, 60].map(rank), [1, 9, 10, 18, 55]);
        for tens in 1..100_000 {
            assert_eq!(rank(10 * tens - 1), 9 * tens);
            assert_eq!(rank(10 * tens), 9 * tens + 1);
        }
    }

    #[test]
    fn errors_that_grow_get_wider_intervals_that_still_cover() {
        let reference: Vec<f64> = (0..6000).map(|i| (f64::from(i) * 0.7).sin() * 10.0).collect();
        let estimate: Vec<f64> = reference
            .iter()
            .enumerate()
            .map(|(i, r)| r * (1.0 + 0.01 * (i as f64 * 1.3).sin()))
            .collect();
        let table = fit(&estimate, &reference, 0.0).unwrap();
        assert!(table.half_widths.windows(2).all(|w| w[0] < w[1]));
        let inside = estimate
            .iter()
            .zip(&reference)
            .filter(|(e, r)| {
                let class = table.upper_edges.partition_point(|&edge| edge < e.abs());
                (*e - *r).abs() <= table.half_widths[class]
            })
            .count();
        // Same values as fitted on: exact up to one window per class.
        assert!((inside as f64 / 6000.0 - 0.9).abs() < 0.002, "{inside}");
    }
}
