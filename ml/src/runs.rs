//! Recorded runs in memory, column by column.

use hydroflex_openapi::channel::Channel;
use std::collections::HashMap;

/// Runs of one machine with the same channels and the same time between samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Runs {
    /// Channels, in the order of every run's columns.
    pub channels: Vec<Channel>,
    /// Time between samples, s.
    pub sample_time_s: f64,
    /// Runs, in run order.
    pub runs: Vec<RunSamples>,
}

/// Samples of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunSamples {
    /// Key of the run.
    pub run_id: u64,
    /// One column per channel, all of the same length, in the column's unit.
    pub columns: Vec<Vec<f64>>,
}

impl RunSamples {
    /// Number of samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.columns.first().map_or(0, Vec::len)
    }

    /// Whether the run has no samples.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Why recorded runs cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RunsError {
    /// A channel that is not there.
    #[error("there is no channel {name:?}; channels are {}", available.join(", "))]
    MissingChannel {
        /// Asked for.
        name: String,
        /// There.
        available: Vec<String>,
    },
    /// A channel asked for twice.
    #[error("channel {name:?} is given twice")]
    DuplicateChannel {
        /// Channel.
        name: String,
    },
    /// Not a number.
    #[error("run {run_id}, step {step}, channel {channel:?}: the value is {value}")]
    NotFinite {
        /// Run.
        run_id: u64,
        /// Step.
        step: usize,
        /// Channel.
        channel: String,
        /// Value.
        value: f64,
    },
    /// Columns of one run differ in length.
    #[error("run {run_id}: channel {channel:?} has {length} samples where the first has {expected}")]
    UnevenColumns {
        /// Run.
        run_id: u64,
        /// Channel.
        channel: String,
        /// Its length.
        length: usize,
        /// Length of the first column.
        expected: usize,
    },
}

impl Runs {
    /// Positions of `names` among the channels.
    ///
    /// # Errors
    /// A name that is not there, or is given twice.
    pub fn positions(&self, names: &[String]) -> Result<Vec<usize>, RunsError> {
        let by_name: HashMap<&str, usize> = self
            .channels
            .iter()
            .enumerate()
            .map(|(i, c)| (c.name.as_str(), i))
            .collect();
        let mut positions = Vec::with_capacity(names.len());
        for name in names {
            let position = *by_name
                .get(name.as_str())
                .ok_or_else(|| RunsError::MissingChannel {
                    name: name.clone(),
                    available: self.channels.iter().map(|c| c.name.clone()).collect(),
                })?;
            if positions.contains(&position) {
                return Err(RunsError::DuplicateChannel { name: name.clone() });
            }
            positions.push(position);
        }
        Ok(positions)
    }

    /// The same runs with only the channels `names`, in that order.
    ///
    /// # Errors
    /// A name that is not there, or is given twice.
    pub fn select(&self, names: &[String]) -> Result<Self, RunsError> {
        let positions = self.positions(names)?;
        Ok(Self {
            channels: positions.iter().map(|&p| self.channels[p].clone()).collect(),
            sample_time_s: self.sample_time_s,
            runs: self
                .runs
                .iter()
                .map(|run| RunSamples {
                    run_id: run.run_id,
                    columns: positions.iter().map(|&p| run.columns[p].clone()).collect(),
                })
                .collect(),
        })
    }

    /// Checks that columns are even and every value is finite.
    ///
    /// # Errors
    /// The first place where this fails.
    pub fn check(&self) -> Result<(), RunsError> {
        for run in &self.runs {
            let expected = run.len();
            for (channel, column) in self.channels.iter().zip(&run.columns) {
                if column.len() != expected {
                    return Err(RunsError::UnevenColumns {
                        run_id: run.run_id,
                        channel: channel.name.clone(),
                        length: column.len(),
                        expected,
                    });
                }
                if let Some(step) = column.iter().position(|v| !v.is_finite()) {
                    return Err(RunsError::NotFinite {
                        run_id: run.run_id,
                        step,
                        channel: channel.name.clone(),
                        value: column[step],
                    });
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hydroflex_openapi::channel::ChannelRole;

    fn runs() -> Runs {
        let channel = |name: &str| Channel {
            name: name.to_owned(),
            unit: "1".to_owned(),
            quantity: String::new(),
            frame: None,
            role: ChannelRole::Sensor,
        };
        Runs {
            channels: vec![channel("a"), channel("b")],
            sample_time_s: 0.005,
            runs: vec![RunSamples {
                run_id: 7,
                columns: vec![vec![1.0, 2.0], vec![3.0, 4.0]],
            }],
        }
    }

    #[test]
    fn select_orders_as_asked() {
        let selected = runs().select(&["b".to_owned(), "a".to_owned()]).unwrap();
        assert_eq!(selected.runs[0].columns, [[3.0, 4.0], [1.0, 2.0]]);
    }

    #[test]
    fn a_missing_channel_is_named_with_what_is_there() {
        let error = runs().select(&["c".to_owned()]).unwrap_err();
        assert_eq!(error.to_string(), "there is no channel \"c\"; channels are a, b");
    }

    #[test]
    fn a_nan_is_found_with_its_place() {
        let mut bad = runs();
        bad.runs[0].columns[1][1] = f64::NAN;
        let error = bad.check().unwrap_err();
        assert_eq!(
            error.to_string(),
            "run 7, step 1, channel \"b\": the value is NaN"
        );
    }
}
