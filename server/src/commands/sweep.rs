//! `hydroflex sweep`: many networks on one data set of a running service, and what they found.

use super::job::ServiceArgs;
use super::read_text;
use crate::client::{Client, bar};
use anyhow::Context;
use hydroflex_openapi::sweep::{SweepPage, SweepState, SweepStatus};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

/// How often a sweep is looked at.
const POLL: Duration = Duration::from_millis(500);

/// Subcommands of `hydroflex sweep`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Submit a sweep from a JSON file (`-` for standard input)
    Submit {
        /// Sweep as JSON
        file: PathBuf,
        /// Wait until every network is trained, and print the table
        #[arg(long)]
        wait: bool,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// List sweeps
    List {
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Show one sweep
    Show {
        /// Sweep id
        sweep: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Follow one sweep until it ends, and print the table
    Watch {
        /// Sweep id
        sweep: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// What a sweep found, as far as it is
    Table {
        /// Sweep id
        sweep: String,
        /// Form of the table
        #[arg(long, value_enum, default_value_t = Form::Markdown)]
        form: Form,
        /// Also write the picture to this SVG file
        #[arg(long)]
        plot: Option<PathBuf>,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Train again what failed or was cancelled
    Retry {
        /// Sweep id
        sweep: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Cancel a sweep; models that are there stay
    Cancel {
        /// Sweep id
        sweep: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
}

/// Form of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Form {
    /// For people: means over the seeds
    Markdown,
    /// For spreadsheets: a line per network and target
    Csv,
    /// For scripts: everything
    Json,
}

/// Runs the command.
///
/// # Errors
/// If the service cannot be reached or refuses, and, for `--wait` and `watch`, if the sweep does not succeed.
pub fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Submit { file, wait, service } => {
            let client = Client::new(&service.url)?;
            let status: SweepStatus = client.post_text("/v1/sweeps", read_text(&file, "sweep")?)?;
            if wait {
                return watch(&client, &status.sweep_id.to_string(), service.json);
            }
            print(&status, service.json)
        }
        Command::List { service } => list(&service),
        Command::Show { sweep, service } => {
            let status: SweepStatus = Client::new(&service.url)?.get(&format!("/v1/sweeps/{sweep}"))?;
            print(&status, service.json)
        }
        Command::Watch { sweep, service } => watch(&Client::new(&service.url)?, &sweep, service.json),
        Command::Table {
            sweep,
            form,
            plot,
            service,
        } => {
            let client = Client::new(&service.url)?;
            if let Some(path) = plot {
                let svg = text(&client, &format!("/v1/sweeps/{sweep}/plot.svg"))?;
                std::fs::write(&path, svg).with_context(|| format!("cannot write {}", path.display()))?;
            }
            let form = if service.json { Form::Json } else { form };
            print_table(&client, &sweep, form)
        }
        Command::Retry { sweep, service } => post(&service, &sweep, "retry"),
        Command::Cancel { sweep, service } => post(&service, &sweep, "cancel"),
    }
}

fn post(service: &ServiceArgs, sweep: &str, what: &str) -> anyhow::Result<()> {
    let client = Client::new(&service.url)?;
    let status: SweepStatus = client.post(&format!("/v1/sweeps/{sweep}/{what}"), &serde_json::json!({}))?;
    print(&status, service.json)
}

fn text(client: &Client, path: &str) -> anyhow::Result<String> {
    client
        .send(client.request(path))?
        .text()
        .with_context(|| format!("unexpected answer from {}", client.url(path)))
}

fn print_table(client: &Client, sweep: &str, form: Form) -> anyhow::Result<()> {
    let ending = match form {
        Form::Markdown => ".md",
        Form::Csv => ".csv",
        Form::Json => {
            let table: serde_json::Value = client.get(&format!("/v1/sweeps/{sweep}/table"))?;
            return super::print_json(&table);
        }
    };
    let table = text(client, &format!("/v1/sweeps/{sweep}/table{ending}"))?;
    super::print_line(format_args!("{}", table.trim_end()))
}

fn watch(client: &Client, sweep: &str, json: bool) -> anyhow::Result<()> {
    let shown = bar("train", 0);
    if json {
        shown.set_draw_target(indicatif::ProgressDrawTarget::hidden());
    }
    let status = loop {
        let status: SweepStatus = client.get(&format!("/v1/sweeps/{sweep}"))?;
        let progress = &status.progress;
        shown.set_length(progress.total);
        shown.set_position(progress.succeeded + progress.failed + progress.cancelled);
        shown.set_message(trained(&status));
        if status.state.is_final() {
            break status;
        }
        std::thread::sleep(POLL);
    };
    shown.finish_and_clear();
    print_table(client, sweep, if json { Form::Json } else { Form::Markdown })?;
    if status.state == SweepState::Succeeded {
        return Ok(());
    }
    anyhow::bail!("sweep {sweep} {}: {}", status.state.as_str(), trained(&status))
}

/// `12 of 25 trained, 1 failed`.
fn trained(status: &SweepStatus) -> String {
    let progress = &status.progress;
    let mut text = format!("{} of {} trained", progress.succeeded, progress.total);
    for (count, what) in [
        (progress.running, "running"),
        (progress.failed, "failed"),
        (progress.cancelled, "cancelled"),
    ] {
        if count > 0 {
            // Writing to a String cannot fail.
            let _ = write!(text, ", {count} {what}");
        }
    }
    text
}

fn list(service: &ServiceArgs) -> anyhow::Result<()> {
    let client = Client::new(&service.url)?;
    let mut path = "/v1/sweeps".to_owned();
    let mut all = Vec::new();
    loop {
        let page: SweepPage = client.get(&path)?;
        all.extend(page.sweeps);
        match page.next_cursor {
            Some(cursor) => path = format!("/v1/sweeps?cursor={cursor}"),
            None => break,
        }
    }
    if service.json {
        return super::print_json(&all);
    }
    for sweep in &all {
        super::print_line(format_args!(
            "{}  {:10}  {}  {}",
            sweep.sweep_id,
            sweep.state.as_str(),
            trained(sweep),
            sweep.created_at
        ))?;
    }
    Ok(())
}

fn print(status: &SweepStatus, json: bool) -> anyhow::Result<()> {
    if json {
        return super::print_json(status);
    }
    super::print_line(format_args!("sweep    {}", status.sweep_id))?;
    super::print_line(format_args!("data set {}", status.dataset_id))?;
    super::print_line(format_args!("state    {}", status.state.as_str()))?;
    super::print_line(format_args!("networks {}", trained(status)))
}
