//! How often a model's envelope flags what it should: stuck sensors, swapped channels.
//!
//! **Stuck**: from some sample on a channel repeats its last value. That can be known only while the truth goes
//! elsewhere, so a window counts when it lies in the stuck stretch and the mean of the truth over the window is at least
//! [`EFFECT`] of the channel's training range away from the stuck value. A case (one channel stuck for [`STRETCH_S`]) is
//! found when one of its windows that count is flagged. **Swapped**: two channels carry each other's values; every
//! window counts, and a case is a run.

use crate::model::Model;
use crate::runs::{Runs, RunsError};
use hydroflex_openapi::model::FaultRate;

/// Part of a channel's training range by which a stuck value has to be wrong, on average over the window.
pub const EFFECT: f64 = 0.05;
/// How long a sensor is stuck, s, beginning one window after the one before.
pub const STRETCH_S: f64 = 2.0;

/// Rates over `runs`, honest ones: each channel stuck, each pair of channels swapped; none without an envelope.
///
/// # Errors
/// A channel is missing.
pub fn fault_rates(model: &Model, runs: &Runs) -> Result<Vec<FaultRate>, RunsError> {
    let config = model.config();
    let Some(envelope) = &config.envelope else {
        return Ok(Vec::new());
    };
    let names: Vec<String> = config.inputs.iter().map(|c| c.name.clone()).collect();
    let inputs = runs.select(&names)?;
    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let mut flags = |columns: &[Vec<f64>]| -> Vec<bool> {
        let columns: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
        predictor
            .predict_series_with(&columns, &mut workspace)
            .inside
            .iter()
            .map(|inside| !inside)
            .collect()
    };
    let steps = config.window_steps;
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a few hundred samples"
    )]
    let stretch = ((STRETCH_S / config.sample_time_s).round() as usize).max(steps + 1);
    let mut rates = Vec::new();
    for (channel, name) in names.iter().enumerate() {
        let effect =
            EFFECT * (envelope.max[channel] - envelope.min[channel]) / crate::scheduled::RANGE_FACTOR;
        let mut rate = Rate::default();
        for run in &inputs.runs {
            // A run shorter than a stretch is one.
            let stretch = stretch.min(run.len());
            if stretch <= steps {
                continue;
            }
            for first in (0..=run.len() - stretch).step_by(stretch) {
                let mut columns: Vec<Vec<f64>> = run
                    .columns
                    .iter()
                    .map(|column| column[first..first + stretch].to_vec())
                    .collect();
                let truth = std::mem::take(&mut columns[channel]);
                columns[channel] = vec![truth[0]; stretch];
                let counting = |(k, flag): (usize, bool)| {
                    let mean = truth[k..k + steps].iter().sum::<f64>() / steps as f64;
                    ((mean - truth[0]).abs() >= effect).then_some(flag)
                };
                rate.add(flags(&columns).into_iter().enumerate().filter_map(counting));
            }
        }
        rates.push(rate.named(format!("{name} stuck")));
    }
    for (a, first) in names.iter().enumerate() {
        for (b, second) in names.iter().enumerate().skip(a + 1) {
            let mut rate = Rate::default();
            for run in &inputs.runs {
                let mut columns = run.columns.clone();
                columns.swap(a, b);
                rate.add(flags(&columns).into_iter());
            }
            rates.push(rate.named(format!("{first} and {second} swapped")));
        }
    }
    Ok(rates)
}

#[derive(Default)]
struct Rate {
    windows: u64,
    flagged: u64,
    cases: u64,
    found: u64,
}

impl Rate {
    /// A case with these windows.
    fn add(&mut self, flags: impl Iterator<Item = bool>) {
        let (mut windows, mut flagged) = (0, 0);
        for flag in flags {
            windows += 1;
            flagged += u64::from(flag);
        }
        self.windows += windows;
        self.flagged += flagged;
        self.cases += u64::from(windows > 0);
        self.found += u64::from(flagged > 0);
    }

    fn named(&self, fault: String) -> FaultRate {
        let part = |some: u64, all: u64| if all == 0 { 0.0 } else { some as f64 / all as f64 };
        FaultRate {
            fault,
            windows: self.windows,
            flagged: part(self.flagged, self.windows),
            cases: self.cases,
            found: part(self.found, self.cases),
        }
    }
}
