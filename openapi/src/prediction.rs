//! Estimates over HTTP, in engineering units.

use crate::id::{DatasetId, ModelId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// Recorded sensor signals. Every input of the model by its column name, with its unit in the name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PredictRequest {
    /// Signals; all of one length, at least one window, one value per sample of the model.
    #[schema(example = json!({"valve_lift_ratio": 0.0, "length_lift_m": 1.0}))]
    pub inputs: BTreeMap<String, Signal>,
    /// Time between samples, if the caller wants it checked against the model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample_time_s: Option<f64>,
}

/// A signal: values over time, or one value for a signal that does not change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    expecting = "invalid value, expected a number, or a list of numbers, one per sample"
)]
pub enum Signal {
    /// The same value for all samples. If every input is constant, one window of them is meant.
    Constant(f64),
    /// One value per sample.
    Samples(Vec<f64>),
}

/// Estimates: one per sample from the end of the first window on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PredictResponse {
    /// The model that made them.
    pub model_id: ModelId,
    /// The data set it learned from.
    pub dataset_id: DatasetId,
    /// Hashes and versions behind the estimates.
    pub provenance: PredictionProvenance,
    /// Time between estimates.
    pub sample_time_s: f64,
    /// Samples in a window.
    pub window_steps: u64,
    /// Sample to which the first estimate belongs, counted from 0.
    pub first_step: u64,
    /// Number of estimates.
    pub count: u64,
    /// Estimates by column name, in the unit of the name.
    pub estimates: BTreeMap<String, Vec<f64>>,
    /// Lower ends of the 90 % intervals; absent if the model has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lower: Option<BTreeMap<String, Vec<f64>>>,
    /// Upper ends of the 90 % intervals; absent if the model has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub upper: Option<BTreeMap<String, Vec<f64>>>,
    /// For each estimate, whether its window lies in the region that the model was trained on;
    /// absent if the model does not know that region.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inside_envelope: Option<Vec<bool>>,
}

/// What an estimate can be traced back to.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PredictionProvenance {
    /// SHA-256 over the model's files.
    pub model_sha256: String,
    /// SHA-256 of the data set's `SHA256SUMS`.
    pub dataset_sha256: String,
    /// Version of hydroflex that simulated the data set; absent where the data set does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub simulator_version: Option<String>,
    /// Version of hydroflex that trained the model.
    pub trained_by_version: String,
}
