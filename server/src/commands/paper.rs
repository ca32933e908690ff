//! `hydroflex reproduce-paper`: the published study, made again from nothing.
//!
//! For each payload: a data set of random runs, an evaluation set (the published 10 s cycle and random
//! 10 s runs), the grid of sensors × structures × seeds, and a report. Everything lies below one
//! directory; what is there already is not made again, so a study that was stopped goes on.

mod report;

use super::simulate::{self, IntegratorName, run_table};
use super::{print_json, print_line};
use anyhow::{Context as _, ensure};
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::load_all;
use hydroflex_ml::evaluate::evaluate;
use hydroflex_ml::model::Model;
use hydroflex_ml::runs::Runs;
use hydroflex_ml::train::{Progress, train_dataset};
use hydroflex_openapi::job::{Excitation, JobSpec, TrainingSpec, ValueOrRange, WindowRule};
use hydroflex_openapi::model::EvaluationReport;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::RunInput;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Time between samples of the study, s.
const SAMPLE_S: f64 = 0.005;
/// Length of an evaluation run, s.
const EVALUATION_S: f64 = 10.0;
/// Start of the published evaluation cycle, degrees.
const CYCLE_ANGLE_DEG: f64 = 18.24;
/// Random 10 s runs simulated, so that enough of them stay within stroke and pressures.
const RANDOM_CANDIDATES: u64 = 40;
/// Those evaluated: the first ones without a flag.
const RANDOM_EVALUATED: usize = 5;
/// Added to the study's seed for the evaluation, which shares no run with the training.
const EVALUATION_SEED: u64 = 1_000_003;
/// Windows of the study in samples: 60 without payload, 100 with.
const WINDOW_STEPS: [usize; 2] = [60, 100];

/// Arguments of `hydroflex reproduce-paper`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Directory for data sets, models and the report
    #[arg(long, default_value = "paper-study")]
    pub out: PathBuf,
    /// Built-in machine or machine file
    #[arg(long, default_value = "lift-boom-published")]
    pub machine: String,
    /// Mesh file, or BODY=FILE, for machines whose mesh is not built in; may be repeated
    #[arg(long)]
    pub mesh: Vec<String>,
    /// Payloads in kg, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "0,50,100")]
    pub payloads: Vec<f64>,
    /// Runs for training; a quarter as many more validate
    #[arg(long, default_value_t = 256)]
    pub runs: u64,
    /// Sensor sets, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "all,usp,us")]
    pub sensors: Vec<SensorSet>,
    /// Structures, separated by commas: `best`, L, RLR, TLTLT, TLSLTLSLT, ELE, …
    #[arg(long, value_delimiter = ',', default_value = "best")]
    pub structures: Vec<String>,
    /// Trainings of each cell, seeds 0, 1, …
    #[arg(long, default_value_t = 5)]
    pub seeds: u64,
    /// Targets, separated by commas (default: each vertical deflection, strain and stress)
    #[arg(long, value_delimiter = ',')]
    pub targets: Vec<String>,
    /// Time integration
    #[arg(long, value_enum, default_value_t = IntegratorName::TrapezoidalIndex2)]
    pub integrator: IntegratorName,
    /// Seed of the study's runs
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Largest number of epochs of a training
    #[arg(long)]
    pub epochs: Option<usize>,
    /// Largest time of a training in seconds
    #[arg(long)]
    pub time_limit_s: Option<f64>,
    /// A few minutes instead of hours: one payload, one seed, 64 runs unless given otherwise
    #[arg(long)]
    pub short: bool,
    /// Print machine-readable results
    #[arg(long)]
    pub json: bool,
}

/// Sensors that a network sees, as in the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SensorSet {
    /// Valve, length, velocity and both pressures
    All,
    /// Valve, length and both pressures
    Usp,
    /// Valve, length, velocity and the rod-side pressure
    Usdp2,
    /// Valve, length and velocity
    Usd,
    /// Valve and length
    Us,
}

impl SensorSet {
    /// How the paper writes it.
    fn label(self) -> &'static str {
        match self {
            Self::All => "U s ds p1 p2",
            Self::Usp => "U s p1 p2",
            Self::Usdp2 => "U s ds p2",
            Self::Usd => "U s ds",
            Self::Us => "U s",
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Usp => "usp",
            Self::Usdp2 => "usdp2",
            Self::Usd => "usd",
            Self::Us => "us",
        }
    }

    /// Channels of a data set that belong to it.
    fn channels(self, dataset: &Dataset) -> Vec<String> {
        let wanted: &[fn(&str) -> bool] = match self {
            Self::All => &[is_valve, is_length, is_velocity, is_pressure],
            Self::Usp => &[is_valve, is_length, is_pressure],
            Self::Usdp2 => &[is_valve, is_length, is_velocity, is_rod_pressure],
            Self::Usd => &[is_valve, is_length, is_velocity],
            Self::Us => &[is_valve, is_length],
        };
        dataset
            .channels()
            .iter()
            .map(|channel| channel.name.clone())
            .filter(|name| wanted.iter().any(|is| is(name)))
            .collect()
    }
}

fn is_valve(name: &str) -> bool {
    name.starts_with("valve_")
}
fn is_length(name: &str) -> bool {
    name.starts_with("length_")
}
fn is_velocity(name: &str) -> bool {
    name.starts_with("velocity_")
}
fn is_pressure(name: &str) -> bool {
    name.starts_with("pressure_")
}
fn is_rod_pressure(name: &str) -> bool {
    is_pressure(name) && name.ends_with("_rod_pa")
}

/// One trained network and what it is worth.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Cell {
    payload_kg: f64,
    sensors: SensorSet,
    structure: String,
    seed: u64,
    /// As asked for.
    spec: TrainingSpec,
    window_steps: usize,
    parameters: usize,
    train_seconds: f64,
    /// On the published cycle.
    cycle: EvaluationReport,
    /// On the random 10 s runs.
    random: EvaluationReport,
    /// On the validation runs: short, of the same kind as the training runs.
    validation_mae: Vec<f64>,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason; what was made until then is kept.
pub fn run(mut args: Args) -> anyhow::Result<()> {
    if args.short {
        shorten(&mut args);
    }
    ensure!(args.runs >= 8, "--runs is {}, allowed is 8 or more", args.runs);
    ensure!(args.seeds >= 1, "--seeds is 0, allowed is 1 or more");
    for payload in &args.payloads {
        ensure!(
            payload.is_finite() && *payload >= 0.0,
            "--payloads has {payload}, allowed is 0 or more"
        );
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let simulator = Simulator::new(Machine::load(&args.machine, &args.mesh)?)?;
    let machine = simulator.machine();
    let mut cells = Vec::new();
    for &payload_kg in &args.payloads {
        let folder = args.out.join(format!("{payload_kg}kg"));
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
        let training = data_set(
            &args,
            machine,
            &folder,
            "training",
            training_runs(&args, &simulator, payload_kg)?,
        )?;
        let evaluation = data_set(
            &args,
            machine,
            &folder,
            "evaluation",
            evaluation_runs(&args, &simulator, payload_kg)?,
        )?;
        for &sensors in &args.sensors {
            for structure in &args.structures {
                for seed in 0..args.seeds {
                    let study = Study {
                        args: &args,
                        folder: &folder,
                        training: &training,
                        evaluation: &evaluation,
                        payload_kg,
                    };
                    cells.push(study.cell(sensors, structure, seed)?);
                }
            }
        }
    }
    let text = report::markdown(&args, &machine.file().name, &cells);
    let path = args.out.join("report.md");
    std::fs::write(&path, &text).with_context(|| format!("cannot write {}", path.display()))?;
    if args.json {
        return print_json(&cells);
    }
    print_line(format_args!("{text}\nreport: {}", path.display()))
}

/// What `--short` stands for; whatever was given differently stays.
fn shorten(args: &mut Args) {
    args.payloads.truncate(1);
    args.seeds = 1;
    args.runs = args.runs.min(64);
    args.time_limit_s = args.time_limit_s.or(Some(10.0));
}

fn job(args: &Args, payload_kg: f64, runs: u64, duration_s: f64, seed: u64) -> anyhow::Result<JobSpec> {
    let mut spec: JobSpec = serde_json::from_value(serde_json::json!({ "runs": runs }))?;
    spec.seed = args.seed.wrapping_add(seed);
    spec.duration_s = duration_s;
    spec.sample_time_s = SAMPLE_S;
    spec.payload_kg = ValueOrRange::Value(payload_kg);
    spec.excitation = Excitation::Random;
    Ok(spec)
}

/// Random runs of 1 s: four fifths train, one fifth validates.
fn training_runs(args: &Args, simulator: &Simulator, payload_kg: f64) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    let count = args.runs + args.runs.div_ceil(4);
    let spec = job(args, payload_kg, count, 1.0, 0)?;
    (0..count)
        .map(|index| Ok(plan_run(&spec, file, simulator, index)?))
        .collect()
}

/// Run 0 is the published cycle; random signals of the same length follow.
fn evaluation_runs(args: &Args, simulator: &Simulator, payload_kg: f64) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    let mut spec = job(
        args,
        payload_kg,
        RANDOM_CANDIDATES + 1,
        EVALUATION_S,
        EVALUATION_SEED,
    )?;
    let mut runs: Vec<RunInput> = (0..=RANDOM_CANDIDATES)
        .map(|index| Ok(plan_run(&spec, file, simulator, index)?))
        .collect::<anyhow::Result<_>>()?;
    spec.excitation = Excitation::Cycle;
    runs[0] = plan_run(&spec, file, simulator, 0)?;
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
    if !out.join("manifest.json").exists() {
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
    let dataset = Dataset::open(&out).with_context(|| format!("cannot open {}", out.display()))?;
    let found = dataset.runs().len();
    ensure!(
        found == runs.len(),
        "{} has {found} runs, this study needs {}: choose another --out",
        out.display(),
        runs.len()
    );
    Ok(dataset)
}

/// What the trainings of one payload share.
struct Study<'a> {
    args: &'a Args,
    folder: &'a Path,
    training: &'a Dataset,
    evaluation: &'a Dataset,
    payload_kg: f64,
}

impl Study<'_> {
    fn cell(&self, sensors: SensorSet, structure: &str, seed: u64) -> anyhow::Result<Cell> {
        let steps = WINDOW_STEPS[usize::from(self.payload_kg > 0.0)];
        let spec = TrainingSpec {
            structure: structure.to_owned(),
            inputs: sensors.channels(self.training),
            targets: self.args.targets.clone(),
            window: WindowRule::Given {
                window_s: steps as f64 * SAMPLE_S,
            },
            seed,
            epochs: self.args.epochs,
            time_limit_s: self.args.time_limit_s,
            ..TrainingSpec::default()
        };
        let name = format!("{}-{structure}-{seed}", sensors.name());
        let path = self.folder.join(format!("{name}.json"));
        if let Some(cell) = finished(&path, self.training, &spec) {
            return Ok(cell);
        }
        let model_dir = self.folder.join(&name);
        let checkpoint = self.folder.join(format!(".{name}.checkpoint"));
        let bar = super::train::training_bar(self.args.json);
        let mut progress = |progress: Progress| {
            super::train::show(&bar, &progress);
            ControlFlow::Continue(())
        };
        let summary = train_dataset(self.training, &spec, &mut progress, &checkpoint, &model_dir);
        bar.finish_and_clear();
        let summary = summary.with_context(|| format!("cannot train {name} at {} kg", self.payload_kg))?;
        // Only an empty directory is removed: whatever else is in it is not ours.
        let _ = std::fs::remove_dir(&checkpoint);
        let model = Model::load(&model_dir)?;
        let (cycle, random) = self.evaluation_runs(&model)?;
        let sha256 = self.evaluation.dataset_sha256();
        let cell = Cell {
            payload_kg: self.payload_kg,
            sensors,
            structure: structure.to_owned(),
            seed,
            spec,
            window_steps: steps,
            parameters: summary.parameters,
            train_seconds: summary.train_seconds,
            cycle: evaluate(&model, &cycle, sha256)?.report,
            random: evaluate(&model, &random, sha256)?.report,
            validation_mae: summary.validation.iter().map(|m| m.mae).collect(),
        };
        std::fs::write(&path, serde_json::to_vec_pretty(&cell)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        if !self.args.json {
            print_line(format_args!("{}", report::line(&cell)))?;
        }
        Ok(cell)
    }

    /// The cycle, and the first random runs within stroke and pressures.
    fn evaluation_runs(&self, model: &Model) -> anyhow::Result<(Runs, Runs)> {
        let config = model.config();
        let channels = config.inputs.iter().chain(&config.targets);
        let names: Vec<String> = channels.map(|c| c.name.clone()).collect();
        let all = load_all(self.evaluation, &names)?;
        let calm = |run_id: u64| {
            self.evaluation
                .run(run_id)
                .is_some_and(|row| row.flags.is_empty())
        };
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
        let random = part(&|id| id > 0 && calm(id), RANDOM_EVALUATED);
        ensure!(
            !random.runs.is_empty(),
            "none of {RANDOM_CANDIDATES} random runs at {} kg stays within stroke and pressures",
            self.payload_kg
        );
        Ok((part(&|id| id == 0, 1), random))
    }
}

/// A cell of an earlier call, if it belongs to this data set and was asked for in the same way.
fn finished(path: &Path, training: &Dataset, spec: &TrainingSpec) -> Option<Cell> {
    let model = Model::load(&path.with_extension("")).ok()?;
    let same = model.config().provenance.dataset_sha256 == training.dataset_sha256();
    let cell: Cell = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    (same && cell.spec == *spec && cell.cycle.model_sha256 == model.sha256()).then_some(cell)
}
