//! `hydroflex predict`: estimates for recorded signals.

use std::path::PathBuf;

/// Arguments of `hydroflex predict`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Model directory
    #[arg(long)]
    pub model: PathBuf,
    /// Recorded signals (Parquet): run_id, step and the model's input channels; or a data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Parquet file to write: run_id, step and the estimates
    #[arg(long)]
    pub out: PathBuf,
    /// Print a machine-readable summary
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
