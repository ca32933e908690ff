//! Messages of a streaming session: one sample in, one estimate out.

use crate::id::ModelId;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// First message of the service: what the session takes and gives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StreamOpened {
    /// The model that answers for the whole session, even if an alias moves meanwhile.
    pub model_id: ModelId,
    /// Inputs, in the order of a binary sample.
    pub inputs: Vec<String>,
    /// Targets, in the order of a binary answer.
    pub targets: Vec<String>,
    /// Time between samples.
    pub sample_time_s: f64,
    /// Samples before the first estimate.
    pub window_steps: u64,
    /// Filled-in samples in a window up to which estimates are given.
    pub max_filled: u64,
}

/// One sample as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct StreamSample {
    /// Number of the sample: one more than the last one's. What is left out was lost.
    pub step: u64,
    /// Every input by its column name; `null` for a sensor that gave nothing.
    pub inputs: BTreeMap<String, Option<f64>>,
}

/// How a sample was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SampleStatus {
    /// In its turn, and the window is whole.
    Ok,
    /// The window has not enough samples yet: no estimate.
    Filling,
    /// The window holds filled-in samples: the estimate is as good as they are.
    Filled,
    /// More filled-in samples than allowed: no estimate.
    Gap,
    /// This step was here before: the estimate is the last one, the sample was not used.
    Repeated,
    /// After its turn: it took the place of a filled-in sample; no estimate.
    Late,
    /// After its turn and of no use: its place is taken or has left the window; no estimate.
    TooLate,
}

impl SampleStatus {
    /// Number of the status in a binary answer.
    #[must_use]
    pub fn code(self) -> u8 {
        match self {
            Self::Ok => 0,
            Self::Filling => 1,
            Self::Filled => 2,
            Self::Gap => 3,
            Self::Repeated => 4,
            Self::Late => 5,
            Self::TooLate => 6,
        }
    }
}

/// The answer to one sample as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StreamEstimate {
    /// Number of the sample.
    pub step: u64,
    /// How it was taken.
    pub status: SampleStatus,
    /// Filled-in samples in the window.
    pub filled: u64,
    /// Estimates by column name; absent where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub estimates: Option<BTreeMap<String, f64>>,
    /// Lower ends of the 90 % intervals.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lower: Option<BTreeMap<String, f64>>,
    /// Upper ends of the 90 % intervals.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub upper: Option<BTreeMap<String, f64>>,
    /// Whether the window lies in the region that the model was trained on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inside_envelope: Option<bool>,
}
