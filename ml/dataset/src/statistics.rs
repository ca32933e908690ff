//! Statistics of channels: per run where the samples are, merged in run order where they meet.
//!
//! ```text
//! mean ← mean + δ n_b/n,   m2 ← m2 + m2_b + δ² n_a n_b/n,   δ = mean_b − mean_a      (Chan et al. 1979)
//! ```
//!
//! Each run is summed by itself and runs are merged in run order, so the result does not depend on
//! how runs were divided into shards.

use hydroflex_openapi::dataset::ChannelStatistics;

/// Running statistics of one channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Accumulator {
    count: u64,
    min: f64,
    max: f64,
    mean: f64,
    m2: f64,
}

impl Default for Accumulator {
    fn default() -> Self {
        Self {
            count: 0,
            min: f64::INFINITY,
            max: f64::NEG_INFINITY,
            mean: 0.0,
            m2: 0.0,
        }
    }
}

impl Accumulator {
    /// Statistics of the samples of one run; all finite.
    #[must_use]
    pub fn of(samples: &[f64]) -> Self {
        if samples.is_empty() {
            return Self::default();
        }
        let mut this = Self::default();
        for &x in samples {
            this.min = if x < this.min { x } else { this.min };
            this.max = if x > this.max { x } else { this.max };
        }
        this.count = samples.len() as u64;
        this.mean = sum(samples, |x| x) / this.count as f64;
        this.m2 = sum(samples, |x| (x - this.mean).powi(2));
        this
    }

    /// Adds what another has seen.
    pub fn merge(&mut self, other: &Self) {
        if other.count == 0 {
            return;
        }
        let (a, b) = (self.count as f64, other.count as f64);
        let delta = other.mean - self.mean;
        self.count += other.count;
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
        self.mean += delta * (b / (a + b));
        self.m2 += other.m2 + delta * delta * (a * b / (a + b));
    }

    /// The result; absent without samples.
    #[must_use]
    pub fn finish(&self) -> Option<ChannelStatistics> {
        if self.count == 0 {
            return None;
        }
        let variance = self.m2 / self.count as f64;
        Some(ChannelStatistics {
            count: self.count,
            min: self.min,
            max: self.max,
            mean: self.mean,
            std: variance.sqrt(),
            rms: (variance + self.mean * self.mean).sqrt(),
        })
    }
}

/// Sum in eight parts, in an order that depends on nothing else: the processor adds them side by side.
fn sum(samples: &[f64], of: impl Fn(f64) -> f64) -> f64 {
    let mut parts = [0.0; 8];
    let (whole, rest) = samples.as_chunks::<8>();
    for eight in whole {
        for (part, &x) in parts.iter_mut().zip(eight) {
            *part += of(x);
        }
    }
    let rest: f64 = rest.iter().map(|&x| of(x)).sum();
    parts.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_parts_agree_with_the_whole() {
        let samples: Vec<f64> = (0..1000).map(|k| 1e7 + f64::from(k * k % 97)).collect();
        let mut merged = Accumulator::default();
        for part in samples.chunks(201) {
            merged.merge(&Accumulator::of(part));
        }
        let (whole, merged) = (
            Accumulator::of(&samples).finish().unwrap(),
            merged.finish().unwrap(),
        );
        assert_eq!(
            (whole.count, whole.min, whole.max),
            (1000, merged.min, merged.max)
        );
        // two-pass sums of 1000 numbers near 1e7: a few ulps of the mean, hence 1e-9 of the spread
        assert!((whole.mean - merged.mean).abs() < 1e-7);
        assert!((whole.std - merged.std).abs() < 1e-9 * whole.std);
        let mean = samples.iter().sum::<f64>() / 1000.0;
        assert!((whole.rms.powi(2) - whole.std.powi(2) - mean * mean).abs() < 1e-2);
        assert!(Accumulator::of(&[]).finish().is_none());
    }
}
