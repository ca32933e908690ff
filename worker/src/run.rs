//! One run of a job: from its index to a record.

use crate::machines::ReadyMachine;
use hydroflex_dataset::{RunKind, RunOutcome, RunRecord, RunSamples, RunStatistics};
use hydroflex_openapi::job::{JobSpec, RunFlag, SolverPath};
use hydroflex_sim::scenario::{self, ScenarioError};
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunFailure, RunInput, RunSettings, Trajectory};
use std::collections::BTreeMap;

/// The run as planned, with the record that it will get if it leaves no samples.
pub struct PlannedRun {
    /// What the simulator is asked.
    pub input: RunInput,
    seed: u64,
    kind: RunKind,
    /// Place in the job's materials, and name.
    material: Option<(usize, String)>,
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
    let seed = match kind {
        RunKind::Job => scenario::run_seed(spec.seed, index),
        RunKind::Settling => scenario::settling_run_seed(spec.seed, index),
    };
    let material = scenario::material_index(spec, seed);
    let simulator = machine.simulator_of(material);
    Ok(PlannedRun {
        input: match kind {
            RunKind::Job => scenario::plan_run(spec, file, simulator, index)?,
            RunKind::Settling => scenario::plan_settling_run(spec, file, simulator, index)?,
        },
        seed,
        kind,
        material: material.map(|index| (index, spec.materials[index].name().to_owned())),
    })
}

impl PlannedRun {
    fn simulator<'a>(&self, machine: &'a ReadyMachine) -> &'a Simulator {
        machine.simulator_of(self.material.as_ref().map(|(index, _)| *index))
    }

    /// Simulates. A run that does not converge, or turns non-finite, is data; a panic is not, and
    /// goes through to whoever counts attempts.
    #[must_use]
    pub fn simulate(self, spec: &JobSpec, machine: &ReadyMachine) -> RunRecord {
        let settings = settings(spec);
        let simulator = self.simulator(machine);
        let result = simulator.run(&self.input, &settings);
        self.ended(result, simulator, &settings)
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
            material: self.material.map(|(_, name)| name),
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
    let settings = settings(spec);
    let together = |run: &PlannedRun| {
        run.simulator(machine)
            .runs_side_by_side(&settings, run.input.payload_kg > 0.0)
    };
    runs.iter().all(together)
}

/// Simulates several runs at a time, which costs a third of simulating them one by one and gives the
/// same numbers. Panics as [`PlannedRun::simulate`] does.
#[must_use]
pub fn simulate_together(runs: Vec<PlannedRun>, spec: &JobSpec, machine: &ReadyMachine) -> Vec<RunRecord> {
    let settings = settings(spec);
    // Runs of one material share a simulator; a job without materials is one such group.
    let mut groups: BTreeMap<Option<usize>, Vec<usize>> = BTreeMap::new();
    for (place, run) in runs.iter().enumerate() {
        let material = run.material.as_ref().map(|(index, _)| *index);
        groups.entry(material).or_default().push(place);
    }
    let mut results: BTreeMap<usize, Result<Trajectory, RunFailure>> = BTreeMap::new();
    for (material, places) in groups {
        let inputs: Vec<RunInput> = places.iter().map(|place| runs[*place].input.clone()).collect();
        let simulated = machine.simulator_of(material).run_batch(&inputs, &settings);
        results.extend(places.into_iter().zip(simulated));
    }
    runs.into_iter()
        .zip(results.into_values())
        .map(|(run, result)| {
            let simulator = run.simulator(machine);
            run.ended(result, simulator, &settings)
        })
        .collect()
}

fn settings(spec: &JobSpec) -> RunSettings {
    RunSettings {
        integrator: spec.integrator,
        sample_time_s: spec.sample_time_s,
    }
}
