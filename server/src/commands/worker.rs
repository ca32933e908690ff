//! `hydroflex worker`: one worker process.

use crate::coordinator::train::{self, TrainerConfig};
use crate::service;
use anyhow::Context;
use hydroflex_worker::lifetime;
use hydroflex_worker::shard_loop::{self, Ended, RunLimits, WorkerConfig};
use std::path::PathBuf;
use std::time::Duration;
use tokio::sync::watch;

/// Arguments of `hydroflex worker`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Database URL: sqlite:PATH or postgres://USER@HOST/NAME
    #[arg(long, env = "HYDROFLEX_DATABASE", hide_env_values = true)]
    pub database: String,
    /// Store URL: file:///DIRECTORY or s3://BUCKET/PREFIX; the usual AWS_… variables name region, endpoint and
    /// credentials
    #[arg(long, env = "HYDROFLEX_STORE", hide_env_values = true)]
    pub store: String,
    /// Directory for caches (default: a folder of the user's cache directory)
    #[arg(long)]
    pub cache: Option<PathBuf>,
    /// Threads that simulate or train
    #[arg(long, default_value_t = 1, value_parser = super::at_once(1))]
    pub threads: usize,
    /// Finish the shard in hand and stop after this many seconds
    #[arg(long)]
    pub drain_after: Option<u64>,
    /// What a run may take
    #[command(flatten)]
    pub limits: LimitArgs,
    /// Simulate runs, or train networks
    #[arg(long, value_enum, default_value_t = Role::Simulate)]
    pub role: Role,
    /// Stop when the process with this id has gone
    #[arg(long, hide = true)]
    pub parent: Option<u32>,
    /// Log as JSON lines
    #[arg(long)]
    pub json: bool,
}

/// What a run may take of a worker. A run that takes more is isolated and recorded; all others are delivered.
#[derive(Debug, Clone, clap::Args)]
pub struct LimitArgs {
    /// Longest time of one run in seconds
    #[arg(long, default_value_t = 600, env = "HYDROFLEX_RUN_LIMIT", value_parser = clap::value_parser!(u64).range(1..))]
    pub run_limit: u64,
    /// Most memory of a worker process in MiB; 0 for no limit
    #[arg(long, default_value_t = 4096, env = "HYDROFLEX_MEMORY_LIMIT")]
    pub memory_limit: u64,
}

impl LimitArgs {
    /// In the worker's terms.
    #[must_use]
    pub fn limits(&self) -> RunLimits {
        RunLimits {
            time: Duration::from_secs(self.run_limit),
            memory_bytes: self.memory_limit << 20,
        }
    }
}

/// What a worker does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Role {
    /// Simulate runs
    Simulate,
    /// Train networks
    Train,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(args: Args) -> anyhow::Result<()> {
    // First of all: from here on this process ends with its parent.
    if let Some(parent) = args.parent {
        lifetime::die_with_parent(parent)?;
        // Ctrl-C reaches the whole group; the parent decides what becomes of us.
        ignore_interrupt()?;
    }
    super::log::start(args.json, if args.parent.is_some() { "warn" } else { "info" });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    let ended = runtime.block_on(work(args));
    // A hung run cannot be stopped, so the process does not wait for its threads.
    runtime.shutdown_background();
    ended
}

async fn work(args: Args) -> anyhow::Result<()> {
    let cache = match args.cache {
        Some(cache) => cache,
        None => default_cache(),
    };
    std::fs::create_dir_all(&cache).with_context(|| format!("cannot make {}", cache.display()))?;
    let (stop, told) = watch::channel(false);
    tokio::spawn(async move {
        if service::until_told_to_stop().await.is_ok() {
            tracing::info!("draining");
            stop.send_replace(true);
        }
        // Dropping the sender would read as "never stop": keep it.
        std::future::pending::<()>().await;
        drop(stop);
    });
    match args.role {
        Role::Simulate => {
            let config = WorkerConfig {
                database: args.database,
                store: args.store,
                cache,
                threads: args.threads,
                drain_after: args.drain_after.map(Duration::from_secs),
                limits: args.limits.limits(),
            };
            match shard_loop::work(config, told).await? {
                Ended::Drained => Ok(()),
                Ended::Spoiled => anyhow::bail!("a run takes more than it may, and cannot be stopped"),
            }
        }
        Role::Train => {
            // Sums do not depend on how many there are.
            rayon::ThreadPoolBuilder::new()
                .num_threads(args.threads.max(1))
                .build_global()
                .context("cannot start the training threads")?;
            let config = TrainerConfig {
                database: args.database,
                store: args.store,
                cache,
            };
            train::work(config, told).await
        }
    }
}

/// Where reduced bodies are kept if nobody says otherwise.
pub(super) fn default_cache() -> PathBuf {
    let home = || std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cache"));
    std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(home)
        .unwrap_or_else(std::env::temp_dir)
        .join("hydroflex")
}

fn ignore_interrupt() -> anyhow::Result<()> {
    // A stream that nobody reads swallows the signal for the life of the process.
    let runtime = std::thread::Builder::new().name("interrupts".to_owned());
    runtime.spawn(|| {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else {
            return;
        };
        runtime.block_on(async { while tokio::signal::ctrl_c().await.is_ok() {} });
    })?;
    Ok(())
}
