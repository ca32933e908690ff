//! Jobs: accepted, listed, moved on, cancelled.

use crate::engine::{Transaction, values};
use crate::events::append;
use crate::record::JobRecord;
use crate::{Claim, Ledger, LedgerError, ShardKind, clock, shards};
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::status::{JobNotice, JobState, TimeSplit};
use sha2::{Digest, Sha256};
use std::fmt::Display;
use std::str::FromStr;

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
    /// Remarks on the job; the first eight are kept.
    pub notices: Vec<JobNotice>,
}

/// Remarks that a job can have.
pub(crate) const NOTICES_MOST: usize = 8;

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

/// Claims the key of a request for what it makes, `id`; or says what an earlier request with it made.
pub(crate) async fn claim_key<Id: FromStr + Display>(
    tx: &mut Transaction,
    key: Option<&IdempotencyKey>,
    id: Id,
) -> Result<Option<Id>, LedgerError> {
    let Some(key) = key else { return Ok(None) };
    let claimed = tx
        .execute(
            "INSERT INTO idempotency_keys (key, body_sha256, resource, created_ms) \
             VALUES ($1, $2, $3, $4) ON CONFLICT (key) DO NOTHING",
            values![
                key.key.as_str(),
                key.body_sha256.as_str(),
                id.to_string(),
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
        row.parse("resource").map(Some)
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
        if let Some(before) = claim_key(&mut tx, key, id).await? {
            return Ok(Created::Before(before));
        }
        tx.execute(
            "INSERT INTO jobs (id, state, priority, spec, machine_sha256, runs, settling_runs, created_ms) \
             VALUES ($1, 'queued', $7, $2, $3, $4, $5, $6)",
            values![
                id.to_string(),
                serde_json::to_string(&new.spec)?,
                new.machine_sha256.as_str(),
                new.spec.runs,
                new.spec.settling_runs,
                clock::now_ms(),
                i64::from(new.spec.priority),
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
        for notice in new.notices.iter().take(NOTICES_MOST) {
            let notice = notice.clone();
            append(&mut tx, id, &EventKind::Notice { notice }).await?;
        }
        shards::plan(&mut tx, id, ShardKind::Settling, 0, &new.settling_shards).await?;
        shards::plan(&mut tx, id, ShardKind::Runs, 0, &new.run_shards).await?;
        tx.commit().await?;
        Ok(Created::New(id))
    }

    /// Whether a request with this key has led to something before.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn knows_key(&self, key: Option<&IdempotencyKey>) -> Result<bool, LedgerError> {
        let Some(key) = key else { return Ok(false) };
        let row = self
            .pool
            .row(
                "SELECT key FROM idempotency_keys WHERE key = $1",
                values![key.key.as_str()],
            )
            .await?;
        Ok(row.is_some())
    }

    /// Remarks with which a job was accepted: events right after its first one.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn notices(&self, job: JobId) -> Result<Vec<JobNotice>, LedgerError> {
        let first = self.events(job, 1, NOTICES_MOST as u64).await?;
        let notices = first.into_iter().map_while(|event| match event.what {
            EventKind::Notice { notice } => Some(notice),
            _ => None,
        });
        Ok(notices.collect())
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

    /// Worker seconds over all jobs, by what they were spent on.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn time_spent(&self) -> Result<TimeSplit, LedgerError> {
        let row = self
            .pool
            .row(
                "SELECT COALESCE(SUM(simulate_s), 0.0) AS simulate_s, COALESCE(SUM(encode_s), 0.0) AS encode_s, \
                 COALESCE(SUM(put_s), 0.0) AS put_s, COALESCE(SUM(wait_s), 0.0) AS wait_s FROM jobs",
                &[],
            )
            .await?
            .ok_or_else(|| LedgerError::corrupt("jobs", "no sums"))?;
        Ok(TimeSplit {
            simulate_s: row.real("simulate_s")?,
            encode_s: row.real("encode_s")?,
            put_s: row.real("put_s")?,
            wait_s: row.real("wait_s")?,
        })
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
        self.end_job(job, JobState::Cancelled, "cancelled on request", None)
            .await
    }

    /// Ends a job that cannot go on. False if it was over already.
    ///
    /// # Errors
    /// [`LedgerError::NoJob`]; what the database says.
    pub async fn fail_job(&self, job: JobId, reason: &str) -> Result<bool, LedgerError> {
        self.end_job(job, JobState::Failed, reason, None).await
    }

    /// Ends the job of a claim that shows that it cannot be simulated. False if the claim is no longer
    /// valid, or the job was over already.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn fail_job_of(&self, claim: &Claim, reason: &str) -> Result<bool, LedgerError> {
        self.end_job(claim.shard.job_id, JobState::Failed, reason, Some(claim))
            .await
    }

    async fn end_job(
        &self,
        job: JobId,
        state: JobState,
        reason: &str,
        only_while_held: Option<&Claim>,
    ) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        if let Some(claim) = only_while_held {
            // Written to take their locks, all in one order: workers that fail a job at the same time would
            // otherwise wait for each other.
            tx.execute(
                "UPDATE shards SET worker = worker WHERE job_id = $1 AND state IN ('open', 'running')",
                values![job.to_string()],
            )
            .await?;
            let held = tx
                .row(
                    "SELECT id FROM shards WHERE id = $1 AND epoch = $2 AND state = 'running'",
                    values![claim.shard.id.to_string(), claim.shard.epoch],
                )
                .await?;
            if held.is_none() {
                return Ok(false);
            }
        }
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

    /// Does again what failed of a job that is over, and nothing else: runs that were given up, and then
    /// the data set and its trainings; or, if every run is there, the trainings that failed. Returns
    /// whether there was anything to do.
    ///
    /// # Errors
    /// [`LedgerError::NoJob`]; what the database says.
    pub async fn retry_job(&self, job: JobId) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let id = job.to_string();
        // Shards and trainings before the job, as in every other transaction.
        let given_up = tx
            .rows(
                "UPDATE shards SET state = 'open', attempt = 0, worker = NULL WHERE job_id = $1 \
                 AND state = 'dead' AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND collected = 0 \
                   AND dataset_id IS NOT NULL AND state IN ('succeeded', 'failed')) RETURNING *",
                values![id.as_str()],
            )
            .await?;
        let retried = if given_up.is_empty() {
            let trainings = tx
                .execute(
                    "UPDATE trainings SET state = 'open', attempt = 0, worker = NULL, reason = NULL, \
                     finished_ms = NULL WHERE job_id = $1 AND state = 'failed' \
                     AND EXISTS (SELECT 1 FROM jobs WHERE id = $1 AND state = 'failed')",
                    values![id.as_str()],
                )
                .await?;
            trainings > 0
                && advance(
                    &mut tx,
                    job,
                    JobState::Training,
                    None,
                    // $3 only takes its place: the job is not over any more.
                    "UPDATE jobs SET state = $2, finished_ms = NULLIF($3, $3), reason = $4 WHERE id = $1 \
                     AND state = 'failed'",
                )
                .await?
        } else {
            let (mut runs, mut settling) = (0, 0);
            for row in &given_up {
                match row.parse("kind")? {
                    ShardKind::Runs => runs += row.count("run_count")?,
                    ShardKind::Settling => settling += row.count("run_count")?,
                }
            }
            // Its trainings learned from the data set without these runs: they stay, and others follow.
            tx.execute(
                "UPDATE trainings SET job_id = NULL WHERE job_id = $1",
                values![id.as_str()],
            )
            .await?;
            tx.execute(
                "UPDATE jobs SET runs_done = runs_done - $2, runs_failed = runs_failed - $2, \
                 settling_done = settling_done - $3, finished_ms = NULL, round = round + 1 WHERE id = $1",
                values![id.as_str(), runs, settling],
            )
            .await?;
            advance(
                &mut tx,
                job,
                JobState::Simulating,
                None,
                "UPDATE jobs SET state = $2, started_ms = $3, reason = $4 WHERE id = $1 \
                 AND state IN ('succeeded', 'failed')",
            )
            .await?
        };
        if !retried {
            return match tx.row(COLUMNS_OF_JOB, values![id.as_str()]).await? {
                Some(_) => Ok(false),
                None => Err(LedgerError::NoJob { id }),
            };
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Jobs that need their shard objects no longer, at most `limit`. A published job whose runs were
    /// given up in part keeps them: [`Ledger::retry_job`] adds the rest.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn uncollected_jobs(&self, limit: u64) -> Result<Vec<JobId>, LedgerError> {
        self.pool
            .rows(
                "SELECT id FROM jobs WHERE collected = 0 \
                 AND state IN ('training', 'succeeded', 'failed', 'cancelled') \
                 AND (state = 'cancelled' OR dataset_id IS NULL OR NOT EXISTS \
                   (SELECT 1 FROM shards WHERE job_id = jobs.id AND state = 'dead')) ORDER BY id LIMIT $1",
                values![limit],
            )
            .await?
            .iter()
            .map(|row| row.parse("id"))
            .collect()
    }

    /// Whether a job's shard objects have been deleted: what is found of it later is an orphan that a
    /// worker put after it had been given up.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn is_collected(&self, job: JobId) -> Result<bool, LedgerError> {
        let row = self
            .pool
            .row(
                "SELECT id FROM jobs WHERE id = $1 AND collected = 1",
                values![job.to_string()],
            )
            .await?;
        Ok(row.is_some())
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
