//! `hydroflex model`: models of a running service.

use super::job::ServiceArgs;

/// Subcommands of `hydroflex model`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// List models with their metrics and the data set they came from
    List {
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
