//! `hydroflex worker`: one worker process.

use std::path::PathBuf;

/// Arguments of `hydroflex worker`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Database URL
    #[arg(long, env = "HYDROFLEX_DATABASE")]
    pub database: String,
    /// Blob store URL
    #[arg(long, env = "HYDROFLEX_STORE")]
    pub store: String,
    /// Directory for caches (default: a folder of the user's cache directory)
    #[arg(long)]
    pub cache: Option<PathBuf>,
    /// Threads that simulate
    #[arg(long, default_value_t = 1)]
    pub threads: usize,
    /// Finish the shard in hand and stop after this many seconds
    #[arg(long)]
    pub drain_after: Option<u64>,
    /// Stop when the process with this id has gone
    #[arg(long, hide = true)]
    pub parent: Option<u32>,
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
