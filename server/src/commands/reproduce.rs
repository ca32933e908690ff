//! `hydroflex reproduce`: a data set made again from its manifest, and compared byte for byte.

use super::worker::default_cache;
use crate::coordinator::machines::CheckedMachine;
use anyhow::{Context, bail, ensure};
use hydroflex_dataset::{DirectorySink, Published, Publisher, RunKind, RunRecord};
use hydroflex_ledger::blobs::{Blobs, mesh_key};
use hydroflex_openapi::dataset::{DATASET_FORMAT, DatasetSource, Manifest, ManifestFile};
use hydroflex_openapi::job::JobSpec;
use hydroflex_worker::machines::{Machines, ReadyMachine, RefusedMachine};
use hydroflex_worker::shard::{self, ShardFailure};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `hydroflex reproduce`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// manifest.json of a data set, or the data set's directory
    pub manifest: PathBuf,
    /// Keep the data set in this directory, absent or empty (default: it is compared and deleted)
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Threads (default: one per core)
    #[arg(long, value_parser = super::at_once(1))]
    pub threads: Option<usize>,
    /// Directory for reduced bodies (default: a folder of the user's cache directory)
    #[arg(long)]
    pub cache: Option<PathBuf>,
    /// Mesh file that was uploaded for the machine; may be repeated, and is known by its content
    #[arg(long)]
    pub mesh: Vec<PathBuf>,
    /// Print a machine-readable summary
    #[arg(long)]
    pub json: bool,
}

/// Runs simulated between two visits to the writer, per thread.
const CHUNK_RUNS_PER_THREAD: usize = 64;

/// Runs of one call of the simulator: as many as workers take.
const BATCH_RUNS: usize = 16;

/// Reads a manifest; a directory stands for the one in it.
///
/// # Errors
/// If there is none, or it is of another format.
pub(super) fn read_manifest(path: &Path) -> anyhow::Result<Manifest> {
    let path = if path.is_dir() {
        path.join("manifest.json")
    } else {
        path.to_owned()
    };
    let text = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    // The format first: another one has other fields.
    let value: serde_json::Value =
        serde_json::from_slice(&text).with_context(|| format!("{} is not JSON", path.display()))?;
    let format = value.get("format").and_then(serde_json::Value::as_u64);
    ensure!(
        format == Some(u64::from(DATASET_FORMAT)),
        "{} has format {}, this build reads {DATASET_FORMAT}",
        path.display(),
        format.map_or_else(|| "none".to_owned(), |format| format.to_string())
    );
    serde_json::from_value(value).with_context(|| format!("{} is not a manifest", path.display()))
}

/// The machine of a job, with the meshes that were uploaded for it.
///
/// # Errors
/// If a mesh cannot be read or is missing, or this build refuses the machine.
pub(super) fn ready_machine(
    spec: &JobSpec,
    cache: Option<PathBuf>,
    meshes: &[PathBuf],
) -> anyhow::Result<Arc<ReadyMachine>> {
    let runtime = tokio::runtime::Runtime::new()?;
    let folder = tempfile::tempdir().context("cannot make a temporary directory")?;
    let blobs = Blobs::directory(folder.path())?;
    for mesh in meshes {
        let content =
            std::fs::read(mesh).with_context(|| format!("cannot read --mesh {}", mesh.display()))?;
        let key = mesh_key(&hex::encode(Sha256::digest(&content))).context("a hash is a key")?;
        runtime.block_on(blobs.create(&key, content.into()))?;
    }
    let _entered = runtime.enter();
    Machines::new(cache.unwrap_or_else(default_cache))
        .ready(spec, &blobs)
        .map_err(|refused| match refused {
            RefusedMachine::NoMesh { body, sha256 } => anyhow::anyhow!(
                "body {body:?} needs the mesh with SHA-256 {sha256}, that was uploaded for the job; give it with --mesh FILE"
            ),
            other => other.into(),
        })
}

/// Runs the command.
///
/// # Errors
/// If the data set cannot be made again, or comes out with other bytes.
pub fn run(args: Args) -> anyhow::Result<()> {
    let expected = read_manifest(&args.manifest)?;
    let temporary;
    let out = if let Some(out) = &args.out {
        out.clone()
    } else {
        temporary = tempfile::tempdir().context("cannot make a temporary directory")?;
        temporary.path().join("dataset")
    };
    let published = make(&args, &expected, &out)?;
    let differing = compare(&expected, &published);
    let same = published.manifest == expected;
    if args.json {
        super::print_json(&serde_json::json!({
            "same": same,
            "dataset_sha256": published.dataset_sha256,
            "differing": differing,
            "out": args.out,
        }))?;
    } else {
        super::print_line(format_args!("sha256 {}", published.dataset_sha256))?;
        if same {
            super::print_line(format_args!(
                "the same: all {} files have the hashes of the manifest",
                expected.files.len()
            ))?;
        }
    }
    ensure!(
        same,
        "the data set came out differently: {}",
        if differing.is_empty() {
            "every file is the same, but the manifests differ".to_owned()
        } else {
            differing.join(", ")
        }
    );
    Ok(())
}

fn make(args: &Args, expected: &Manifest, out: &Path) -> anyhow::Result<Published> {
    let DatasetSource::Job { spec } = &expected.source else {
        bail!(
            "this data set was made from a table of runs; `hydroflex simulate --runs TABLE` makes it again, \
             with the table that it was made from"
        );
    };
    let level = hydroflex_sim::instruction_set::level();
    ensure!(
        expected.code.instruction_set == level,
        "the data set was made with instruction set {}, this machine has {level}: its last bits would differ",
        expected.code.instruction_set
    );
    if expected.code.version != env!("CARGO_PKG_VERSION") {
        eprintln!(
            "note: made with hydroflex {}, this is {}; the bytes may differ",
            expected.code.version,
            env!("CARGO_PKG_VERSION")
        );
    }
    let machine = ready_machine(spec, args.cache.clone(), &args.mesh)?;
    ensure!(
        machine.sha256 == expected.machine.content_sha256,
        "this build's machine has SHA-256 {}, the data set was made with {}",
        machine.sha256,
        expected.machine.content_sha256
    );
    let machine = CheckedMachine::new(machine);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.unwrap_or(0))
        .build()
        .context("cannot start the simulation threads")?;
    let sink = DirectorySink::create(out)
        .with_context(|| format!("--out {} must be absent or empty", out.display()))?;
    let mut publisher = Publisher::new(
        machine.publish_spec((**spec).clone(), hydroflex_sim::instruction_set::level()),
        sink,
    )?;
    let bar = progress_bar(spec.settling_runs + spec.runs);
    for (kind, count) in [(RunKind::Settling, spec.settling_runs), (RunKind::Job, spec.runs)] {
        let mut first = 0;
        while first < count {
            let chunk = (CHUNK_RUNS_PER_THREAD * pool.current_num_threads()) as u64;
            let runs: Vec<u64> = (first..count.min(first + chunk)).collect();
            for record in pool.install(|| simulate(spec, &machine, kind, &runs))? {
                publisher.push(&record)?;
            }
            first += runs.len() as u64;
            bar.inc(runs.len() as u64);
        }
    }
    let (published, sink) = publisher.finish()?;
    sink.commit()
        .with_context(|| format!("--out {}", out.display()))?;
    bar.finish_and_clear();
    Ok(published)
}

fn simulate(
    spec: &JobSpec,
    machine: &CheckedMachine,
    kind: RunKind,
    runs: &[u64],
) -> Result<Vec<RunRecord>, ShardFailure> {
    let parts = runs
        .par_chunks(BATCH_RUNS)
        .map(|some| shard::records(spec, machine.ready(), kind, some))
        .collect::<Result<Vec<_>, _>>()?;
    Ok(parts.into_iter().flatten().collect())
}

/// Paths whose bytes are not those of the manifest, missing and additional ones among them.
fn compare(expected: &Manifest, published: &Published) -> Vec<String> {
    let hashes = |files: &[ManifestFile]| -> BTreeMap<String, String> {
        files
            .iter()
            .map(|file| (file.path.clone(), file.sha256.clone()))
            .collect()
    };
    let (expected, found) = (hashes(&expected.files), hashes(&published.manifest.files));
    expected
        .keys()
        .chain(found.keys().filter(|path| !expected.contains_key(*path)))
        .filter(|path| expected.get(*path) != found.get(*path))
        .cloned()
        .collect()
}

/// On a terminal; elsewhere nothing is drawn.
fn progress_bar(runs: u64) -> ProgressBar {
    let bar = ProgressBar::new(runs);
    match ProgressStyle::with_template("simulating {bar:40} {pos}/{len} runs, {eta} left") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar, // the template is constant; its default would do
    }
}
