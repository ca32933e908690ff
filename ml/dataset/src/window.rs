//! Length of the SLIDE window from settling runs: valve open for the first part, then shut.
//!
//! ```text
//! band    first time after which |d − d_end| ≤ 0.05 (max d − min d) for good, counted from the closing
//! paper   end of the first n/10 consecutive samples with |d| < 1.05 |mean d|, from the start of the run
//! script  start of the last stretch of samples with d < (1 − 2 ln(0.01)/100) mean d, from the start of the run
//! ```
//!
//! `d` is a structural channel. The paper's two rules (Khadim et al., text and published script) take
//! the samples 0 … n−1 of a run of n steps, and call sample i the time (i + 1) h. They compare with
//! the mean, so they fail where it is near zero; the band compares with the range.

use crate::record::RunSamples;
use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::dataset::{ChannelWindow, WindowFacts};

/// Half-width of the band over the range.
pub const BAND: f64 = 0.05;

/// Factor on the mean in the paper's text.
pub const PAPER_FACTOR: f64 = 1.05;

/// Steps from the closing of the valve until `d` stays within the band for good.
///
/// `closing` is the last sample with an open valve. A constant channel needs no step at all.
#[must_use]
pub fn band_steps(d: &[f64], closing: usize) -> Option<usize> {
    let (&end, range) = (d.last()?, range(d));
    let outside = |x: &f64| (x - end).abs() > BAND * range;
    let settled = d.iter().rposition(outside).map_or(0, |last| last + 1);
    Some(settled.saturating_sub(closing))
}

/// The rule of the paper's text, in steps from the start of the run; absent if `d` never settles.
#[must_use]
pub fn paper_steps(d: &[f64]) -> Option<usize> {
    let d = without_last(d);
    let threshold = PAPER_FACTOR * mean(d)?.abs();
    let block = (d.len() / 10).max(1);
    let mut below = 0;
    for (i, x) in d.iter().enumerate() {
        below = if x.abs() < threshold { below + 1 } else { 0 };
        if below == block {
            return Some(i + 1);
        }
    }
    None
}

/// The rule of the published script, in steps from the start of the run; absent if no sample is
/// below its threshold.
#[must_use]
pub fn script_steps(d: &[f64]) -> Option<usize> {
    let d = without_last(d);
    let factor = 1.0 - 2.0 * 0.01_f64.ln() / 100.0;
    let threshold = factor * mean(d)?;
    let last = d.iter().rposition(|&x| x < threshold)?;
    let start = d[..last].iter().rposition(|&x| x >= threshold);
    Some(start.map_or(0, |above| above + 1) + 1)
}

/// Last sample at which any valve is open; 0 if none ever is.
#[must_use]
pub fn closing_step(valves: &[&[f64]]) -> usize {
    let open = |valve: &&[f64]| valve.iter().rposition(|&u| u != 0.0);
    valves.iter().filter_map(open).max().unwrap_or(0)
}

fn without_last(d: &[f64]) -> &[f64] {
    &d[..d.len().saturating_sub(1)]
}

fn mean(d: &[f64]) -> Option<f64> {
    (!d.is_empty()).then(|| d.iter().sum::<f64>() / d.len() as f64)
}

fn range(d: &[f64]) -> f64 {
    let (min, max) = d
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), &x| {
            (min.min(x), max.max(x))
        });
    max - min
}

/// Gathers the windows of settling runs, one run at a time.
#[derive(Debug, Clone)]
pub struct WindowCollector {
    sample_time_s: f64,
    valves: Vec<usize>,
    targets: Vec<Target>,
    runs: u64,
    open_steps: usize,
    all_steps: usize,
}

#[derive(Debug, Clone)]
struct Target {
    column: usize,
    name: String,
    decides: bool,
    band: Mean,
    band_longest: usize,
    paper: Mean,
    script: Mean,
}

#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: usize,
    count: u32,
}

impl Mean {
    fn add(&mut self, steps: Option<usize>) {
        if let Some(steps) = steps {
            self.sum += steps;
            self.count += 1;
        }
    }

    fn seconds(self, sample_time_s: f64) -> Option<f64> {
        let mean = self.sum as f64 / f64::from(self.count);
        (self.count > 0).then_some(mean * sample_time_s)
    }
}

impl WindowCollector {
    /// For runs of these channels.
    #[must_use]
    pub fn new(channels: &[Channel], sample_time_s: f64) -> Self {
        let of_role = |role| {
            channels
                .iter()
                .enumerate()
                .filter(move |(_, channel)| channel.role == role)
        };
        let vertical = |name: &str| name.starts_with("deflection_") && name.ends_with("_y_m");
        let any_vertical = of_role(ChannelRole::Target).any(|(_, c)| vertical(&c.name));
        Self {
            sample_time_s,
            valves: of_role(ChannelRole::Command).map(|(i, _)| i).collect(),
            targets: of_role(ChannelRole::Target)
                .map(|(column, channel)| Target {
                    column,
                    name: channel.name.clone(),
                    decides: vertical(&channel.name) || !any_vertical,
                    band: Mean::default(),
                    band_longest: 0,
                    paper: Mean::default(),
                    script: Mean::default(),
                })
                .collect(),
            runs: 0,
            open_steps: 0,
            all_steps: 0,
        }
    }

    /// Adds a settling run.
    pub fn add(&mut self, samples: &RunSamples) {
        let valves: Vec<&[f64]> = self
            .valves
            .iter()
            .map(|&column| samples.columns[column].as_slice())
            .collect();
        let closing = closing_step(&valves);
        self.runs += 1;
        self.open_steps += closing;
        self.all_steps += samples.sample_count.saturating_sub(1);
        for target in &mut self.targets {
            let d = &samples.columns[target.column];
            let band = band_steps(d, closing);
            target.band.add(band);
            target.band_longest = target.band_longest.max(band.unwrap_or(0));
            target.paper.add(paper_steps(d));
            target.script.add(script_steps(d));
        }
    }

    /// The windows.
    #[must_use]
    pub fn finish(&self) -> WindowFacts {
        let h = self.sample_time_s;
        let mut facts = WindowFacts {
            settling_runs: self.runs,
            ..WindowFacts::default()
        };
        if self.runs == 0 {
            return facts;
        }
        // One division of whole numbers: a fifth of the steps is 0.2 and nothing beside it.
        facts.open_part = self.open_steps as f64 / self.all_steps.max(1) as f64;
        for target in &self.targets {
            let window = ChannelWindow {
                band_s: target.band.seconds(h),
                band_longest_s: Some(target.band_longest as f64 * h),
                paper_s: target.paper.seconds(h),
                script_s: target.script.seconds(h),
            };
            let longer = facts.band_s.is_none() || window.band_s > facts.band_s;
            if target.decides && longer {
                facts.channel = Some(target.name.clone());
                facts.band_s = window.band_s;
                facts.paper_s = window.paper_s;
                facts.script_s = window.script_s;
            }
            facts.channels.insert(target.name.clone(), window);
        }
        facts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An oscillation that decays like exp(−t/τ) around 1 after a closing at step 40.
    fn ringing() -> Vec<f64> {
        (0..=200)
            .map(|k| match k {
                0..=40 => 0.0,
                _ => 1.0 + (-f64::from(k - 41) / 20.0).exp() * (f64::from(k - 41) * 0.7).cos(),
            })
            .collect()
    }

    #[test]
    fn the_band_is_left_for_the_last_time_where_the_envelope_says() {
        let d = ringing();
        let steps = band_steps(&d, 40).unwrap();
        // range 2, band 0.1: the envelope exp(−k/20) crosses it at k = 20 ln 10 = 46.05; the last
        // crest before that is at most half a period (π/0.7 = 4.5 steps) earlier
        assert!((41..=47).contains(&steps), "{steps}");
        assert_eq!(band_steps(&[3.0; 201], 40), Some(0));
        assert_eq!(band_steps(&[], 0), None);
    }

    #[test]
    fn the_papers_rules_on_a_signal_known_by_hand() {
        // samples 0..n−1 are 2, 2, 2, 1 × 37: mean 1.075, thresholds 1.129 and 1.174
        let mut d = vec![2.0; 3];
        d.extend([1.0; 38]);
        assert_eq!(script_steps(&d), Some(4));
        assert_eq!(paper_steps(&d), Some(3 + 4));
        assert_eq!(paper_steps(&[-5.0, 5.0, -5.0]), None);
    }

    #[test]
    fn closing_is_the_last_open_sample_of_any_valve() {
        assert_eq!(closing_step(&[&[0.0, 1.0, 1.0, 0.0], &[0.0, -0.5, 0.0, 0.0]]), 2);
        assert_eq!(closing_step(&[&[0.0, 0.0]]), 0);
    }
}
