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
use hydroflex_openapi::machine::{AngleSpec, CylinderSpec, InsteadSpec, MachineFile};
use stream::Stream;

pub use validate::{validate, validate_materials};

/// Part of a settling run during which the valve is open (the paper's text; its script has 10 %).
pub const SETTLING_OPEN_PART: f64 = 0.2;

/// Shortest and longest settling run, s; between them it lasts as long as the job's runs.
pub const SETTLING_DURATION_S: [f64; 2] = [1.0, 2.0];

/// Why a run cannot be planned; [`validate()`] finds these before any run is.
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
    /// No configuration was found from which the machine can start.
    #[error("in {draws} random configurations a cylinder starts outside the lengths it may start at")]
    OutOfReach {
        /// Configurations tried.
        draws: usize,
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

/// Draws of a configuration after which a run is given up. [`reachable_part`] refuses jobs for which so many
/// could be needed.
const DRAWS_MOST: usize = 1000;

/// What knows which configurations a machine can start from.
pub trait Reach {
    /// Whether every cylinder starts at a length that it may start at.
    fn can_start(&self, with_payload: bool, angles_rad: &[f64]) -> bool;
}

/// Every configuration will do.
#[derive(Debug, Clone, Copy)]
pub struct Anywhere;

impl Reach for Anywhere {
    fn can_start(&self, _: bool, _: &[f64]) -> bool {
        true
    }
}

/// Part of the first `draws` runs' first draws from which the machine can start.
#[must_use]
pub fn reachable_part(spec: &JobSpec, machine: &MachineFile, reach: &impl Reach, draws: u64) -> f64 {
    let fits = |&index: &u64| {
        let seed = run_seed(spec.seed, index);
        let angles_rad = Draws::new(spec, machine, seed).next_rad();
        reach.can_start(payload_kg(spec, seed) > 0.0, &angles_rad)
    };
    (0..draws).filter(fits).count() as f64 / draws.max(1) as f64
}

/// Input of the run of this index; its `run_id` is the index.
///
/// # Errors
/// The index is too large, a given signal does not fit, or the machine can start from none of the
/// configurations.
pub fn plan_run(
    spec: &JobSpec,
    machine: &MachineFile,
    reach: &impl Reach,
    run_index: u64,
) -> Result<RunInput, ScenarioError> {
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
        angles_rad: angles_rad(spec, machine, reach, seed)?,
        valves_ratio,
    })
}

/// Input of the settling run of this index: a random configuration of the job, every valve open for
/// the first part and then shut. Its `run_id` is the index; settling runs count on their own.
///
/// # Errors
/// The index is too large, or the machine can start from none of the configurations.
pub fn plan_settling_run(
    spec: &JobSpec,
    machine: &MachineFile,
    reach: &impl Reach,
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
        angles_rad: angles_rad(spec, machine, reach, seed)?,
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

/// Material of the run with this seed, a place in the job's list; none if the job varies none. From a stream of its own: a
/// job's other random numbers are the same with and without.
#[must_use]
pub fn material_index(spec: &JobSpec, seed: u64) -> Option<usize> {
    (!spec.materials.is_empty()).then(|| Stream::new(seed, "material").below(spec.materials.len()))
}

fn payload_kg(spec: &JobSpec, seed: u64) -> f64 {
    match spec.payload_kg {
        ValueOrRange::Value(value) => value,
        // A stream of its own: the payloads of the other runs are the same with and without empty ones.
        ValueOrRange::Range { empty, .. } if Stream::new(seed, "empty").uniform(0.0, 1.0) < empty => 0.0,
        ValueOrRange::Range { min, max, .. } => Stream::new(seed, "payload").uniform(min, max),
    }
}

/// The first configuration that the machine can start from.
fn angles_rad(
    spec: &JobSpec,
    machine: &MachineFile,
    reach: &impl Reach,
    seed: u64,
) -> Result<Vec<f64>, ScenarioError> {
    let with_payload = payload_kg(spec, seed) > 0.0;
    let mut draws = Draws::new(spec, machine, seed);
    for _ in 0..DRAWS_MOST {
        let angles_rad = draws.next_rad();
        if reach.can_start(with_payload, &angles_rad) {
            return Ok(angles_rad);
        }
    }
    Err(ScenarioError::OutOfReach { draws: DRAWS_MOST })
}

/// Configurations of one run, one after the other: every angle draws from a stream of its own.
struct Draws<'a> {
    spec: &'a JobSpec,
    machine: &'a MachineFile,
    streams: Vec<Stream>,
}

impl<'a> Draws<'a> {
    fn new(spec: &'a JobSpec, machine: &'a MachineFile, seed: u64) -> Self {
        let stream = |angle: &AngleSpec| Stream::new(seed, &format!("angle/{}", angle.name));
        Self {
            spec,
            machine,
            streams: machine.angles.iter().map(stream).collect(),
        }
    }

    fn next_rad(&mut self) -> Vec<f64> {
        let angles = &self.machine.angles;
        let mut drawn_deg: Vec<f64> = Vec::with_capacity(angles.len());
        for (angle, stream) in angles.iter().zip(&mut self.streams) {
            let fits = |other: &&InsteadSpec| {
                let value = angles.iter().zip(&drawn_deg).find(|(a, _)| a.name == other.angle);
                let [above, most] = other.between_deg;
                value.is_some_and(|(_, &deg)| deg > above && deg <= most)
            };
            // A job's own range counts as it stands.
            let [min, max] = match self.spec.initial_angle_deg.get(&angle.name) {
                Some(range) => *range,
                None => angle
                    .instead
                    .iter()
                    .find(fits)
                    .map_or(angle.range_deg, |i| i.range_deg),
            };
            drawn_deg.push(stream.uniform(min, max));
        }
        drawn_deg.into_iter().map(f64::to_radians).collect()
    }
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
