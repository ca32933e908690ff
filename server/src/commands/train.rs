//! `hydroflex train`: a network from a data set on disk.

use anyhow::Context as _;
use hydroflex_dataset::Dataset;
use hydroflex_ml::evaluate::table::table;
use hydroflex_ml::train::{Progress, train_dataset};
use hydroflex_openapi::job::{TrainingSpec, WindowRule};
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
    /// Directory to write the model to
    #[arg(long)]
    pub out: PathBuf,
    /// `best`, or the letters of the paper: L, RLR, TLTLT, TLSLTLSLT, ELE, …
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
    /// Largest number of epochs
    #[arg(long)]
    pub epochs: Option<usize>,
    /// Largest training time in seconds
    #[arg(long)]
    pub time_limit_s: Option<f64>,
    /// Print a machine-readable summary
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    let dataset =
        Dataset::open(&args.data).with_context(|| format!("cannot open {}", args.data.display()))?;
    let spec = TrainingSpec {
        structure: args.structure,
        inputs: args.inputs,
        targets: args.targets,
        window: args
            .window_s
            .map_or_else(WindowRule::default, |window_s| WindowRule::Given { window_s }),
        seed: args.seed,
        epochs: args.epochs,
        time_limit_s: args.time_limit_s,
        ..TrainingSpec::default()
    };
    let bar = training_bar(args.json);
    let mut progress = |progress: Progress| {
        show(&bar, &progress);
        ControlFlow::Continue(())
    };
    let checkpoint = checkpoint_dir(&args.out);
    let result = train_dataset(&dataset, &spec, &mut progress, &checkpoint, &args.out);
    bar.finish_and_clear();
    let summary = result.with_context(|| format!("cannot train on {}", args.data.display()))?;
    // Only an empty directory is removed: whatever else is in it is not ours.
    let _ = std::fs::remove_dir(&checkpoint);
    if args.json {
        return super::print_json(&summary);
    }
    super::print_line(format_args!("{}", describe(&summary, &args.out)))
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
    };
    text.push_str(table(&report).trim_end());
    text
}
