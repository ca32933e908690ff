//! Claim, simulate, put, commit; and around it the heartbeat, the limits, the end.

use crate::machines::{Machines, RefusedMachine};
use crate::memory;
use crate::shard::{self, EncodedShard, ShardControl, ShardFailure};
use anyhow::Context;
use hydroflex_ledger::blobs::{BlobError, Blobs};
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::{Claim, CommitOutcome, Ledger, LedgerError, ShardResult, identity};
use hydroflex_openapi::id::JobId;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tracing::Instrument;

/// How often a worker reports that it lives.
const BEAT: Duration = Duration::from_secs(1);
/// How often a shard in work asks whether it is still wanted.
const LOOK: Duration = Duration::from_millis(500);
/// Longest wait between two looks for work.
const LONGEST_IDLE: Duration = Duration::from_millis(100);
/// How long the database or the store may be away before a shard is given back.
const PATIENCE: Duration = Duration::from_mins(1);

/// How a worker works.
#[derive(Debug, Clone)]
pub struct WorkerConfig {
    /// Database URL.
    pub database: String,
    /// Store URL.
    pub store: String,
    /// Directory for reduced bodies.
    pub cache: PathBuf,
    /// Threads that simulate.
    pub threads: usize,
    /// Stop after this time, once the shard in hand is done.
    pub drain_after: Option<Duration>,
    /// What a run may take.
    pub limits: RunLimits,
}

/// What a run may take before it counts as lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunLimits {
    /// Time.
    pub time: Duration,
    /// Memory of the whole process; 0 for no limit.
    pub memory_bytes: u64,
}

impl Default for RunLimits {
    fn default() -> Self {
        Self {
            time: Duration::from_mins(10),
            memory_bytes: 4 << 30,
        }
    }
}

/// Why a worker ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// Told to, or its time was up.
    Drained,
    /// A run hangs or eats memory: the process must end, because a thread in it cannot be stopped.
    Spoiled,
}

struct Worker {
    ledger: Ledger,
    blobs: Blobs,
    machines: Arc<Machines>,
    pool: Arc<rayon::ThreadPool>,
    limits: RunLimits,
    stop: watch::Receiver<bool>,
}

/// Works until told to stop. Survives restarts of the database and of the coordinator.
///
/// # Errors
/// If the database or store cannot be used at all, or threads cannot be started.
pub async fn work(config: WorkerConfig, stop: watch::Receiver<bool>) -> anyhow::Result<Ended> {
    memory::limit(config.limits.memory_bytes);
    let Some(ledger) = connect(&config.database, stop.clone()).await? else {
        return Ok(Ended::Drained);
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(config.threads.max(1))
        .thread_name(|number| format!("simulate-{number}"))
        .build()
        .context("cannot start the simulation threads")?;
    let blobs = Blobs::open(&config.store)?;
    blobs
        .wait_until_there(PATIENCE)
        .await
        .context("the store does not answer")?;
    let worker = Worker {
        blobs,
        machines: Arc::new(Machines::new(config.cache)),
        pool: Arc::new(pool),
        limits: config.limits,
        ledger,
        stop,
    };
    let deadline = config.drain_after.map(|after| Instant::now() + after);
    for life in 1.. {
        let name = identity::worker_name("worker", life);
        match worker.live(&name, deadline).await {
            Ok(Some(ended)) => {
                let _ = worker.ledger.give_up_worker(&name, "its worker stopped").await;
                return Ok(ended);
            }
            Ok(None) => tracing::warn!(worker = name, "was given up by the coordinator; starting over"),
            Err(error) if error.is_transient() => {
                tracing::warn!(worker = name, %error, "the database is away; trying again");
                tokio::time::sleep(BEAT).await;
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(Ended::Drained)
}

/// Waits for the database and its schema.
async fn connect(url: &str, mut stop: watch::Receiver<bool>) -> anyhow::Result<Option<Ledger>> {
    let start = Instant::now();
    loop {
        match Ledger::open(url).await {
            Ok(ledger) => return Ok(Some(ledger)),
            Err(error)
                if start.elapsed() < PATIENCE
                    && (error.is_transient() || matches!(error, LedgerError::NoSchema)) =>
            {
                tracing::debug!(%error, "waiting for the database");
            }
            Err(error) => return Err(error).context("cannot open the database"),
        }
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(None),
            () = tokio::time::sleep(LOOK) => {}
        }
    }
}

impl Worker {
    /// Works under one name. `None` if the name was given up by the coordinator.
    async fn live(&self, name: &str, deadline: Option<Instant>) -> Result<Option<Ended>, LedgerError> {
        let level = hydroflex_sim::instruction_set::level();
        self.ledger.register_worker(name, Some(level)).await?;
        let alive = Arc::new(AtomicBool::new(true));
        let heart = tokio::spawn(beat(self.ledger.clone(), name.to_owned(), alive.clone()));
        let ended = self.claim_and_work(name, deadline, &alive).await;
        heart.abort();
        ended
    }

    async fn claim_and_work(
        &self,
        name: &str,
        deadline: Option<Instant>,
        alive: &AtomicBool,
    ) -> Result<Option<Ended>, LedgerError> {
        let mut idle = Duration::from_millis(20);
        // The job of the last shard and when its object was there: what passes until the next shard of
        // the same job is time that the job's worker waits.
        let mut last: Option<(JobId, Instant)> = None;
        loop {
            if self.told_to_stop() || deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                return Ok(Some(Ended::Drained));
            }
            if !alive.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let asked = Instant::now();
            match self.ledger.begin_shard(name).await {
                Ok(Some(claim)) => {
                    crash_point("begin");
                    idle = Duration::from_millis(20);
                    let since = match last {
                        Some((job, at)) if job == claim.job.id => at,
                        _ => asked,
                    };
                    let mut work = Work {
                        wait_s: since.elapsed().as_secs_f64(),
                        ended: None,
                    };
                    let spoiled = self.do_shard(&claim, &mut work).await?;
                    last = work.ended.map(|at| (claim.job.id, at));
                    if spoiled {
                        return Ok(Some(Ended::Spoiled));
                    }
                }
                Ok(None) => {
                    let mut stop = self.stop.clone();
                    tokio::select! {
                        _ = stop.wait_for(|stop| *stop) => {}
                        () = tokio::time::sleep(idle) => {}
                    }
                    idle = (idle * 2).min(LONGEST_IDLE);
                }
                Err(error) if error.is_transient() => {
                    tracing::warn!(%error, "the database is away; trying again");
                    tokio::time::sleep(BEAT).await;
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn told_to_stop(&self) -> bool {
        *self.stop.borrow()
    }

    /// Does one shard, or gives it back with the reason. True if this process is spoiled.
    async fn do_shard(&self, claim: &Claim, work: &mut Work) -> Result<bool, LedgerError> {
        let shard = &claim.shard;
        let span = tracing::info_span!(
            "shard", job = %shard.job_id, kind = %shard.kind, first_run = shard.first_run, runs = shard.run_count,
            attempt = shard.attempt
        );
        self.do_shard_in(claim, work).instrument(span).await
    }

    async fn do_shard_in(&self, claim: &Claim, work: &mut Work) -> Result<bool, LedgerError> {
        let shard = &claim.shard;
        tracing::debug!("begun");
        match self.simulate(claim).await {
            Simulated::Done(encoded) => self.hand_in(claim, encoded, work).await?,
            Simulated::Stopped => {
                self.ledger.release_shard(claim).await?;
            }
            Simulated::Fenced => tracing::debug!("no longer wanted"),
            Simulated::Spoiled { reason } => {
                tracing::error!(reason, "attempt lost, and this process with it");
                self.ledger.lose_shard(shard.id, shard.epoch, &reason).await?;
                return Ok(true);
            }
            Simulated::Lost(reason) => {
                tracing::warn!(reason, "attempt lost");
                self.ledger.lose_shard(shard.id, shard.epoch, &reason).await?;
            }
            Simulated::Impossible(reason) => {
                tracing::error!(reason, "the job cannot be simulated");
                self.ledger.fail_job(shard.job_id, &reason).await?;
            }
        }
        Ok(false)
    }

    async fn simulate(&self, claim: &Claim) -> Simulated {
        let control = Arc::new(ShardControl::default());
        let mut work = tokio::task::spawn_blocking({
            let (claim, control) = (claim.clone(), control.clone());
            let (machines, pool, blobs) = (self.machines.clone(), self.pool.clone(), self.blobs.clone());
            move || {
                let machine = match machines.ready(&claim.job.spec, &blobs) {
                    Ok(machine) => machine,
                    Err(refused @ RefusedMachine::Store { .. }) => {
                        return Err(Simulated::Lost(refused.to_string()));
                    }
                    Err(refused) => return Err(Simulated::Impossible(refused.to_string())),
                };
                if machine.sha256 != claim.job.machine_sha256 {
                    return Err(Simulated::Impossible(format!(
                        "this build's machine has SHA-256 {}, the job was accepted with {}",
                        machine.sha256, claim.job.machine_sha256
                    )));
                }
                shard::make(&claim, &machine, &pool, &control).map_err(|failure| match failure {
                    ShardFailure::Stopped => Simulated::Stopped,
                    ShardFailure::Plan { .. } => Simulated::Impossible(failure.to_string()),
                    ShardFailure::Panicked { .. } | ShardFailure::Encode(_) => {
                        Simulated::Lost(failure.to_string())
                    }
                })
            }
        });
        let mut stop = self.stop.clone();
        let mut fenced = false;
        let mut progress = (0, Instant::now());
        loop {
            tokio::select! {
                done = &mut work => {
                    return match done {
                        Ok(Ok(encoded)) => Simulated::Done(encoded),
                        Ok(Err(Simulated::Stopped)) if fenced => Simulated::Fenced,
                        Ok(Err(other)) => other,
                        Err(error) => Simulated::Lost(format!("the worker panicked: {error}")),
                    };
                }
                told = stop.wait_for(|stop| *stop), if !control.stop.load(Ordering::Relaxed) => {
                    drop(told);
                    control.stop.store(true, Ordering::Relaxed);
                }
                () = memory::exceeded(self.limits.memory_bytes) => {
                    let runs_done = control.runs_done.load(Ordering::Relaxed);
                    let reason = format!(
                        "a run took more than {} MiB of memory, after {runs_done} runs of the shard",
                        self.limits.memory_bytes >> 20
                    );
                    return Simulated::Spoiled { reason };
                }
                () = tokio::time::sleep(LOOK) => {
                    // If the database does not answer, the work goes on: the commit decides.
                    if let Ok(false) = self.ledger.holds(claim).await {
                        fenced = true;
                        control.stop.store(true, Ordering::Relaxed);
                    }
                    let runs_done = control.runs_done.load(Ordering::Relaxed);
                    if runs_done != progress.0 {
                        progress = (runs_done, Instant::now());
                    } else if progress.1.elapsed() > self.limits.time {
                        let reason = format!(
                            "a run took longer than {} s, after {runs_done} runs of the shard",
                            self.limits.time.as_secs_f64()
                        );
                        return Simulated::Spoiled { reason };
                    }
                }
            }
        }
    }

    /// Puts the object, then commits: in this order, so that what is committed is there.
    async fn hand_in(
        &self,
        claim: &Claim,
        encoded: EncodedShard,
        work: &mut Work,
    ) -> Result<(), LedgerError> {
        let object = claim.object();
        let start = Instant::now();
        if let Err(error) = self.put(&object, &encoded).await {
            tracing::warn!(%error, object, "the object could not be put");
            let reason = format!("the store refused the object: {error}");
            self.ledger
                .lose_shard(claim.shard.id, claim.shard.epoch, &reason)
                .await?;
            return Ok(());
        }
        crash_point("put");
        let mut spent = encoded.spent;
        spent.put_s = start.elapsed().as_secs_f64();
        spent.wait_s = work.wait_s;
        work.ended = Some(Instant::now());
        let result = ShardResult {
            size_bytes: encoded.content.len() as u64,
            sha256: encoded.sha256,
            failed_runs: encoded.failed_runs,
            object,
            spent,
        };
        let outcome = self.commit(claim, &result).await?;
        crash_point("commit");
        match outcome {
            CommitOutcome::Committed => tracing::debug!(simulate_s = spent.simulate_s, "committed"),
            CommitOutcome::Fenced => {
                tracing::info!(object = result.object, "fenced off; deleting the object");
                if let Err(error) = self.blobs.delete(&result.object).await {
                    tracing::warn!(%error, "an orphan stays until it is collected");
                }
            }
        }
        Ok(())
    }

    async fn put(&self, object: &str, encoded: &EncodedShard) -> Result<(), BlobError> {
        let start = Instant::now();
        let mut pause = Duration::from_millis(100);
        loop {
            match self.blobs.create(object, encoded.content.clone()).await {
                Ok(()) => return Ok(()),
                // Nobody else has this name: an earlier try of ours has worked without telling.
                Err(error) if error.is_already_there() => return Ok(()),
                Err(error) if start.elapsed() > PATIENCE => return Err(error),
                Err(error) => tracing::warn!(%error, object, "put failed; trying again"),
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_secs(5));
        }
    }

    async fn commit(&self, claim: &Claim, result: &ShardResult) -> Result<CommitOutcome, LedgerError> {
        let start = Instant::now();
        loop {
            match self.ledger.commit_shard(claim, result).await {
                Err(error) if error.is_transient() && start.elapsed() < PATIENCE => {
                    tracing::warn!(%error, "commit failed; trying again");
                    tokio::time::sleep(LOOK).await;
                }
                outcome => return outcome,
            }
        }
    }
}

/// A worker's time around a shard.
struct Work {
    /// Waited for it.
    wait_s: f64,
    /// When its object was in the store.
    ended: Option<Instant>,
}

enum Simulated {
    Done(EncodedShard),
    Stopped,
    Fenced,
    Spoiled { reason: String },
    Lost(String),
    Impossible(String),
}

async fn beat(ledger: Ledger, name: String, alive: Arc<AtomicBool>) {
    loop {
        match ledger.beat(&name).await {
            Ok(true) => {}
            Ok(false) => {
                alive.store(false, Ordering::Relaxed);
                return;
            }
            Err(error) => tracing::debug!(%error, "beat missed"),
        }
        tokio::time::sleep(BEAT).await;
    }
}
