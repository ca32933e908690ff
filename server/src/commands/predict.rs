//! `hydroflex predict`: estimates for recorded signals.

use anyhow::{Context as _, bail};
use hydroflex_ml::dataset::load_all;
use hydroflex_ml::evaluate::check_sample_time;
use hydroflex_ml::model::Model;
use hydroflex_ml::recording::{predict_runs, read_parquet, write_predictions};
use hydroflex_ml::runs::Runs;
use std::path::{Path, PathBuf};

/// Arguments of `hydroflex predict`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Model directory
    #[arg(long)]
    pub model: PathBuf,
    /// Recorded signals (Parquet): run_id, step and the model's input channels; or a data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Parquet file to write: run_id, step and the estimates
    #[arg(long)]
    pub out: PathBuf,
    /// Print a machine-readable summary
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    // The same file by whatever name: the estimates would take the place of the signals.
    if let (Ok(data), Ok(out)) = (args.data.canonicalize(), args.out.canonicalize())
        && data == out
    {
        bail!("--out {} is the recording itself", args.out.display());
    }
    let model = Model::load(&args.model).with_context(|| format!("cannot load {}", args.model.display()))?;
    let runs = read_signals(&args.data, &model)?;
    check_sample_time(&model, runs.sample_time_s)?;
    runs.check()?;
    let table = predict_runs(&model, &runs);
    write_predictions(&args.out, &table)?;
    let rows = table.run_id.len();
    let estimates = table
        .targets
        .first()
        .map_or(0, |t| t.values.iter().flatten().count());
    let outside = table.inside_envelope.as_ref().map(|flags| {
        let judged = flags.iter().flatten();
        judged.filter(|&&inside| !inside).count()
    });
    if args.json {
        return super::print_json(&serde_json::json!({
            "outside_envelope": outside,
            "model_sha256": model.sha256(), "runs": runs.runs.len(), "rows": rows, "estimates": estimates,
            "targets": table.targets.iter().map(|t| &t.name).collect::<Vec<_>>(), "out": args.out,
        }));
    }
    super::print_line(format_args!(
        "{} runs, {rows} rows, {estimates} with estimates (the first {} samples of a run have none): {}",
        runs.runs.len(),
        model.config().window_steps - 1,
        args.out.display()
    ))?;
    match outside {
        Some(outside) if outside > 0 => super::print_line(format_args!(
            "{outside} of the {estimates} windows are unlike anything that the model was trained on (inside_envelope is false): \
             don't trust their estimates; check units, sensors and payload"
        )),
        _ => Ok(()),
    }
}

/// The model's inputs from a recording or a data set directory.
fn read_signals(path: &Path, model: &Model) -> anyhow::Result<Runs> {
    let names: Vec<String> = model.config().inputs.iter().map(|c| c.name.clone()).collect();
    if path.is_dir() {
        let dataset = super::open_dataset(path)?;
        return Ok(load_all(&dataset, &names)?);
    }
    Ok(read_parquet(path, &names, model.config().sample_time_s)?)
}
