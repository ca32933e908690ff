//! `hydroflex job`: jobs of a running service.

use super::read_text;
use crate::client::Client;
use anyhow::Context;
use hydroflex_openapi::catalogue::MeshInfo;
use hydroflex_openapi::status::{JobPage, JobState, JobStatus};
use std::path::{Path, PathBuf};

/// Where the service is.
#[derive(Debug, Clone, clap::Args)]
pub struct ServiceArgs {
    /// Address of the service
    #[arg(long, default_value = "http://127.0.0.1:8080", env = "HYDROFLEX_URL")]
    pub url: String,
    /// Print machine-readable output
    #[arg(long)]
    pub json: bool,
}

/// Subcommands of `hydroflex job`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Submit a job from a JSON file (`-` for standard input)
    Submit {
        /// Job as JSON
        file: PathBuf,
        /// Machine file of one's own, in place of the job's machine
        #[arg(long)]
        machine: Option<PathBuf>,
        /// BODY=FILE: upload this Abaqus mesh and give it to the job's machine; may be repeated
        #[arg(long, value_parser = mesh_of_body)]
        mesh: Vec<(String, PathBuf)>,
        /// Wait until the data set is published and the networks are trained
        #[arg(long)]
        wait: bool,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// List jobs
    List {
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Show one job
    Show {
        /// Job id
        job: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Follow one job until it ends
    Watch {
        /// Job id
        job: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Do again what failed of a job that is over: given-up runs, or failed trainings
    Retry {
        /// Job id
        job: String,
        /// Wait until it is over
        #[arg(long)]
        wait: bool,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Cancel a job
    Cancel {
        /// Job id
        job: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
}

/// Runs the command.
///
/// # Errors
/// If the service cannot be reached or refuses, and, for `--wait` and `watch`, if the job does not succeed.
pub fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Submit {
            file,
            machine,
            mesh,
            wait,
            service,
        } => submit(&file, machine.as_deref(), &mesh, wait, &service),
        Command::List { service } => list(&service),
        Command::Show { job, service } => {
            let status: JobStatus = Client::new(&service.url)?.get(&format!("/v1/jobs/{job}"))?;
            print(&status, service.json)
        }
        Command::Watch { job, service } => watch(&Client::new(&service.url)?, &job, service.json),
        Command::Retry { job, wait, service } => {
            let client = Client::new(&service.url)?;
            let status: JobStatus = client.post(&format!("/v1/jobs/{job}/retry"), &serde_json::json!({}))?;
            if wait {
                return watch(&client, &job, service.json);
            }
            print(&status, service.json)
        }
        Command::Cancel { job, service } => {
            let client = Client::new(&service.url)?;
            let status: JobStatus = client.post(&format!("/v1/jobs/{job}/cancel"), &serde_json::json!({}))?;
            print(&status, service.json)
        }
    }
}

fn mesh_of_body(argument: &str) -> Result<(String, PathBuf), String> {
    match argument.split_once('=') {
        Some((body, file)) if !body.is_empty() && !file.is_empty() => Ok((body.to_owned(), file.into())),
        _ => Err("expected BODY=FILE, for example lift=boom.inp".to_owned()),
    }
}

/// The job with another machine.
fn with_machine(text: &str, machine: &Path) -> anyhow::Result<String> {
    let mut job: serde_json::Value = serde_json::from_str(text).context("the job is not JSON")?;
    let fields = job.as_object_mut().context("the job is not a JSON object")?;
    let toml = read_text(machine, "machine file")?;
    fields.insert("machine".to_owned(), serde_json::json!({ "toml": toml }));
    Ok(job.to_string())
}

/// The job with the hashes of meshes that are uploaded for it.
fn with_meshes(client: &Client, text: &str, meshes: &[(String, PathBuf)]) -> anyhow::Result<String> {
    let mut job: serde_json::Value = serde_json::from_str(text).context("the job is not JSON")?;
    let fields = job.as_object_mut().context("the job is not a JSON object")?;
    let given = fields
        .entry("meshes")
        .or_insert_with(|| serde_json::json!({}))
        .as_object_mut()
        .context("the job's \"meshes\" is not an object")?;
    for (body, file) in meshes {
        let content =
            std::fs::read(file).with_context(|| format!("cannot read the mesh {}", file.display()))?;
        let info: MeshInfo = client
            .post_bytes("/v1/meshes", content)
            .with_context(|| format!("mesh {}", file.display()))?;
        given.insert(body.clone(), info.mesh_sha256.into());
    }
    Ok(job.to_string())
}

fn submit(
    file: &Path,
    machine: Option<&Path>,
    meshes: &[(String, PathBuf)],
    wait: bool,
    service: &ServiceArgs,
) -> anyhow::Result<()> {
    let mut text = read_text(file, "job")?;
    if let Some(machine) = machine {
        text = with_machine(&text, machine)?;
    }
    let client = Client::new(&service.url)?;
    if !meshes.is_empty() {
        text = with_meshes(&client, &text, meshes)?;
    }
    let status: JobStatus = client.post_text("/v1/jobs", text)?;
    if wait {
        // At once: who stops waiting, or may not read, still knows which job it is.
        eprintln!("job {}", status.job_id);
        return watch(&client, &status.job_id.to_string(), service.json);
    }
    print(&status, service.json)
}

fn watch(client: &Client, job: &str, json: bool) -> anyhow::Result<()> {
    let status = client.follow(job, json)?;
    print(&status, json)?;
    if status.state == JobState::Succeeded {
        return Ok(());
    }
    anyhow::bail!(
        "job {} {}: {}",
        status.job_id,
        status.state,
        status.reason.as_deref().unwrap_or("no reason given")
    )
}

fn list(service: &ServiceArgs) -> anyhow::Result<()> {
    let client = Client::new(&service.url)?;
    let mut path = "/v1/jobs".to_owned();
    let mut all = Vec::new();
    loop {
        let page: JobPage = client.get(&path)?;
        all.extend(page.jobs);
        match page.next_cursor {
            Some(cursor) => path = format!("/v1/jobs?cursor={cursor}"),
            None => break,
        }
    }
    if service.json {
        return super::print_json(&all);
    }
    super::print_line(format_args!(
        "{:36}  {:10}  {:>16}  created",
        "job", "state", "runs"
    ))?;
    for job in &all {
        super::print_line(format_args!(
            "{}  {:10}  {:>7} / {:<6}  {}",
            job.job_id,
            job.state.as_str(),
            job.progress.runs_done,
            job.progress.runs_total,
            job.created_at
        ))?;
    }
    Ok(())
}

fn print(status: &JobStatus, json: bool) -> anyhow::Result<()> {
    if json {
        return super::print_json(status);
    }
    let progress = &status.progress;
    super::print_line(format_args!("job      {}", status.job_id))?;
    super::print_line(format_args!("state    {}", status.state))?;
    if let Some(reason) = &status.reason {
        super::print_line(format_args!("reason   {reason}"))?;
    }
    for notice in &status.notices {
        super::print_line(format_args!("notice   {}: {}", notice.pointer, notice.detail))?;
    }
    super::print_line(format_args!(
        "runs     {} of {} done, {} failed",
        progress.runs_done, progress.runs_total, progress.runs_failed
    ))?;
    let spent = &progress.spent;
    let done = progress.runs_done + progress.settling_done;
    if done > 0 {
        let per_run_ms = |seconds: f64| 1e3 * seconds / done as f64;
        super::print_line(format_args!(
            "workers  {:.3} ms per run: {:.3} simulate, {:.3} encode, {:.3} put; {:.3} waiting beside",
            per_run_ms(spent.simulate_s + spent.encode_s + spent.put_s),
            per_run_ms(spent.simulate_s),
            per_run_ms(spent.encode_s),
            per_run_ms(spent.put_s),
            per_run_ms(spent.wait_s)
        ))?;
    }
    if let (Some(id), Some(sha256)) = (&status.dataset_id, &status.dataset_sha256) {
        super::print_line(format_args!("data set {id} (SHA-256 {sha256})"))?;
    }
    for training in &status.trainings {
        let outcome = match (&training.model_id, &training.reason) {
            (Some(model), _) => format!("model {model}"),
            (None, Some(reason)) => reason.clone(),
            (None, None) => String::new(),
        };
        super::print_line(format_args!(
            "training {} {} {outcome}",
            training.spec.structure, training.state
        ))?;
    }
    Ok(())
}
