//! What a published data set says about itself: its manifest, its runs, its SLIDE window.
//!
//! A data set is a function of the job's specification, the machine, the version of the code and
//! the instruction-set level alone. Nothing here holds a time, a host, a job id, a worker or a shard.

use crate::channel::Channel;
use crate::job::{Integrator, JobSpec, SampleType, Split};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// Version of the manifest and of the layout that this build writes.
pub const DATASET_FORMAT: u32 = 1;

/// Part of a data set; parts are made of whole runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SplitName {
    /// Networks learn from it.
    Train,
    /// Decides when to stop and what to keep.
    Validation,
    /// Touched once, at the end.
    Test,
}

impl SplitName {
    /// Every part, in the order of the layout.
    pub const ALL: [Self; 3] = [Self::Train, Self::Validation, Self::Test];

    /// Name in files and paths: `train`, `validation`, `test`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }

    /// The part of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|split| split.as_str() == name)
    }
}

impl std::fmt::Display for SplitName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl Split {
    /// Part to which the run of this index belongs.
    ///
    /// Runs are independent draws, so nothing is gained by shuffling them; parts are interleaved
    /// instead (with 0.8/0.2, runs 2, 7, 12, … validate). Of the first `n` runs exactly
    /// `round(n · train)` train, for every `n`: 64 and 16 of 80. A job of more runs with the same
    /// seed therefore keeps the part of every run that the smaller job had.
    #[must_use]
    pub fn of(&self, run_index: u64) -> SplitName {
        let train = parts_per_billion(self.train);
        let before = share(run_index, train);
        if share(run_index + 1, train) > before {
            return SplitName::Train;
        }
        let rest = self.validation + self.test;
        let validation = if rest > 0.0 {
            parts_per_billion(self.validation / rest)
        } else {
            PARTS
        };
        let index = run_index - before;
        if share(index + 1, validation) > share(index, validation) {
            SplitName::Validation
        } else {
            SplitName::Test
        }
    }
}

const PARTS: u64 = 1_000_000_000;

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 0..=1 before it is scaled"
)]
fn parts_per_billion(part: f64) -> u64 {
    (part.clamp(0.0, 1.0) * PARTS as f64).round() as u64
}

/// round(n · parts / 10⁹) in integers, so that no platform rounds differently.
fn share(n: u64, parts: u64) -> u64 {
    let product = u128::from(n) * u128::from(parts) + u128::from(PARTS / 2);
    u64::try_from(product / u128::from(PARTS)).unwrap_or(u64::MAX)
}

/// The file `manifest.json`: what a data set is, and everything needed to make it again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this format and of the layout, [`DATASET_FORMAT`].
    pub format: u32,
    /// What the runs come from.
    pub source: DatasetSource,
    /// The machine.
    pub machine: MachineFacts,
    /// The code.
    pub code: CodeFacts,
    /// Time between samples.
    pub sample_time_s: f64,
    /// Type of the samples.
    pub sample_type: SampleType,
    /// How runs are divided.
    pub split: Split,
    /// Columns of the samples after `run_id`, `step` and `time_s`.
    pub channels: Vec<Channel>,
    /// Numbers of runs.
    pub runs: RunCounts,
    /// Runs per flag.
    pub flags: BTreeMap<String, u64>,
    /// Runs per path through the solver: `planar`, `tree`, `general`, `trapezoidal-index-2`, `generalized-alpha`.
    #[serde(default)]
    pub solver_paths: BTreeMap<String, u64>,
    /// Every file but this one and `SHA256SUMS`, by path.
    pub files: Vec<ManifestFile>,
}

/// What the runs of a data set come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum DatasetSource {
    /// Random runs.
    Job {
        /// The whole specification; a run is a function of its seed and its index.
        spec: Box<JobSpec>,
    },
    /// Runs given in a table; the samples and `meta/runs.parquet` hold all its inputs.
    RunTable {
        /// SHA-256 of the table's file.
        sha256: String,
        /// Time integration.
        integrator: Integrator,
    },
}

/// The machine of a data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MachineFacts {
    /// Name in the machine file.
    pub name: String,
    /// The machine file's text.
    pub toml: String,
    /// Hash of text, meshes and version of the reduction, hexadecimal.
    pub content_sha256: String,
    /// Names of the angles, in the order of the machine file.
    pub angles: Vec<String>,
}

/// The code that made a data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CodeFacts {
    /// Version of hydroflex.
    pub version: String,
    /// Instruction-set level that the simulator used: `portable`, `x86-64-v3`, …
    pub instruction_set: String,
}

/// Numbers of runs of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RunCounts {
    /// All, settling runs not counted.
    pub total: u64,
    /// With samples.
    pub ok: u64,
    /// Without.
    pub failed: u64,
    /// In the training part, failed ones counted.
    pub train: u64,
    /// In the validation part, failed ones counted.
    pub validation: u64,
    /// In the test part, failed ones counted.
    pub test: u64,
    /// Settling runs, beside `total`.
    pub settling: u64,
}

/// One published file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ManifestFile {
    /// Path relative to the data set, with `/`.
    pub path: String,
    /// Length.
    pub bytes: u64,
    /// SHA-256, hexadecimal.
    pub sha256: String,
    /// Rows, for Parquet files.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rows: Option<u64>,
}

/// The file `meta/window.json`: lengths of the SLIDE window by every rule.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct WindowFacts {
    /// Settling runs that ended well.
    pub settling_runs: u64,
    /// Part of a settling run during which the valve is open.
    pub open_part: f64,
    /// Channel by which the lengths in `band_s`, `paper_s` and `script_s` are decided: of the
    /// vertical deflections the one with the longest window by the band rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<String>,
    /// Default rule: last time outside 5 % of the range around the final value, counted from the
    /// closing of the valve, mean over the runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_s: Option<f64>,
    /// The paper's text, counted from the start of the run, mean over the runs that settle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paper_s: Option<f64>,
    /// The published script, counted from the start of the run, mean over the runs that settle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub script_s: Option<f64>,
    /// Time in which the slowest damped motion decays to 1 %: from the eigenvalues of the machine of the job's softest
    /// material with its largest payload, oil included, valves shut.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eigenvalues_s: Option<f64>,
    /// Every structural channel by itself.
    pub channels: BTreeMap<String, ChannelWindow>,
}

/// Window lengths of one channel, means over the settling runs to which the rule applies.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ChannelWindow {
    /// See [`WindowFacts::band_s`].
    pub band_s: Option<f64>,
    /// Longest of the runs by the band rule.
    pub band_longest_s: Option<f64>,
    /// See [`WindowFacts::paper_s`].
    pub paper_s: Option<f64>,
    /// See [`WindowFacts::script_s`].
    pub script_s: Option<f64>,
}

/// The file `meta/stats.json`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DatasetStatistics {
    /// Over every run with samples.
    pub all: BTreeMap<String, ChannelStatistics>,
    /// Over the training runs with samples: what scales may be fitted on.
    pub train: BTreeMap<String, ChannelStatistics>,
}

/// Statistics of one channel in the channel's unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ChannelStatistics {
    /// Samples.
    pub count: u64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (of the population).
    pub std: f64,
    /// Root of the mean square.
    pub rms: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(split: Split, runs: u64) -> [u64; 3] {
        let mut counts = [0; 3];
        for run in 0..runs {
            counts[split.of(run) as usize] += 1;
        }
        counts
    }

    #[test]
    fn counts_are_exact_for_every_number_of_runs() {
        let split = Split::default();
        assert_eq!(counts(split, 80), [64, 16, 0]);
        assert_eq!(counts(split, 2560), [2048, 512, 0]);
        for runs in 0..200 {
            let train = (runs as f64 * 0.8).round() as u64;
            assert_eq!(counts(split, runs), [train, runs - train, 0]);
        }
    }

    #[test]
    fn three_parts_and_parts_that_decimals_cannot_hold() {
        let thirds = Split {
            train: 1.0 / 3.0,
            validation: 1.0 / 3.0,
            test: 1.0 / 3.0,
        };
        assert_eq!(counts(thirds, 9), [3, 3, 3]);
        let split = Split {
            train: 0.8,
            validation: 0.1,
            test: 0.1,
        };
        assert_eq!(counts(split, 80), [64, 8, 8]);
        let test = Split {
            train: 0.0,
            validation: 0.0,
            test: 1.0,
        };
        assert_eq!(counts(test, 7), [0, 0, 7]);
        let train = Split {
            train: 1.0,
            validation: 0.0,
            test: 0.0,
        };
        assert_eq!(counts(train, 7), [7, 0, 0]);
    }
}
