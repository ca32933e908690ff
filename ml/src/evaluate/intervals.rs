//! 90 % intervals by split conformal prediction (Vovk et al.), in classes of amplitude.
//!
//! Within a class the half width is the ⌈0.9 (n + 1)⌉-th smallest absolute error of the windows that
//! calibrate. Errors grow with the estimate's distance from the mean, so a single width would cover
//! small amplitudes too often and large ones too rarely.
//!
//! A network that follows a payload has errors that depend on it, an empty machine's a fraction of a loaded one's. There an
//! error is first divided by that of its class of the estimated payload, and what is said above holds for the quotient.

use hydroflex_openapi::model::{IntervalTable, PayloadWidths};

/// Part of the true values inside, in tenths.
const LEVEL_TENTHS: usize = 9;
/// Classes of amplitude, of equal numbers of windows: at least three, and more where the windows fill them, because errors
/// also differ within a third …
const CLASSES: std::ops::RangeInclusive<usize> = 3..=12;
/// … which needs this many windows in each; neighbouring windows tell nearly the same.
const FILLED_CLASS: usize = 2000;
/// Most classes of payload, and windows for each.
const PAYLOAD_CLASSES: usize = 24;
const FILLED_PAYLOAD_CLASS: usize = 4000;
/// Fewest windows in a class.
const SMALLEST_CLASS: usize = 60;

/// Table for one target; absent when there are too few windows. `estimate`, `reference` and `centre` in the target's unit, a value per window.
#[must_use]
pub fn fit(estimate: &[f64], reference: &[f64], centre: f64) -> Option<IntervalTable> {
    by_amplitude(estimate, &errors(estimate, reference), centre)
}

/// As [`fit`] for a model that tells the payload of each window, kg.
#[must_use]
pub fn fit_by_payload(
    estimate: &[f64],
    reference: &[f64],
    payload_kg: &[f64],
    centre: f64,
) -> Option<IntervalTable> {
    let errors = errors(estimate, reference);
    let classes = (payload_kg.len() / FILLED_PAYLOAD_CLASS).clamp(1, PAYLOAD_CLASSES);
    let (upper_edges_kg, widths) = in_classes(payload_kg, &errors, classes)?;
    // An estimator without error in a class: nothing to divide by.
    let factors = widths.iter().map(|width| width.max(f64::MIN_POSITIVE)).collect();
    let widths = PayloadWidths {
        upper_edges_kg,
        factors,
    };
    let in_units: Vec<f64> = (errors.iter().zip(payload_kg))
        .map(|(error, kg)| error / factor(&widths, *kg))
        .collect();
    Some(IntervalTable {
        payload: Some(widths),
        ..by_amplitude(estimate, &in_units, centre)?
    })
}

fn errors(estimate: &[f64], reference: &[f64]) -> Vec<f64> {
    let pairs = estimate.iter().zip(reference);
    pairs.map(|(e, r)| (e - r).abs()).collect()
}

fn by_amplitude(estimate: &[f64], errors: &[f64], centre: f64) -> Option<IntervalTable> {
    let amplitudes: Vec<f64> = estimate.iter().map(|e| (e - centre).abs()).collect();
    let classes = (errors.len() / FILLED_CLASS)
        .clamp(*CLASSES.start(), *CLASSES.end())
        .min(errors.len() / SMALLEST_CLASS);
    let (upper_edges, half_widths) = in_classes(&amplitudes, errors, classes)?;
    Some(IntervalTable {
        centre,
        upper_edges,
        half_widths,
        payload: None,
    })
}

/// Upper edges of classes of equal numbers of windows by `key`, but the last one's, and the half width of each; none without windows or classes.
fn in_classes(key: &[f64], errors: &[f64], classes: usize) -> Option<(Vec<f64>, Vec<f64>)> {
    let mut pairs: Vec<(f64, f64)> = key.iter().copied().zip(errors.iter().copied()).collect();
    if classes == 0 || pairs.len() < classes {
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
    Some((upper_edges, half_widths))
}

/// Half width around an estimate; absent where a table has no class for it, or wants a payload and gets none.
#[must_use]
pub fn half_width(table: &IntervalTable, estimate: f64, payload_kg: Option<f64>) -> Option<f64> {
    let distance = (estimate - table.centre).abs();
    let class = table.upper_edges.partition_point(|&edge| edge < distance);
    let factor = match &table.payload {
        None => 1.0,
        Some(widths) => factor(widths, payload_kg?),
    };
    table.half_widths.get(class).map(|half| half * factor)
}

fn factor(widths: &PayloadWidths, payload_kg: f64) -> f64 {
    let class = widths.upper_edges_kg.partition_point(|&edge| edge < payload_kg);
    widths.factors.get(class).copied().unwrap_or(f64::NAN)
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
    fn payloads_with_other_errors_have_other_widths() {
        // Four payloads, errors in proportion to each, amplitudes that say nothing about it.
        let windows = 4 * 12_000_usize;
        let payload_kg: Vec<f64> = (0..windows).map(|i| (1 + i % 4) as f64).collect();
        let estimate: Vec<f64> = (0..windows).map(|i| (i as f64 * 0.7).sin()).collect();
        let reference: Vec<f64> = (0..windows)
            .map(|i| estimate[i] + 1e-3 * payload_kg[i] * (i as f64 * 1.3).sin())
            .collect();
        let part = |kg: f64, table: &IntervalTable| {
            let of = (0..windows).filter(|&i| (payload_kg[i] - kg).abs() < 0.5);
            let inside = of.clone().filter(|&i| {
                (estimate[i] - reference[i]).abs()
                    <= half_width(table, estimate[i], Some(payload_kg[i])).unwrap()
            });
            inside.count() as f64 / of.count() as f64
        };
        let table = fit_by_payload(&estimate, &reference, &payload_kg, 0.0).unwrap();
        let plain = fit(&estimate, &reference, 0.0).unwrap();
        for kg in [1.0, 2.0, 3.0, 4.0] {
            let covered = part(kg, &table);
            // Deterministic errors, spread evenly: within a class of amplitude a tenth is cut to the window.
            assert!((covered - 0.9).abs() < 0.01, "{kg} kg: {covered}");
        }
        assert!(part(1.0, &plain) > 0.99 && part(4.0, &plain) < 0.8);
        assert_eq!(half_width(&table, 0.0, None), None, "a payload is wanted");
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
