//! What happens to a job, in order: the events of `GET /v1/jobs/{id}/events`.

use crate::id::{DatasetId, ModelId, TrainingId};
use crate::status::{JobNotice, JobState, TrainingProgress};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// One event of a job. `sequence` counts from 1 without gaps and is the SSE event id.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobEvent {
    /// Place in the job's history.
    pub sequence: u64,
    /// When (RFC 3339, UTC).
    pub at: String,
    /// What.
    #[serde(flatten)]
    pub what: EventKind,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum EventKind {
    /// The job moved on.
    State {
        /// New state.
        state: JobState,
        /// Why, where there is a reason.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        reason: Option<String>,
    },
    /// The job was accepted with a remark.
    Notice {
        /// The remark.
        notice: JobNotice,
    },
    /// A shard was committed.
    Progress {
        /// Runs accounted for, failed ones included.
        runs_done: u64,
        /// Runs without samples.
        runs_failed: u64,
        /// Settling runs accounted for.
        settling_done: u64,
    },
    /// A shard was lost by its worker and will be done again, or was given up.
    ShardLost {
        /// First run of the shard.
        first_run: u64,
        /// Runs in the shard.
        run_count: u64,
        /// Attempts so far.
        attempt: u64,
        /// What happens with it: `retried`, `halved` or `given_up`.
        outcome: String,
        /// Why it was lost.
        reason: String,
    },
    /// The data set is published.
    Dataset {
        /// Data set.
        dataset_id: DatasetId,
        /// SHA-256 of its `SHA256SUMS`.
        dataset_sha256: String,
    },
    /// A training moved on.
    Training {
        /// Training.
        training_id: TrainingId,
        /// Progress.
        progress: TrainingProgress,
    },
    /// A model is registered.
    Model {
        /// Training.
        training_id: TrainingId,
        /// Model.
        model_id: ModelId,
    },
    /// A training failed.
    TrainingFailed {
        /// Training.
        training_id: TrainingId,
        /// Why.
        reason: String,
    },
}

impl EventKind {
    /// The SSE event name.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::State { .. } => "state",
            Self::Notice { .. } => "notice",
            Self::Progress { .. } => "progress",
            Self::ShardLost { .. } => "shard_lost",
            Self::Dataset { .. } => "dataset",
            Self::Training { .. } => "training",
            Self::Model { .. } => "model",
            Self::TrainingFailed { .. } => "training_failed",
        }
    }
}
