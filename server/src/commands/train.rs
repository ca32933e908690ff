//! `hydroflex train`: a network from a data set on disk.

use crate::calibration;
use crate::coordinator::machines::CheckedMachine;
use anyhow::{Context as _, bail};
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::load_all;
use hydroflex_ml::evaluate::table::table;
use hydroflex_ml::model::write::{Place, place};
use hydroflex_ml::runs::Runs;
use hydroflex_ml::train::{Progress, train_dataset};
use hydroflex_openapi::dataset::DatasetSource;
use hydroflex_openapi::job::{NoiseLevel, NoiseSpec, TrainingSpec, WindowCut, WindowRule};
use hydroflex_openapi::model::{BaselineMetrics, EvaluationReport, ModelSummary};
use indicatif::{ProgressBar, ProgressStyle};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Arguments of `hydroflex train`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Directory to write the model to, absent or empty
    #[arg(long)]
    pub out: PathBuf,
    /// Replace the model that is in that directory
    #[arg(long)]
    pub replace: bool,
    /// `best`, or the letters of the paper: L, RLR, TLTLT, TLSLTLSLT, ELE, …, RDLR (with dropout)
    #[arg(long, default_value = "best")]
    pub structure: String,
    /// Input channels, separated by commas
    #[arg(long, value_delimiter = ',')]
    pub inputs: Vec<String>,
    /// Target channels, separated by commas
    #[arg(long, value_delimiter = ',')]
    pub targets: Vec<String>,
    /// Window length in seconds (default: from the data set)
    #[arg(long)]
    pub window_s: Option<f64>,
    /// Seed of initial weights and batches
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Samples that the network estimates at once, the last ones of its window (10, 15, 30 in the paper; default: one)
    #[arg(long)]
    pub output_steps: Option<usize>,
    /// Width of the hidden layers, or a multiple of the number of window steps, as 2w (default: 1w)
    #[arg(long, value_parser = parse_width)]
    pub width: Option<Width>,
    /// Part of a layer's values that dropout (letter D) leaves out in training (default: 0.1)
    #[arg(long)]
    pub dropout: Option<f64>,
    /// Which windows of a run are trained on: `overlapping`, or `disjoint` as published
    #[arg(long, value_parser = parse_windows, default_value = "overlapping")]
    pub windows: WindowCut,
    /// Windows per batch
    #[arg(long)]
    pub batch: Option<usize>,
    /// Adam's learning rate at the start
    #[arg(long)]
    pub learning_rate: Option<f64>,
    /// Largest number of epochs
    #[arg(long)]
    pub epochs: Option<usize>,
    /// Largest training time in seconds
    #[arg(long)]
    pub time_limit_s: Option<f64>,
    /// Sensor noise to train for: `crane` (0.49 mm, 11.7 kPa, one bit of twelve), or COLUMN=STANDARD_DEVIATION, separated
    /// by commas
    #[arg(long, value_parser = parse_noise)]
    pub noise: Option<NoiseSpec>,
    /// Data set directory of long runs on which intervals and envelope are calibrated, runs without a flag only
    /// (default: runs of 10 s simulated from the data set's job)
    #[arg(long)]
    pub calibration: Option<PathBuf>,
    /// Mesh file that was uploaded for the data set's job; may be repeated
    #[arg(long)]
    pub mesh: Vec<PathBuf>,
    /// Print a machine-readable summary
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    if place(&args.out)? == Place::Model && !args.replace {
        bail!(
            "--out {} holds a model; --replace replaces it",
            args.out.display()
        );
    }
    let dataset = super::open_dataset(&args.data)?;
    let spec = TrainingSpec {
        structure: args.structure,
        inputs: args.inputs,
        targets: args.targets,
        window: args
            .window_s
            .map_or_else(WindowRule::default, |window_s| WindowRule::Given { window_s }),
        seed: args.seed,
        output_steps: args.output_steps,
        width: match args.width {
            Some(Width::Values(width)) => Some(width),
            _ => None,
        },
        width_windows: match args.width {
            Some(Width::Windows(times)) => Some(times),
            _ => None,
        },
        dropout: args.dropout,
        windows: args.windows,
        batch: args.batch,
        learning_rate: args.learning_rate,
        epochs: args.epochs,
        time_limit_s: args.time_limit_s,
        noise: args.noise,
    };
    let long = match &args.calibration {
        Some(path) => Some(calm_runs(&super::open_dataset(path)?)?),
        None => simulated(&dataset, &args.mesh),
    };
    if follows_payload(&dataset, &spec) {
        eprintln!(
            "note: the payload differs between the runs; fitting how the coefficients follow it comes before the first epoch and \
             takes seconds to minutes"
        );
    }
    let bar = training_bar(args.json);
    let mut progress = |progress: Progress| {
        show(&bar, &progress);
        ControlFlow::Continue(())
    };
    let checkpoint = checkpoint_dir(&args.out);
    let result = train_dataset(
        &dataset,
        &spec,
        long.as_ref(),
        &mut progress,
        &checkpoint,
        &args.out,
    );
    bar.finish_and_clear();
    let summary = result.with_context(|| format!("cannot train on {}", args.data.display()))?;
    // Only an empty directory is removed: whatever else is in it is not ours.
    let _ = std::fs::remove_dir(&checkpoint);
    if args.json {
        return super::print_json(&summary);
    }
    super::print_line(format_args!("{}", describe(&summary, &args.out)))
}

/// Whether our network's linear part may follow a payload that differs between the runs, see [`hydroflex_ml::payload`].
fn follows_payload(dataset: &Dataset, spec: &TrainingSpec) -> bool {
    let mut payloads = dataset.runs().iter().map(|run| run.payload_kg);
    let first = payloads.next();
    spec.structure == "best" && spec.noise.is_none() && payloads.any(|kg| Some(kg) != first)
}

/// Width of the hidden layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Width {
    /// Given.
    Values(usize),
    /// So many times the number of window steps.
    Windows(usize),
}

fn parse_width(text: &str) -> Result<Width, String> {
    let parsed = match text.strip_suffix('w') {
        Some(times) => times.parse().map(Width::Windows),
        None => text.parse().map(Width::Values),
    };
    parsed.map_err(|_| "allowed are a number of values, such as 200, or of windows, such as 2w".to_owned())
}

fn parse_windows(text: &str) -> Result<WindowCut, String> {
    match text {
        "overlapping" => Ok(WindowCut::Overlapping),
        "disjoint" => Ok(WindowCut::Disjoint),
        _ => Err("allowed are overlapping and disjoint".to_owned()),
    }
}

/// `crane`, or `COLUMN=VALUE,COLUMN=VALUE`.
pub(crate) fn parse_noise(text: &str) -> Result<NoiseSpec, String> {
    if text == "crane" {
        return Ok(NoiseSpec::Level(NoiseLevel::Crane));
    }
    text.split(',')
        .map(|part| {
            let (name, value) = part.split_once('=').ok_or_else(|| {
                format!("{part:?} is neither a level (crane) nor COLUMN=STANDARD_DEVIATION")
            })?;
            let value = value
                .parse()
                .map_err(|_| format!("{value:?} is not a standard deviation"))?;
            Ok((name.to_owned(), value))
        })
        .collect::<Result<_, _>>()
        .map(NoiseSpec::Channels)
}

/// Runs of a data set without a flag, all channels.
pub(crate) fn calm_runs(dataset: &Dataset) -> anyhow::Result<Runs> {
    let names: Vec<String> = dataset.channels().iter().map(|c| c.name.clone()).collect();
    let mut runs = load_all(dataset, &names)?;
    runs.runs
        .retain(|run| dataset.run(run.run_id).is_some_and(|row| row.flags.is_empty()));
    Ok(runs)
}

/// Long runs of the job that made the data set; without them, says why on standard error.
fn simulated(dataset: &Dataset, meshes: &[PathBuf]) -> Option<Runs> {
    let DatasetSource::Job { spec } = &dataset.manifest().source else {
        return None;
    };
    let made = super::reproduce::ready_machine(spec, None, meshes)
        .and_then(|ready| calibration::simulate(spec, &CheckedMachine::new(ready)));
    match made {
        Ok(runs) => Some(runs),
        Err(error) => {
            eprintln!("note: the validation runs calibrate the intervals alone: {error:#}");
            None
        }
    }
}

/// Where an unfinished training of `out` keeps its state: beside the model folder.
fn checkpoint_dir(out: &Path) -> PathBuf {
    let name = out
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    out.with_file_name(format!(".{name}.checkpoint"))
}

/// A bar for the schedule of a training; hidden for scripts.
pub(crate) fn training_bar(hidden: bool) -> ProgressBar {
    if hidden {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{prefix:>10} [{bar:40}] {percent:>3} %  {msg}") {
        bar.set_style(style.progress_chars("=> "));
    }
    bar.set_prefix("training");
    bar
}

/// Moves the bar and says how good the network is.
pub(crate) fn show(bar: &ProgressBar, progress: &Progress) {
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "0 to 1000"
    )]
    bar.set_position((progress.fraction.clamp(0.0, 1.0) * 1000.0) as u64);
    let validation = progress
        .validation_loss
        .map_or_else(String::new, |loss| format!(", validation {loss:.2e}"));
    let resumed = progress
        .resumed_at
        .map_or_else(String::new, |epoch| format!(" (resumed at epoch {epoch})"));
    bar.set_message(format!(
        "epoch {}{resumed}, loss {:.2e}{validation}",
        progress.epoch, progress.train_loss
    ));
}

fn describe(summary: &ModelSummary, out: &Path) -> String {
    let mut text = format!(
        "{}: {} with {} parameters on a window of {} samples ({:.3} s), {} epochs in {:.1} s\n",
        out.display(),
        summary.structure,
        summary.parameters,
        summary.window_steps,
        summary.window_s,
        summary.epochs,
        summary.train_seconds
    );
    text.push_str("errors on the validation runs:\n");
    let report = EvaluationReport {
        model_sha256: summary.model_sha256.clone(),
        dataset_sha256: summary.dataset_sha256.clone(),
        runs: 0,
        targets: summary.validation.clone(),
        baselines: vec![BaselineMetrics {
            name: "least_squares".to_owned(),
            targets: summary.validation_least_squares.clone(),
        }],
        inside_envelope: None,
        flagged_by_length: None,
    };
    text.push_str(table(&report).trim_end());
    text
}
