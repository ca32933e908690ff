//! Data sets of a study: what networks train on, are calibrated with and judged by.

use super::super::simulate::{self, run_table};
use super::super::train::calm_runs;
use super::{Args, DEFAULT_SIGNALS, SAMPLE_S};
use anyhow::{Context as _, ensure};
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::load_all;
use hydroflex_ml::evaluate::{EvaluateError, with_noise_of_training};
use hydroflex_ml::model::Model;
use hydroflex_ml::runs::Runs;
use hydroflex_openapi::dataset::DatasetSource;
use hydroflex_openapi::job::{Excitation, JobSpec, ValueOrRange};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::RunInput;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Length of an evaluation run, s.
const EVALUATION_S: f64 = 10.0;
/// Start of the published evaluation cycle, degrees.
const CYCLE_ANGLE_DEG: f64 = 18.24;
/// Random 10 s runs simulated, at least and for each one whose errors are reported, so that enough of them stay
/// within stroke and pressures. Intervals, envelope and faults take all that do.
const RANDOM_CANDIDATES: u64 = 40;
const CANDIDATES_PER_SIGNAL: u64 = 8;
/// Random 10 s runs of which those without a flag calibrate: at least, for each one whose errors are reported (who judges by more runs
/// sees what calibration on few leaves to chance), and at most.
const CALIBRATION_CANDIDATES: u64 = 1024;
const CALIBRATION_PER_SIGNAL: u64 = 40;
const MOST_CALIBRATION_CANDIDATES: u64 = 4096;
/// Added to the study's seed for the calibration runs.
const CALIBRATION_SEED: u64 = 2_000_003;
/// Part of the runs with random payloads from 0 kg on that carry exactly nothing.
const MIXED_EMPTY: f64 = 0.25;
/// Windows of the study in samples: 60 without payload, 100 with.
const WINDOW_STEPS: [usize; 2] = [60, 100];

/// Payload of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum Payload {
    Fixed(f64),
    Range { min: f64, max: f64 },
}

impl Payload {
    pub(super) fn name(self) -> String {
        match self {
            Self::Fixed(kg) => format!("{kg}kg"),
            Self::Range { min, max } => format!("{min}-{max}kg"),
        }
    }

    fn asked(self) -> ValueOrRange {
        match self {
            Self::Fixed(kg) => ValueOrRange::Value(kg),
            Self::Range { min, max } => ValueOrRange::Range { min, max, empty: 0.0 },
        }
    }

    pub(super) fn window_steps(self) -> usize {
        WINDOW_STEPS[usize::from(self != Self::Fixed(0.0))]
    }
}

/// Data sets of one payload and one number of training runs.
pub(super) struct Sets {
    pub(super) payload: Payload,
    /// Training runs, where the study has several numbers of them.
    pub(super) runs: Option<u64>,
    pub(super) folder: PathBuf,
    pub(super) training: Dataset,
    pub(super) calibration: Runs,
    /// Of a fixed payload.
    pub(super) evaluation: Option<Dataset>,
}

impl Sets {
    /// Makes what is not there yet.
    pub(super) fn make(
        args: &Args,
        simulator: &Simulator,
        payload: Payload,
        runs: u64,
    ) -> anyhow::Result<Self> {
        let one_of_several = (args.runs.len() > 1).then_some(runs);
        let machine = simulator.machine();
        let folder = args.out.join(payload.name());
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
        let set = |name: &str, runs| data_set(args, machine, &folder, name, runs);
        let name = one_of_several.map_or_else(|| "training".to_owned(), |runs| format!("training-{runs}"));
        let training = set(&name, training_runs(args, simulator, payload, runs)?)?;
        let spec = job(
            args,
            payload,
            calibration_candidates(args.signals),
            EVALUATION_S,
            CALIBRATION_SEED,
        )?;
        let calibration = set("calibration", planned(args, simulator, payload, &spec)?)?;
        let evaluation = match payload {
            Payload::Fixed(_) => Some(set("evaluation", evaluation_runs(args, simulator, payload)?)?),
            Payload::Range { .. } => None,
        };
        Ok(Self {
            payload,
            runs: one_of_several,
            training,
            calibration: calm_runs(&calibration)?,
            evaluation,
            folder,
        })
    }
}

fn calibration_candidates(signals: u64) -> u64 {
    (CALIBRATION_PER_SIGNAL * signals).clamp(CALIBRATION_CANDIDATES, MOST_CALIBRATION_CANDIDATES)
}

fn job(args: &Args, payload: Payload, runs: u64, duration_s: f64, seed: u64) -> anyhow::Result<JobSpec> {
    let mut spec: JobSpec = serde_json::from_value(serde_json::json!({ "runs": runs }))?;
    spec.seed = args.seed.wrapping_add(seed);
    spec.duration_s = duration_s;
    spec.sample_time_s = SAMPLE_S;
    spec.payload_kg = payload.asked();
    spec.excitation = Excitation::Random;
    Ok(spec)
}

/// Random runs of 1 s: four fifths train, one fifth validates.
fn training_runs(
    args: &Args,
    simulator: &Simulator,
    payload: Payload,
    runs: u64,
) -> anyhow::Result<Vec<RunInput>> {
    let runs = match payload {
        Payload::Fixed(_) => runs,
        Payload::Range { .. } => runs * args.payloads.len() as u64,
    };
    let spec = job(args, payload, runs + runs.div_ceil(4), 1.0, 0)?;
    planned(args, simulator, payload, &spec)
}

/// The job of run `index`: evenly spread runs of a range carry exactly nothing, if asked for. (A job draws its empty runs; a study's small sets
/// get the same part of them in each.)
fn of_run(args: &Args, payload: Payload, spec: &JobSpec, index: u64) -> JobSpec {
    let mut spec = spec.clone();
    if let Payload::Range { min, .. } = payload {
        let part = args
            .mixed_empty
            .unwrap_or(if min == 0.0 { MIXED_EMPTY } else { 0.0 });
        let empty = |runs: u64| (runs as f64 * part).floor();
        if empty(index + 1) > empty(index) {
            spec.payload_kg = ValueOrRange::Value(0.0);
        }
    }
    spec
}

/// Every run of the job.
fn planned(
    args: &Args,
    simulator: &Simulator,
    payload: Payload,
    spec: &JobSpec,
) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    (0..spec.runs)
        .map(|index| {
            Ok(plan_run(
                &of_run(args, payload, spec, index),
                file,
                simulator,
                index,
            )?)
        })
        .collect()
}

/// Run 0 is the published cycle; random signals of the same length follow.
fn evaluation_runs(args: &Args, simulator: &Simulator, payload: Payload) -> anyhow::Result<Vec<RunInput>> {
    let candidates = RANDOM_CANDIDATES.max(CANDIDATES_PER_SIGNAL * args.signals);
    let mut spec = job(args, payload, candidates + 1, EVALUATION_S, args.evaluation_seed)?;
    let mut runs = planned(args, simulator, payload, &spec)?;
    spec.excitation = Excitation::Cycle;
    runs[0] = plan_run(&spec, simulator.machine().file(), simulator, 0)?;
    runs[0].angles_rad = vec![CYCLE_ANGLE_DEG.to_radians(); runs[0].angles_rad.len()];
    Ok(runs)
}

/// The data set of these runs, made unless it is there.
fn data_set(
    args: &Args,
    machine: &Machine,
    folder: &Path,
    name: &str,
    runs: Vec<RunInput>,
) -> anyhow::Result<Dataset> {
    let out = folder.join(name);
    let is_there = out.join("manifest.json").exists();
    if !is_there {
        let table = folder.join(format!("{name}-runs.parquet"));
        run_table::write(&table, machine.file(), &runs)?;
        simulate::run(simulate::Args {
            machine: args.machine.clone(),
            mesh: args.mesh.clone(),
            runs: table,
            out: out.clone(),
            threads: None,
            integrator: args.integrator,
            step_s: None,
            sample_s: SAMPLE_S,
            float32: false,
            json: args.json,
        })?;
    }
    let dataset = super::super::open_dataset(&out)?;
    if is_there {
        let manifest = dataset.manifest();
        let source = DatasetSource::RunTable {
            sha256: hash_of_table(folder, machine, &runs)?,
            integrator: simulate::integrator(args.integrator, None)?,
        };
        ensure!(
            manifest.machine.content_sha256 == hex::encode(machine.content_hash())
                && manifest.source == source,
            "{} was made of other runs, another machine or another integrator than this study asks for: choose \
             another --out, or call as before",
            out.display()
        );
    }
    Ok(dataset)
}

/// Hash of the table of these runs.
fn hash_of_table(folder: &Path, machine: &Machine, runs: &[RunInput]) -> anyhow::Result<String> {
    let table = tempfile::NamedTempFile::new_in(folder)
        .with_context(|| format!("cannot write in {}", folder.display()))?;
    run_table::write(table.path(), machine.file(), runs)?;
    let bytes = std::fs::read(table.path()).context("run table")?;
    Ok(hex::encode(Sha256::digest(&bytes)))
}

/// Evaluation runs by kind, with the noise of the model's training.
pub(super) struct EvaluationParts {
    pub(super) cycle: Runs,
    pub(super) random: Runs,
    pub(super) calm: Runs,
    pub(super) flagged: Runs,
}

pub(super) fn parts_for(
    model: &Model,
    evaluation: &Dataset,
    seed: u64,
    signals: u64,
) -> anyhow::Result<EvaluationParts> {
    let config = model.config();
    let channels = config.inputs.iter().chain(&config.targets);
    let names: Vec<String> = channels.map(|c| c.name.clone()).collect();
    evaluation_parts(&names, evaluation, signals, &|runs| {
        with_noise_of_training(model, runs, seed)
    })
}

/// Runs of `evaluation` with the channels `names` and what `noisy` makes of them.
pub(super) fn evaluation_parts(
    names: &[String],
    evaluation: &Dataset,
    signals: u64,
    noisy: &dyn Fn(&Runs) -> Result<Runs, EvaluateError>,
) -> anyhow::Result<EvaluationParts> {
    let all = noisy(&load_all(evaluation, names)?)?;
    let is_calm = |run_id: u64| evaluation.run(run_id).is_some_and(|row| row.flags.is_empty());
    let part = |chosen: &dyn Fn(u64) -> bool, count: usize| Runs {
        channels: all.channels.clone(),
        sample_time_s: all.sample_time_s,
        runs: all
            .runs
            .iter()
            .filter(|run| chosen(run.run_id))
            .take(count)
            .cloned()
            .collect(),
    };
    let calm = |id| id > 0 && is_calm(id);
    let parts = EvaluationParts {
        cycle: part(&|id| id == 0, 1),
        random: part(&calm, usize::try_from(signals).unwrap_or(usize::MAX)),
        calm: part(&calm, usize::MAX),
        flagged: part(&|id| id > 0 && !is_calm(id), usize::MAX),
    };
    let (found, of) = (parts.calm.runs.len(), evaluation.runs().len().saturating_sub(1));
    ensure!(
        found > 0,
        "none of {of} random runs stays within stroke and pressures"
    );
    ensure!(
        signals <= DEFAULT_SIGNALS || found as u64 >= signals,
        "--signals is {signals}, but only {found} of {of} random runs stay within stroke and pressures"
    );
    Ok(parts)
}
