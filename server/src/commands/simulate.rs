//! `hydroflex simulate`: given runs, no service.

pub(crate) mod run_table;

use anyhow::{Context, bail, ensure};
use hydroflex_dataset::{DirectorySink, PublishSpec, Published, Publisher, RunKind, RunLengths, RunRecord};
use hydroflex_openapi::dataset::{CodeFacts, DatasetSource, MachineFacts};
use hydroflex_openapi::job::{Integrator, SampleType, Split};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings};
use hydroflex_worker::run::Ended;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::io::Write;
use std::path::PathBuf;
use std::sync::mpsc;
use std::time::Instant;

/// Arguments of `hydroflex simulate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Built-in machine or machine file
    #[arg(long, default_value = "lift-boom")]
    pub machine: String,
    /// Mesh file, or BODY=FILE, for machines whose mesh is not built in; may be repeated
    #[arg(long)]
    pub mesh: Vec<String>,
    /// Run table (Parquet): run_id, payload_kg, angle_*_rad, valve_*_ratio
    #[arg(long)]
    pub runs: PathBuf,
    /// Directory to write the data set to; must be absent or empty
    #[arg(long)]
    pub out: PathBuf,
    /// Threads (default: one per core)
    #[arg(long, value_parser = super::at_once(1))]
    pub threads: Option<usize>,
    /// Time integration
    #[arg(long, value_enum, default_value_t = IntegratorName::Accurate)]
    pub integrator: IntegratorName,
    /// Step of the fixed-step schemes in seconds (default 0.005); refused with `accurate`
    #[arg(long)]
    pub step_s: Option<f64>,
    /// Time between samples in seconds
    #[arg(long, default_value_t = 0.005)]
    pub sample_s: f64,
    /// Write samples as 32-bit floats
    #[arg(long)]
    pub float32: bool,
    /// Print a machine-readable summary
    #[arg(long)]
    pub json: bool,
}

/// Scheme by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum IntegratorName {
    /// Error-controlled
    Accurate,
    /// Newmark 1/4, 1/2 with velocity-level constraints, as the published scripts
    #[value(name = "trapezoidal-index-2")]
    TrapezoidalIndex2,
    /// Generalised-alpha, spectral radius 0.7, position-level constraints
    GeneralizedAlpha,
}

/// Step of the fixed-step schemes where none is given, s.
const DEFAULT_STEP_S: f64 = 0.005;

/// Runs simulated between two visits to the writer, per thread; also bounded by their samples.
const CHUNK_RUNS_PER_THREAD: usize = 16;
const CHUNK_SAMPLES: usize = 200_000;

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason; runs that fail are data.
pub fn run(args: Args) -> anyhow::Result<()> {
    let started = Instant::now();
    let settings = settings(&args)?;
    let sink = DirectorySink::create(&args.out)
        .with_context(|| format!("--out {} must be absent or empty", args.out.display()))?;
    let machine = Machine::load(&args.machine, &args.mesh)?;
    let runs = run_table::read(&args.runs, machine.file())?;
    let simulator = Simulator::new(machine)?;
    let spec = publish_spec(&args, &simulator, &settings, &runs)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.unwrap_or(0))
        .build()
        .context("threads")?;
    for with_payload in [false, true] {
        if runs.iter().any(|run| (run.payload_kg > 0.0) == with_payload) {
            pool.install(|| simulator.prepare(with_payload))?;
        }
    }

    let bar = progress_bar(runs.len());
    // One thread writes beside one that simulates; beside several it would be the slowest.
    let encoders = match pool.current_num_threads() {
        1 => 0,
        threads => threads,
    };
    let mut publisher = Publisher::with_encoders(spec, sink, encoders)?;
    let (sender, receiver) = mpsc::sync_channel::<Vec<RunRecord>>(1);
    std::thread::scope(|scope| {
        // one chunk is simulated while the one before it is written
        scope.spawn(|| {
            for chunk in chunks(&runs, pool.current_num_threads()) {
                let records = pool.install(|| {
                    chunk
                        .par_chunks(group_size(&simulator, &settings, chunk))
                        .flat_map_iter(|group| simulate(&simulator, &settings, group, &bar))
                        .collect()
                });
                if sender.send(records).is_err() {
                    break; // the writer has failed, and says why
                }
            }
            drop(sender);
        });
        for records in receiver {
            for record in &records {
                publisher.push(record)?;
            }
        }
        anyhow::Ok(())
    })?;
    let (published, sink) = publisher.finish()?;
    sink.commit()
        .with_context(|| format!("--out {}", args.out.display()))?;
    bar.finish_and_clear();
    report(&args, &published, started.elapsed().as_secs_f64())
}

fn settings(args: &Args) -> anyhow::Result<RunSettings> {
    ensure!(
        args.sample_s.is_finite() && args.sample_s > 0.0,
        "--sample-s is {}, allowed is above 0",
        args.sample_s
    );
    ensure!(args.threads != Some(0), "--threads is 0, allowed is 1 or more");
    let step_s = args.step_s.unwrap_or(DEFAULT_STEP_S);
    let integrator = integrator(args.integrator, args.step_s)?;
    if integrator != Integrator::Accurate {
        let ratio = args.sample_s / step_s;
        ensure!(
            step_s > 0.0 && ratio.round() >= 1.0 && (ratio - ratio.round()).abs() < 1e-9 * ratio,
            "--step-s is {step_s}, allowed is --sample-s ({}) divided by a whole number",
            args.sample_s
        );
    }
    Ok(RunSettings {
        integrator,
        sample_time_s: args.sample_s,
    })
}

/// The scheme of that name with a step, by default of 5 ms.
///
/// # Errors
/// A step for `accurate`, which chooses its own.
pub(crate) fn integrator(name: IntegratorName, step_s: Option<f64>) -> anyhow::Result<Integrator> {
    let fixed_s = step_s.unwrap_or(DEFAULT_STEP_S);
    Ok(match (name, step_s) {
        (IntegratorName::Accurate, None) => Integrator::Accurate,
        (IntegratorName::Accurate, Some(step_s)) => bail!(
            "--step-s {step_s} does not go with --integrator accurate, which chooses its steps itself; \
             it belongs to trapezoidal-index-2 and generalized-alpha"
        ),
        (IntegratorName::TrapezoidalIndex2, _) => Integrator::TrapezoidalIndex2 { step_s: fixed_s },
        (IntegratorName::GeneralizedAlpha, _) => Integrator::GeneralizedAlpha { step_s: fixed_s },
    })
}

fn publish_spec(
    args: &Args,
    simulator: &Simulator,
    settings: &RunSettings,
    runs: &[RunInput],
) -> anyhow::Result<PublishSpec> {
    let table = std::fs::read(&args.runs)?;
    let machine = simulator.machine();
    let rows = |run: &RunInput| run.valves_ratio.first().map_or(0, Vec::len) as u64 + 1;
    Ok(PublishSpec {
        source: DatasetSource::RunTable {
            sha256: hex::encode(Sha256::digest(&table)),
            integrator: settings.integrator,
        },
        machine: MachineFacts {
            name: machine.file().name.clone(),
            toml: machine.text().to_owned(),
            content_sha256: hex::encode(machine.content_hash()),
            angles: machine.file().angles.iter().map(|a| a.name.clone()).collect(),
        },
        code: CodeFacts {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            instruction_set: hydroflex_sim::instruction_set::level().to_owned(),
        },
        channels: simulator.channels().to_vec(),
        sample_time_s: settings.sample_time_s,
        sample_type: if args.float32 {
            SampleType::Float32
        } else {
            SampleType::Float64
        },
        split: Split::default(),
        file_size_mb: hydroflex_dataset::cut::FILE_SIZE_MB,
        lengths: RunLengths::Listed(runs.iter().map(rows).collect()),
        eigenvalue_window_s: None,
    })
}

/// Parts of the table that fit into memory whatever the length of its runs.
fn chunks(runs: &[RunInput], threads: usize) -> Vec<&[RunInput]> {
    let samples = |run: &RunInput| run.valves_ratio.first().map_or(0, Vec::len) + 1;
    let mut chunks = Vec::new();
    let mut rest = runs;
    while !rest.is_empty() {
        let mut sum = 0;
        let fitting = rest
            .iter()
            .take(CHUNK_RUNS_PER_THREAD * threads)
            .take_while(|run| {
                sum += samples(run);
                sum <= CHUNK_SAMPLES * threads
            });
        let (chunk, later) = rest.split_at(fitting.count().max(1));
        chunks.push(chunk);
        rest = later;
    }
    chunks
}

/// Runs that one thread takes at a time: enough to fill the vector registers, or one.
fn group_size(simulator: &Simulator, settings: &RunSettings, chunk: &[RunInput]) -> usize {
    let side_by_side = |run: &RunInput| simulator.runs_side_by_side(settings, run.payload_kg > 0.0);
    if chunk.iter().any(side_by_side) {
        CHUNK_RUNS_PER_THREAD
    } else {
        1
    }
}

fn simulate(
    simulator: &Simulator,
    settings: &RunSettings,
    runs: &[RunInput],
    bar: &ProgressBar,
) -> Vec<RunRecord> {
    let results = simulator.run_batch(runs, settings);
    bar.inc(runs.len() as u64);
    let records = runs.iter().zip(results);
    records
        .map(|(run, result)| record(run, Ended::of(result, run, simulator, settings)))
        .collect()
}

fn record(run: &RunInput, ended: Ended) -> RunRecord {
    RunRecord {
        kind: RunKind::Job,
        run_id: run.run_id,
        seed: None,
        payload_kg: run.payload_kg,
        material: None,
        angles_rad: run.angles_rad.clone(),
        outcome: ended.outcome,
        flags: ended.flags,
        statistics: ended.statistics,
    }
}

/// On a terminal; elsewhere nothing is drawn.
fn progress_bar(runs: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("simulating {bar:40} {pos}/{len} runs, {eta} left");
    let bar = ProgressBar::new(runs as u64);
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar, // the template is constant; its default would do
    }
}

fn report(args: &Args, published: &Published, wall_s: f64) -> anyhow::Result<()> {
    let manifest = &published.manifest;
    let bytes: u64 = published.files.iter().map(|file| file.bytes).sum();
    let mut out = std::io::stdout().lock();
    if args.json {
        let summary = serde_json::json!({
            "out": args.out,
            "dataset_sha256": published.dataset_sha256,
            "machine": manifest.machine.name,
            "machine_sha256": manifest.machine.content_sha256,
            "runs": manifest.runs,
            "flags": manifest.flags,
            "solver_paths": manifest.solver_paths,
            "files": published.files.len(),
            "bytes": bytes,
            "wall_s": wall_s,
        });
        writeln!(out, "{summary}")?;
    } else {
        writeln!(
            out,
            "{} runs ({} failed) in {wall_s:.1} s, {:.1} MB in {}",
            manifest.runs.total,
            manifest.runs.failed,
            bytes as f64 / 1e6,
            args.out.display()
        )?;
        let paths: Vec<String> = manifest
            .solver_paths
            .iter()
            .map(|(path, runs)| format!("{path} {runs}"))
            .collect();
        writeln!(out, "solver path (runs): {}", paths.join(", "))?;
        writeln!(out, "sha256 {}", published.dataset_sha256)?;
    }
    Ok(())
}
