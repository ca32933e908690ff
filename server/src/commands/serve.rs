//! `hydroflex serve`: coordinator, REST interface and local workers.

use std::path::PathBuf;

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
    #[arg(long, env = "HYDROFLEX_DATABASE")]
    pub database: Option<String>,
    /// Blob store URL (default: a directory below --data)
    #[arg(long, env = "HYDROFLEX_STORE")]
    pub store: Option<String>,
    /// Log as JSON lines
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(_args: Args) -> anyhow::Result<()> {
    anyhow::bail!("not wired yet")
}
