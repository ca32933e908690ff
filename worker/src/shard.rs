//! The runs of a shard, simulated and encoded.

use crate::machines::ReadyMachine;
use crate::run;
use bytes::Bytes;
use hydroflex_dataset::{RunKind, RunOutcome, RunRecord, ShardError, ShardSchema, ShardWriter};
use hydroflex_ledger::crash::crash_point_of;
use hydroflex_ledger::{Claim, ShardKind};
use hydroflex_openapi::job::{JobSpec, RunStatus};
use hydroflex_openapi::status::TimeSplit;
use hydroflex_sim::scenario::ScenarioError;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

/// Runs simulated before their records are encoded, per thread: bounds the memory of a shard of
/// thousands of runs. A batch ends with lanes that wait for the last run, so it is many times the lanes.
const BATCH_PER_THREAD: usize = 64;
/// Most runs side by side: a part of a batch is a multiple of it.
const LANES: usize = 8;

/// A shard ready to be put.
#[derive(Debug, Clone)]
pub struct EncodedShard {
    /// Content of the object.
    pub content: Bytes,
    /// Its SHA-256.
    pub sha256: String,
    /// Runs without samples.
    pub failed_runs: u64,
    /// Time spent; `put_s` and `wait_s` come with the delivery.
    pub spent: TimeSplit,
}

/// Why a shard was not finished.
#[derive(Debug, thiserror::Error)]
pub enum ShardFailure {
    /// Told to stop; nothing is wrong with the shard.
    #[error("told to stop")]
    Stopped,
    /// A run panicked: a fault of ours that another attempt, or its halves, will narrow down.
    #[error("run {run_id} panicked: {message}")]
    Panicked {
        /// Run.
        run_id: u64,
        /// Text of the panic.
        message: String,
    },
    /// A run cannot be planned: the job was never checked.
    #[error("run {run_id} cannot be planned: {source}")]
    Plan {
        /// Run.
        run_id: u64,
        /// Cause.
        source: ScenarioError,
    },
    /// Encoding failed.
    #[error("the shard cannot be encoded: {0}")]
    Encode(#[from] ShardError),
}

/// What others may see of a shard in work, and say to it.
#[derive(Debug, Default)]
pub struct ShardControl {
    /// Set to stop before the next run.
    pub stop: AtomicBool,
    /// Runs done: a number that stands still means a run that hangs.
    pub runs_done: AtomicU64,
    /// Most runs that a thread has under way before it counts them, so how many run times may pass until
    /// `runs_done` moves; 0 until the first run begins.
    pub counted_together: AtomicU64,
}

impl ShardControl {
    /// Says that a thread begins runs that it will count together.
    pub(crate) fn begin(&self, runs: u64) {
        self.counted_together.fetch_max(runs, Ordering::Relaxed);
    }
}

/// Simulates and encodes the runs of a claim, on the threads of `pool`. The bytes do not depend on
/// their number.
///
/// # Errors
/// See [`ShardFailure`].
pub fn make(
    claim: &Claim,
    machine: &ReadyMachine,
    pool: &rayon::ThreadPool,
    control: &ShardControl,
) -> Result<EncodedShard, ShardFailure> {
    let spec = &claim.job.spec;
    let kind = match claim.shard.kind {
        ShardKind::Runs => RunKind::Job,
        ShardKind::Settling => RunKind::Settling,
    };
    let schema = ShardSchema {
        channels: machine
            .simulator
            .channels()
            .iter()
            .filter(|channel| spec.keeps(&channel.name))
            .map(|channel| channel.name.clone())
            .collect(),
        angles: machine
            .machine()
            .file()
            .angles
            .iter()
            .map(|angle| angle.name.clone())
            .collect(),
        sample_type: spec.sample_type,
    };
    let mut spent = TimeSplit::default();
    let mut failed_runs = 0;
    let mut writer = ShardWriter::new(schema, Vec::new())?;
    let runs: Vec<u64> = (claim.shard.first_run..)
        .take(usize::try_from(claim.shard.run_count).unwrap_or(0))
        .collect();
    for batch in runs.chunks(BATCH_PER_THREAD * pool.current_num_threads()) {
        let start = Instant::now();
        let part = batch
            .len()
            .div_ceil(pool.current_num_threads())
            .next_multiple_of(LANES);
        let records = pool.install(|| {
            batch
                .par_chunks(part)
                .map(|some| simulate(spec, machine, kind, some, control))
                .collect::<Result<Vec<Vec<RunRecord>>, ShardFailure>>()
        })?;
        // Of one thread: what the shard would have cost alone.
        spent.simulate_s +=
            start.elapsed().as_secs_f64() * pool.current_num_threads().min(batch.len()) as f64;
        let start = Instant::now();
        for record in records.iter().flatten() {
            failed_runs += u64::from(record.status() == RunStatus::Failed);
            writer.push(record)?;
        }
        spent.encode_s += start.elapsed().as_secs_f64();
    }
    let start = Instant::now();
    let content = Bytes::from(writer.finish()?);
    let sha256 = hex::encode(Sha256::digest(&content));
    spent.encode_s += start.elapsed().as_secs_f64();
    Ok(EncodedShard {
        content,
        sha256,
        failed_runs,
        spent,
    })
}

/// Records of some runs, on this thread, as a shard would hold them.
///
/// # Errors
/// See [`ShardFailure`].
pub fn records(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    runs: &[u64],
) -> Result<Vec<RunRecord>, ShardFailure> {
    simulate(spec, machine, kind, runs, &ShardControl::default())
}

fn simulate(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    runs: &[u64],
    control: &ShardControl,
) -> Result<Vec<RunRecord>, ShardFailure> {
    let mut records = simulate_whole(spec, machine, kind, runs, control)?;
    if !spec.columns.is_empty() {
        for record in &mut records {
            if let RunOutcome::Ok(samples) = &mut record.outcome {
                let mut channels = machine.simulator.channels().iter();
                samples
                    .columns
                    .retain(|_| channels.next().is_some_and(|channel| spec.keeps(&channel.name)));
            }
        }
    }
    Ok(records)
}

/// Simulates some runs on one thread: together, or one by one if that panics, to name the culprit. With
/// every column of the simulator.
fn simulate_whole(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    runs: &[u64],
    control: &ShardControl,
) -> Result<Vec<RunRecord>, ShardFailure> {
    if control.stop.load(Ordering::Relaxed) {
        return Err(ShardFailure::Stopped);
    }
    control.begin(1);
    for index in runs {
        crash_point_of("run", *index);
    }
    let planned = runs
        .iter()
        .map(|index| plan(spec, machine, kind, *index))
        .collect::<Result<Vec<_>, ShardFailure>>()?;
    if run::side_by_side(&planned, spec, machine) {
        control.begin(runs.len() as u64);
        let together = catch_unwind(AssertUnwindSafe(|| {
            run::simulate_together(planned, spec, machine)
        }));
        if let Ok(records) = together {
            control.runs_done.fetch_add(runs.len() as u64, Ordering::Relaxed);
            return Ok(records);
        }
    }
    runs.iter()
        .map(|index| simulate_alone(spec, machine, kind, *index, control))
        .collect()
}

fn plan(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    index: u64,
) -> Result<run::PlannedRun, ShardFailure> {
    run::plan(spec, machine, kind, index).map_err(|source| ShardFailure::Plan {
        run_id: index,
        source,
    })
}

fn simulate_alone(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    index: u64,
    control: &ShardControl,
) -> Result<RunRecord, ShardFailure> {
    if control.stop.load(Ordering::Relaxed) {
        return Err(ShardFailure::Stopped);
    }
    let planned = plan(spec, machine, kind, index)?;
    let record = catch_unwind(AssertUnwindSafe(|| planned.simulate(spec, machine)));
    control.runs_done.fetch_add(1, Ordering::Relaxed);
    record.map_err(|cause| {
        let message = cause
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| cause.downcast_ref::<&str>().copied())
            .unwrap_or("no message");
        ShardFailure::Panicked {
            run_id: index,
            message: message.chars().take(400).collect(),
        }
    })
}
