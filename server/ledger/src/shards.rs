//! Shards: planned by a coordinator, begun and committed by workers, taken back when lost.

use crate::engine::{Engine, Transaction, values};
use crate::events::append;
use crate::jobs::advance;
use crate::record::{JobRecord, ShardRecord};
use crate::transition::{AfterLoss, after_loss};
use crate::{Ledger, LedgerError};
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::{JobId, ShardId};
use hydroflex_openapi::status::{JobState, TimeSplit};
use std::fmt;
use std::str::FromStr;

/// What kind of runs a shard holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ShardKind {
    /// Runs of the job.
    Runs,
    /// Extra runs with the test signal, numbered apart.
    Settling,
}

impl ShardKind {
    /// As written in the database and in object names.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Runs => "runs",
            Self::Settling => "settling",
        }
    }
}

impl fmt::Display for ShardKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for ShardKind {
    type Err = ();
    fn from_str(text: &str) -> Result<Self, ()> {
        [Self::Runs, Self::Settling]
            .into_iter()
            .find(|kind| kind.as_str() == text)
            .ok_or(())
    }
}

/// A shard in a worker's hands, valid as long as nobody has begun it again.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// The shard as begun.
    pub shard: ShardRecord,
    /// The job it belongs to.
    pub job: JobRecord,
}

impl Claim {
    /// The object of this attempt: no other attempt ever has the same name.
    #[must_use]
    pub fn object(&self) -> String {
        let ShardRecord {
            id,
            job_id,
            kind,
            first_run,
            epoch,
            ..
        } = &self.shard;
        format!("shards/{job_id}/{kind}-{first_run:012}-{id}-e{epoch}.parquet")
    }
}

/// What a worker hands in.
#[derive(Debug, Clone, PartialEq)]
pub struct ShardResult {
    /// Object in the store, already durable.
    pub object: String,
    /// Its SHA-256.
    pub sha256: String,
    /// Its size.
    pub size_bytes: u64,
    /// Runs without samples.
    pub failed_runs: u64,
    /// What the time went into.
    pub spent: TimeSplit,
}

/// Whether a commit counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommitOutcome {
    /// It did.
    Committed,
    /// The shard was taken back or cancelled in the meantime: the object is an orphan.
    Fenced,
}

/// Cuts the next runs of a job into open shards.
pub(crate) async fn plan(
    tx: &mut Transaction,
    job: JobId,
    kind: ShardKind,
    from: u64,
    sizes: &[u64],
) -> Result<(), LedgerError> {
    let mut first = from;
    for size in sizes {
        insert_open(tx, job, kind, first, *size, false).await?;
        first += size;
    }
    let statement = match kind {
        ShardKind::Runs => "UPDATE jobs SET runs_planned = $2 WHERE id = $1",
        ShardKind::Settling => "UPDATE jobs SET settling_planned = $2 WHERE id = $1",
    };
    tx.execute(statement, values![job.to_string(), first])
        .await
        .map(drop)
}

async fn insert_open(
    tx: &mut Transaction,
    job: JobId,
    kind: ShardKind,
    first_run: u64,
    run_count: u64,
    is_half: bool,
) -> Result<(), LedgerError> {
    tx.execute(
        "INSERT INTO shards (id, job_id, kind, first_run, run_count, state, is_half) \
         VALUES ($1, $2, $3, $4, $5, 'open', $6)",
        values![
            ShardId::generate().to_string(),
            job.to_string(),
            kind.as_str(),
            first_run,
            run_count,
            i64::from(is_half),
        ],
    )
    .await
    .map(drop)
}

/// Counts runs as accounted for and says so in an event.
async fn count_runs(
    tx: &mut Transaction,
    job: JobId,
    kind: ShardKind,
    runs: u64,
    failed: u64,
    spent: TimeSplit,
) -> Result<(), LedgerError> {
    let statement = match kind {
        ShardKind::Runs => {
            "UPDATE jobs SET runs_done = runs_done + $2, runs_failed = runs_failed + $3, \
             simulate_s = simulate_s + $4, encode_s = encode_s + $5, put_s = put_s + $6, wait_s = wait_s + $7 WHERE id = $1 \
             RETURNING runs_done, runs_failed, settling_done"
        }
        // Failed settling runs are not counted: $3 only takes its place among the parameters.
        ShardKind::Settling => {
            "UPDATE jobs SET settling_done = settling_done + $2, runs_failed = runs_failed + 0 * $3, \
             simulate_s = simulate_s + $4, encode_s = encode_s + $5, put_s = put_s + $6, wait_s = wait_s + $7 WHERE id = $1 \
             RETURNING runs_done, runs_failed, settling_done"
        }
    };
    let row = tx
        .row(
            statement,
            values![
                job.to_string(),
                runs,
                failed,
                spent.simulate_s,
                spent.encode_s,
                spent.put_s,
                spent.wait_s,
            ],
        )
        .await?
        .ok_or_else(|| LedgerError::NoJob { id: job.to_string() })?;
    let event = EventKind::Progress {
        runs_done: row.count("runs_done")?,
        runs_failed: row.count("runs_failed")?,
        settling_done: row.count("settling_done")?,
    };
    append(tx, job, &event).await
}

impl Ledger {
    /// Cuts the next runs of a job into shards, if nobody else did since `planned` was read.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn plan_shards(
        &self,
        job: JobId,
        kind: ShardKind,
        planned: u64,
        sizes: &[u64],
    ) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        // The row is written to take its lock: of two coordinators the second one then sees what
        // the first has planned.
        let statement = match kind {
            ShardKind::Runs => {
                "UPDATE jobs SET runs_planned = runs_planned WHERE id = $1 AND runs_planned = $2 \
                 AND state IN ('queued', 'simulating')"
            }
            ShardKind::Settling => {
                "UPDATE jobs SET settling_planned = settling_planned WHERE id = $1 \
                 AND settling_planned = $2 AND state IN ('queued', 'simulating')"
            }
        };
        if tx.execute(statement, values![job.to_string(), planned]).await? == 0 {
            return Ok(false);
        }
        plan(&mut tx, job, kind, planned, sizes).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// Takes the next shard: of the most urgent, then oldest job; settling runs first, then in run
    /// order. Only of jobs that nobody has begun, or that were begun on the worker's instruction-set
    /// level. `None` if there is nothing to do, or the worker has been given up.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn begin_shard(&self, worker: &str) -> Result<Option<Claim>, LedgerError> {
        // Asked first without any lock: an idle worker must not take the write lock.
        let any = self
            .pool
            .row(
                "SELECT s.id FROM shards s JOIN jobs j ON j.id = s.job_id JOIN workers w ON w.name = $1 \
                 WHERE s.state = 'open' AND j.state IN ('queued', 'simulating', 'publishing') \
                 AND (j.instruction_set IS NULL OR j.instruction_set = w.instruction_set) LIMIT 1",
                values![worker],
            )
            .await?;
        if any.is_none() {
            return Ok(None);
        }
        let mut tx = self.pool.begin().await?;
        let statement = match self.engine() {
            Engine::Sqlite => {
                "UPDATE shards SET epoch = epoch + 1, attempt = attempt + 1, state = 'running', worker = $1 \
                 WHERE id = (SELECT s.id FROM shards s JOIN jobs j ON j.id = s.job_id JOIN workers w ON w.name = $1 \
                   WHERE s.state = 'open' AND j.state IN ('queued', 'simulating', 'publishing') \
                   AND (j.instruction_set IS NULL OR j.instruction_set = w.instruction_set) \
                   ORDER BY j.priority DESC, j.id, s.kind DESC, s.first_run LIMIT 1) \
                 AND EXISTS (SELECT 1 FROM workers WHERE name = $1 AND state = 'alive') RETURNING *"
            }
            Engine::Postgres => {
                "UPDATE shards SET epoch = epoch + 1, attempt = attempt + 1, state = 'running', worker = $1 \
                 WHERE id = (SELECT s.id FROM shards s JOIN jobs j ON j.id = s.job_id JOIN workers w ON w.name = $1 \
                   WHERE s.state = 'open' AND j.state IN ('queued', 'simulating', 'publishing') \
                   AND (j.instruction_set IS NULL OR j.instruction_set = w.instruction_set) \
                   ORDER BY j.priority DESC, j.id, s.kind DESC, s.first_run LIMIT 1 \
                   FOR UPDATE OF s SKIP LOCKED) \
                 AND EXISTS (SELECT 1 FROM workers WHERE name = $1 AND state = 'alive') RETURNING *"
            }
        };
        let Some(row) = tx.row(statement, values![worker]).await? else {
            return Ok(None);
        };
        let shard = ShardRecord::read(&row)?;
        advance(
            &mut tx,
            shard.job_id,
            JobState::Simulating,
            None,
            "UPDATE jobs SET state = $2, started_ms = $3, reason = $4 WHERE id = $1 AND state = 'queued'",
        )
        .await?;
        tx.execute(
            "UPDATE jobs SET instruction_set = (SELECT instruction_set FROM workers WHERE name = $2) \
             WHERE id = $1 AND instruction_set IS NULL",
            values![shard.job_id.to_string(), worker],
        )
        .await?;
        let row = tx
            .row(
                "SELECT j.*, w.instruction_set AS worker_set FROM jobs j, workers w \
                 WHERE j.id = $1 AND w.name = $2",
                values![shard.job_id.to_string(), worker],
            )
            .await?
            .ok_or_else(|| LedgerError::NoJob {
                id: shard.job_id.to_string(),
            })?;
        let job = JobRecord::read(&row)?;
        if job.instruction_set != row.optional_text("worker_set")? {
            // A worker of another level has begun the same job a moment ago: nothing is taken.
            return Ok(None);
        }
        let claim = Claim { shard, job };
        tx.commit().await?;
        Ok(Some(claim))
    }

    /// True while a claim is valid: asked by a running worker every now and then.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn holds(&self, claim: &Claim) -> Result<bool, LedgerError> {
        Ok(self
            .pool
            .row(
                "SELECT id FROM shards WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![claim.shard.id.to_string(), claim.shard.epoch],
            )
            .await?
            .is_some())
    }

    /// Hands a shard in. Its object must be durable under [`Claim::object`] before.
    ///
    /// # Errors
    /// Passes on what the database says; the outcome is then unknown, and asking again is safe.
    pub async fn commit_shard(
        &self,
        claim: &Claim,
        result: &ShardResult,
    ) -> Result<CommitOutcome, LedgerError> {
        let shard = &claim.shard;
        let mut tx = self.pool.begin().await?;
        let changed = tx
            .execute(
                "UPDATE shards SET state = 'committed', object = $3, sha256 = $4, size_bytes = $5, \
                 failed_runs = $6, simulate_s = $7 WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![
                    shard.id.to_string(),
                    shard.epoch,
                    result.object.as_str(),
                    result.sha256.as_str(),
                    result.size_bytes,
                    result.failed_runs,
                    result.spent.simulate_s,
                ],
            )
            .await?;
        if changed == 0 {
            // A commit whose answer was lost is asked again: the same object is the same commit.
            let same = tx
                .row(
                    "SELECT id FROM shards WHERE id = $1 AND epoch = $2 AND state = 'committed' \
                     AND sha256 = $3",
                    values![shard.id.to_string(), shard.epoch, result.sha256.as_str()],
                )
                .await?
                .is_some();
            return Ok(if same {
                CommitOutcome::Committed
            } else {
                CommitOutcome::Fenced
            });
        }
        count_runs(
            &mut tx,
            shard.job_id,
            shard.kind,
            shard.run_count,
            result.failed_runs,
            result.spent,
        )
        .await?;
        tx.commit().await?;
        Ok(CommitOutcome::Committed)
    }

    /// Gives a shard back untouched (a worker drains): the attempt does not count.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn release_shard(&self, claim: &Claim) -> Result<bool, LedgerError> {
        let changed = self
            .pool
            .execute(
                "UPDATE shards SET state = 'open', attempt = attempt - 1, worker = NULL \
                 WHERE id = $1 AND epoch = $2 AND state = 'running'",
                values![claim.shard.id.to_string(), claim.shard.epoch],
            )
            .await?;
        Ok(changed == 1)
    }

    /// Takes back the attempt `epoch` of a shard: it is open again, halved, or given up. False if
    /// that attempt was over already.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn lose_shard(&self, id: ShardId, epoch: u64, reason: &str) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        // Takes the row's lock under the fence; the state it goes to is decided below.
        let Some(row) = tx
            .row(
                "UPDATE shards SET state = 'open', worker = NULL, reason = $3 \
                 WHERE id = $1 AND epoch = $2 AND state = 'running' RETURNING *",
                values![id.to_string(), epoch, reason],
            )
            .await?
        else {
            return Ok(false);
        };
        let shard = ShardRecord::read(&row)?;
        let outcome = after_loss(shard.attempt, shard.run_count, shard.is_half);
        let event = EventKind::ShardLost {
            first_run: shard.first_run,
            run_count: shard.run_count,
            attempt: shard.attempt,
            outcome: match outcome {
                AfterLoss::Retry => "retried",
                AfterLoss::Halve { .. } => "halved",
                AfterLoss::GiveUp => "given_up",
            }
            .to_owned(),
            reason: reason.to_owned(),
        };
        append(&mut tx, shard.job_id, &event).await?;
        match outcome {
            AfterLoss::Retry => {}
            AfterLoss::Halve { left, right } => {
                tx.execute(
                    "UPDATE shards SET state = 'halved' WHERE id = $1",
                    values![id.to_string()],
                )
                .await?;
                let ShardRecord {
                    job_id,
                    kind,
                    first_run,
                    ..
                } = shard;
                insert_open(&mut tx, job_id, kind, first_run, left, true).await?;
                insert_open(&mut tx, job_id, kind, first_run + left, right, true).await?;
            }
            AfterLoss::GiveUp => {
                tx.execute(
                    "UPDATE shards SET state = 'dead' WHERE id = $1",
                    values![id.to_string()],
                )
                .await?;
                count_runs(&mut tx, shard.job_id, shard.kind, 1, 1, TimeSplit::default()).await?;
            }
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Has a committed shard done again, because its object is missing or damaged. Its job waits in
    /// its state until it is complete again. False if somebody else has done so.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn redo_shard(&self, id: ShardId, epoch: u64, reason: &str) -> Result<bool, LedgerError> {
        let mut tx = self.pool.begin().await?;
        let Some(row) = tx
            .row(
                "UPDATE shards SET state = 'open', worker = NULL, attempt = 0, object = NULL, reason = $3 \
                 WHERE id = $1 AND epoch = $2 AND state = 'committed' RETURNING *",
                values![id.to_string(), epoch, reason],
            )
            .await?
        else {
            return Ok(false);
        };
        let shard = ShardRecord::read(&row)?;
        let statement = match shard.kind {
            ShardKind::Runs => {
                "UPDATE jobs SET runs_done = runs_done - $2, runs_failed = runs_failed - $3 \
                 WHERE id = $1 AND state IN ('simulating', 'publishing')"
            }
            ShardKind::Settling => {
                "UPDATE jobs SET settling_done = settling_done - $2, runs_failed = runs_failed - 0 * $3 \
                 WHERE id = $1 AND state IN ('simulating', 'publishing')"
            }
        };
        let values = values![
            shard.job_id.to_string(),
            shard.run_count,
            row.count("failed_runs")?
        ];
        if tx.execute(statement, values).await? == 0 {
            return Ok(false);
        }
        let event = EventKind::ShardLost {
            first_run: shard.first_run,
            run_count: shard.run_count,
            attempt: shard.attempt,
            outcome: "retried".to_owned(),
            reason: reason.to_owned(),
        };
        append(&mut tx, shard.job_id, &event).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// Shards of a job in run order that hold its runs: committed and dead ones, from a run on.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn settled_shards(
        &self,
        job: JobId,
        kind: ShardKind,
        from_run: u64,
        limit: u64,
    ) -> Result<Vec<ShardRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT * FROM shards WHERE job_id = $1 AND kind = $2 AND first_run >= $3 \
                 AND state IN ('committed', 'dead') ORDER BY first_run LIMIT $4",
                values![job.to_string(), kind.as_str(), from_run, limit],
            )
            .await?
            .iter()
            .map(ShardRecord::read)
            .collect()
    }

    /// Shards of a job that wait or run.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn open_shard_count(&self, job: JobId) -> Result<u64, LedgerError> {
        self.pool
            .row(
                "SELECT COUNT(*) AS n FROM shards WHERE state IN ('open', 'running') AND job_id = $1",
                values![job.to_string()],
            )
            .await?
            .map_or(Ok(0), |row| row.count("n"))
    }

    /// Measured cost of one run of a machine: mean over the shards last committed, in seconds.
    /// `None` before the first.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn run_cost_s(&self, job: JobId) -> Result<Option<f64>, LedgerError> {
        let row = self
            .pool
            .row(
                "SELECT SUM(simulate_s) AS cost, CAST(SUM(run_count) AS BIGINT) AS runs FROM \
                 (SELECT simulate_s, run_count FROM shards WHERE job_id = $1 AND kind = 'runs' \
                  AND state = 'committed' ORDER BY first_run DESC LIMIT 16) AS last",
                values![job.to_string()],
            )
            .await?;
        match row {
            Some(row) => match row.optional_int("runs")? {
                Some(runs) if runs > 0 => Ok(Some(row.real("cost")? / runs as f64)),
                _ => Ok(None),
            },
            None => Ok(None),
        }
    }

    /// Number of shards in each state, over all jobs.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn shard_counts(&self) -> Result<Vec<(String, u64)>, LedgerError> {
        self.pool
            .rows(
                "SELECT state, COUNT(*) AS n FROM shards GROUP BY state ORDER BY state",
                &[],
            )
            .await?
            .iter()
            .map(|row| Ok((row.text("state")?, row.count("n")?)))
            .collect()
    }
}
