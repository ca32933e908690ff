//! From a job to its runs: pure functions of (job specification, run index).
//!
//! ```text
//! job seed, index ──SHA-256──► run seed ──SHA-256 with a domain──► ChaCha8 stream
//!                                          "payload", "angle/lift", "valve/lift", …
//! ```
//!
//! A run's numbers do not depend on its neighbours, and a machine with one cylinder more draws the
//! same numbers for those it had. Nothing here depends on the C library or on a crate's choice of
//! distributions: see [`stream::Stream`].

pub mod stream;
pub mod signal;
pub mod validate;

use crate::trajectory::RunInput;
use hydroflex_openapi::dataset::SplitName;
use hydroflex_openapi::job::{Excitation, JobSpec, ValueOrRange};
use hydroflex_openapi::machine::{CylinderSpec, MachineFile};
use stream::Stream;

pub use validate::validate;

/// Part of a settling run during which the valve is open (the paper's text; its script has 10 %).
pub const SETTLING_OPEN_PART: f64 = 0.2;

/// Shortest and longest settling run, s; between them it lasts as long as the job's runs.
pub const SETTLING_DURATION_S: [f64; 2] = [1.0, 2.0];

/// Why a run cannot be planned; [`validate`] finds these before any run is.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ScenarioError {
    /// The job has no run of that index.
    #[error("run {index} of a job of {runs}")]
    Index {
        /// Asked for.
        index: u64,
        /// Runs of the job.
        runs: u64,
    },
    /// The specification gives signals, but not for this cylinder.
    #[error("no valve signal is given for cylinder {cylinder:?}")]
    NoSignal {
        /// Name of the cylinder.
        cylinder: String,
    },
    /// A given signal does not fit the duration.
    #[error("the valve signal given for {cylinder:?} has {found} values, a run has {expected} steps")]
    SignalLength {
        /// Name of the cylinder.
        cylinder: String,
        /// Values.
        found: usize,
        /// Steps of a run.
        expected: usize,
    },
}

/// Input of the run of this index; its `run_id` is the index.
///
/// # Errors
/// The index is too large, or a given signal does not fit.
pub fn plan_run(spec: &JobSpec, machine: &MachineFile, run_index: u64) -> Result<RunInput, ScenarioError> {
    if run_index >= spec.runs {
        return Err(ScenarioError::Index {
            index: run_index,
            runs: spec.runs,
        });
    }
    let steps = spec.steps();
    let seed = run_seed(spec.seed, run_index);
    let valves_ratio = machine
        .cylinders
        .iter()
        .map(|cylinder| valve_signal(&spec.excitation, cylinder, seed, steps))
        .collect::<Result<_, _>>()?;
    Ok(RunInput {
        run_id: run_index,
        payload_kg: payload_kg(spec, seed),
        angles_rad: angles_rad(spec, machine, seed),
        valves_ratio,
    })
}

/// Input of the settling run of this index: a random configuration of the job, every valve open for
/// the first part and then shut. Its `run_id` is the index; settling runs count on their own.
///
/// # Errors
/// The index is too large.
pub fn plan_settling_run(
    spec: &JobSpec,
    machine: &MachineFile,
    index: u64,
) -> Result<RunInput, ScenarioError> {
    if index >= spec.settling_runs {
        return Err(ScenarioError::Index {
            index,
            runs: spec.settling_runs,
        });
    }
    let seed = settling_run_seed(spec.seed, index);
    let signal = signal::open_then_shut(SETTLING_OPEN_PART, settling_steps(spec));
    Ok(RunInput {
        run_id: index,
        payload_kg: payload_kg(spec, seed),
        angles_rad: angles_rad(spec, machine, seed),
        valves_ratio: vec![signal; machine.cylinders.len()],
    })
}

/// Steps of a settling run.
#[must_use]
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "`as` saturates, and validation bounds the sample time"
)]
pub fn settling_steps(spec: &JobSpec) -> usize {
    let [shortest, longest] = SETTLING_DURATION_S;
    let duration_s = spec.duration_s.max(shortest).min(longest);
    (duration_s / spec.sample_time_s).round() as usize
}

/// Part of the data set to which a run belongs: see [`hydroflex_openapi::job::Split::of`].
#[must_use]
pub fn split_of(spec: &JobSpec, run_index: u64) -> SplitName {
    spec.split.of(run_index)
}

/// Seed of a run's own streams, as `meta/runs.parquet` shows it.
#[must_use]
pub fn run_seed(job_seed: u64, run_index: u64) -> u64 {
    stream::derive_seed("run", job_seed, run_index)
}

/// Seed of a settling run's own streams.
#[must_use]
pub fn settling_run_seed(job_seed: u64, index: u64) -> u64 {
    stream::derive_seed("settling", job_seed, index)
}

fn payload_kg(spec: &JobSpec, seed: u64) -> f64 {
    match spec.payload_kg {
        ValueOrRange::Value(value) => value,
        ValueOrRange::Range { min, max } => Stream::new(seed, "payload").uniform(min, max),
    }
}

fn angles_rad(spec: &JobSpec, machine: &MachineFile, seed: u64) -> Vec<f64> {
    let draw = |angle: &hydroflex_openapi::machine::AngleSpec| {
        let range = spec.initial_angle_deg.get(&angle.name);
        let [min, max] = *range.unwrap_or(&angle.range_deg);
        let mut stream = Stream::new(seed, &format!("angle/{}", angle.name));
        stream.uniform(min, max).to_radians()
    };
    machine.angles.iter().map(draw).collect()
}

fn valve_signal(
    excitation: &Excitation,
    cylinder: &CylinderSpec,
    seed: u64,
    steps: usize,
) -> Result<Vec<f64>, ScenarioError> {
    match excitation {
        Excitation::Random => {
            let mut stream = Stream::new(seed, &format!("valve/{}", cylinder.name));
            Ok(signal::random(&mut stream, steps))
        }
        Excitation::OpenThenShut { open_part } => Ok(signal::open_then_shut(*open_part, steps)),
        Excitation::Cycle => Ok(signal::cycle(steps)),
        Excitation::Given { valve_ratio } => {
            let given = valve_ratio.get(&cylinder.name);
            let given = given.ok_or_else(|| ScenarioError::NoSignal {
                cylinder: cylinder.name.clone(),
            })?;
            if given.len() == steps {
                Ok(given.clone())
            } else {
                Err(ScenarioError::SignalLength {
                    cylinder: cylinder.name.clone(),
                    found: given.len(),
                    expected: steps,
                })
            }
        }
    }
}

#[cfg(test)]
mod tests;
