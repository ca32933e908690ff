//! Rows as their own types.

use crate::engine::Row;
use crate::shards::ShardKind;
use crate::transition::ShardState;
use crate::{LedgerError, clock};
use hydroflex_openapi::catalogue::{DatasetInfo, FileEntry, ModelInfo};
use hydroflex_openapi::id::{DatasetId, JobId, ModelId, ShardId, TrainingId};
use hydroflex_openapi::job::{JobSpec, TrainingSpec};
use hydroflex_openapi::status::{
    JobState, Progress, TimeSplit, TrainingProgress, TrainingState, TrainingStatus,
};

/// A job.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// Identifier.
    pub id: JobId,
    /// State.
    pub state: JobState,
    /// Specification, defaults filled in.
    pub spec: JobSpec,
    /// SHA-256 of the machine.
    pub machine_sha256: String,
    /// Instruction-set level of the workers that compute it; `None` before the first one begins.
    pub instruction_set: Option<String>,
    /// Runs `0..runs_planned` are cut into shards.
    pub runs_planned: u64,
    /// Settling runs `0..settling_planned` are cut into shards.
    pub settling_planned: u64,
    /// Counts.
    pub progress: Progress,
    /// Why it ended.
    pub reason: Option<String>,
    /// Data set, once published.
    pub dataset_id: Option<DatasetId>,
    /// How often it was begun again by a retry: what was read of it in one round is not published in another.
    pub round: u64,
    /// Sequence of its last event.
    pub last_sequence: u64,
    /// When it was accepted, ms since 1970.
    pub created_ms: i64,
    /// When the first worker began.
    pub started_ms: Option<i64>,
    /// When it ended.
    pub finished_ms: Option<i64>,
}

impl JobRecord {
    /// True if every run is accounted for.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.progress.runs_done == self.progress.runs_total
            && self.progress.settling_done == self.progress.settling_total
    }

    pub(crate) fn read(row: &Row) -> Result<Self, LedgerError> {
        let mut progress = Progress {
            runs_total: row.count("runs")?,
            runs_done: row.count("runs_done")?,
            runs_failed: row.count("runs_failed")?,
            settling_total: row.count("settling_runs")?,
            settling_done: row.count("settling_done")?,
            runs_per_s: None,
            remaining_s: None,
            spent: TimeSplit {
                simulate_s: row.real("simulate_s")?,
                encode_s: row.real("encode_s")?,
                put_s: row.real("put_s")?,
                wait_s: row.real("wait_s")?,
            },
        };
        let state: JobState = row.parse("state")?;
        let started_ms = row.optional_int("started_ms")?;
        if state == JobState::Simulating
            && let Some(started_ms) = started_ms
        {
            let elapsed_s = (clock::now_ms() - started_ms).max(1) as f64 / 1e3;
            let done = progress.runs_done + progress.settling_done;
            if done > 0 {
                let rate = done as f64 / elapsed_s;
                let left = progress.runs_total + progress.settling_total - done;
                progress.runs_per_s = Some(rate);
                progress.remaining_s = Some(left as f64 / rate);
            }
        }
        Ok(Self {
            id: row.parse("id")?,
            state,
            spec: row.json("spec")?,
            machine_sha256: row.text("machine_sha256")?,
            instruction_set: row.optional_text("instruction_set")?,
            runs_planned: row.count("runs_planned")?,
            settling_planned: row.count("settling_planned")?,
            progress,
            reason: row.optional_text("reason")?,
            dataset_id: row.parse_optional("dataset_id")?,
            round: row.count("round")?,
            last_sequence: row.count("last_sequence")?,
            created_ms: row.int("created_ms")?,
            started_ms,
            finished_ms: row.optional_int("finished_ms")?,
        })
    }
}

/// A shard.
#[derive(Debug, Clone, PartialEq)]
pub struct ShardRecord {
    /// Identifier.
    pub id: ShardId,
    /// Job.
    pub job_id: JobId,
    /// What kind of runs.
    pub kind: ShardKind,
    /// First run.
    pub first_run: u64,
    /// Runs.
    pub run_count: u64,
    /// State.
    pub state: ShardState,
    /// Fencing token.
    pub epoch: u64,
    /// Attempts begun.
    pub attempt: u64,
    /// True if it came from halving a shard that had used up its attempts.
    pub is_half: bool,
    /// Who has or had it.
    pub worker: Option<String>,
    /// Committed object.
    pub object: Option<String>,
    /// Its SHA-256.
    pub sha256: Option<String>,
    /// Why the last attempt was lost.
    pub reason: Option<String>,
}

impl ShardRecord {
    /// True if it, or the shard that it is a half of, has met a death: its worker takes nothing else
    /// beside it.
    #[must_use]
    pub fn was_tried_before(&self) -> bool {
        self.attempt > 1 || self.is_half
    }

    pub(crate) fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            id: row.parse("id")?,
            job_id: row.parse("job_id")?,
            kind: row.parse("kind")?,
            first_run: row.count("first_run")?,
            run_count: row.count("run_count")?,
            state: row.parse("state")?,
            epoch: row.count("epoch")?,
            attempt: row.count("attempt")?,
            is_half: row.int("is_half")? != 0,
            worker: row.optional_text("worker")?,
            object: row.optional_text("object")?,
            sha256: row.optional_text("sha256")?,
            reason: row.optional_text("reason")?,
        })
    }
}

/// A published data set.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetRecord {
    /// Identifier.
    pub id: DatasetId,
    /// SHA-256 of its `SHA256SUMS`.
    pub sha256: String,
    /// First job that made it.
    pub job_id: JobId,
    /// What it was made from.
    pub spec: JobSpec,
    /// Runs.
    pub runs: u64,
    /// Files, sorted by path.
    pub files: Vec<FileEntry>,
    /// When, ms since 1970.
    pub created_ms: i64,
}

impl DatasetRecord {
    pub(crate) fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            id: row.parse("id")?,
            sha256: row.text("sha256")?,
            job_id: row.parse("job_id")?,
            spec: row.json("spec")?,
            runs: row.count("runs")?,
            files: row.json("files")?,
            created_ms: row.int("created_ms")?,
        })
    }

    /// Where its files are in the store: `datasets/ID/PATH`.
    #[must_use]
    pub fn key(&self, path: &str) -> String {
        format!("datasets/{}/{path}", self.id)
    }

    /// The file with this path; only listed files exist.
    #[must_use]
    pub fn file(&self, path: &str) -> Option<&FileEntry> {
        self.files.iter().find(|file| file.path == path)
    }

    /// As the contract shows it.
    #[must_use]
    pub fn info(&self) -> DatasetInfo {
        DatasetInfo {
            dataset_id: self.id.clone(),
            dataset_sha256: self.sha256.clone(),
            runs: self.runs,
            size_bytes: self.files.iter().map(|file| file.size_bytes).sum(),
            spec: self.spec.clone(),
            job_id: self.job_id,
            created_at: clock::rfc3339(self.created_ms),
            files: self.files.clone(),
        }
    }
}

/// A registered model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelRecord {
    /// Identifier.
    pub id: ModelId,
    /// SHA-256 over its files.
    pub sha256: String,
    /// Training that made it.
    pub training_id: TrainingId,
    /// Data set it learned from.
    pub dataset_id: DatasetId,
    /// What was asked for.
    pub spec: TrainingSpec,
    /// Errors per target.
    pub metrics: serde_json::Value,
    /// Files, sorted by path.
    pub files: Vec<FileEntry>,
    /// When, ms since 1970.
    pub created_ms: i64,
}

impl ModelRecord {
    pub(crate) fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            id: row.parse("id")?,
            sha256: row.text("sha256")?,
            training_id: row.parse("training_id")?,
            dataset_id: row.parse("dataset_id")?,
            spec: row.json("spec")?,
            metrics: row.json("metrics")?,
            files: row.json("files")?,
            created_ms: row.int("created_ms")?,
        })
    }

    /// Where its files are in the store: `models/ID/PATH`.
    #[must_use]
    pub fn key(&self, path: &str) -> String {
        format!("models/{}/{path}", self.id)
    }

    /// The file with this path; only listed files exist.
    #[must_use]
    pub fn file(&self, path: &str) -> Option<&FileEntry> {
        self.files.iter().find(|file| file.path == path)
    }

    /// As the contract shows it.
    #[must_use]
    pub fn info(&self) -> ModelInfo {
        ModelInfo {
            model_id: self.id.clone(),
            model_sha256: self.sha256.clone(),
            training_id: self.training_id,
            dataset_id: self.dataset_id.clone(),
            spec: self.spec.clone(),
            metrics: self.metrics.clone(),
            created_at: clock::rfc3339(self.created_ms),
            files: self.files.clone(),
        }
    }
}

/// A training.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRecord {
    /// Identifier.
    pub id: TrainingId,
    /// Job that asked for it.
    pub job_id: Option<JobId>,
    /// Data set it learns from.
    pub dataset_id: DatasetId,
    /// What was asked for.
    pub spec: TrainingSpec,
    /// State.
    pub state: TrainingState,
    /// Fencing token.
    pub epoch: u64,
    /// Attempts begun.
    pub attempt: u64,
    /// Who has it.
    pub worker: Option<String>,
    /// How far it is.
    pub progress: Option<TrainingProgress>,
    /// Why it failed.
    pub reason: Option<String>,
    /// Model, once registered.
    pub model_id: Option<ModelId>,
    /// When it was asked for, ms since 1970.
    pub created_ms: i64,
    /// When it ended.
    pub finished_ms: Option<i64>,
}

impl TrainingRecord {
    pub(crate) fn read(row: &Row) -> Result<Self, LedgerError> {
        let progress = match row.optional_text("progress")? {
            Some(_) => Some(row.json("progress")?),
            None => None,
        };
        Ok(Self {
            id: row.parse("id")?,
            job_id: row.parse_optional("job_id")?,
            dataset_id: row.parse("dataset_id")?,
            spec: row.json("spec")?,
            state: row.parse("state")?,
            epoch: row.count("epoch")?,
            attempt: row.count("attempt")?,
            worker: row.optional_text("worker")?,
            progress,
            reason: row.optional_text("reason")?,
            model_id: row.parse_optional("model_id")?,
            created_ms: row.int("created_ms")?,
            finished_ms: row.optional_int("finished_ms")?,
        })
    }

    /// As the contract shows it.
    #[must_use]
    pub fn status(&self) -> TrainingStatus {
        TrainingStatus {
            training_id: self.id,
            job_id: self.job_id,
            dataset_id: self.dataset_id.clone(),
            state: self.state,
            reason: self.reason.clone(),
            spec: self.spec.clone(),
            progress: self.progress.clone(),
            model_id: self.model_id.clone(),
            created_at: clock::rfc3339(self.created_ms),
            finished_at: self.finished_ms.map(clock::rfc3339),
        }
    }
}
