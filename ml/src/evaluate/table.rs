//! Errors for people: tables in mm, microstrain and N/mm².

use hydroflex_openapi::model::{EvaluationReport, TargetMetrics};

/// A unit to show values of a column in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplayUnit {
    /// Factor from the column's unit.
    pub factor: f64,
    /// Label.
    pub label: &'static str,
}

/// How people read a column: deflection in mm, strain in microstrain, stress in N/mm². Other
/// columns keep their unit.
#[must_use]
pub fn display_unit(target: &str) -> Option<DisplayUnit> {
    if target.starts_with("deflection_") {
        Some(DisplayUnit {
            factor: 1e3,
            label: "mm",
        })
    } else if target.starts_with("strain_") {
        Some(DisplayUnit {
            factor: 1e6,
            label: "µstrain",
        })
    } else if target.starts_with("stress_") {
        Some(DisplayUnit {
            factor: 1e-6,
            label: "N/mm²",
        })
    } else {
        None
    }
}

/// A published figure, read off the plotted curves of the paper (Khadim et al. 2025), mean
/// absolute error of the vertical deflection over the published 10 s evaluation signal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PublishedError {
    /// Payload, kg.
    pub payload_kg: f64,
    /// Mean absolute error, mm.
    pub deflection_mae_mm: f64,
}

/// The paper's boom, the paper's networks: another structure than the built-in boom, so these
/// stand beside our errors for orientation only.
pub const PUBLISHED: [PublishedError; 3] = [
    PublishedError {
        payload_kg: 0.0,
        deflection_mae_mm: 0.024,
    },
    PublishedError {
        payload_kg: 50.0,
        deflection_mae_mm: 0.070,
    },
    PublishedError {
        payload_kg: 100.0,
        deflection_mae_mm: 0.112,
    },
];

/// Table of a report: one line per target and estimator, ending in a line break.
#[must_use]
pub fn table(report: &EvaluationReport) -> String {
    let mut text = format!(
        "{:<24} {:<16} {:>10} {:>10} {:>10} {:>10} {:>10} {:>9}\n",
        "target", "estimator", "MAE", "RMSE", "p95", "max", "MAE/range", "R²"
    );
    for (t, target) in report.targets.iter().enumerate() {
        text.push_str(&line(&title(target), "network", target));
        for baseline in &report.baselines {
            if let Some(metrics) = baseline.targets.get(t) {
                text.push_str(&line("", baseline_name(&baseline.name), metrics));
            }
        }
    }
    text
}

fn title(target: &TargetMetrics) -> String {
    let unit = display_unit(&target.target).map_or(target.unit.as_str(), |u| u.label);
    let name = target
        .target
        .strip_suffix("_m")
        .or_else(|| target.target.strip_suffix("_pa"))
        .unwrap_or(&target.target);
    format!("{name} [{unit}]")
}

/// A baseline for people.
#[must_use]
pub fn baseline_name(name: &str) -> &str {
    match name {
        "least_squares" => "least squares",
        "quasi_static" => "quasi-static",
        other => other,
    }
}

fn line(title: &str, estimator: &str, m: &TargetMetrics) -> String {
    let factor = display_unit(&m.target).map_or(1.0, |u| u.factor);
    let show = |value: f64| significant(value * factor);
    format!(
        "{title:<24} {estimator:<16} {:>10} {:>10} {:>10} {:>10} {:>9.4} % {:>9.6}\n",
        show(m.mae),
        show(m.rmse),
        show(m.p95),
        show(m.max),
        100.0 * m.mae_relative_to_range,
        m.r2
    )
}

/// Three significant digits, without an exponent where that stays short.
#[must_use]
pub fn significant(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let rounded = format!("{value:.2e}");
    let magnitude: i32 = rounded
        .split_once('e')
        .and_then(|(_, power)| power.parse().ok())
        .unwrap_or(0);
    if (-6..6).contains(&magnitude) {
        let decimals = usize::try_from(2 - magnitude).unwrap_or(0);
        format!("{value:.decimals$}")
    } else {
        rounded
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_digits_for_people() {
        assert_eq!(significant(0.000_612_3), "0.000612");
        assert_eq!(significant(12.345), "12.3");
        assert_eq!(significant(1234.5), "1234");
        assert_eq!(significant(0.009_999_999), "0.0100");
        assert_eq!(significant(0.0), "0");
    }
}
