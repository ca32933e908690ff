//! The `accurate` integrator of machines with one degree of freedom in the plane: one flexible body
//! on a revolute joint to the ground, one cylinder, perhaps a payload.

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]
#![allow(
    clippy::needless_range_loop,
    reason = "a loop over modes or chambers reads several arrays at once"
)]
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
pub(crate) mod tableau;
mod track;

#[cfg(test)]
mod tests;

pub use crate::instruction_set::InstructionSet;
pub use model::{MOST_MODES, NotPlanar, PlanarModel};

use crate::equilibrium::EquilibriumError;
use crate::simulator::SimulatorError;
#[cfg(doc)]
use crate::trajectory::ACCURATE_TOLERANCE;
use crate::trajectory::{InputError, RunFailure, RunInput, Trajectory};
use lockstep::{Common, RunResult};
use model::Modes;

/// Scratch memory; may be dirty, and keeps the modes of the last payload.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    modes: Option<Modes>,
}

impl PlanarModel {
    /// Simulates one run. `tolerance` bounds the error of every channel but accelerations, over
    /// its usual range; [`ACCURATE_TOLERANCE`] is the default, 1e-4 the other proven value.
    ///
    /// # Errors
    /// [`RunFailure`] if the run cannot be finished.
    pub fn run(
        &self,
        input: &RunInput,
        sample_time_s: f64,
        tolerance: f64,
        ws: &mut Workspace,
    ) -> Result<Trajectory, RunFailure> {
        let inputs = std::slice::from_ref(input);
        let common = Common::new(sample_time_s, tolerance);
        let mut results = [None];
        self.group(
            inputs,
            &[0],
            &common,
            Layout::OneByOne,
            InstructionSet::detect(),
            ws,
            &mut results,
        );
        let [result] = results;
        result.unwrap_or(Err(UNFINISHED))
    }

    /// Simulates many runs, as many at a time as a vector register holds; results in the order of
    /// the inputs. Every run gives bit for bit what [`Self::run`] gives.
    pub fn run_batch(
        &self,
        inputs: &[RunInput],
        sample_time_s: f64,
        tolerance: f64,
        ws: &mut Workspace,
    ) -> Vec<Result<Trajectory, RunFailure>> {
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
    ) -> Vec<Result<Trajectory, RunFailure>> {
        let common = Common::new(sample_time_s, tolerance);
        let mut results: Vec<_> = inputs.iter().map(|_| None).collect();
        // Runs of one payload share the modes; what is too few for that has modes of its own, lane by lane.
        let mut order: Vec<usize> = (0..inputs.len()).collect();
        order.sort_by(|&i, &j| {
            inputs[i]
                .payload_kg
                .total_cmp(&inputs[j].payload_kg)
                .then(i.cmp(&j))
        });
        let (mut few, mut payloads) = (Vec::new(), 0);
        for jobs in order.chunk_by(|&i, &j| inputs[i].payload_kg.to_bits() == inputs[j].payload_kg.to_bits())
        {
            if jobs.len() < MANY {
                few.extend_from_slice(jobs);
                payloads += 1;
            } else {
                self.group(inputs, jobs, &common, Layout::SideBySide, set, ws, &mut results);
            }
        }
        if payloads > 1 {
            self.mixed(inputs, &mut few, &common, set, &mut results);
        }
        for jobs in few.chunk_by(|&i, &j| inputs[i].payload_kg.to_bits() == inputs[j].payload_kg.to_bits()) {
            let layout = if jobs.len() > 1 {
                Layout::SideBySide
            } else {
                Layout::OneByOne
            };
            self.group(inputs, jobs, &common, layout, set, ws, &mut results);
        }
        results
            .into_iter()
            .map(|r| r.unwrap_or(Err(UNFINISHED)))
            .collect()
    }

    /// Simulates runs of several payloads side by side. Keeps in `jobs` those that are still to be done.
    fn mixed(
        &self,
        inputs: &[RunInput],
        jobs: &mut Vec<usize>,
        common: &Common,
        set: InstructionSet,
        results: &mut [Option<RunResult>],
    ) {
        jobs.retain(|&job| match self.check(&inputs[job]) {
            Ok(()) => true,
            Err(bad) => {
                results[job] = Some(Err(bad));
                false
            }
        });
        // The size that the modes of a boom with a payload need; larger bodies run one by one.
        dispatch::mixed::<8, 8, 8>(set, self, common, inputs, jobs, results);
        jobs.retain(|&job| results[job].is_none());
    }

    /// Simulates runs of one payload.
    #[allow(
        clippy::too_many_arguments,
        reason = "the one place where batch and single run meet"
    )]
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
                Err(bad) => results[job] = Some(Err(bad)),
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
                let reason = RunFailure::Machine(SimulatorError::Planar(reason));
                for job in fit {
                    results[job] = Some(Err(reason.clone()));
                }
                return;
            }
        };
        let order = self.order(modes, common.tolerance);
        // The sizes that the loop is compiled for; padding modes are zero.
        macro_rules! sizes {
            ($(($coupled:literal, $plain:literal, $followers:literal)),*) => {
                $(if let Some(c) = self.constants::<$coupled, $plain, $followers>(modes, &order) {
                    match layout {
                        Layout::OneByOne => dispatch::one_by_one(set, &c, common, inputs, &fit, results),
                        Layout::SideBySide => dispatch::side_by_side(set, &c, common, inputs, &fit, results),
                    }
                    return;
                })*
            };
        }
        sizes!((4, 4, 4), (8, 8, 8), (32, 32, 32));
    }

    fn check(&self, input: &RunInput) -> Result<(), RunFailure> {
        let number = |name, value, allowed| RunFailure::Input(InputError::Number { name, value, allowed });
        let &[angle_rad] = input.angles_rad.as_slice() else {
            return Err(RunFailure::NoEquilibrium(EquilibriumError::AngleCount {
                given: input.angles_rad.len(),
                expected: 1,
            }));
        };
        if !angle_rad.is_finite() {
            return Err(number("angle", angle_rad, "a number of radians"));
        }
        let [valve] = input.valves_ratio.as_slice() else {
            return Err(RunFailure::Input(InputError::ValveCount {
                given: input.valves_ratio.len(),
                expected: 1,
            }));
        };
        if let Some(k) = valve.iter().position(|u| !(-1.0..=1.0).contains(u)) {
            return Err(RunFailure::Input(InputError::ValveRange {
                value: valve[k],
                sample: k + 1,
            }));
        }
        let fits = input.payload_kg == 0.0 || self.carries_payload();
        if !(fits && input.payload_kg.is_finite() && input.payload_kg >= 0.0) {
            return Err(number("payload", input.payload_kg, "carried by the machine"));
        }
        Ok(())
    }
}

/// Every run of a group leaves a result; this one would say that it did not.
const UNFINISHED: RunFailure = RunFailure::NotFinite {
    quantity: "result",
    t_s: 0.0,
};

/// Runs of one payload from which on they share their modes: twice the lanes, since a group ends with lanes
/// that wait for the last.
const MANY: usize = 16;

/// How the runs of a group share the registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Layout {
    OneByOne,
    SideBySide,
}
