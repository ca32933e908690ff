//! What goes into a run and what comes out.

use hydroflex_openapi::job::{Integrator, RunFlag, SolverPath};

mod channels;
mod failure;
pub(crate) mod recorder;

pub use channels::channels;
pub use failure::{InputError, RunFailure};
pub use recorder::von_mises_pa;

/// What `accurate` promises: every channel but accelerations within this of its range.
pub const ACCURATE_TOLERANCE: f64 = 1e-3;

/// One run as asked for: the configuration, and the valve signal of every cylinder.
#[derive(Debug, Clone, PartialEq)]
pub struct RunInput {
    /// Key of the run.
    pub run_id: u64,
    /// Payload, kg; 0 means none, and selects the body without the payload interface.
    pub payload_kg: f64,
    /// One per angle of the machine, in its order, rad, as the run table gives them.
    pub angles_rad: Vec<f64>,
    /// One list per cylinder of the machine, in its order: U_1..U_n, one value per sample. The
    /// signal is piecewise linear through (0, 0) and (k·sample, U_k).
    pub valves_ratio: Vec<Vec<f64>>,
}

/// How to integrate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunSettings {
    /// Scheme.
    pub integrator: Integrator,
    /// Time between samples, s.
    pub sample_time_s: f64,
}

/// Samples of a run, one column per channel, n + 1 rows: step 0 is the state at t = 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// Rows.
    pub sample_count: usize,
    /// Columns in the order of the simulator's channels, each of `sample_count` values.
    pub columns: Vec<Vec<f64>>,
    /// What the run met, sorted, without duplicates.
    pub flags: Vec<RunFlag>,
    /// Cost of the run.
    pub statistics: SolverStatistics,
}

/// Counts of one run; a function of the input alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SolverStatistics {
    /// Accepted steps.
    pub steps: u64,
    /// Rejected steps.
    pub rejected: u64,
    /// Newton iterations (0 for Rosenbrock methods).
    pub iterations: u64,
    /// Jacobian evaluations with factorisation.
    pub factorisations: u64,
    /// Which equations were solved.
    pub path: SolverPath,
}
