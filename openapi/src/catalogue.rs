//! What a service holds: data sets, models, machines.

use crate::id::{AliasName, DatasetId, JobId, ModelId, TrainingId};
use crate::job::{JobSpec, TrainingSpec};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A file of a data set or model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FileEntry {
    /// Path inside the folder, `/` between its parts: `data/train-00000-of-00001.parquet`.
    pub path: String,
    /// Size.
    pub size_bytes: u64,
    /// SHA-256, 64 hexadecimal digits; also the strong ETag.
    pub sha256: String,
}

/// A published data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DatasetInfo {
    /// Identifier: the first half of `dataset_sha256`.
    pub dataset_id: DatasetId,
    /// SHA-256 of the data set's `SHA256SUMS`.
    pub dataset_sha256: String,
    /// Runs, failed ones included.
    pub runs: u64,
    /// Size of all files.
    pub size_bytes: u64,
    /// What it was made from.
    pub spec: JobSpec,
    /// The first job that made it.
    pub job_id: JobId,
    /// When it was first published (RFC 3339, UTC).
    pub created_at: String,
    /// Files.
    pub files: Vec<FileEntry>,
}

/// Data sets, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DatasetPage {
    /// Data sets.
    pub datasets: Vec<DatasetInfo>,
    /// Ask with this `cursor` for the next page; absent on the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_cursor: Option<String>,
}

/// A trained model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelInfo {
    /// Identifier: the first half of `model_sha256`.
    pub model_id: ModelId,
    /// SHA-256 over its files.
    pub model_sha256: String,
    /// The training that made it.
    pub training_id: TrainingId,
    /// The data set it learned from.
    pub dataset_id: DatasetId,
    /// What was asked for.
    pub spec: TrainingSpec,
    /// Errors on the data set's validation runs, per target, in the target's unit.
    #[schema(value_type = Object)]
    pub metrics: serde_json::Value,
    /// When it was registered (RFC 3339, UTC).
    pub created_at: String,
    /// Files.
    pub files: Vec<FileEntry>,
}

/// Models, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelPage {
    /// Models.
    pub models: Vec<ModelInfo>,
    /// Ask with this `cursor` for the next page; absent on the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_cursor: Option<String>,
}

/// Where an alias is to point.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AliasRequest {
    /// The model; it is loaded and checked before the alias moves.
    pub model_id: ModelId,
}

/// An alias: a name for a model that can be moved to another one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AliasInfo {
    /// Its name.
    pub alias: AliasName,
    /// The model that it points at.
    pub model_id: ModelId,
    /// Counts from 1 with every move; also the ETag. Earlier ones stay addressable as versions of
    /// the Open Inference Protocol.
    pub generation: u64,
    /// When it was moved there (RFC 3339, UTC).
    pub moved_at: String,
}

/// Every alias, by name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AliasList {
    /// Aliases.
    pub aliases: Vec<AliasInfo>,
}

/// A machine that the service carries.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct MachineInfo {
    /// Name, as a job gives it.
    pub name: String,
    /// In words.
    pub description: String,
    /// Names of its cylinders.
    pub cylinders: Vec<String>,
    /// Names of its angles.
    pub angles: Vec<String>,
    /// False if a job must give its meshes (`POST /v1/meshes`).
    pub available: bool,
    /// The machine file.
    pub toml: String,
}

/// Machines that the service carries.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct MachineList {
    /// Machines.
    pub machines: Vec<MachineInfo>,
}

/// An uploaded mesh.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MeshInfo {
    /// SHA-256 of the file, 64 hexadecimal digits: what a job's `meshes` name.
    pub mesh_sha256: String,
    /// Size of the file.
    pub size_bytes: u64,
    /// Nodes.
    pub nodes: u64,
    /// Elements.
    pub elements: u64,
    /// `C3D4` or `C3D10`.
    pub element_kind: String,
    /// Volume of all elements.
    pub volume_m3: f64,
    /// Names of its node sets.
    pub node_sets: Vec<String>,
}
