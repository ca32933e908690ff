//! `hydroflex dataset`: data sets of a running service.

use super::job::ServiceArgs;

/// Subcommands of `hydroflex dataset`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Download a data set, resuming where an earlier download stopped, and check its hashes
    Fetch {
        /// Data set id
        dataset: String,
        /// Directory to write to
        #[arg(long)]
        out: std::path::PathBuf,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(_command: Command) -> anyhow::Result<()> {
    anyhow::bail!("not wired yet")
}
