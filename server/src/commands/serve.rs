//! `hydroflex serve`: coordinator, REST interface and local workers.

use crate::service::{self, ServiceConfig};
use anyhow::Context;
use std::path::PathBuf;
use std::time::Duration;
use tokio::net::TcpListener;

/// Arguments of `hydroflex serve`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Address to listen on
    #[arg(long, default_value = "127.0.0.1:8080", env = "HYDROFLEX_LISTEN")]
    pub listen: std::net::SocketAddr,
    /// Directory of the embedded database and store
    #[arg(long, default_value = "hydroflex-data", env = "HYDROFLEX_DATA")]
    pub data: PathBuf,
    /// Directory for reduced bodies (default: below --data)
    #[arg(long, env = "HYDROFLEX_CACHE")]
    pub cache: Option<PathBuf>,
    /// Local worker processes (default: one per core; 0 for none)
    #[arg(long, value_parser = super::at_once(0))]
    pub workers: Option<usize>,
    /// Local trainer processes, which share the cores: trainings that go on at once (0 for none)
    #[arg(long, default_value_t = 1, env = "HYDROFLEX_TRAINERS", value_parser = super::at_once(0))]
    pub trainers: usize,
    /// Database URL: sqlite:PATH or postgres://USER@HOST/NAME (default: SQLite below --data)
    #[arg(long, env = "HYDROFLEX_DATABASE", hide_env_values = true)]
    pub database: Option<String>,
    /// Store URL: file:///DIRECTORY or s3://BUCKET/PREFIX; the usual AWS_… variables name region, endpoint and
    /// credentials (default: a directory below --data)
    #[arg(long, env = "HYDROFLEX_STORE", hide_env_values = true)]
    pub store: Option<String>,
    /// Ask for API keys (`hydroflex key create`); `auto`: unless it listens on loopback only
    #[arg(long, value_enum, default_value_t = Keys::Auto, env = "HYDROFLEX_KEYS")]
    pub keys: Keys,
    /// Unfinished jobs above which no more are accepted
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    pub most_jobs: u64,
    /// Silence in seconds after which a worker is given up and its shard simulated elsewhere
    #[arg(long, default_value_t = 10, env = "HYDROFLEX_LEASE", value_parser = clap::value_parser!(u64).range(2..=3600))]
    pub lease: u64,
    /// What a run may take
    #[command(flatten)]
    pub limits: super::worker::LimitArgs,
    /// Log as JSON lines
    #[arg(long)]
    pub json: bool,
}

/// When to ask for API keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Keys {
    /// Unless the service listens on loopback only
    Auto,
    /// Always
    On,
    /// Never: everybody who reaches the address may do everything
    Off,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    super::log::start(args.json, "info");
    tokio::runtime::Runtime::new()?.block_on(serve(args))
}

async fn serve(args: Args) -> anyhow::Result<()> {
    let listener = TcpListener::bind(args.listen)
        .await
        .with_context(|| format!("cannot listen on {}; --listen takes another address", args.listen))?;
    let mut config = ServiceConfig::new(args.data)?;
    config.database = args.database;
    config.store = args.store;
    config.cache = args.cache;
    if let Some(workers) = args.workers {
        config.workers = workers;
    }
    config.trainers = args.trainers;
    config.lease = Duration::from_secs(args.lease);
    config.limits = args.limits.limits();
    config.most_jobs = args.most_jobs;
    config.keys = match args.keys {
        Keys::Auto => !listener.local_addr()?.ip().is_loopback(),
        Keys::On => true,
        Keys::Off => false,
    };
    let (workers, keys) = (config.workers, config.keys);
    let service = service::start(config, listener).await?;
    tracing::info!(
        url = service.url(),
        workers,
        keys,
        "serving; {}/docs/ shows the interface",
        service.url()
    );
    service::until_told_to_stop().await?;
    tracing::info!("stopping");
    service.stop().await;
    Ok(())
}
