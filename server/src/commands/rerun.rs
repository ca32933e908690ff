//! `hydroflex rerun`: one run of a job again, here and now, for a look at it.

use super::job::ServiceArgs;
use crate::client::Client;
use anyhow::{Context, ensure};
use hydroflex_dataset::{RunKind, RunOutcome, RunRecord};
use hydroflex_openapi::dataset::{DatasetSource, Manifest};
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::status::JobStatus;
use hydroflex_worker::machines::ReadyMachine;
use hydroflex_worker::run;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Arguments of `hydroflex rerun`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Id of a job of a running service, or the manifest.json of a data set
    pub job: String,
    /// Index of the run, from 0
    #[arg(long)]
    pub run: u64,
    /// Take the settling run of that index instead
    #[arg(long)]
    pub settling: bool,
    /// Write the samples to this file (CSV)
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Mesh file that was uploaded for the machine; may be repeated, and is known by its content
    #[arg(long)]
    pub mesh: Vec<PathBuf>,
    /// Directory for reduced bodies (default: a folder of the user's cache directory)
    #[arg(long)]
    pub cache: Option<PathBuf>,
    /// Service
    #[command(flatten)]
    pub service: ServiceArgs,
}

/// What a job is, from wherever it was found.
struct Source {
    spec: JobSpec,
    machine_sha256: String,
}

/// Runs the command. A run that hangs or panics does so here too: that is what one comes to see.
///
/// # Errors
/// Every failure ends the command with its reason; a run that fails is shown.
pub fn run(args: Args) -> anyhow::Result<()> {
    let source = find(&args)?;
    let spec = &source.spec;
    let (kind, runs, of) = if args.settling {
        (RunKind::Settling, spec.settling_runs, "settling runs")
    } else {
        (RunKind::Job, spec.runs, "runs")
    };
    ensure!(
        args.run < runs,
        "--run is {}, the job has {runs} {of}: allowed is 0 to {}",
        args.run,
        runs.saturating_sub(1)
    );
    let machine = super::reproduce::ready_machine(spec, args.cache.clone(), &args.mesh)?;
    ensure!(
        machine.sha256 == source.machine_sha256,
        "this build's machine has SHA-256 {}, the job was made with {}: its runs would be others",
        machine.sha256,
        source.machine_sha256
    );
    let planned = run::plan(spec, &machine, kind, args.run)?;
    let start = Instant::now();
    let record = planned.simulate(spec, &machine);
    let wall_s = start.elapsed().as_secs_f64();
    if let Some(path) = &args.out {
        write_csv(path, &record, spec, &machine)
            .with_context(|| format!("cannot write --out {}", path.display()))?;
    }
    if args.service.json {
        return super::print_json(&as_json(&record, &machine, wall_s));
    }
    show(&record, &machine, wall_s)
}

fn find(args: &Args) -> anyhow::Result<Source> {
    let path = Path::new(&args.job);
    if path.exists() {
        let manifest = super::reproduce::read_manifest(path)?;
        return of_manifest(&manifest);
    }
    let client = Client::new(&args.service.url)?;
    let status: JobStatus = client
        .get(&format!("/v1/jobs/{}", args.job))
        .with_context(|| format!("{} is no file, and as a job", args.job))?;
    Ok(Source {
        spec: status.spec,
        machine_sha256: status.machine_sha256,
    })
}

fn of_manifest(manifest: &Manifest) -> anyhow::Result<Source> {
    let DatasetSource::Job { spec } = &manifest.source else {
        anyhow::bail!(
            "this data set was made from a table of runs; `hydroflex simulate --runs TABLE` makes them again"
        );
    };
    Ok(Source {
        spec: (**spec).clone(),
        machine_sha256: manifest.machine.content_sha256.clone(),
    })
}

/// First, smallest, largest and last sample of a channel.
fn summary(column: &[f64]) -> [f64; 4] {
    let least = column.iter().copied().fold(f64::INFINITY, f64::min);
    let most = column.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [
        column.first().copied().unwrap_or(f64::NAN),
        least,
        most,
        column.last().copied().unwrap_or(f64::NAN),
    ]
}

fn as_json(record: &RunRecord, machine: &ReadyMachine, wall_s: f64) -> serde_json::Value {
    let angles: serde_json::Map<_, _> = machine
        .machine()
        .file()
        .angles
        .iter()
        .zip(&record.angles_rad)
        .map(|(angle, value)| (format!("{}_rad", angle.name), (*value).into()))
        .collect();
    let mut channels = serde_json::Map::new();
    if let RunOutcome::Ok(samples) = &record.outcome {
        for (channel, column) in machine.simulator.channels().iter().zip(&samples.columns) {
            let [first, min, max, last] = summary(column);
            channels.insert(
                channel.name.clone(),
                serde_json::json!({ "first": first, "min": min, "max": max, "last": last }),
            );
        }
    }
    serde_json::json!({
        "run_id": record.run_id,
        "seed": record.seed,
        "payload_kg": record.payload_kg,
        "material": record.material,
        "angles": angles,
        "status": record.status(),
        "reason": record.reason(),
        "flags": record.flags.iter().map(|flag| flag.as_str()).collect::<Vec<_>>(),
        "steps": record.statistics.steps,
        "rejected": record.statistics.rejected,
        "iterations": record.statistics.iterations,
        "factorisations": record.statistics.factorisations,
        "solver_path": record.statistics.path,
        "wall_s": wall_s,
        "channels": channels,
    })
}

fn show(record: &RunRecord, machine: &ReadyMachine, wall_s: f64) -> anyhow::Result<()> {
    let line = |name: &str, value: String| super::print_line(format_args!("{name:9} {value}"));
    line("run", record.run_id.to_string())?;
    if let Some(seed) = record.seed {
        line("seed", seed.to_string())?;
    }
    line("payload", format!("{} kg", record.payload_kg))?;
    if let Some(material) = &record.material {
        line("material", material.clone())?;
    }
    for (angle, value) in machine.machine().file().angles.iter().zip(&record.angles_rad) {
        line(&angle.name, format!("{:.6} deg at the start", value.to_degrees()))?;
    }
    let flags: Vec<&str> = record.flags.iter().map(|flag| flag.as_str()).collect();
    match record.reason() {
        None => line("ended", format!("well, after {:.2} ms", wall_s * 1e3))?,
        Some(reason) => line("failed", reason.to_owned())?,
    }
    if !flags.is_empty() {
        line("flags", flags.join(", "))?;
    }
    let statistics = &record.statistics;
    line(
        "steps",
        format!(
            "{}, {} rejected, {} factorisations",
            statistics.steps, statistics.rejected, statistics.factorisations
        ),
    )?;
    if let Some(path) = statistics.path {
        line("solver", path.as_str().to_owned())?;
    }
    if let RunOutcome::Ok(samples) = &record.outcome {
        super::print_line(format_args!(
            "\n{:40} {:>14} {:>14} {:>14} {:>14}",
            "channel", "first", "min", "max", "last"
        ))?;
        for (channel, column) in machine.simulator.channels().iter().zip(&samples.columns) {
            let [first, min, max, last] = summary(column);
            super::print_line(format_args!(
                "{:40} {first:>14.6e} {min:>14.6e} {max:>14.6e} {last:>14.6e}",
                channel.name
            ))?;
        }
    }
    Ok(())
}

fn write_csv(path: &Path, record: &RunRecord, spec: &JobSpec, machine: &ReadyMachine) -> anyhow::Result<()> {
    let RunOutcome::Ok(samples) = &record.outcome else {
        anyhow::bail!(
            "the run failed and has no samples: {}",
            record.reason().unwrap_or_default()
        );
    };
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    write!(out, "time_s")?;
    for channel in machine.simulator.channels() {
        write!(out, ",{}", channel.name)?;
    }
    writeln!(out)?;
    for step in 0..samples.sample_count {
        write!(out, "{}", step as f64 * spec.sample_time_s)?;
        for column in &samples.columns {
            // Rust prints the shortest text that reads back as the same number.
            write!(out, ",{}", column[step])?;
        }
        writeln!(out)?;
    }
    out.flush()?;
    Ok(())
}
