//! The Open Inference Protocol, version 2, as this service speaks it.
//!
//! A model has one input, `window` (`[batch, steps, inputs]`, oldest sample first, in the units of
//! the columns), and the outputs `estimates`, `lower`, `upper` (`[batch, targets]`) and
//! `inside_envelope` (`[batch]`): the tensors of `model.onnx`, and what goes with an estimate.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// What the server is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerMetadata {
    /// `hydroflex`.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Extensions of the protocol that it speaks.
    pub extensions: Vec<String>,
}

/// Whether the server answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerLive {
    /// True.
    pub live: bool,
}

/// Whether the server can do its work.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ServerReady {
    /// True.
    pub ready: bool,
}

/// Whether a model is loaded and has passed its checks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ModelReady {
    /// As asked for.
    pub name: String,
    /// True.
    pub ready: bool,
}

/// What a model takes and gives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelMetadata {
    /// As asked for.
    pub name: String,
    /// Versions that can be asked for: of an alias, every model that it has pointed at.
    pub versions: Vec<String>,
    /// `hydroflex_slide`.
    pub platform: String,
    /// Tensors in.
    pub inputs: Vec<TensorMetadata>,
    /// Tensors out.
    pub outputs: Vec<TensorMetadata>,
    /// What the tensors hold.
    pub parameters: ModelParameters,
}

/// What the tensors of a model hold, and where it comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelParameters {
    /// The model, by its content.
    pub model_id: String,
    /// SHA-256 over its files.
    pub model_sha256: String,
    /// Columns of `window`, in order.
    pub inputs: Vec<String>,
    /// Columns of `estimates`, `lower` and `upper`, in order.
    pub targets: Vec<String>,
    /// Time between samples.
    pub sample_time_s: f64,
}

/// A tensor that a model takes or gives.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct TensorMetadata {
    /// Name.
    pub name: String,
    /// `FP64` or `BOOL`; `FP32` is taken for `window` too.
    pub datatype: String,
    /// Size of each dimension; −1 is the batch.
    pub shape: Vec<i64>,
}

/// Estimates for a batch of windows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InferRequest {
    /// Sent back as it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// `binary_data_output`: outputs as bytes after the JSON.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = Object)]
    pub parameters: BTreeMap<String, serde_json::Value>,
    /// One tensor, `window`.
    pub inputs: Vec<InferInput>,
    /// Outputs asked for; all of them if absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outputs: Vec<InferRequestedOutput>,
}

/// A tensor in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InferInput {
    /// `window`.
    pub name: String,
    /// `FP32` or `FP64`.
    pub datatype: String,
    /// Batch, steps, inputs.
    pub shape: Vec<u64>,
    /// `binary_data_size`: bytes of this tensor after the JSON.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = Object)]
    pub parameters: BTreeMap<String, serde_json::Value>,
    /// Values in row-major order, flat or nested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Vec<f64>)]
    pub data: Option<serde_json::Value>,
}

/// An output asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InferRequestedOutput {
    /// `estimates`, `lower`, `upper` or `inside_envelope`.
    pub name: String,
    /// `binary_data`: as bytes after the JSON.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = Object)]
    pub parameters: BTreeMap<String, serde_json::Value>,
}

/// Estimates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InferResponse {
    /// As asked for.
    pub model_name: String,
    /// Version that answered.
    pub model_version: String,
    /// As sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Tensors out.
    pub outputs: Vec<InferOutput>,
}

/// A tensor out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InferOutput {
    /// Name.
    pub name: String,
    /// `FP64` or `BOOL`.
    pub datatype: String,
    /// Batch, and targets where there is one value for each.
    pub shape: Vec<u64>,
    /// `binary_data_size`: bytes of this tensor after the JSON.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schema(value_type = Object)]
    pub parameters: BTreeMap<String, serde_json::Value>,
    /// Values in row-major order; absent if they follow as bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Vec<f64>)]
    pub data: Option<serde_json::Value>,
}

/// An error as the protocol has it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct InferError {
    /// What is wrong, where, and what is allowed.
    pub error: String,
}
