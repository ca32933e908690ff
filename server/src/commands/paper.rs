//! `hydroflex reproduce-paper`: the published study, made again from nothing.
//!
//! For each payload: a data set of random runs, a calibration set (random 10 s runs), an evaluation set (the published
//! 10 s cycle and other random 10 s runs), the grid of sensors × structures × noise × seeds, and a report; with `--mixed`
//! also networks for payloads that they are not told. Everything lies below one
//! directory; what is there already is not made again, so a study that was stopped goes on.

mod report;

use super::simulate::{self, IntegratorName, run_table};
use super::{print_json, print_line};
use anyhow::{Context as _, ensure};
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::load_all;
use hydroflex_ml::evaluate::faults::fault_rates;
use hydroflex_ml::evaluate::{EvaluateError, evaluate, with_noise_of_training};
use hydroflex_ml::model::Model;
use hydroflex_ml::plot::profile;
use hydroflex_ml::runs::Runs;
use hydroflex_ml::structure::Structure;
use hydroflex_ml::train::comparison::Comparison;
use hydroflex_ml::train::{Progress, train_dataset};
use hydroflex_openapi::job::{
    Excitation, JobSpec, NoiseLevel, NoiseSpec, TrainingSpec, ValueOrRange, WindowCut, WindowRule,
};
use hydroflex_openapi::model::{EvaluationReport, FaultRate};
use hydroflex_openapi::sweep;
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
/// Random 10 s runs simulated, at least and for each one whose errors are reported, so that enough of them stay
/// within stroke and pressures. Intervals, envelope and faults take all that do.
const RANDOM_CANDIDATES: u64 = 40;
const CANDIDATES_PER_SIGNAL: u64 = 8;
/// Signals whose errors are reported by default.
const DEFAULT_SIGNALS: u64 = 5;
/// Random 10 s runs of which those without a flag calibrate.
const CALIBRATION_CANDIDATES: u64 = 128;
/// Added to the study's seed for the calibration runs.
const CALIBRATION_SEED: u64 = 2_000_003;
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
    /// How the paper's letters are trained, separated by commas: `ours`, `published` (disjoint windows, learning rate
    /// 1e-4, a batch of an eighth of the runs, at most 1,000 epochs); other structures always as we do
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ours")]
    pub recipes: Vec<Recipe>,
    /// Structures, separated by commas: `best`, L, RLR, TLTLT, TLSLTLSLT, ELE, …; for comparison RNN, LSTM, CNN
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
    /// Added to the seed for the evaluation, which shares no run with the training; another one judges anew
    #[arg(long, default_value_t = 1_000_003)]
    pub evaluation_seed: u64,
    /// Random 10 s signals whose errors are reported: the first ones that stay within stroke and pressures
    #[arg(long, default_value_t = DEFAULT_SIGNALS, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub signals: u64,
    /// Sensor noise to train and evaluate with, separated by commas: `none`, `crane`
    #[arg(long, value_enum, value_delimiter = ',', default_value = "none")]
    pub noise: Vec<NoiseChoice>,
    /// Also train networks on random payloads over the range of --payloads, as many runs as all payloads together
    #[arg(long)]
    pub mixed: bool,
    /// Part of these runs that carry exactly nothing, where the machine has other modes than with the smallest payload
    #[arg(long, default_value_t = 0.0, requires = "mixed")]
    pub mixed_empty: f64,
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

/// Noise to study.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseChoice {
    /// None, as in the paper
    None,
    /// As measured on a crane
    Crane,
}

impl NoiseChoice {
    fn spec(self) -> Option<NoiseSpec> {
        match self {
            Self::None => None,
            Self::Crane => Some(NoiseSpec::Level(NoiseLevel::Crane)),
        }
    }
}

/// How a network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recipe {
    /// All overlapping windows, a learning rate that falls to zero
    #[default]
    Ours,
    /// As in the published scripts
    Published,
}

impl Recipe {
    /// Whether a structure is trained in this way: the published way belongs to the paper's letters.
    fn applies_to(self, structure: &str) -> bool {
        self == Self::Ours || !(structure == "best" || Structure::is_comparison(structure))
    }

    fn windows(self) -> WindowCut {
        match self {
            Self::Ours => WindowCut::Overlapping,
            Self::Published => WindowCut::Disjoint,
        }
    }
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
    fn set(self) -> sweep::SensorSet {
        match self {
            Self::All => sweep::SensorSet::All,
            Self::Usp => sweep::SensorSet::Usp,
            Self::Usdp2 => sweep::SensorSet::Usdp2,
            Self::Usd => sweep::SensorSet::Usd,
            Self::Us => sweep::SensorSet::Us,
        }
    }

    /// How the paper writes it.
    fn label(self) -> &'static str {
        self.set().label()
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
        dataset
            .channels()
            .iter()
            .map(|channel| channel.name.clone())
            .filter(|name| self.set().has(name))
            .collect()
    }
}

fn default_signals() -> u64 {
    DEFAULT_SIGNALS
}

/// One trained network and what it is worth on one payload.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Cell {
    /// Of the evaluation.
    payload_kg: f64,
    /// Random signals asked for.
    #[serde(default = "default_signals")]
    signals: u64,
    /// Of the training runs.
    trained: Payload,
    sensors: SensorSet,
    structure: String,
    #[serde(default)]
    recipe: Recipe,
    noise: NoiseChoice,
    seed: u64,
    /// As asked for.
    spec: TrainingSpec,
    window_steps: usize,
    parameters: usize,
    train_seconds: f64,
    /// On the published cycle.
    cycle: EvaluationReport,
    /// On the first random 10 s runs.
    random: EvaluationReport,
    /// On all random 10 s runs without a flag: intervals and envelope.
    calm: EvaluationReport,
    /// On all random 10 s runs with a flag: end stops, cavitation.
    flagged: Option<EvaluationReport>,
    /// Stuck and swapped sensors in the runs of `calm`.
    faults: Vec<FaultRate>,
    /// Part of the windows flagged of the other payloads' random runs without a flag.
    other_payloads: Vec<(f64, f64)>,
    /// On the validation runs: short, of the same kind as the training runs.
    validation_mae: Vec<f64>,
    /// Hash of the training data, where no model folder says it: of networks for comparison.
    #[serde(default)]
    trained_on: Option<String>,
}

/// Payload of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
enum Payload {
    Fixed(f64),
    Range { min: f64, max: f64 },
}

impl Payload {
    fn name(self) -> String {
        match self {
            Self::Fixed(kg) => format!("{kg}kg"),
            Self::Range { min, max } => format!("{min}-{max}kg"),
        }
    }

    fn asked(self) -> ValueOrRange {
        match self {
            Self::Fixed(kg) => ValueOrRange::Value(kg),
            Self::Range { min, max } => ValueOrRange::Range { min, max },
        }
    }

    fn window_steps(self) -> usize {
        WINDOW_STEPS[usize::from(self != Self::Fixed(0.0))]
    }
}

/// Data sets of one payload.
struct Sets {
    payload: Payload,
    folder: PathBuf,
    training: Dataset,
    calibration: Runs,
    /// Of a fixed payload.
    evaluation: Option<Dataset>,
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
    ensure!(
        (0.0..1.0).contains(&args.mixed_empty),
        "--mixed-empty is {}, allowed is 0 or more, below 1",
        args.mixed_empty
    );
    ensure!(args.seeds >= 1, "--seeds is 0, allowed is 1 or more");
    for payload in &args.payloads {
        ensure!(
            payload.is_finite() && *payload >= 0.0,
            "--payloads has {payload}, allowed is 0 or more"
        );
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let simulator = Simulator::new(Machine::load(&args.machine, &args.mesh)?)?;
    let mut payloads: Vec<Payload> = args.payloads.iter().map(|&kg| Payload::Fixed(kg)).collect();
    if args.mixed {
        payloads.push(Payload::Range {
            min: args.payloads.iter().copied().fold(f64::INFINITY, f64::min),
            max: args.payloads.iter().copied().fold(0.0, f64::max),
        });
    }
    let sets = payloads
        .into_iter()
        .map(|payload| make_sets(&args, &simulator, payload))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut cells = Vec::new();
    for trained in &sets {
        for &sensors in &args.sensors {
            for structure in &args.structures {
                let recipes = args.recipes.iter().filter(|recipe| recipe.applies_to(structure));
                for (&recipe, &noise) in recipes.flat_map(|r| args.noise.iter().map(move |n| (r, n))) {
                    for seed in 0..args.seeds {
                        let study = Study {
                            args: &args,
                            sets: &sets,
                            trained,
                        };
                        cells.extend(study.cells(sensors, structure, recipe, noise, seed)?);
                    }
                }
            }
        }
    }
    // Seeds of a cell side by side.
    cells.sort_by(|a, b| {
        let key = |c: &Cell| (c.trained.name(), c.payload_kg.to_bits());
        let position = |c: &Cell| sets.iter().position(|set| set.payload == c.trained);
        position(a).cmp(&position(b)).then_with(|| key(a).cmp(&key(b)))
    });
    let text = report::markdown(&args, &simulator.machine().file().name, &cells);
    let path = args.out.join("report.md");
    std::fs::write(&path, &text).with_context(|| format!("cannot write {}", path.display()))?;
    let picture = args.out.join("report.svg");
    std::fs::write(&picture, report::picture(&cells).to_svg())
        .with_context(|| format!("cannot write {}", picture.display()))?;
    if args.json {
        return print_json(&cells);
    }
    print_line(format_args!(
        "{text}\nreport: {}, picture: {}",
        path.display(),
        picture.display()
    ))
}

/// What `--short` stands for; whatever was given differently stays.
fn shorten(args: &mut Args) {
    args.payloads.truncate(1);
    args.seeds = 1;
    args.runs = args.runs.min(64);
    args.time_limit_s = args.time_limit_s.or(Some(10.0));
}

fn make_sets(args: &Args, simulator: &Simulator, payload: Payload) -> anyhow::Result<Sets> {
    let machine = simulator.machine();
    let folder = args.out.join(payload.name());
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let set = |name: &str, runs| data_set(args, machine, &folder, name, runs);
    let training = set("training", training_runs(args, simulator, payload)?)?;
    let calibration = set(
        "calibration",
        random_runs(args, simulator, payload, CALIBRATION_CANDIDATES, CALIBRATION_SEED)?,
    )?;
    let evaluation = match payload {
        Payload::Fixed(_) => Some(set("evaluation", evaluation_runs(args, simulator, payload)?)?),
        Payload::Range { .. } => None,
    };
    Ok(Sets {
        payload,
        training,
        calibration: super::train::calm_runs(&calibration)?,
        evaluation,
        folder,
    })
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
fn training_runs(args: &Args, simulator: &Simulator, payload: Payload) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    let runs = match payload {
        Payload::Fixed(_) => args.runs,
        Payload::Range { .. } => args.runs * args.payloads.len() as u64,
    };
    let count = runs + runs.div_ceil(4);
    let spec = job(args, payload, count, 1.0, 0)?;
    (0..count)
        .map(|index| {
            Ok(plan_run(
                &of_run(args, payload, &spec, index),
                file,
                simulator,
                index,
            )?)
        })
        .collect()
}

/// The job of run `index`: evenly spread runs of a range carry exactly nothing, if asked for.
fn of_run(args: &Args, payload: Payload, spec: &JobSpec, index: u64) -> JobSpec {
    let empty = |runs: u64| (runs as f64 * args.mixed_empty).floor();
    let mut spec = spec.clone();
    if matches!(payload, Payload::Range { .. }) && empty(index + 1) > empty(index) {
        spec.payload_kg = ValueOrRange::Value(0.0);
    }
    spec
}

/// Random runs of 10 s.
fn random_runs(
    args: &Args,
    simulator: &Simulator,
    payload: Payload,
    count: u64,
    seed: u64,
) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    let spec = job(args, payload, count, EVALUATION_S, seed)?;
    (0..count)
        .map(|index| {
            Ok(plan_run(
                &of_run(args, payload, &spec, index),
                file,
                simulator,
                index,
            )?)
        })
        .collect()
}

/// Random runs simulated for the evaluation.
fn candidates(args: &Args) -> u64 {
    RANDOM_CANDIDATES.max(CANDIDATES_PER_SIGNAL * args.signals)
}

/// Run 0 is the published cycle; random signals of the same length follow.
fn evaluation_runs(args: &Args, simulator: &Simulator, payload: Payload) -> anyhow::Result<Vec<RunInput>> {
    let file = simulator.machine().file();
    let mut spec = job(
        args,
        payload,
        candidates(args) + 1,
        EVALUATION_S,
        args.evaluation_seed,
    )?;
    let mut runs = random_runs(
        args,
        simulator,
        payload,
        candidates(args) + 1,
        args.evaluation_seed,
    )?;
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

/// A network for comparison as it was asked for.
struct Asked {
    sensors: SensorSet,
    noise: NoiseChoice,
    spec: TrainingSpec,
    name: String,
}

/// What the trainings on one data set share.
struct Study<'a> {
    args: &'a Args,
    sets: &'a [Sets],
    trained: &'a Sets,
}

impl Study<'_> {
    /// One network; a cell per payload that it is evaluated on: its own, or all of those in its range.
    fn cells(
        &self,
        sensors: SensorSet,
        structure: &str,
        recipe: Recipe,
        noise: NoiseChoice,
        seed: u64,
    ) -> anyhow::Result<Vec<Cell>> {
        let Sets {
            payload,
            folder,
            training,
            calibration,
            ..
        } = self.trained;
        let steps = payload.window_steps();
        let spec = TrainingSpec {
            structure: structure.to_owned(),
            inputs: sensors.channels(training),
            targets: self.args.targets.clone(),
            window: WindowRule::Given {
                window_s: steps as f64 * SAMPLE_S,
            },
            seed,
            // The published length belongs to the published way.
            epochs: self.args.epochs.filter(|_| recipe == Recipe::Ours),
            time_limit_s: self.args.time_limit_s,
            noise: noise.spec(),
            windows: recipe.windows(),
            ..TrainingSpec::default()
        };
        let name = cell_name(sensors, structure, recipe, noise, seed);
        let path = folder.join(format!("{name}.json"));
        let evaluated = self.evaluated();
        if Structure::is_comparison(structure) {
            let asked = Asked {
                sensors,
                noise,
                spec,
                name,
            };
            return self.comparison(asked, &evaluated);
        }
        if let Some(cells) = finished(&path, training, &spec, &evaluated, self.args.signals) {
            return Ok(cells);
        }
        let model_dir = folder.join(&name);
        let checkpoint = folder.join(format!(".{name}.checkpoint"));
        let bar = super::train::training_bar(self.args.json);
        let mut progress = |progress: Progress| {
            super::train::show(&bar, &progress);
            ControlFlow::Continue(())
        };
        let summary = train_dataset(
            training,
            &spec,
            Some(calibration),
            &mut progress,
            &checkpoint,
            &model_dir,
        );
        bar.finish_and_clear();
        let summary = summary.with_context(|| format!("cannot train {name} at {}", payload.name()))?;
        // Only an empty directory is removed: whatever else is in it is not ours.
        let _ = std::fs::remove_dir(&checkpoint);
        let model = Model::load(&model_dir)?;
        let mut cells = Vec::new();
        for (payload_kg, evaluation) in evaluated {
            let runs = parts_for(&model, evaluation, seed, self.args.signals)
                .with_context(|| format!("cannot evaluate {name} at {payload_kg} kg"))?;
            let sha256 = evaluation.dataset_sha256();
            let report = |runs: &Runs| anyhow::Ok(evaluate(&model, runs, sha256)?.report);
            let picture = folder.join(format!("{name}-at-{payload_kg}-kg.svg"));
            let title = format!("{name} at {payload_kg} kg");
            let random = evaluate_and_draw(&model, &runs.random, sha256, &picture, &title)?;
            let cell = Cell {
                payload_kg,
                signals: self.args.signals,
                trained: *payload,
                sensors,
                structure: structure.to_owned(),
                recipe,
                noise,
                seed,
                spec: spec.clone(),
                window_steps: steps,
                parameters: summary.parameters,
                train_seconds: summary.train_seconds,
                cycle: report(&runs.cycle)?,
                random,
                calm: report(&runs.calm)?,
                flagged: (!runs.flagged.runs.is_empty())
                    .then(|| report(&runs.flagged))
                    .transpose()?,
                faults: fault_rates(&model, &runs.calm)?,
                other_payloads: self.other_payloads(&model, seed)?,
                validation_mae: summary.validation.iter().map(|m| m.mae).collect(),
                trained_on: None,
            };
            if !self.args.json {
                print_line(format_args!("{}", report::line(&cell)))?;
            }
            cells.push(cell);
        }
        std::fs::write(&path, serde_json::to_vec_pretty(&cells)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(cells)
    }

    /// The evaluation sets of the payloads that the trained network is for.
    fn evaluated(&self) -> Vec<(f64, &Dataset)> {
        let payload = self.trained.payload;
        self.sets
            .iter()
            .filter_map(|set| match (set.payload, &set.evaluation) {
                (Payload::Fixed(kg), Some(evaluation)) => Some((kg, evaluation)),
                _ => None,
            })
            .filter(|(kg, _)| match payload {
                Payload::Fixed(own) => own.to_bits() == kg.to_bits(),
                Payload::Range { .. } => true,
            })
            .collect()
    }

    /// The same for a network for comparison, which has no folder, intervals or envelope.
    fn comparison(&self, asked: Asked, evaluated: &[(f64, &Dataset)]) -> anyhow::Result<Vec<Cell>> {
        let Sets {
            payload,
            folder,
            training,
            ..
        } = self.trained;
        let Asked {
            sensors,
            noise,
            spec,
            name,
        } = asked;
        let path = folder.join(format!("{name}.json"));
        if let Some(cells) = compared(&path, training, &spec, evaluated, self.args.signals) {
            return Ok(cells);
        }
        let bar = super::train::training_bar(self.args.json);
        let mut progress = |progress: Progress| {
            super::train::show(&bar, &progress);
            ControlFlow::Continue(())
        };
        let checkpoint = folder.join(format!(".{name}.checkpoint"));
        let network = Comparison::train_dataset(training, &spec, &mut progress, &checkpoint);
        bar.finish_and_clear();
        let network = network.with_context(|| format!("cannot train {name} at {}", payload.name()))?;
        // Only an empty directory is removed: whatever else is in it is not ours.
        let _ = std::fs::remove_dir(&checkpoint);
        let mut cells = Vec::new();
        for &(payload_kg, evaluation) in evaluated {
            let noisy = |runs: &Runs| network.with_noise_of_training(runs, spec.seed);
            let runs = evaluation_parts(&network.channels(), evaluation, self.args.signals, &noisy)
                .with_context(|| format!("cannot evaluate {name} at {payload_kg} kg"))?;
            let report = |runs: &Runs| network.evaluate(runs, evaluation.dataset_sha256());
            let cell = Cell {
                payload_kg,
                signals: self.args.signals,
                trained: *payload,
                sensors,
                structure: spec.structure.clone(),
                recipe: Recipe::Ours,
                noise,
                seed: spec.seed,
                spec: spec.clone(),
                window_steps: payload.window_steps(),
                parameters: network.parameters(),
                train_seconds: network.train_seconds,
                cycle: report(&runs.cycle)?,
                random: report(&runs.random)?,
                calm: report(&runs.calm)?,
                flagged: None,
                faults: Vec::new(),
                other_payloads: Vec::new(),
                validation_mae: Vec::new(),
                trained_on: Some(training.dataset_sha256().to_owned()),
            };
            if !self.args.json {
                print_line(format_args!("{}", report::line(&cell)))?;
            }
            cells.push(cell);
        }
        std::fs::write(&path, serde_json::to_vec_pretty(&cells)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(cells)
    }

    /// Part of the windows outside the envelope, by payload, of the payloads that the model was not trained on.
    fn other_payloads(&self, model: &Model, seed: u64) -> anyhow::Result<Vec<(f64, f64)>> {
        let Payload::Fixed(own) = self.trained.payload else {
            return Ok(Vec::new());
        };
        let mut parts = Vec::new();
        for set in self.sets {
            if let (Payload::Fixed(kg), Some(evaluation)) = (set.payload, &set.evaluation)
                && kg.to_bits() != own.to_bits()
            {
                let runs = parts_for(model, evaluation, seed, self.args.signals)?.calm;
                let inside = evaluate(model, &runs, evaluation.dataset_sha256())?
                    .report
                    .inside_envelope;
                parts.extend(inside.map(|inside| (kg, 1.0 - inside)));
            }
        }
        Ok(parts)
    }
}

/// Evaluation runs by kind, with the noise of the model's training.
struct EvaluationParts {
    cycle: Runs,
    random: Runs,
    calm: Runs,
    flagged: Runs,
}

fn parts_for(
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
fn evaluation_parts(
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

/// Name of a network's files.
fn cell_name(sensors: SensorSet, structure: &str, recipe: Recipe, noise: NoiseChoice, seed: u64) -> String {
    let noisy = if noise == NoiseChoice::Crane { "-crane" } else { "" };
    let published = if recipe == Recipe::Published {
        "-published"
    } else {
        ""
    };
    format!("{}-{structure}{published}{noisy}-{seed}", sensors.name())
}

/// Errors on `runs`, and a picture of where they stand.
fn evaluate_and_draw(
    model: &Model,
    runs: &Runs,
    dataset_sha256: &str,
    picture: &Path,
    title: &str,
) -> anyhow::Result<EvaluationReport> {
    let evaluation = evaluate(model, runs, dataset_sha256)?;
    std::fs::write(picture, profile::of_target(model, &evaluation, 0, title))
        .with_context(|| format!("cannot write {}", picture.display()))?;
    Ok(evaluation.report)
}

/// As [`finished`], for networks for comparison.
fn compared(
    path: &Path,
    training: &Dataset,
    spec: &TrainingSpec,
    evaluated: &[(f64, &Dataset)],
    signals: u64,
) -> Option<Vec<Cell>> {
    let cells: Vec<Cell> = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    let matches = |(cell, (kg, evaluation)): (&Cell, &(f64, &Dataset))| {
        cell.payload_kg.to_bits() == kg.to_bits()
            && cell.spec == *spec
            && cell.signals == signals
            && cell.trained_on.as_deref() == Some(training.dataset_sha256())
            && cell.cycle.dataset_sha256 == evaluation.dataset_sha256()
    };
    (cells.len() == evaluated.len() && cells.iter().zip(evaluated).all(matches)).then_some(cells)
}

/// Cells of an earlier call, if they belong to these data sets and were asked for in the same way.
fn finished(
    path: &Path,
    training: &Dataset,
    spec: &TrainingSpec,
    evaluated: &[(f64, &Dataset)],
    signals: u64,
) -> Option<Vec<Cell>> {
    let model = Model::load(&path.with_extension("")).ok()?;
    let same = model.config().provenance.dataset_sha256 == training.dataset_sha256();
    let cells: Vec<Cell> = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
    let matches = |(cell, (kg, evaluation)): (&Cell, &(f64, &Dataset))| {
        cell.payload_kg.to_bits() == kg.to_bits()
            && cell.spec == *spec
            && cell.signals == signals
            && cell.cycle.model_sha256 == model.sha256()
            && cell.cycle.dataset_sha256 == evaluation.dataset_sha256()
    };
    (same && cells.len() == evaluated.len() && cells.iter().zip(evaluated).all(matches)).then_some(cells)
}
