//! The `accurate` integrator of machines with one degree of freedom in the plane: one flexible body
//! on a revolute joint to the ground, one cylinder, perhaps a payload.
#![doc = include_str!("../../theory/minimal_coordinates.md")]

mod constants;
mod dispatch;
mod dynamics;
mod eigen;
mod elementary;
mod lane;
#[cfg(target_arch = "x86_64")]
mod lane_x86;
mod lockstep;
mod model;
mod record;
mod schedule;
mod solve;
mod statics;
mod step;
mod sums;
mod tableau;
mod track;

pub use dispatch::InstructionSet;
pub use model::{MOST_MODES, NotPlanar, PlanarModel};

use crate::trajectory::{RunInput, Trajectory};
use lockstep::{Common, RunResult};
use model::Modes;

/// Why a run ended early.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanarFailure {
    /// The step or the equilibrium did not converge.
    #[error("no convergence at {t_s} s after {iterations} attempts: residual {residual:e}, tolerance {tolerance:e}")]
    NotConverged {
        /// Time of the run, s.
        t_s: f64,
        /// Attempts.
        iterations: u32,
        /// What is left.
        residual: f64,
        /// What is allowed.
        tolerance: f64,
    },
    /// A number is not finite.
    #[error("{quantity} is not finite at {t_s} s")]
    NotFinite {
        /// Which.
        quantity: &'static str,
        /// Time of the run, s.
        t_s: f64,
    },
    /// The modes with this payload cannot be found.
    #[error(transparent)]
    Modes(#[from] NotPlanar),
    /// The run does not fit the model.
    #[error("{0}")]
    Input(BadInput),
}

/// What is wrong with a run's input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum BadInput {
    /// Not one angle.
    #[error("the run must give one angle")]
    Angles,
    /// Not one valve signal.
    #[error("the run must give one valve signal")]
    Valves,
    /// A payload on a body without payload interface.
    #[error("the run has a payload, and the body no interface for it")]
    Payload,
}

/// Default accuracy: every channel but accelerations within 1e-3 of its range.
pub const TOLERANCE: f64 = 1e-3;

/// Scratch memory; may be dirty, and keeps the modes of the last payload.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    modes: Option<Modes>,
}

impl PlanarModel {
    /// Simulates one run. `tolerance` bounds the error of every channel but accelerations, over
    /// its usual range; [`TOLERANCE`] is the default, 1e-4 the other proven value.
    ///
    /// # Errors
    /// [`PlanarFailure`] if the run cannot be finished.
    pub fn run(
        &self,
        input: &RunInput,
        sample_time_s: f64,
        tolerance: f64,
        ws: &mut Workspace,
    ) -> Result<Trajectory, PlanarFailure> {
        let inputs = std::slice::from_ref(input);
        let common = Common::new(sample_time_s, tolerance);
        let mut results = [None];
        self.group(inputs, &[0], &common, Layout::OneByOne, InstructionSet::detect(), ws, &mut results);
        let [result] = results;
        result.unwrap_or(Err(PlanarFailure::Input(BadInput::Angles)))
    }

    /// Simulates many runs, as many at a time as a vector register holds; results in the order of
    /// the inputs. Every run gives bit for bit what [`Self::run`] gives.
    pub fn run_batch(
        &self,
        inputs: &[RunInput],
        sample_time_s: f64,
        tolerance: f64,
        ws: &mut Workspace,
    ) -> Vec<Result<Trajectory, PlanarFailure>> {
        self.run_batch_on(InstructionSet::detect(), inputs, sample_time_s, tolerance, ws)
    }

    /// The same on a given instruction set, which the machine must have.
    #[doc(hidden)]
    pub fn run_batch_on(
        &self,
        set: InstructionSet,
        inputs: &[RunInput],
        sample_time_s: f64,
        tolerance: f64,
        ws: &mut Workspace,
    ) -> Vec<Result<Trajectory, PlanarFailure>> {
        let common = Common::new(sample_time_s, tolerance);
        let mut results: Vec<_> = inputs.iter().map(|_| None).collect();
        // Lanes share the modes, so a group has one payload.
        let mut order: Vec<usize> = (0..inputs.len()).collect();
        order.sort_by(|&i, &j| inputs[i].payload_kg.total_cmp(&inputs[j].payload_kg).then(i.cmp(&j)));
        for jobs in order.chunk_by(|&i, &j| inputs[i].payload_kg.to_bits() == inputs[j].payload_kg.to_bits()) {
            let layout = if jobs.len() > 1 { Layout::SideBySide } else { Layout::OneByOne };
            self.group(inputs, jobs, &common, layout, set, ws, &mut results);
        }
        results
            .into_iter()
            .map(|r| r.unwrap_or(Err(PlanarFailure::Input(BadInput::Angles))))
            .collect()
    }

    /// Simulates runs of one payload.
    #[allow(clippy::too_many_arguments, reason = "the one place where batch and single run meet")]
    fn group(
        &self,
        inputs: &[RunInput],
        jobs: &[usize],
        common: &Common,
        layout: Layout,
        set: InstructionSet,
        ws: &mut Workspace,
        results: &mut [Option<RunResult>],
    ) {
        let mut fit = Vec::with_capacity(jobs.len());
        for &job in jobs {
            match self.check(&inputs[job]) {
                Ok(()) => fit.push(job),
                Err(bad) => results[job] = Some(Err(PlanarFailure::Input(bad))),
            }
        }
        let Some(&first) = fit.first() else { return };
        let payload_kg = inputs[first].payload_kg;
        let modes = match ws.modes.take() {
            Some(modes) if modes.payload_kg.to_bits() == payload_kg.to_bits() => Ok(modes),
            _ => self.modes(payload_kg),
        };
        let modes = match modes {
            Ok(modes) => ws.modes.insert(modes),
            Err(reason) => {
                for job in fit {
                    results[job] = Some(Err(PlanarFailure::Modes(reason.clone())));
                }
                return;
            }
        };
        // The sizes that the loop is compiled for; padding modes are zero.
        macro_rules! sizes {
            ($(($modes:literal, $coupled:literal)),*) => {
                $(if let Some(c) = self.constants::<$modes, $coupled>(modes) {
                    match layout {
                        Layout::OneByOne => dispatch::one_by_one(set, &c, common, inputs, &fit, results),
                        Layout::SideBySide => dispatch::side_by_side(set, &c, common, inputs, &fit, results),
                    }
                    return;
                })*
            };
        }
        sizes!((8, 4), (16, 8), (32, 32));
    }

    fn check(&self, input: &RunInput) -> Result<(), BadInput> {
        if input.angles_rad.len() != 1 {
            return Err(BadInput::Angles);
        }
        if input.valves_ratio.len() != 1 {
            return Err(BadInput::Valves);
        }
        if input.payload_kg != 0.0 && !self.carries_payload() {
            return Err(BadInput::Payload);
        }
        Ok(())
    }
}

/// How the runs of a group share the registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Layout {
    OneByOne,
    SideBySide,
}
