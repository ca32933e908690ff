//! Axes: round ticks, labels without noise, and lines reduced to what a screen can show.

/// A linear map of values to pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    /// Value at `start_px`.
    pub min: f64,
    /// Value at `end_px`.
    pub max: f64,
    /// Pixel of `min`.
    pub start_px: f64,
    /// Pixel of `max`.
    pub end_px: f64,
}

impl Axis {
    /// Pixel of a value.
    #[must_use]
    pub fn px(&self, value: f64) -> f64 {
        self.start_px + (value - self.min) / (self.max - self.min) * (self.end_px - self.start_px)
    }

    /// Round values inside the axis, about `count` of them, at least three.
    #[must_use]
    pub fn ticks(&self, count: usize) -> Vec<f64> {
        let ticks = self.multiples(round_step((self.max - self.min) / count as f64));
        if ticks.len() < 3 && count < 12 {
            self.ticks(count + 1)
        } else {
            ticks
        }
    }

    fn multiples(&self, step: f64) -> Vec<f64> {
        let first = (self.min / step - 1e-9).ceil();
        let last = (self.max / step + 1e-9).floor();
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a handful of ticks"
        )]
        let steps = (last - first).max(0.0) as usize;
        (0..=steps).map(|i| (first + i as f64) * step).collect()
    }
}

/// 1, 2 or 5 times a power of ten, nearest above `step`.
fn round_step(step: f64) -> f64 {
    if !(step.is_finite() && step > 0.0) {
        return 1.0;
    }
    let power = 10.0_f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 5.0]
        .into_iter()
        .find(|f| f * power >= step * 0.999)
        .unwrap_or(10.0);
    factor * power
}

/// A tick's label with as many decimals as the distance between ticks needs, and a real minus.
#[must_use]
pub fn label(value: f64, step: f64) -> String {
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and 12"
    )]
    let decimals = (-step.log10().floor()).clamp(0.0, 12.0) as usize;
    let text = format!(
        "{:.decimals$}",
        if value.abs() < step * 1e-6 { 0.0 } else { value }
    );
    text.replace('-', "\u{2212}")
}

/// Range of all values with a margin on both sides; never empty.
#[must_use]
pub fn padded_range<'a>(values: impl Iterator<Item = &'a f64>, margin: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for &value in values.filter(|v| v.is_finite()) {
        low = low.min(value);
        high = high.max(value);
    }
    if low > high {
        return (-1.0, 1.0);
    }
    let span = if high > low {
        high - low
    } else {
        high.abs().max(1e-12)
    };
    (low - margin * span, high + margin * span)
}

/// Points of a line that matter at a tenth of a pixel: a point is left out when it lies within
/// 0.12 px of the line between its kept neighbours.
#[must_use]
pub fn simplify(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    const TOLERANCE_PX: f64 = 0.12;
    const LONGEST: usize = 60;
    let Some(&first) = points.first() else {
        return Vec::new();
    };
    let mut kept = vec![first];
    let mut anchor = 0;
    for end in 1..points.len() {
        let last = end + 1 == points.len();
        let next = if last { end } else { end + 1 };
        let (a, b) = (points[anchor], points[next]);
        let off = points[anchor + 1..next].iter().any(|p| {
            let part = if b.0 > a.0 { (p.0 - a.0) / (b.0 - a.0) } else { 0.0 };
            (a.1 + part * (b.1 - a.1) - p.1).abs() > TOLERANCE_PX
        });
        if last || off || next - anchor > LONGEST {
            kept.push(points[end]);
            anchor = end;
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let axis = Axis {
            min: -0.013,
            max: 0.021,
            start_px: 0.0,
            end_px: 100.0,
        };
        let ticks = axis.ticks(4);
        assert_eq!(ticks.len(), 4, "{ticks:?}");
        assert!((ticks[0] + 0.01).abs() < 1e-12 && (ticks[3] - 0.02).abs() < 1e-12);
        assert_eq!(label(ticks[0], 0.01), "\u{2212}0.01");
        assert_eq!(label(ticks[1], 0.01), "0.00");
    }

    #[test]
    fn straight_parts_need_two_points() {
        let mut points: Vec<(f64, f64)> = (0..50).map(|i| (f64::from(i), 3.0)).collect();
        points.extend((50..90).map(|i| (f64::from(i), f64::from(i) - 47.0)));
        let kept = simplify(&points);
        assert!(kept.len() <= 4, "{kept:?}");
        assert_eq!(kept.last(), points.last());
    }
}
