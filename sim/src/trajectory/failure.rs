//! How a run can fail: as data, with its reason.

use crate::equilibrium::EquilibriumError;
use crate::integrate::StepError;
use crate::linearise::LinearisationError;
use crate::simulator::SimulatorError;

/// Why a run has no samples.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RunFailure {
    /// Newton's method did not converge even in the shortest step.
    #[error(
        "not converged at {t_s} s: increment {increment:e} after {iterations} iterations, tolerance {tolerance:e}"
    )]
    NotConverged {
        /// Time, s.
        t_s: f64,
        /// Iterations of the last attempt.
        iterations: u32,
        /// Last increment.
        increment: f64,
        /// Bound of the increment.
        tolerance: f64,
    },
    /// A quantity is not a finite number.
    #[error("{quantity} not finite at {t_s} s")]
    NotFinite {
        /// Which.
        quantity: &'static str,
        /// Time, s.
        t_s: f64,
    },
    /// The machine does not come to rest at the run's angles.
    #[error("no equilibrium: {0}")]
    NoEquilibrium(#[from] EquilibriumError),
    /// The machine cannot run at all with this payload.
    #[error(transparent)]
    Machine(#[from] SimulatorError),
    /// The machine cannot be linearised.
    #[error(transparent)]
    Linearisation(#[from] LinearisationError),
    /// The run table does not fit the machine.
    #[error(transparent)]
    Input(#[from] InputError),
}

/// What is wrong with a run's input.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InputError {
    /// Wrong number of valve signals.
    #[error("{given} valve signals given, the machine has {expected} cylinders")]
    ValveCount {
        /// Given.
        given: usize,
        /// Expected.
        expected: usize,
    },
    /// Valve signals of different length.
    #[error("valve signals have {first} and {other} values; all need the same number")]
    ValveLengths {
        /// Length of the first signal.
        first: usize,
        /// Length of another one.
        other: usize,
    },
    /// A valve value outside its range.
    #[error("valve value {value} of sample {sample} is outside [−1, 1]")]
    ValveRange {
        /// Value.
        value: f64,
        /// Sample, from 1.
        sample: usize,
    },
    /// A number that must be finite and positive is not.
    #[error("{name} is {value}, but must be finite and {allowed}")]
    Number {
        /// Which.
        name: &'static str,
        /// Value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
}

impl From<StepError> for RunFailure {
    fn from(error: StepError) -> Self {
        match error {
            StepError::NotConverged {
                t_s,
                iterations,
                increment,
                tolerance,
            } => Self::NotConverged {
                t_s,
                iterations,
                increment,
                tolerance,
            },
            StepError::NotFinite { quantity, t_s } => Self::NotFinite { quantity, t_s },
        }
    }
}
