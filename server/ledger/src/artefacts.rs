//! What jobs leave behind: data sets, trainings, models.

use crate::engine::{Engine, Transaction, values};
use crate::events::append;
use crate::jobs::{IdempotencyKey, advance, claim_key};
use crate::orphans::forget;
use crate::record::{DatasetRecord, ModelRecord, TrainingRecord};
use crate::transition::ATTEMPT_LIMIT;
use crate::{Created, Ledger, LedgerError, clock};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::{DatasetId, JobId, ModelId, SweepId, TrainingId};
use hydroflex_openapi::job::{JobSpec, TrainingSpec};
use hydroflex_openapi::status::{JobState, TrainingProgress};

/// A data set whose files are all in the store.
#[derive(Debug, Clone)]
pub struct NewDataset {
    /// Identifier.
    pub id: DatasetId,
    /// SHA-256 of its `SHA256SUMS`.
    pub sha256: String,
    /// What it was made from.
    pub spec: JobSpec,
    /// Runs.
    pub runs: u64,
    /// Files, sorted by path.
    pub files: Vec<FileEntry>,
    /// [`crate::JobRecord::round`] of the job when its shards were read.
    pub round: u64,
}

/// A model whose files are all in the store.
#[derive(Debug, Clone)]
pub struct NewModel {
    /// Identifier.
    pub id: ModelId,
    /// SHA-256 over its files.
    pub sha256: String,
    /// Errors per target.
    pub metrics: serde_json::Value,
    /// Files, sorted by path.
    pub files: Vec<FileEntry>,
}

/// A training in a trainer's hands.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingClaim {
    /// The training as begun.
    pub training: TrainingRecord,
    /// The data set.
    pub dataset: DatasetRecord,
}

/// `sweep`: the sweep that the training is a cell of.
pub(crate) async fn insert_training(
    tx: &mut Transaction,
    job: Option<JobId>,
    sweep: Option<SweepId>,
    dataset: &DatasetId,
    spec: &TrainingSpec,
) -> Result<TrainingId, LedgerError> {
    let id = TrainingId::generate();
    tx.execute(
        "INSERT INTO trainings (id, job_id, sweep_id, dataset_id, spec, state, created_ms) \
         VALUES ($1, $2, $3, $4, $5, 'open', $6)",
        values![
            id.to_string(),
            job.map(|job| job.to_string()),
            sweep.map(|sweep| sweep.to_string()),
            dataset.as_str(),
            serde_json::to_string(spec)?,
            clock::now_ms(),
        ],
    )
    .await?;
    Ok(id)
}

/// Ends a job whose trainings have all ended.
async fn finish_job(tx: &mut Transaction, job: JobId) -> Result<(), LedgerError> {
    let row = tx
        .row(
            "SELECT CAST(COALESCE(SUM(CASE WHEN state IN ('open', 'running') THEN 1 ELSE 0 END), 0) AS BIGINT) \
               AS unfinished, \
             CAST(COALESCE(SUM(CASE WHEN state = 'failed' THEN 1 ELSE 0 END), 0) AS BIGINT) AS failed, \
             COUNT(*) AS n FROM trainings WHERE job_id = $1",
            values![job.to_string()],
        )
        .await?;
    let Some(row) = row else { return Ok(()) };
    if row.count("unfinished")? > 0 {
        return Ok(());
    }
    let failed = row.count("failed")?;
    let (state, reason) = if failed == 0 {
        (JobState::Succeeded, None)
    } else {
        let total = row.count("n")?;
        (
            JobState::Failed,
            Some(format!(
                "{failed} of {total} trainings failed; the data set is published"
            )),
        )
    };
    advance(
        tx,
        job,
        state,
        reason.as_deref(),
        "UPDATE jobs SET state = $2, finished_ms = $3, reason = $4 WHERE id = $1 AND state = 'training'",
    )
    .await
    .map(drop)
}

impl Ledger {
    /// Makes a data set visible, ties it to its job and opens the job's trainings, all at once.
    /// False if the job is no longer being published, or was begun again since its shards were read.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn publish_dataset(
        &self,
        job: JobId,
        dataset: &NewDataset,
        trainings: &[TrainingSpec],
    ) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let changed = tx
            .execute(
                "UPDATE jobs SET dataset_id = $2 WHERE id = $1 AND state = 'publishing' AND round = $3",
                values![job.to_string(), dataset.id.as_str(), dataset.round],
            )
            .await?;
        if changed == 0 {
            return Ok(false);
        }
        tx.execute(
            "INSERT INTO datasets (id, sha256, job_id, spec, runs, files, created_ms) \
             VALUES ($1, $2, $3, $4, $5, $6, $7) ON CONFLICT (id) DO NOTHING",
            values![
                dataset.id.as_str(),
                dataset.sha256.as_str(),
                job.to_string(),
                serde_json::to_string(&dataset.spec)?,
                dataset.runs,
                serde_json::to_string(&dataset.files)?,
                clock::now_ms(),
            ],
        )
        .await?;
        forget(&mut tx, &dataset.id).await?;
        let event = EventKind::Dataset {
            dataset_id: dataset.id.clone(),
            dataset_sha256: dataset.sha256.clone(),
        };
        append(&mut tx, job, &event).await?;
        for spec in trainings {
            insert_training(&mut tx, Some(job), None, &dataset.id, spec).await?;
        }
        advance(
            &mut tx,
            job,
            JobState::Training,
            None,
            "UPDATE jobs SET state = $2, started_ms = COALESCE(started_ms, $3), reason = $4 \
             WHERE id = $1 AND state = 'publishing'",
        )
        .await?;
        // Without trainings the job is done in the same breath.
        finish_job(&mut tx, job).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// One data set.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn dataset(&self, id: &DatasetId) -> Result<Option<DatasetRecord>, LedgerError> {
        self.pool
            .row("SELECT * FROM datasets WHERE id = $1", values![id.as_str()])
            .await?
            .as_ref()
            .map(DatasetRecord::read)
            .transpose()
    }

    /// Data sets, newest first, after the one that `before` names.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn datasets(
        &self,
        before: Option<(i64, &str)>,
        limit: u64,
    ) -> Result<Vec<DatasetRecord>, LedgerError> {
        let (ms, id) = before.unwrap_or((i64::MAX, ""));
        self.pool
            .rows(
                "SELECT * FROM datasets WHERE created_ms < $1 OR (created_ms = $1 AND id < $2) \
                 ORDER BY created_ms DESC, id DESC LIMIT $3",
                values![ms, id, limit],
            )
            .await?
            .iter()
            .map(DatasetRecord::read)
            .collect()
    }

    /// Asks for a training on a data set.
    ///
    /// # Errors
    /// [`LedgerError::KeyReused`]; what the database says.
    pub async fn create_training(
        &self,
        dataset: &DatasetId,
        spec: &TrainingSpec,
        key: Option<&IdempotencyKey>,
    ) -> Result<Created<TrainingId>, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let id = insert_training(&mut tx, None, None, dataset, spec).await?;
        if let Some(before) = claim_key(&mut tx, key, id).await? {
            return Ok(Created::Before(before));
        }
        tx.commit().await?;
        Ok(Created::New(id))
    }

    /// One training.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn training(&self, id: TrainingId) -> Result<Option<TrainingRecord>, LedgerError> {
        self.pool
            .row("SELECT * FROM trainings WHERE id = $1", values![id.to_string()])
            .await?
            .as_ref()
            .map(TrainingRecord::read)
            .transpose()
    }

    /// Trainings of a job, in the order of its specification.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn trainings_of(&self, job: JobId) -> Result<Vec<TrainingRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT * FROM trainings WHERE job_id = $1 ORDER BY id",
                values![job.to_string()],
            )
            .await?
            .iter()
            .map(TrainingRecord::read)
            .collect()
    }

    /// Takes the next training, cells of sweeps after all others. `None` if there is none, or the trainer has been given up.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn begin_training(&self, worker: &str) -> Result<Option<TrainingClaim>, LedgerError> {
        if self
            .pool
            .row("SELECT id FROM trainings WHERE state = 'open' LIMIT 1", &[])
            .await?
            .is_none()
        {
            return Ok(None);
        }
        let mut tx = self.pool.begin().await?;
        let statement = match self.engine() {
            Engine::Sqlite => {
                "UPDATE trainings SET epoch = epoch + 1, attempt = attempt + 1, state = 'running', \
                 worker = $1 WHERE id = (SELECT id FROM trainings WHERE state = 'open' ORDER BY sweep_id IS NOT NULL, id LIMIT 1) \
                 AND EXISTS (SELECT 1 FROM workers WHERE name = $1 AND state = 'alive') RETURNING *"
            }
            Engine::Postgres => {
                "UPDATE trainings SET epoch = epoch + 1, attempt = attempt + 1, state = 'running', \
                 worker = $1 WHERE id = (SELECT id FROM trainings WHERE state = 'open' ORDER BY sweep_id IS NOT NULL, id LIMIT 1 \
                 FOR UPDATE SKIP LOCKED) \
                 AND EXISTS (SELECT 1 FROM workers WHERE name = $1 AND state = 'alive') RETURNING *"
            }
        };
        let Some(row) = tx.row(statement, values![worker]).await? else {
            return Ok(None);
        };
        let training = TrainingRecord::read(&row)?;
        let dataset = tx
            .row(
                "SELECT * FROM datasets WHERE id = $1",
                values![training.dataset_id.as_str()],
            )
            .await?
            .ok_or_else(|| LedgerError::corrupt("dataset_id", training.dataset_id.as_str()))?;
        let claim = TrainingClaim {
            dataset: DatasetRecord::read(&dataset)?,
            training,
        };
        tx.commit().await?;
        Ok(Some(claim))
    }

    /// Notes how far a training is. False if it is no longer the trainer's.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn report_training(
        &self,
        claim: &TrainingClaim,
        progress: &TrainingProgress,
    ) -> Result<bool, LedgerError> {
        let TrainingRecord {
            id, epoch, job_id, ..
        } = &claim.training;
        let mut tx = self.pool.begin().await?;
        let changed = tx
            .execute(
                "UPDATE trainings SET progress = $3 WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![id.to_string(), *epoch, serde_json::to_string(progress)?],
            )
            .await?;
        if changed == 1
            && let Some(job) = job_id
        {
            let event = EventKind::Training {
                training_id: *id,
                progress: progress.clone(),
            };
            append(&mut tx, *job, &event).await?;
        }
        tx.commit().await?;
        Ok(changed == 1)
    }

    /// Registers the model of a training. False if the training is no longer the trainer's.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn commit_training(
        &self,
        claim: &TrainingClaim,
        model: &NewModel,
    ) -> Result<bool, LedgerError> {
        let TrainingRecord {
            id,
            epoch,
            job_id,
            dataset_id,
            spec,
            ..
        } = &claim.training;
        let mut tx = self.pool.begin().await?;
        let changed = tx
            .execute(
                "UPDATE trainings SET state = 'succeeded', model_id = $3, finished_ms = $4, reason = NULL \
                 WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![id.to_string(), *epoch, model.id.as_str(), clock::now_ms()],
            )
            .await?;
        if changed == 0 {
            return Ok(false);
        }
        tx.execute(
            "INSERT INTO models (id, sha256, training_id, dataset_id, spec, metrics, files, created_ms) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8) ON CONFLICT (id) DO NOTHING",
            values![
                model.id.as_str(),
                model.sha256.as_str(),
                id.to_string(),
                dataset_id.as_str(),
                serde_json::to_string(spec)?,
                serde_json::to_string(&model.metrics)?,
                serde_json::to_string(&model.files)?,
                clock::now_ms(),
            ],
        )
        .await?;
        if let Some(job) = job_id {
            let event = EventKind::Model {
                training_id: *id,
                model_id: model.id.clone(),
            };
            append(&mut tx, *job, &event).await?;
            finish_job(&mut tx, *job).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Ends a training that would fail again in the same way.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn fail_training(&self, claim: &TrainingClaim, reason: &str) -> Result<bool, LedgerError> {
        self.end_training(claim.training.id, claim.training.epoch, reason, true)
            .await
    }

    /// Takes a training back from a trainer that is gone: open again, or failed when its attempts
    /// are used up.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn lose_training(&self, id: TrainingId, epoch: u64, reason: &str) -> Result<bool, LedgerError> {
        self.end_training(id, epoch, reason, false).await
    }

    async fn end_training(
        &self,
        id: TrainingId,
        epoch: u64,
        reason: &str,
        for_good: bool,
    ) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let Some(row) = tx
            .row(
                "UPDATE trainings SET state = 'open', worker = NULL, reason = $3 \
                 WHERE id = $1 AND epoch = $2 AND state = 'running' RETURNING *",
                values![id.to_string(), epoch, reason],
            )
            .await?
        else {
            return Ok(false);
        };
        let training = TrainingRecord::read(&row)?;
        if for_good || training.attempt >= ATTEMPT_LIMIT {
            tx.execute(
                "UPDATE trainings SET state = 'failed', finished_ms = $2 WHERE id = $1",
                values![id.to_string(), clock::now_ms()],
            )
            .await?;
            if let Some(job) = training.job_id {
                let event = EventKind::TrainingFailed {
                    training_id: id,
                    reason: reason.to_owned(),
                };
                append(&mut tx, job, &event).await?;
                finish_job(&mut tx, job).await?;
            }
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Gives a training back untouched (a trainer stops): the attempt does not count.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn release_training(&self, claim: &TrainingClaim) -> Result<bool, LedgerError> {
        let changed = self
            .pool
            .execute(
                "UPDATE trainings SET state = 'open', attempt = attempt - 1, worker = NULL \
                 WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![claim.training.id.to_string(), claim.training.epoch],
            )
            .await?;
        Ok(changed == 1)
    }

    /// True while a training is the trainer's.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn holds_training(&self, claim: &TrainingClaim) -> Result<bool, LedgerError> {
        Ok(self
            .pool
            .row(
                "SELECT id FROM trainings WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![claim.training.id.to_string(), claim.training.epoch],
            )
            .await?
            .is_some())
    }

    /// One model.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn model(&self, id: &ModelId) -> Result<Option<ModelRecord>, LedgerError> {
        self.pool
            .row("SELECT * FROM models WHERE id = $1", values![id.as_str()])
            .await?
            .as_ref()
            .map(ModelRecord::read)
            .transpose()
    }

    /// Models, newest first, after the one that `before` names.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn models(
        &self,
        before: Option<(i64, &str)>,
        limit: u64,
    ) -> Result<Vec<ModelRecord>, LedgerError> {
        let (ms, id) = before.unwrap_or((i64::MAX, ""));
        self.pool
            .rows(
                "SELECT * FROM models WHERE created_ms < $1 OR (created_ms = $1 AND id < $2) \
                 ORDER BY created_ms DESC, id DESC LIMIT $3",
                values![ms, id, limit],
            )
            .await?
            .iter()
            .map(ModelRecord::read)
            .collect()
    }
}
