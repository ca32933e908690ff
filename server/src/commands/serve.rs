//! `hydroflex serve`: coordinator, REST interface and local workers.

use crate::service::{self, ServiceConfig};
use anyhow::Context;
use std::path::PathBuf;
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
    /// Local worker processes (default: one per core; 0 for none)
    #[arg(long)]
    pub workers: Option<usize>,
    /// Database URL (default: SQLite below --data)
    #[arg(long, env = "HYDROFLEX_DATABASE", hide_env_values = true)]
    pub database: Option<String>,
    /// Blob store URL (default: a directory below --data)
    #[arg(long, env = "HYDROFLEX_STORE", hide_env_values = true)]
    pub store: Option<String>,
    /// Log as JSON lines
    #[arg(long)]
    pub json: bool,
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
    if let Some(workers) = args.workers {
        config.workers = workers;
    }
    let workers = config.workers;
    let service = service::start(config, listener).await?;
    tracing::info!(
        url = service.url(),
        workers,
        "serving; {}/docs/ shows the interface",
        service.url()
    );
    service::until_told_to_stop().await?;
    tracing::info!("stopping");
    service.stop().await;
    Ok(())
}
