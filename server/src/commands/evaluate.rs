//! `hydroflex evaluate`: a model against a data set it has not seen.

use std::path::PathBuf;

/// Arguments of `hydroflex evaluate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Model directory
    #[arg(long)]
    pub model: PathBuf,
    /// Data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Write a picture (SVG) of one run: reference, estimate and error over time
    #[arg(long)]
    pub plot: Option<PathBuf>,
    /// Run of the picture (default: the first)
    #[arg(long)]
    pub run: Option<u64>,
    /// Print machine-readable metrics
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
