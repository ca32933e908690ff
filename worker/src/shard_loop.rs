//! Claim, simulate, deliver; and around it the heartbeat, the limits, the end.

use crate::delivery::Delivery;
use crate::machines::{Machines, RefusedMachine};
use crate::memory;
use crate::shard::{self, EncodedShard, ShardControl, ShardFailure};
use crate::standstill::Standstill;
use anyhow::Context;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::{Claim, Ledger, LedgerError, identity};
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
/// How long the database or the store may be away before this process gives up.
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
    /// How long the database or the store may be away before a shard is given back.
    patience: Duration,
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
        patience: PATIENCE,
        ledger,
        stop,
    };
    let deadline = config.drain_after.map(|after| Instant::now() + after);
    for life in 1.. {
        let name = identity::worker_name("worker", life);
        let ended = worker.live(&name, deadline).await;
        // A claim whose answer was lost is in nobody's hands as long as this name counts as alive. If the
        // database is still away, the beats that stop here say the same a lease later.
        let _ = worker.ledger.give_up_worker(&name, "its worker stopped").await;
        match ended {
            Ok(Some(ended)) => return Ok(ended),
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
        let mut delivery = Delivery::new(self.ledger.clone(), self.blobs.clone(), self.patience);
        let ended = self.claim_and_work(name, deadline, &alive, &mut delivery).await;
        let delivered = if matches!(ended, Ok(Some(Ended::Spoiled))) {
            // It may hold memory that this process has not got, so not for long.
            let _ = tokio::time::timeout(BEAT, delivery.finish()).await;
            Ok(())
        } else {
            // Also after an error: what is on its way is simulated, and needs this name alive to count.
            delivery.finish().await
        };
        heart.abort();
        let ended = ended?;
        delivered?;
        Ok(ended)
    }

    async fn claim_and_work(
        &self,
        name: &str,
        deadline: Option<Instant>,
        alive: &AtomicBool,
        delivery: &mut Delivery,
    ) -> Result<Option<Ended>, LedgerError> {
        let longest_idle = self.ledger.longest_idle();
        let mut idle = longest_idle / 4;
        // The job of the last shard and when this process was done with it: what passes until the next
        // shard of the same job is time that the job's worker waits.
        let mut last: Option<(JobId, Instant)> = None;
        loop {
            if self.told_to_stop() || deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                return Ok(Some(Ended::Drained));
            }
            if !alive.load(Ordering::Relaxed) {
                return Ok(None);
            }
            if delivery.outage().pause().is_some() {
                // Simulated for a store that still refuses what came before, a shard would be lost work.
                delivery.finish().await?;
                if let Some(pause) = delivery.outage().pause() {
                    self.pause(pause).await;
                    if self.told_to_stop() {
                        continue;
                    }
                }
            }
            let asked = Instant::now();
            // After an error nobody knows whether a shard was begun: it ends this life, so that none stays in
            // the hands of a name that beats and knows nothing of it.
            let Some(claim) = self.ledger.begin_shard(name).await? else {
                delivery.finish().await?;
                self.pause(idle).await;
                idle = (idle * 2).min(longest_idle);
                continue;
            };
            crash_point("begin");
            idle = longest_idle / 4;
            // A death is charged to every shard in hand. One that has met a death is alone in hand, so
            // that no shard is charged twice for what another does; whoever has free hands may take it.
            let alone = claim.shard.was_tried_before();
            if alone && delivery.is_under_way() {
                self.ledger.release_shard(&claim).await?;
                delivery.finish().await?;
                continue;
            }
            let since = match last {
                Some((job, at)) if job == claim.job.id => at,
                _ => asked,
            };
            if self.do_shard(&claim, since.elapsed(), delivery).await? {
                return Ok(Some(Ended::Spoiled));
            }
            last = Some((claim.job.id, Instant::now()));
            if alone {
                delivery.finish().await?;
            }
        }
    }

    /// Sleeps, unless told to stop.
    async fn pause(&self, pause: Duration) {
        let mut stop = self.stop.clone();
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => {}
            () = tokio::time::sleep(pause) => {}
        }
    }

    fn told_to_stop(&self) -> bool {
        *self.stop.borrow()
    }

    /// Does one shard and sends it off, or gives it back with the reason. True if this process is spoiled.
    async fn do_shard(
        &self,
        claim: &Claim,
        waited: Duration,
        delivery: &mut Delivery,
    ) -> Result<bool, LedgerError> {
        let shard = &claim.shard;
        let span = tracing::info_span!(
            "shard", job = %shard.job_id, kind = %shard.kind, first_run = shard.first_run, runs = shard.run_count,
            attempt = shard.attempt
        );
        self.do_shard_in(claim, waited, delivery).instrument(span).await
    }

    async fn do_shard_in(
        &self,
        claim: &Claim,
        waited: Duration,
        delivery: &mut Delivery,
    ) -> Result<bool, LedgerError> {
        let shard = &claim.shard;
        tracing::debug!("begun");
        match self.simulate(claim).await {
            Simulated::Done(mut encoded) => {
                let done = Instant::now();
                delivery.finish().await?;
                encoded.spent.wait_s = (waited + done.elapsed()).as_secs_f64();
                delivery.begin(claim.clone(), encoded);
            }
            Simulated::Stopped => {
                self.ledger.release_shard(claim).await?;
            }
            Simulated::StoreAway(reason) => {
                tracing::warn!(reason, "giving the shard back");
                self.ledger.release_shard(claim).await?;
                delivery.outage().refused();
            }
            Simulated::Fenced => tracing::debug!("no longer wanted"),
            Simulated::Spoiled { reason } => {
                tracing::error!(reason, "attempt lost, and this process with it");
                // Told or not, this process is not to go on: the end of its worker says the same.
                if let Err(error) = self.ledger.lose_shard(shard.id, shard.epoch, &reason).await {
                    tracing::warn!(%error, "the loss cannot be reported");
                }
                return Ok(true);
            }
            Simulated::Lost(reason) => {
                tracing::warn!(reason, "attempt lost");
                self.ledger.lose_shard(shard.id, shard.epoch, &reason).await?;
            }
            Simulated::Impossible(reason) => {
                tracing::error!(reason, "the job cannot be simulated");
                self.ledger.fail_job_of(claim, &reason).await?;
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
                        return Err(Simulated::StoreAway(refused.to_string()));
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
        let mut standstill = Standstill::new(Instant::now());
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
                    if standstill.is_too_long(Instant::now(), &control, self.limits.time) {
                        let runs_done = control.runs_done.load(Ordering::Relaxed);
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
}

enum Simulated {
    Done(EncodedShard),
    Stopped,
    Fenced,
    /// The store does not give what the runs need.
    StoreAway(String),
    Spoiled {
        reason: String,
    },
    Lost(String),
    /// No build can simulate the job.
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

#[cfg(test)]
mod tests;
