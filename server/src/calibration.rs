//! Long random runs on which a model's intervals and envelope are calibrated.
//!
//! A job's runs are short and start at rest; a machine in service goes on. Errors of a network drift with the motion,
//! so that intervals calibrated on 1 s runs cover far too little of a 10 s one. A job's data set is left as it is: these
//! runs are a function of the job (its machine, ranges and seed) and are simulated when a network is trained.

use crate::coordinator::machines::CheckedMachine;
use anyhow::Context;
use hydroflex_dataset::{RunKind, RunOutcome};
use hydroflex_ml::runs::{RunSamples, Runs};
use hydroflex_openapi::job::{Excitation, JobSpec};
use hydroflex_worker::shard;
use rayon::prelude::*;

/// Length of a run, s; jobs of longer runs calibrate on their validation runs alone.
pub const DURATION_S: f64 = 10.0;
/// Runs without a flag that are enough …
const ENOUGH: usize = 32;
/// … and runs simulated at most to find them, in blocks of `BLOCK`.
const CANDIDATES: u64 = 128;
const BLOCK: u64 = 32;
/// Added to the job's seed: these runs are none of the job's.
const SEED_OFFSET: u64 = 0x5eed_ca1b;
/// Runs simulated together.
const BATCH_RUNS: usize = 8;

/// The job of which the calibration runs are the first ones; none for signals that are not random or runs that are
/// long already.
#[must_use]
pub fn job(spec: &JobSpec) -> Option<JobSpec> {
    let random = matches!(spec.excitation, Excitation::Random);
    (random && spec.duration_s < DURATION_S).then(|| JobSpec {
        runs: CANDIDATES,
        duration_s: DURATION_S,
        seed: spec.seed.wrapping_add(SEED_OFFSET),
        settling_runs: 0,
        train: Vec::new(),
        // Every column: the trainings choose.
        columns: Vec::new(),
        ..spec.clone()
    })
}

/// Runs of [`job`] without a flag; empty where there is no such job.
///
/// # Errors
/// A run cannot be planned or made the simulator panic.
pub fn simulate(spec: &JobSpec, machine: &CheckedMachine) -> anyhow::Result<Runs> {
    let mut calm = Runs {
        channels: machine.ready().simulator.channels().to_vec(),
        sample_time_s: spec.sample_time_s,
        runs: Vec::new(),
    };
    let Some(long) = job(spec) else {
        return Ok(calm);
    };
    for first in (0..CANDIDATES).step_by(usize::try_from(BLOCK)?) {
        if calm.runs.len() >= ENOUGH {
            break;
        }
        let indices: Vec<u64> = (first..(first + BLOCK).min(CANDIDATES)).collect();
        let records = indices
            .par_chunks(BATCH_RUNS)
            .map(|some| shard::records(&long, machine.ready(), RunKind::Job, some))
            .collect::<Result<Vec<_>, _>>()
            .context("cannot simulate the calibration runs")?;
        for record in records.into_iter().flatten() {
            if let (RunOutcome::Ok(samples), true) = (record.outcome, record.flags.is_empty()) {
                calm.runs.push(RunSamples {
                    run_id: record.run_id,
                    columns: samples.columns,
                });
            }
        }
    }
    Ok(calm)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calibration_runs_are_long_and_none_of_the_jobs_own() {
        let spec: JobSpec = serde_json::from_str(r#"{"runs": 40, "seed": 7}"#).unwrap();
        let long = job(&spec).unwrap();
        assert!(long.duration_s > spec.duration_s && long.seed != spec.seed);
        assert_eq!(
            (long.payload_kg, long.machine.clone()),
            (spec.payload_kg, spec.machine.clone())
        );
        let cycle: JobSpec = serde_json::from_str(r#"{"runs": 1, "excitation": {"kind": "cycle"}}"#).unwrap();
        assert!(job(&cycle).is_none());
        let long: JobSpec = serde_json::from_str(r#"{"runs": 1, "duration_s": 10}"#).unwrap();
        assert!(job(&long).is_none());
    }
}
