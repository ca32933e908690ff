//! `hydroflex demo`: the whole chain on one machine.
//!
//! A user of the service like any other: what it does, it does over the service's own REST
//! interface, and what it shows it computes from what it downloaded. Everything lies below one
//! directory, and a second call goes on where the first one was stopped.

use super::dataset::{fetch, fetch_files};
use super::{print_json, print_line};
use crate::client::Client;
use crate::service::{self, ServiceConfig};
use anyhow::{Context, bail};
use hydroflex_dataset::Dataset;
use hydroflex_ml::dataset::evaluation_runs;
use hydroflex_ml::evaluate::evaluate;
use hydroflex_ml::evaluate::table::table;
use hydroflex_ml::model::Model;
use hydroflex_ml::plot::of_run;
use hydroflex_ml::runs::Runs;
use hydroflex_openapi::catalogue::ModelInfo;
use hydroflex_openapi::status::{JobState, JobStatus};
use serde::{Deserialize, Serialize};
use serde_json::json;
use sha2::{Digest, Sha256};
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use tokio::net::TcpListener;

/// Seed of the demo's job.
const SEED: u64 = 2026;

/// Seed of the evaluation, which shares no run with the job.
const EVALUATION_SEED: u64 = 4052;

/// Payload of every run, kg: with it the boom rings long enough to be looked at.
const PAYLOAD_KG: f64 = 100.0;

/// Errors recovered from the plotted curves of Khadim et al. (arXiv 2503.07528), 100 kg, 256 runs, valve, length and
/// both pressures; for orientation: another boom, another mesh.
const PAPER: &str = "The paper's boom (100 kg, 256 runs), mean absolute error of the paper's networks: \
    deflection 0.112 mm, strain xy 0.39 to 0.66 µstrain, stress xx 0.95 to 1.55 N/mm²";

/// Length of the evaluation signal, s.
const EVALUATION_S: f64 = 10.0;

/// Start of the published evaluation signal, degrees.
const EVALUATION_ANGLE_DEG: f64 = 18.24;

/// Arguments of `hydroflex demo`.
#[derive(Debug, Clone, clap::Args)]
pub struct Args {
    /// Directory for everything the demo writes
    #[arg(long, default_value = "hydroflex-demo")]
    pub data: PathBuf,
    /// Address of the REST interface; a taken port is replaced by a free one
    #[arg(long, default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Runs of the job
    #[arg(long, default_value_t = 80)]
    pub runs: u64,
    /// Worker processes (default: one per core)
    #[arg(long, value_parser = super::at_once(1))]
    pub workers: Option<usize>,
    /// Stop when the chain is done instead of serving on
    #[arg(long)]
    pub exit: bool,
    /// Print machine-readable results
    #[arg(long)]
    pub json: bool,
}

/// What a second call has to know of the first one.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Memory {
    version: String,
    runs: u64,
    job_id: Option<String>,
    evaluation_job_id: Option<String>,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    runtime.block_on(serve_and_run(args))
}

async fn serve_and_run(args: Args) -> anyhow::Result<()> {
    std::fs::create_dir_all(&args.data).with_context(|| format!("cannot make {}", args.data.display()))?;
    let listener = listen(&args).await?;
    let mut config = ServiceConfig::new(args.data.join("service"))?;
    config.workers = args.workers.unwrap_or_else(service::cores);
    config.worker_log = Some(args.data.join("workers.log"));
    let workers = config.workers;
    let service = service::start(config, listener).await?;
    let url = service.url();
    if !args.json {
        print_line(format_args!(
            "hydroflex is up at {url} with {workers} worker process{}; everything it writes is in {}",
            if workers == 1 { "" } else { "es" },
            args.data.display()
        ))?;
    }
    // The client blocks, and owns its runtime: it gets a thread of its own.
    let (done, chain) = tokio::sync::oneshot::channel();
    let client_args = args.clone();
    let client_url = url.clone();
    std::thread::spawn(move || {
        let _ = done.send(chain_of(&client_args, &client_url));
    });
    let result = tokio::select! {
        result = chain => result.context("the demo ended without a result")?,
        signal = service::until_told_to_stop() => {
            signal.context("cannot wait for signals")?;
            service.stop().await;
            bail!("stopped; call `hydroflex demo` again to go on");
        }
    };
    if result.is_ok() && !args.exit {
        if !args.json {
            print_line(format_args!("\nThe service stays up. Stop it with Ctrl-C."))?;
        }
        service::until_told_to_stop()
            .await
            .context("cannot wait for signals")?;
    }
    service.stop().await;
    result
}

/// The address asked for, or a free port of the same host.
async fn listen(args: &Args) -> anyhow::Result<TcpListener> {
    match TcpListener::bind(args.listen).await {
        Ok(listener) => Ok(listener),
        Err(error) if error.kind() == ErrorKind::AddrInUse => {
            let free = SocketAddr::new(args.listen.ip(), 0);
            let listener = TcpListener::bind(free)
                .await
                .with_context(|| format!("cannot listen on {free}"))?;
            if !args.json {
                print_line(format_args!(
                    "port {} is taken; using port {}",
                    args.listen.port(),
                    listener.local_addr()?.port()
                ))?;
            }
            Ok(listener)
        }
        Err(error) => Err(error).with_context(|| format!("cannot listen on {}", args.listen)),
    }
}

/// Submit, follow, download, evaluate, draw, print.
fn chain_of(args: &Args, url: &str) -> anyhow::Result<()> {
    let client = Client::new(url)?;
    let memory_path = args.data.join("demo.json");
    let mut memory = recall(&memory_path, args);
    let resumed = memory.job_id.is_some();
    say(
        args,
        if resumed {
            "going on with the demo that was begun here"
        } else {
            "starting a new demo"
        },
    )?;

    let job = ensure(&client, &mut memory.job_id, &training_job(args.runs))?;
    // The evaluation is queued behind the job: workers turn to it while the network is trained.
    let evaluation = ensure(&client, &mut memory.evaluation_job_id, &evaluation_job())?;
    remember(&memory_path, &memory)?;

    let job = succeeded(client.follow(&job, args.json)?)?;
    let evaluation = succeeded(client.follow(&evaluation, args.json)?)?;
    let dataset_id = job
        .dataset_id
        .as_ref()
        .context("the job ended without a data set")?
        .to_string();
    let model_id = job
        .model_ids
        .first()
        .context("the job ended without a model")?
        .to_string();
    let evaluation_id = evaluation
        .dataset_id
        .as_ref()
        .context("the evaluation has no data set")?
        .to_string();

    let dataset_dir = folder_for(&args.data.join("dataset"), &dataset_id)?;
    fetch(&client, &dataset_id, &dataset_dir, args.json)?;
    let evaluation_dir = folder_for(&args.data.join("evaluation-dataset"), &evaluation_id)?;
    fetch(&client, &evaluation_id, &evaluation_dir, args.json)?;
    let model_dir = args.data.join("model");
    let info: ModelInfo = client.get(&format!("/v1/models/{model_id}"))?;
    fetch_files(
        &client,
        &format!("/v1/models/{model_id}/files"),
        &info.files,
        &model_dir,
        args.json,
    )?;

    let model = Model::load(&model_dir).context("cannot load the model")?;
    let unseen = Dataset::open(&evaluation_dir).context("cannot open the evaluation data set")?;
    let runs = evaluation_runs(&unseen, &model).context("cannot read the evaluation data set")?;
    let result = evaluate(&model, &runs, unseen.dataset_sha256()).context("cannot evaluate the model")?;
    let title = "Built-in lift boom, 100 kg payload: structural estimates from hydraulic signals";
    let picture = args.data.join("evaluation.svg");
    write(
        &picture,
        of_run(&model, &runs, &result, 0, title)?.to_svg().as_bytes(),
    )?;
    let report = args.data.join("evaluation.json");
    write(&report, &serde_json::to_vec_pretty(&result.report)?)?;

    let lines = lines_to_copy(url, &dataset_id, &model_id, &model, &runs)?;
    if args.json {
        return print_json(&json!({
            "url": url, "resumed": resumed, "job_id": job.job_id, "dataset_id": dataset_id,
            "dataset_sha256": job.dataset_sha256, "model_id": model_id, "evaluation": result.report,
            "picture": picture, "report": report, "curl": lines,
        }));
    }
    print_line(format_args!(
        "\nErrors on a signal of {EVALUATION_S} s that the network has never seen\n"
    ))?;
    print_line(format_args!("{}", table(&result.report)))?;
    print_line(format_args!("{PAPER}"))?;
    print_line(format_args!(
        "\npicture  {}\nreport   {}",
        picture.display(),
        report.display()
    ))?;
    print_line(format_args!(
        "\nThree lines to copy: submit a job, download this data set, ask for an estimate\n"
    ))?;
    for line in &lines {
        print_line(format_args!("{line}"))?;
    }
    Ok(())
}

/// One physical line each, so that they can be copied.
fn lines_to_copy(
    url: &str,
    dataset: &str,
    model_id: &str,
    model: &Model,
    runs: &Runs,
) -> anyhow::Result<[String; 3]> {
    let job = json!({"machine": "lift-boom", "runs": 160, "seed": 1, "payload_kg": {"min": 0, "max": 100}});
    // The boom at rest, as the evaluation starts: a window of constant signals.
    let run = runs.runs.first().context("the evaluation has no run")?;
    let names: Vec<String> = model
        .config()
        .inputs
        .iter()
        .map(|channel| channel.name.clone())
        .collect();
    let mut inputs = serde_json::Map::new();
    for (name, position) in names.iter().zip(runs.positions(&names)?) {
        let value = run.columns[position]
            .first()
            .copied()
            .context("the evaluation run has no rows")?;
        inputs.insert(name.clone(), rounded(value).into());
    }
    let body = json!({ "inputs": inputs });
    Ok([
        format!("curl -sS {url}/v1/jobs -H 'content-type: application/json' -d '{job}'"),
        format!("curl -sS {url}/v1/datasets/{dataset}/archive.tar -o hydroflex-dataset.tar"),
        format!(
            "curl -sS {url}/v1/models/{model_id}/predict -H 'content-type: application/json' -d '{body}'"
        ),
    ])
}

/// Six significant digits: enough for any sensor, and short enough to read.
fn rounded(value: f64) -> f64 {
    format!("{value:.5e}").parse().unwrap_or(value)
}

fn say(args: &Args, text: &str) -> anyhow::Result<()> {
    if args.json {
        Ok(())
    } else {
        print_line(format_args!("{text}"))
    }
}

/// Where a data set is copied to: `folder`, or, if that holds another one (of an earlier call that asked for other runs, or of
/// another version), a folder beside it that is named by the id.
fn folder_for(folder: &Path, dataset_id: &str) -> anyhow::Result<PathBuf> {
    let path = folder.join("SHA256SUMS");
    let sums = match std::fs::read(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(folder.to_owned()),
        sums => sums.with_context(|| format!("cannot read {}", path.display()))?,
    };
    // An id is how the hash of this file begins.
    if hex::encode(Sha256::digest(sums)).starts_with(dataset_id) {
        return Ok(folder.to_owned());
    }
    let mut name = folder.as_os_str().to_owned();
    name.push(format!("-{dataset_id}"));
    Ok(name.into())
}

fn training_job(runs: u64) -> serde_json::Value {
    json!({
        "title": "demo", "machine": "lift-boom", "runs": runs, "seed": SEED, "payload_kg": PAYLOAD_KG,
        "train": [{"structure": "best"}],
    })
}

fn evaluation_job() -> serde_json::Value {
    json!({
        "title": "demo: unseen signal", "machine": "lift-boom", "runs": 1, "seed": EVALUATION_SEED,
        "payload_kg": PAYLOAD_KG,
        "duration_s": EVALUATION_S, "excitation": {"kind": "cycle"}, "settling_runs": 0,
        "initial_angle_deg": {"lift": [EVALUATION_ANGLE_DEG, EVALUATION_ANGLE_DEG]},
        "split": {"train": 0.0, "validation": 0.0, "test": 1.0},
    })
}

/// The job of an earlier call if the service still has it and it may still succeed, else a new one.
fn ensure(client: &Client, known: &mut Option<String>, spec: &serde_json::Value) -> anyhow::Result<String> {
    if let Some(id) = known
        && let Ok(status) = client.get::<JobStatus>(&format!("/v1/jobs/{id}"))
        && !matches!(status.state, JobState::Failed | JobState::Cancelled)
    {
        return Ok(id.clone());
    }
    let status: JobStatus = client.post("/v1/jobs", spec)?;
    Ok(known.insert(status.job_id.to_string()).clone())
}

fn succeeded(status: JobStatus) -> anyhow::Result<JobStatus> {
    if status.state == JobState::Succeeded {
        return Ok(status);
    }
    bail!(
        "job {} {}: {}",
        status.job_id,
        status.state,
        status.reason.as_deref().unwrap_or("no reason given")
    )
}

/// What an earlier call of the same demo left; another version or size starts anew.
fn recall(path: &Path, args: &Args) -> Memory {
    let fresh = Memory {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        runs: args.runs,
        ..Memory::default()
    };
    let earlier = std::fs::read(path)
        .ok()
        .and_then(|bytes| serde_json::from_slice::<Memory>(&bytes).ok());
    match earlier {
        Some(memory) if memory.version == fresh.version && memory.runs == fresh.runs => memory,
        _ => fresh,
    }
}

fn remember(path: &Path, memory: &Memory) -> anyhow::Result<()> {
    write(path, &serde_json::to_vec_pretty(memory)?)
}

/// Writes a whole file or none.
fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    let part = PathBuf::from(name);
    std::fs::write(&part, bytes).with_context(|| format!("cannot write {}", part.display()))?;
    std::fs::rename(&part, path).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_data_set_goes_beside_the_one_that_is_there() {
        let data = tempfile::tempdir().unwrap();
        let folder = data.path().join("dataset");
        let id = |sums: &str| hex::encode(Sha256::digest(sums))[..32].to_owned();
        assert_eq!(folder_for(&folder, &id("one")).unwrap(), folder, "free");
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("SHA256SUMS"), "one").unwrap();
        assert_eq!(folder_for(&folder, &id("one")).unwrap(), folder, "the same");
        let beside = data.path().join(format!("dataset-{}", id("two")));
        assert_eq!(folder_for(&folder, &id("two")).unwrap(), beside);
    }
}
