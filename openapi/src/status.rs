//! How far jobs and trainings are.

use crate::id::{DatasetId, JobId, ModelId, TrainingId};
use crate::job::{JobSpec, TrainingSpec};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use utoipa::ToSchema;

/// Where a job is in its life. It only ever moves down this list, unless it is asked to do again what failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Accepted; no worker has begun.
    Queued,
    /// Workers simulate.
    Simulating,
    /// Every run is accounted for; the data set is being written.
    Publishing,
    /// The data set is published; networks are being trained.
    Training,
    /// Everything asked for is there.
    Succeeded,
    /// Ended with a reason.
    Failed,
    /// Ended on request.
    Cancelled,
}

impl JobState {
    /// True if nothing more will happen.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// As written in JSON and in the database.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Simulating => "simulating",
            Self::Publishing => "publishing",
            Self::Training => "training",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A word that names no state.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} names no state")]
pub struct UnknownState(pub String);

impl FromStr for JobState {
    type Err = UnknownState;
    fn from_str(text: &str) -> Result<Self, UnknownState> {
        [
            Self::Queued,
            Self::Simulating,
            Self::Publishing,
            Self::Training,
            Self::Succeeded,
            Self::Failed,
            Self::Cancelled,
        ]
        .into_iter()
        .find(|state| state.as_str() == text)
        .ok_or_else(|| UnknownState(text.to_owned()))
    }
}

/// A job and how far it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobStatus {
    /// Identifier.
    pub job_id: JobId,
    /// State.
    pub state: JobState,
    /// Why it ended, if it failed or was cancelled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What was asked for, defaults filled in.
    pub spec: JobSpec,
    /// SHA-256 of the machine (file, meshes, version of the reduction).
    pub machine_sha256: String,
    /// Instruction-set level of the workers that simulate it, once the first one has begun: workers of
    /// another level leave the job alone, because their numbers would differ in the last digits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// What the service has to say about the job as it was asked for: nothing is wrong, but something may not be meant.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notices: Vec<JobNotice>,
    /// Runs.
    pub progress: Progress,
    /// The data set, once published.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset_id: Option<DatasetId>,
    /// SHA-256 of the data set's `SHA256SUMS`, once published.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset_sha256: Option<String>,
    /// Trainings of this job, in the order of the specification.
    #[serde(default)]
    pub trainings: Vec<TrainingStatus>,
    /// Models, as trainings finish.
    #[serde(default)]
    pub model_ids: Vec<ModelId>,
    /// When the job was accepted (RFC 3339, UTC).
    pub created_at: String,
    /// When the first worker began.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started_at: Option<String>,
    /// When it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<String>,
}

/// A remark on a job that was accepted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobNotice {
    /// JSON pointer (RFC 6901) into the job: `/duration_s`.
    pub pointer: String,
    /// What is remarkable.
    pub detail: String,
    /// A value that would not be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub proposed: Option<serde_json::Value>,
}

/// Runs of a job, counted.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Progress {
    /// Runs asked for.
    pub runs_total: u64,
    /// Runs accounted for, failed ones included.
    pub runs_done: u64,
    /// Runs without samples: not converged, or not finite.
    pub runs_failed: u64,
    /// Settling runs asked for.
    pub settling_total: u64,
    /// Settling runs accounted for.
    pub settling_done: u64,
    /// Runs per second since the first worker began.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub runs_per_s: Option<f64>,
    /// Seconds of simulation left at this rate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remaining_s: Option<f64>,
    /// Worker seconds spent so far, by what they were spent on.
    pub spent: TimeSplit,
}

/// Worker time.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct TimeSplit {
    /// Planning and simulating.
    pub simulate_s: f64,
    /// Encoding and hashing.
    pub encode_s: f64,
    /// Writing to the store, beside the next shard of the same worker.
    pub put_s: f64,
    /// Neither simulating nor encoding, from one shard of the job to the next: waiting for the ledger, for the
    /// next shard, or for the store to take the one before.
    pub wait_s: f64,
}

/// A list of jobs, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobPage {
    /// Jobs.
    pub jobs: Vec<JobStatus>,
    /// Ask with this `cursor` for the next page; absent on the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_cursor: Option<String>,
}

/// Where a training is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TrainingState {
    /// Waits for a trainer.
    Open,
    /// A trainer has it.
    Running,
    /// The model is registered.
    Succeeded,
    /// Ended with a reason.
    Failed,
    /// Ended on request.
    Cancelled,
}

impl TrainingState {
    /// As written in JSON and in the database.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// True if nothing more will happen.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl fmt::Display for TrainingState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for TrainingState {
    type Err = UnknownState;
    fn from_str(text: &str) -> Result<Self, UnknownState> {
        [
            Self::Open,
            Self::Running,
            Self::Succeeded,
            Self::Failed,
            Self::Cancelled,
        ]
        .into_iter()
        .find(|state| state.as_str() == text)
        .ok_or_else(|| UnknownState(text.to_owned()))
    }
}

/// What `POST /v1/trainings` takes: a network for a published data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingRequest {
    /// The data set to learn from.
    pub dataset_id: DatasetId,
    /// The network; default: our best.
    #[serde(default)]
    pub spec: TrainingSpec,
}

/// A training and how far it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrainingStatus {
    /// Identifier.
    pub training_id: TrainingId,
    /// The job that asked for it; absent for trainings asked for directly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub job_id: Option<JobId>,
    /// The data set it learns from.
    pub dataset_id: DatasetId,
    /// State.
    pub state: TrainingState,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The network.
    pub spec: TrainingSpec,
    /// Progress.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<TrainingProgress>,
    /// The model, once registered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model_id: Option<ModelId>,
    /// When it was asked for (RFC 3339, UTC).
    pub created_at: String,
    /// When it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<String>,
}

/// How far a training is.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct TrainingProgress {
    /// Epochs done.
    pub epoch: u64,
    /// Epochs at most.
    pub epochs: u64,
    /// Part done, 0 to 1.
    pub fraction: f64,
    /// Training loss.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub loss: Option<f64>,
    /// Validation loss.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation_loss: Option<f64>,
}
