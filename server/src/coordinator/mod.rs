//! The coordinator: takes jobs in, cuts them into shards, notices what is lost, publishes, cleans up.
//!
//! Everything it knows is in the ledger. It may be killed at any moment and started again, or run
//! twice beside itself: each step below is a transaction that counts once.

pub mod machines;
pub mod notices;
pub mod plan;
pub mod publish;
pub mod train;
pub mod supervise;
pub mod watch;

use crate::http::error::ApiError;
use crate::sweeps::Sweep;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::orphans::Orphans;
use hydroflex_ledger::{JobRecord, Ledger, LedgerError, NewJob, ShardKind};
use hydroflex_openapi::catalogue::MachineInfo;
use hydroflex_openapi::id::{DatasetId, JobId};
use hydroflex_openapi::job::{JobSpec, TrainingSpec};
use hydroflex_openapi::problem::FieldError;
use hydroflex_openapi::status::JobState;
use hydroflex_openapi::sweep::SweepRequest;
use hydroflex_sim::scenario::validate::MAX_TRAININGS;
use machines::{CheckedMachine, MachineDesk};
use plan::{Situation, shard_sizes};
use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use watch::Watch;

/// How often the ledger is looked at while a job is unfinished: a few reads of a local file, against
/// workers that wait for their next shard.
const BUSY_TICK: Duration = Duration::from_millis(50);
/// The same while the first runs of a job are measured and its workers may soon have nothing to do.
const SHORT_TICK: Duration = Duration::from_millis(5);
/// How often objects are looked for that nothing names: rare, and in nobody's way.
const SWEEP: Duration = Duration::from_mins(1);
/// And when there is none; whoever accepts a job calls.
const IDLE_TICK: Duration = Duration::from_millis(500);
/// Jobs whose data sets are written at a time while their runs are still simulated: each has the memory of
/// a few row groups and files of its own.
const MOST_EARLY: usize = 2;

/// Where a coordinator keeps things, and how patient it is.
#[derive(Debug, Clone)]
pub struct CoordinatorConfig {
    /// Directory for what is being written; anything in it may be deleted at the next start.
    pub scratch: PathBuf,
    /// Directory for reduced bodies, shared with workers.
    pub cache: PathBuf,
    /// Workers to plan for while none has reported yet.
    pub workers: usize,
    /// Silence after which a worker is given up.
    pub lease: Duration,
    /// Unfinished jobs above which no more are accepted.
    pub most_jobs: u64,
    /// Time after which objects of no data set may be deleted.
    pub orphan_grace: Duration,
}

/// The coordinator; clones are handles on one.
#[derive(Clone)]
pub struct Coordinator(Arc<Inner>);

struct Inner {
    ledger: Ledger,
    blobs: Blobs,
    config: CoordinatorConfig,
    machines: MachineDesk,
    wake: Notify,
    publishing: Mutex<HashSet<JobId>>,
}

impl Coordinator {
    /// A coordinator on a ledger and a store. Nothing happens before [`Coordinator::run`].
    #[must_use]
    pub fn new(ledger: Ledger, blobs: Blobs, config: CoordinatorConfig) -> Self {
        let machines = MachineDesk::new(config.cache.clone(), blobs.clone());
        let publishing = Mutex::default();
        Self(Arc::new(Inner {
            ledger,
            blobs,
            config,
            machines,
            wake: Notify::new(),
            publishing,
        }))
    }

    /// The ledger.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        &self.0.ledger
    }

    /// The store.
    #[must_use]
    pub fn blobs(&self) -> &Blobs {
        &self.0.blobs
    }

    /// Configuration.
    #[must_use]
    pub fn config(&self) -> &CoordinatorConfig {
        &self.0.config
    }

    /// Machines that jobs may name.
    #[must_use]
    pub fn machines(&self) -> Vec<MachineInfo> {
        machines::built_in()
    }

    /// The machine of a job, checked and reduced.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub async fn machine(&self, spec: &JobSpec) -> Result<Arc<CheckedMachine>, FieldError> {
        self.0.machines.checked(spec).await
    }

    /// Looks at the ledger now rather than at the next tick.
    pub fn wake(&self) {
        self.0.wake.notify_one();
    }

    /// Checks a job whole: the machine with its meshes and its structure, then every field.
    ///
    /// # Errors
    /// The fields at fault.
    pub async fn accept(&self, spec: JobSpec) -> Result<NewJob, ApiError> {
        let machine = self.machine(&spec).await.map_err(ApiError::field)?;
        machine.validate(&spec).map_err(ApiError::Invalid)?;
        let workers = self.worker_count(&self.ledger().beats().await?);
        let situation = Situation {
            remaining: spec.runs,
            open: 0,
            workers,
            run_cost_s: None,
            run_bytes: run_bytes(&spec),
        };
        let settling = Situation {
            remaining: spec.settling_runs,
            ..situation
        };
        Ok(NewJob {
            machine_sha256: machine.sha256().to_owned(),
            settling_shards: shard_sizes(settling),
            run_shards: shard_sizes(situation),
            notices: self.0.machines.notices(machine, &spec).await,
            spec,
        })
    }

    /// Refuses one more job where there are as many as we look after.
    ///
    /// # Errors
    /// Says how many there are.
    pub async fn refuse_if_full(&self) -> Result<(), ApiError> {
        let unfinished: u64 = self
            .ledger()
            .job_counts()
            .await?
            .iter()
            .filter(|(state, _)| !state.is_final())
            .map(|(_, count)| count)
            .sum();
        self.refuse_beyond("jobs", unfinished)
    }

    fn refuse_beyond(&self, what: &str, unfinished: u64) -> Result<(), ApiError> {
        let most = self.config().most_jobs;
        if unfinished < most {
            return Ok(());
        }
        Err(ApiError::TooManyRequests(format!(
            "{unfinished} {what} are unfinished, at most {most} are looked after; try again when some are done"
        )))
    }

    /// Checks a training against its data set.
    ///
    /// # Errors
    /// The fields at fault.
    pub async fn accept_training(&self, dataset: &DatasetId, spec: &TrainingSpec) -> Result<(), ApiError> {
        let Some(record) = self.ledger().dataset(dataset).await? else {
            let error = FieldError::new("/dataset_id", "no such data set")
                .value(dataset.as_str())
                .allowed("a dataset_id of GET /v1/datasets");
            return Err(ApiError::field(error));
        };
        // The same rules as for a job that would have asked for it.
        let machine = self.machine(&record.spec).await.map_err(ApiError::field)?;
        let mut job = record.spec;
        job.train = vec![spec.clone()];
        machine.validate(&job).map_err(|errors| {
            let moved = errors.into_iter().map(|mut error| {
                if let Some(rest) = error.pointer.strip_prefix("/train/0") {
                    error.pointer = format!("/spec{rest}");
                }
                error
            });
            ApiError::Invalid(moved.collect())
        })
    }

    /// Checks a sweep against its data set: every entry of every list by the rules of a job's `train`.
    ///
    /// # Errors
    /// The fields at fault.
    pub async fn accept_sweep(&self, asked: &SweepRequest) -> Result<Sweep, ApiError> {
        let Some(record) = self.ledger().dataset(&asked.dataset_id).await? else {
            let error = FieldError::new("/dataset_id", "no such data set")
                .value(asked.dataset_id.as_str())
                .allowed("a dataset_id of GET /v1/datasets");
            return Err(ApiError::field(error));
        };
        let machine = self.machine(&record.spec).await.map_err(ApiError::field)?;
        let mut channels = machine.ready().simulator.channels().to_vec();
        channels.retain(|channel| record.spec.keeps(&channel.name));
        let sweep = Sweep::new(asked, &channels).map_err(ApiError::Invalid)?;
        let probes = sweep.probes();
        let mut told = HashSet::new();
        let mut errors = Vec::new();
        // As many at a time as a job may ask for.
        for probes in probes.chunks(MAX_TRAININGS) {
            let train = probes.iter().map(|(_, training)| training.clone()).collect();
            let job = JobSpec {
                train,
                ..record.spec.clone()
            };
            for mut error in machine.validate(&job).err().into_iter().flatten() {
                let place = error.pointer.strip_prefix("/train/").and_then(|rest| {
                    let at = rest.find('/')?;
                    let (place, _) = probes.get(rest[..at].parse::<usize>().ok()?)?;
                    Some((*place, &rest[at..]))
                });
                error.pointer = match place {
                    Some((place, rest)) => sweep.pointer(place, rest),
                    // What the data set's job lacks for it.
                    None => format!("/dataset_id{}", error.pointer),
                };
                if told.insert(error.pointer.clone()) {
                    errors.push(error);
                }
            }
        }
        if errors.is_empty() {
            Ok(sweep)
        } else {
            Err(ApiError::Invalid(errors))
        }
    }

    /// Refuses one more sweep where there are as many as jobs may be.
    ///
    /// # Errors
    /// Says how many there are.
    pub async fn refuse_sweep_if_full(&self) -> Result<(), ApiError> {
        let unfinished = self.ledger().unfinished_sweeps().await?;
        self.refuse_beyond("sweeps", unfinished)
    }

    /// Looks after every job until told to stop.
    pub async fn run(self, stop: CancellationToken) {
        let mut watch = Watch::new(self.config().lease);
        let mut tasks = tokio::task::JoinSet::new();
        let mut orphans = Orphans::new(self.config().orphan_grace);
        let mut swept: Option<Instant> = None;
        self.clear_scratch();
        loop {
            if swept.is_none_or(|at| at.elapsed() > SWEEP) {
                match orphans.sweep(self.ledger(), self.blobs()).await {
                    Ok(deleted) => {
                        swept = Some(Instant::now());
                        if deleted > 0 {
                            tracing::info!(deleted, "orphans deleted");
                        }
                    }
                    Err(error) => tracing::debug!(%error, "orphans could not be looked for; trying again"),
                }
            }
            let pause = match self.tick(&mut watch, &mut tasks).await {
                Ok(Need::Shards) => SHORT_TICK,
                Ok(Need::Care) => BUSY_TICK,
                Ok(Need::Nothing) => IDLE_TICK,
                Err(error) => {
                    // The database may be restarting; nothing is lost by looking again.
                    tracing::warn!(%error, "the ledger could not be looked after; trying again");
                    Duration::from_secs(1)
                }
            };
            while tasks.try_join_next().is_some() {}
            tokio::select! {
                () = stop.cancelled() => break,
                () = self.0.wake.notified() => {}
                () = tokio::time::sleep(pause) => {}
            }
        }
        // Publishing is safe to cut off: nothing of it is visible before its last step.
        tasks.shutdown().await;
    }

    fn clear_scratch(&self) {
        let scratch = &self.config().scratch;
        let cleared = match std::fs::remove_dir_all(scratch) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error),
            _ => std::fs::create_dir_all(scratch),
        };
        if let Err(error) = cleared {
            tracing::warn!(%error, path = %scratch.display(), "the scratch directory cannot be cleared");
        }
    }

    /// One look at everything.
    async fn tick(
        &self,
        watch: &mut Watch,
        tasks: &mut tokio::task::JoinSet<()>,
    ) -> Result<Need, LedgerError> {
        let beats = self.ledger().beats().await?;
        for (worker, reason) in watch.look(Instant::now(), &beats) {
            tracing::warn!(worker, reason, "worker given up");
            self.ledger().give_up_worker(&worker, &reason).await?;
        }
        self.ledger().recover_lost("its worker was given up").await?;
        let workers = self.worker_count(&beats);
        let unfinished = self.ledger().unfinished_jobs().await?;
        let mut need = if unfinished.is_empty() {
            Need::Nothing
        } else {
            Need::Care
        };
        for job in unfinished {
            if !job.is_complete() && watch.becomes_stranded(&job, &beats) {
                tracing::warn!(
                    job = %job.id,
                    instruction_set = job.instruction_set,
                    "no worker has the instruction set that this job was begun on; start one, or cancel the job \
                     and submit it again"
                );
            }
            match job.state {
                JobState::Queued => need = need.max(self.advance(&job, workers).await?),
                JobState::Simulating => {
                    need = need.max(self.advance(&job, workers).await?);
                    if self.publishes_fewer_than(MOST_EARLY) {
                        self.publish_in_background(job, tasks);
                    }
                }
                // Incomplete again if an object turned out damaged and its shard is done anew.
                JobState::Publishing if job.is_complete() => self.publish_in_background(job, tasks),
                _ => {}
            }
        }
        for job in self.ledger().uncollected_jobs(16).await? {
            match self.blobs().delete_below(&format!("shards/{job}")).await {
                Ok(_) => self.ledger().mark_collected(job).await?,
                Err(error) => {
                    tracing::warn!(%job, %error, "shard objects could not be deleted; trying again");
                }
            }
        }
        // Without workers nothing is soon done.
        Ok(if beats.is_empty() {
            need.min(Need::Care)
        } else {
            need
        })
    }

    /// Workers that simulate; the configured number while none has reported.
    fn worker_count(&self, beats: &[hydroflex_ledger::Beat]) -> u64 {
        let simulating = beats
            .iter()
            .filter(|beat| beat.worker.starts_with("worker."))
            .count();
        simulating.max(self.config().workers).max(1) as u64
    }

    /// Plans the next shards of a job, or sees that it is complete.
    async fn advance(&self, job: &JobRecord, workers: u64) -> Result<Need, LedgerError> {
        if job.is_complete() {
            if self.ledger().begin_publishing(job.id).await? {
                tracing::info!(job = %job.id, "every run is accounted for; publishing");
                self.wake();
            }
            return Ok(Need::Care);
        }
        let settling = job.progress.settling_total - job.settling_planned;
        let runs = job.progress.runs_total - job.runs_planned;
        if settling + runs == 0 {
            return Ok(Need::Care);
        }
        let mut situation = Situation {
            remaining: settling,
            open: self.ledger().open_shard_count(job.id).await?,
            workers,
            run_cost_s: self.ledger().run_cost_s(job.id).await?,
            run_bytes: run_bytes(&job.spec),
        };
        let sizes = shard_sizes(situation);
        if !sizes.is_empty() {
            self.ledger()
                .plan_shards(job.id, ShardKind::Settling, job.settling_planned, &sizes)
                .await?;
            situation.open += sizes.len() as u64;
        }
        situation.remaining = runs;
        let sizes = shard_sizes(situation);
        if !sizes.is_empty() {
            self.ledger()
                .plan_shards(job.id, ShardKind::Runs, job.runs_planned, &sizes)
                .await?;
            situation.open += sizes.len() as u64;
        }
        let planned: u64 = sizes.iter().sum();
        // The first shards are there to measure with, and are soon done.
        let measuring = situation.run_cost_s.is_none() && job.state == JobState::Simulating;
        Ok(if measuring && planned < runs {
            Need::Shards
        } else {
            Need::Care
        })
    }

    fn publishes_fewer_than(&self, most: usize) -> bool {
        self.0
            .publishing
            .lock()
            .is_ok_and(|publishing| publishing.len() < most)
    }

    fn publish_in_background(&self, job: JobRecord, tasks: &mut tokio::task::JoinSet<()>) {
        let id = job.id;
        let started = self
            .0
            .publishing
            .lock()
            .is_ok_and(|mut publishing| publishing.insert(id));
        if !started {
            return;
        }
        let coordinator = self.clone();
        tasks.spawn(async move {
            match publish::publish(&coordinator, &job).await {
                Ok(()) => coordinator.wake(),
                Err(error) if error.is_permanent() => {
                    tracing::error!(job = %id, %error, "publishing failed");
                    if let Err(error) = coordinator.ledger().fail_job(id, &error.to_string()).await {
                        tracing::warn!(job = %id, %error, "the failure could not be recorded; trying again");
                    }
                }
                Err(error) => {
                    tracing::warn!(job = %id, %error, "publishing failed; trying again");
                    tokio::time::sleep(Duration::from_secs(2)).await;
                }
            }
            if let Ok(mut publishing) = coordinator.0.publishing.lock() {
                publishing.remove(&id);
            }
        });
    }
}

/// What a look has found, least urgent first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Need {
    /// No job is unfinished.
    Nothing,
    /// Jobs are unfinished.
    Care,
    /// Workers may soon wait for shards.
    Shards,
}

/// Uncompressed size of a run, for at most 32 channels. Only bounds the size of shards.
fn run_bytes(spec: &JobSpec) -> u64 {
    const CHANNELS: u64 = 32;
    (spec.steps() as u64 + 1) * CHANNELS * 8
}
