//! One run of a job: from its index to a record.

use crate::machines::ReadyMachine;
use hydroflex_dataset::{RunKind, RunOutcome, RunRecord, RunSamples, RunStatistics};
use hydroflex_openapi::job::{JobSpec, RunFlag, SolverPath};
use hydroflex_sim::scenario::{self, ScenarioError};
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunFailure, RunInput, RunSettings, Trajectory};

/// The run as planned, with the record that it will get if it leaves no samples.
pub struct PlannedRun {
    /// What the simulator is asked.
    pub input: RunInput,
    seed: u64,
    kind: RunKind,
}

/// Plans run `index` of a job.
///
/// # Errors
/// Only for jobs that were never checked.
pub fn plan(
    spec: &JobSpec,
    machine: &ReadyMachine,
    kind: RunKind,
    index: u64,
) -> Result<PlannedRun, ScenarioError> {
    let file = machine.machine().file();
    let (input, seed) = match kind {
        RunKind::Job => (
            scenario::plan_run(spec, file, &machine.simulator, index)?,
            scenario::run_seed(spec.seed, index),
        ),
        RunKind::Settling => (
            scenario::plan_settling_run(spec, file, &machine.simulator, index)?,
            scenario::settling_run_seed(spec.seed, index),
        ),
    };
    Ok(PlannedRun { input, seed, kind })
}

impl PlannedRun {
    /// Simulates. A run that does not converge, or turns non-finite, is data; a panic is not, and
    /// goes through to whoever counts attempts.
    #[must_use]
    pub fn simulate(self, spec: &JobSpec, machine: &ReadyMachine) -> RunRecord {
        let settings = settings(spec);
        let result = machine.simulator.run(&self.input, &settings);
        self.ended(result, &machine.simulator, &settings)
    }

    /// The record of a simulated run.
    fn ended(
        self,
        result: Result<Trajectory, RunFailure>,
        simulator: &Simulator,
        settings: &RunSettings,
    ) -> RunRecord {
        let ended = Ended::of(result, &self.input, simulator, settings);
        self.record(ended)
    }

    /// The record of a run without samples.
    #[must_use]
    pub fn failed(self, reason: String) -> RunRecord {
        self.record(Ended::failed(reason, None))
    }

    fn record(self, ended: Ended) -> RunRecord {
        RunRecord {
            kind: self.kind,
            run_id: self.input.run_id,
            seed: Some(self.seed),
            payload_kg: self.input.payload_kg,
            angles_rad: self.input.angles_rad,
            outcome: ended.outcome,
            flags: ended.flags,
            statistics: ended.statistics,
        }
    }
}

/// What a record says of how a run ended.
pub struct Ended {
    /// Samples, or the reason why there are none.
    pub outcome: RunOutcome,
    /// What it met on its way.
    pub flags: Vec<RunFlag>,
    /// Cost.
    pub statistics: RunStatistics,
}

impl Ended {
    fn failed(reason: String, path: Option<SolverPath>) -> Self {
        Self {
            outcome: RunOutcome::Failed { reason },
            flags: Vec::new(),
            statistics: RunStatistics {
                path,
                ..RunStatistics::default()
            },
        }
    }

    /// What the simulator made of a run, or the path on which it failed.
    #[must_use]
    pub fn of(
        result: Result<Trajectory, RunFailure>,
        input: &RunInput,
        simulator: &Simulator,
        settings: &RunSettings,
    ) -> Self {
        match result {
            Ok(trajectory) => Self {
                statistics: RunStatistics {
                    steps: trajectory.statistics.steps,
                    rejected: trajectory.statistics.rejected,
                    iterations: trajectory.statistics.iterations,
                    factorisations: trajectory.statistics.factorisations,
                    path: Some(trajectory.statistics.path),
                },
                outcome: RunOutcome::Ok(RunSamples {
                    sample_count: trajectory.sample_count,
                    columns: trajectory.columns,
                }),
                flags: trajectory.flags,
            },
            Err(failure) => {
                let path = simulator.solver_path(settings.integrator, input.payload_kg > 0.0);
                Self::failed(failure.to_string(), path.ok())
            }
        }
    }
}

/// Whether all of these runs can share the processor's vector registers.
#[must_use]
pub fn side_by_side(runs: &[PlannedRun], spec: &JobSpec, machine: &ReadyMachine) -> bool {
    let together = |with_payload| machine.simulator.runs_side_by_side(&settings(spec), with_payload);
    runs.iter().all(|run| together(run.input.payload_kg > 0.0))
}

/// Simulates several runs at a time, which costs a third of simulating them one by one and gives the
/// same numbers. Panics as [`PlannedRun::simulate`] does.
#[must_use]
pub fn simulate_together(runs: Vec<PlannedRun>, spec: &JobSpec, machine: &ReadyMachine) -> Vec<RunRecord> {
    let inputs: Vec<RunInput> = runs.iter().map(|run| run.input.clone()).collect();
    let settings = settings(spec);
    let results = machine.simulator.run_batch(&inputs, &settings);
    runs.into_iter()
        .zip(results)
        .map(|(run, result)| run.ended(result, &machine.simulator, &settings))
        .collect()
}

fn settings(spec: &JobSpec) -> RunSettings {
    RunSettings {
        integrator: spec.integrator,
        sample_time_s: spec.sample_time_s,
    }
}
