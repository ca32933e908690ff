//! One run, between the simulator that made it and the files that keep it.

use hydroflex_openapi::job::{RunFlag, RunStatus, SolverPath};

/// One run: its parameters, how it ended, and its samples if it ended well.
#[derive(Debug, Clone, PartialEq)]
pub struct RunRecord {
    /// Run of the job, or settling run beside it.
    pub kind: RunKind,
    /// Key of the run: for jobs the run's index. Settling runs count from 0 on their own.
    pub run_id: u64,
    /// Seed of the run's own random streams; absent for runs that were given.
    pub seed: Option<u64>,
    /// Payload.
    pub payload_kg: f64,
    /// Material of the flexible bodies, where the job varies it.
    pub material: Option<String>,
    /// Initial angles in the order of the machine file.
    pub angles_rad: Vec<f64>,
    /// How it ended.
    pub outcome: RunOutcome,
    /// What it met on its way, sorted, without duplicates.
    pub flags: Vec<RunFlag>,
    /// Cost.
    pub statistics: RunStatistics,
}

impl RunRecord {
    /// `ok` or `failed`.
    #[must_use]
    pub fn status(&self) -> RunStatus {
        match self.outcome {
            RunOutcome::Ok(_) => RunStatus::Ok,
            RunOutcome::Failed { .. } => RunStatus::Failed,
        }
    }

    /// Samples, if it ended well.
    #[must_use]
    pub fn samples(&self) -> Option<&RunSamples> {
        match &self.outcome {
            RunOutcome::Ok(samples) => Some(samples),
            RunOutcome::Failed { .. } => None,
        }
    }

    /// Reason, if it failed.
    #[must_use]
    pub fn reason(&self) -> Option<&str> {
        match &self.outcome {
            RunOutcome::Ok(_) => None,
            RunOutcome::Failed { reason } => Some(reason),
        }
    }
}

/// What a run is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunKind {
    /// One of the runs asked for.
    Job,
    /// An extra run with the test signal, for the SLIDE window.
    Settling,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub enum RunOutcome {
    /// With samples.
    Ok(RunSamples),
    /// Without.
    Failed {
        /// Why, in one line.
        reason: String,
    },
}

/// Samples of a run, one column per channel; row 0 is the state at t = 0.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RunSamples {
    /// Rows, the same in every column.
    pub sample_count: usize,
    /// Columns in the order of the data set's channels.
    pub columns: Vec<Vec<f64>>,
}

/// Counts of one run; a function of its input alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RunStatistics {
    /// Accepted steps.
    pub steps: u64,
    /// Rejected steps.
    pub rejected: u64,
    /// Newton iterations.
    pub iterations: u64,
    /// Jacobian evaluations with factorisation.
    pub factorisations: u64,
    /// Which equations were solved, or would have been; absent if the run never came to the solver.
    pub path: Option<SolverPath>,
}
