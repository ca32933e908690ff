//! Jobs: accepted, listed, moved on, cancelled.

use crate::engine::{Transaction, values};
use crate::events::append;
use crate::record::JobRecord;
use crate::{Ledger, LedgerError, ShardKind, clock, shards};
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::status::JobState;
use sha2::{Digest, Sha256};

/// A job as it is accepted: checked, defaults filled in.
#[derive(Debug, Clone)]
pub struct NewJob {
    /// Specification.
    pub spec: JobSpec,
    /// SHA-256 of the machine.
    pub machine_sha256: String,
    /// Sizes of the first shards of settling runs, in run order.
    pub settling_shards: Vec<u64>,
    /// Sizes of the first shards of runs, in run order.
    pub run_shards: Vec<u64>,
}

/// A key that makes a request safe to repeat.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyKey {
    /// The key, as the client chose it.
    pub key: String,
    body_sha256: String,
}

impl IdempotencyKey {
    /// A key with the body it came with.
    #[must_use]
    pub fn new(key: impl Into<String>, body: &[u8]) -> Self {
        Self {
            key: key.into(),
            body_sha256: hex::encode(Sha256::digest(body)),
        }
    }
}

/// What a request for something new led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Created<Id> {
    /// It was made.
    New(Id),
    /// The same request made it before.
    Before(Id),
}

impl<Id: Copy> Created<Id> {
    /// The identifier, new or not.
    pub fn id(&self) -> Id {
        match self {
            Self::New(id) | Self::Before(id) => *id,
        }
    }
}

/// Looks a key up, and claims it for `resource` if it is free.
pub(crate) async fn claim_key(
    tx: &mut Transaction,
    key: &IdempotencyKey,
    resource: &str,
) -> Result<Option<String>, LedgerError> {
    let claimed = tx
        .execute(
            "INSERT INTO idempotency_keys (key, body_sha256, resource, created_ms) \
             VALUES ($1, $2, $3, $4) ON CONFLICT (key) DO NOTHING",
            values![
                key.key.as_str(),
                key.body_sha256.as_str(),
                resource,
                clock::now_ms()
            ],
        )
        .await?;
    if claimed == 1 {
        return Ok(None);
    }
    let row = tx
        .row(
            "SELECT body_sha256, resource FROM idempotency_keys WHERE key = $1",
            values![key.key.as_str()],
        )
        .await?
        .ok_or_else(|| LedgerError::corrupt("idempotency_keys.key", &key.key))?;
    if row.text("body_sha256")? == key.body_sha256 {
        row.text("resource").map(Some)
    } else {
        Err(LedgerError::KeyReused { key: key.key.clone() })
    }
}

/// Moves a job from one of the states `from` (a list in SQL) to another, with its event.
pub(crate) async fn advance(
    tx: &mut Transaction,
    job: JobId,
    to: JobState,
    reason: Option<&str>,
    statement: &'static str,
) -> Result<bool, LedgerError> {
    let reason = reason.map(str::to_owned);
    let changed = tx
        .execute(
            statement,
            values![job.to_string(), to.as_str(), clock::now_ms(), reason.clone()],
        )
        .await?;
    if changed == 1 {
        append(tx, job, &EventKind::State { state: to, reason }).await?;
    }
    Ok(changed == 1)
}

const COLUMNS_OF_JOB: &str = "SELECT * FROM jobs WHERE id = $1";

impl Ledger {
    /// Accepts a job: the job, its first shards and its first event, or nothing at all.
    ///
    /// # Errors
    /// [`LedgerError::KeyReused`] if the key came with another body before; what the database says.
    pub async fn create_job(
        &self,
        new: &NewJob,
        key: Option<&IdempotencyKey>,
    ) -> Result<Created<JobId>, LedgerError> {
        let id = JobId::generate();
        let mut tx = self.pool.begin().await?;
        if let Some(key) = key
            && let Some(before) = claim_key(&mut tx, key, &id.to_string()).await?
        {
            let before = before
                .parse()
                .map_err(|_| LedgerError::corrupt("resource", &before))?;
            return Ok(Created::Before(before));
        }
        tx.execute(
            "INSERT INTO jobs (id, state, priority, spec, machine_sha256, runs, settling_runs, created_ms) \
             VALUES ($1, 'queued', 0, $2, $3, $4, $5, $6)",
            values![
                id.to_string(),
                serde_json::to_string(&new.spec)?,
                new.machine_sha256.as_str(),
                new.spec.runs,
                new.spec.settling_runs,
                clock::now_ms(),
            ],
        )
        .await?;
        append(
            &mut tx,
            id,
            &EventKind::State {
                state: JobState::Queued,
                reason: None,
            },
        )
        .await?;
        shards::plan(&mut tx, id, ShardKind::Settling, 0, &new.settling_shards).await?;
        shards::plan(&mut tx, id, ShardKind::Runs, 0, &new.run_shards).await?;
        tx.commit().await?;
        Ok(Created::New(id))
    }

    /// One job.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn job(&self, id: JobId) -> Result<Option<JobRecord>, LedgerError> {
        self.pool
            .row(COLUMNS_OF_JOB, values![id.to_string()])
            .await?
            .as_ref()
            .map(JobRecord::read)
            .transpose()
    }

    /// Jobs, newest first, older than `before`.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn jobs(&self, before: Option<JobId>, limit: u64) -> Result<Vec<JobRecord>, LedgerError> {
        // No hexadecimal digit sorts after `g`, in whatever order a database has for text.
        let before = before.map_or_else(|| "g".to_owned(), |id| id.to_string());
        self.pool
            .rows(
                "SELECT * FROM jobs WHERE id < $1 ORDER BY id DESC LIMIT $2",
                values![before, limit],
            )
            .await?
            .iter()
            .map(JobRecord::read)
            .collect()
    }

    /// Jobs that are not over, oldest first: what a coordinator looks after.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn unfinished_jobs(&self) -> Result<Vec<JobRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT * FROM jobs WHERE state IN ('queued', 'simulating', 'publishing', 'training') \
                 ORDER BY id",
                &[],
            )
            .await?
            .iter()
            .map(JobRecord::read)
            .collect()
    }

    /// Number of jobs in each state.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn job_counts(&self) -> Result<Vec<(JobState, u64)>, LedgerError> {
        self.pool
            .rows(
                "SELECT state, COUNT(*) AS n FROM jobs GROUP BY state ORDER BY state",
                &[],
            )
            .await?
            .iter()
            .map(|row| Ok((row.parse("state")?, row.count("n")?)))
            .collect()
    }

    /// Says that every run is accounted for and the data set is being written. True once per job.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn begin_publishing(&self, job: JobId) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let done = advance(
            &mut tx,
            job,
            JobState::Publishing,
            None,
            // $3 and $4 are the time and the reason that every such statement is given.
            "UPDATE jobs SET state = $2, started_ms = COALESCE(started_ms, $3), reason = $4 WHERE id = $1 \
             AND state IN ('queued', 'simulating') AND runs_done = runs AND settling_done = settling_runs",
        )
        .await?;
        tx.commit().await?;
        Ok(done)
    }

    /// Ends a job on request. False if it was over already.
    ///
    /// # Errors
    /// [`LedgerError::NoJob`]; what the database says.
    pub async fn cancel_job(&self, job: JobId) -> Result<bool, LedgerError> {
        self.end_job(job, JobState::Cancelled, "cancelled on request")
            .await
    }

    /// Ends a job that cannot go on. False if it was over already.
    ///
    /// # Errors
    /// [`LedgerError::NoJob`]; what the database says.
    pub async fn fail_job(&self, job: JobId, reason: &str) -> Result<bool, LedgerError> {
        self.end_job(job, JobState::Failed, reason).await
    }

    async fn end_job(&self, job: JobId, state: JobState, reason: &str) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        // Shards and trainings before the job, as in every other transaction: two of them that lock
        // the same rows in different order would wait for each other. A shard planned in between
        // stays open, but nobody begins a shard of a job that is over.
        tx.execute(
            "UPDATE shards SET state = 'cancelled' WHERE job_id = $1 AND state IN ('open', 'running')",
            values![job.to_string()],
        )
        .await?;
        tx.execute(
            "UPDATE trainings SET state = 'cancelled', reason = $2, finished_ms = $3 \
             WHERE job_id = $1 AND state IN ('open', 'running')",
            values![job.to_string(), reason, clock::now_ms()],
        )
        .await?;
        let ended = advance(
            &mut tx,
            job,
            state,
            Some(reason),
            "UPDATE jobs SET state = $2, finished_ms = $3, reason = $4 WHERE id = $1 \
             AND state IN ('queued', 'simulating', 'publishing', 'training')",
        )
        .await?;
        if !ended && tx.row(COLUMNS_OF_JOB, values![job.to_string()]).await?.is_none() {
            return Err(LedgerError::NoJob { id: job.to_string() });
        }
        tx.commit().await?;
        Ok(ended)
    }

    /// Jobs that need their shard objects no longer, at most `limit`.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn uncollected_jobs(&self, limit: u64) -> Result<Vec<JobId>, LedgerError> {
        self.pool
            .rows(
                "SELECT id FROM jobs WHERE collected = 0 \
                 AND state IN ('training', 'succeeded', 'failed', 'cancelled') ORDER BY id LIMIT $1",
                values![limit],
            )
            .await?
            .iter()
            .map(|row| row.parse("id"))
            .collect()
    }

    /// Notes that a job's shard objects are deleted.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn mark_collected(&self, job: JobId) -> Result<(), LedgerError> {
        self.pool
            .execute(
                "UPDATE jobs SET collected = 1 WHERE id = $1",
                values![job.to_string()],
            )
            .await
            .map(drop)
    }
}
