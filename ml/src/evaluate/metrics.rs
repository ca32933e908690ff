//! Errors in physical units. No percentage of a value that crosses zero.

use hydroflex_openapi::model::TargetMetrics;

/// Errors of `estimate` against `reference`, both in the column's unit.
///
/// ```text
/// MAE = mean |e|,  RMSE = √mean e²,  R² = 1 − Σ e² / Σ (y − ȳ)²
/// ```
///
/// # Panics
/// When the lengths differ.
#[must_use]
pub fn metrics(target: &str, unit: &str, estimate: &[f64], reference: &[f64]) -> TargetMetrics {
    assert_eq!(
        estimate.len(),
        reference.len(),
        "one estimate per reference value"
    );
    let count = reference.len().max(1) as f64;
    let mut errors: Vec<f64> = estimate
        .iter()
        .zip(reference)
        .map(|(e, r)| (e - r).abs())
        .collect();
    let mae = errors.iter().sum::<f64>() / count;
    let squares: f64 = errors.iter().map(|e| e * e).sum();
    let max = errors.iter().copied().fold(0.0, f64::max);
    let low = reference.iter().copied().fold(f64::INFINITY, f64::min);
    let high = reference.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let range = if reference.is_empty() { 0.0 } else { high - low };
    let mean = reference.iter().sum::<f64>() / count;
    let spread: f64 = reference.iter().map(|r| (r - mean).powi(2)).sum();
    TargetMetrics {
        target: target.to_owned(),
        unit: unit.to_owned(),
        samples: reference.len() as u64,
        mae,
        rmse: (squares / count).sqrt(),
        max,
        p95: quantile(&mut errors, 0.95),
        range,
        mae_relative_to_range: if range > 0.0 { mae / range } else { 0.0 },
        r2: if spread > 0.0 { 1.0 - squares / spread } else { 0.0 },
        coverage: None,
        coverage_thirds: None,
        interval_width: None,
    }
}

/// Smallest value that at least the part `q` of `values` do not exceed; 0 for no values. Sorts.
#[must_use]
pub fn quantile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    values.sort_by(f64::total_cmp);
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and the length"
    )]
    let rank = (q * values.len() as f64).ceil().max(1.0) as usize;
    values[rank.min(values.len()) - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_errors() {
        let m = metrics("x", "m", &[1.0, 2.0, 3.0, 5.0], &[1.0, 2.0, 3.0, 4.0]);
        assert!((m.mae - 0.25).abs() < 1e-15);
        assert!((m.rmse - 0.5).abs() < 1e-15);
        assert!((m.max - 1.0).abs() < 1e-15 && (m.range - 3.0).abs() < 1e-15);
        assert!((m.r2 - 0.8).abs() < 1e-12);
    }

    #[test]
    fn quantiles_are_conservative() {
        let mut values: Vec<f64> = (1..=100).map(f64::from).collect();
        assert!((quantile(&mut values, 0.95) - 95.0).abs() < 1e-12);
        assert!((quantile(&mut values, 1.0) - 100.0).abs() < 1e-12);
    }
}
