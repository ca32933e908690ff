//! `hydroflex demo`: the whole chain on one machine.

use std::path::PathBuf;

/// Arguments of `hydroflex demo`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Directory for everything the demo writes
    #[arg(long, default_value = "hydroflex-demo")]
    pub data: PathBuf,
    /// Address of the REST interface; a taken port is replaced by a free one
    #[arg(long, default_value = "127.0.0.1:8080")]
    pub listen: std::net::SocketAddr,
    /// Runs of the job
    #[arg(long, default_value_t = 80)]
    pub runs: u64,
    /// Worker processes (default: one per core)
    #[arg(long)]
    pub workers: Option<usize>,
    /// Stop when the chain is done instead of serving on
    #[arg(long)]
    pub exit: bool,
    /// Print machine-readable progress and results
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
