//! `hydroflex evaluate`: a model against a data set it has not seen.

use anyhow::Context as _;
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::evaluation_runs;
use hydroflex_ml::evaluate::evaluate;
use hydroflex_ml::evaluate::table::{PUBLISHED, table};
use hydroflex_ml::model::Model;
use hydroflex_ml::plot::{of_run, profile};
use hydroflex_openapi::model::EvaluationReport;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Arguments of `hydroflex evaluate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Model directory
    #[arg(long)]
    pub model: PathBuf,
    /// Data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Write a picture (SVG) of one run: reference, estimate and error over time
    #[arg(long)]
    pub plot: Option<PathBuf>,
    /// Write a picture (SVG) of where the errors stand: over time, amplitude and frequency, with the learning curve
    #[arg(long)]
    pub profile: Option<PathBuf>,
    /// Target of that picture (default: the model's first)
    #[arg(long, requires = "profile")]
    pub target: Option<String>,
    /// Run of the picture of one run (default: the first)
    #[arg(long)]
    pub run: Option<u64>,
    /// Print machine-readable metrics
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    let model = Model::load(&args.model).with_context(|| format!("cannot load {}", args.model.display()))?;
    let dataset = super::open_dataset(&args.data)?;
    let seen = dataset.dataset_sha256() == model.config().provenance.dataset_sha256;
    let runs = evaluation_runs(&dataset, &model)?;
    let evaluation = evaluate(&model, &runs, dataset.dataset_sha256())
        .with_context(|| format!("cannot evaluate on {}", args.data.display()))?;
    if let Some(path) = &args.plot {
        let run = match args.run {
            Some(id) => evaluation
                .runs
                .iter()
                .position(|run| run.run_id == id)
                .with_context(|| format!("run {id} is not among the evaluated runs"))?,
            None => 0,
        };
        let title = format!(
            "{}: structural estimates from hydraulic signals",
            machine_title(&dataset)
        );
        let picture = of_run(&model, &runs, &evaluation, run, &title)?;
        std::fs::write(path, picture.to_svg()).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(path) = &args.profile {
        let targets = &model.config().targets;
        let target = match &args.target {
            Some(name) => targets.iter().position(|t| t.name == *name).with_context(|| {
                let names: Vec<&str> = targets.iter().map(|t| t.name.as_str()).collect();
                format!("--target is {name:?}, allowed is one of {}", names.join(", "))
            })?,
            None => 0,
        };
        let title = format!("{}: where the errors stand", machine_title(&dataset));
        let svg = profile::of_target(&model, &evaluation, target, &title);
        std::fs::write(path, svg).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if args.json {
        return super::print_json(&evaluation.report);
    }
    super::print_line(format_args!(
        "{}",
        describe(&evaluation.report, seen, args.plot.as_deref())
    ))
}

/// `lift-boom` as a title: `Lift boom`.
fn machine_title(dataset: &Dataset) -> String {
    let name = dataset.manifest().machine.name.replace(['-', '_'], " ");
    let mut letters = name.chars();
    letters
        .next()
        .map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

fn describe(report: &EvaluationReport, seen: bool, plot: Option<&Path>) -> String {
    let mut text = format!("{} runs", report.runs);
    if seen {
        text.push_str(" of the model's own data set, not trained on");
    }
    if let Some(inside) = report.inside_envelope {
        let _ = write!(
            text,
            ", {:.1} % of the windows inside the envelope",
            100.0 * inside
        );
    }
    if let Some(by_length) = report.flagged_by_length.filter(|l| l.beyond > 0.0) {
        let _ = write!(
            text,
            "; {:.1} % go beyond the cylinder lengths of the training runs ({:.1} % of these are outside the envelope, {:.1} % of \
             the others)",
            100.0 * by_length.beyond,
            100.0 * by_length.flagged_beyond.unwrap_or(0.0),
            100.0 * by_length.flagged_within.unwrap_or(0.0),
        );
    }
    text.push_str("\n\n");
    text.push_str(&table(report));
    text.push_str("\npublished for another boom (the paper's), MAE of the vertical deflection: ");
    let published: Vec<String> = PUBLISHED
        .iter()
        .map(|p| format!("{:.3} mm at {:.0} kg", p.deflection_mae_mm, p.payload_kg))
        .collect();
    text.push_str(&published.join(", "));
    if let Some(path) = plot {
        let _ = write!(text, "\npicture: {}", path.display());
    }
    text
}
