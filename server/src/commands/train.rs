//! `hydroflex train`: a network from a data set on disk.

use std::path::PathBuf;

/// Arguments of `hydroflex train`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Data set directory
    #[arg(long)]
    pub data: PathBuf,
    /// Directory to write the model to
    #[arg(long)]
    pub out: PathBuf,
    /// `best`, or the letters of the paper: L, RLR, TLTLT, TLSLTLSLT, ELE, …
    #[arg(long, default_value = "best")]
    pub structure: String,
    /// Input channels, separated by commas
    #[arg(long, value_delimiter = ',')]
    pub inputs: Vec<String>,
    /// Target channels, separated by commas
    #[arg(long, value_delimiter = ',')]
    pub targets: Vec<String>,
    /// Window length in seconds (default: from the data set)
    #[arg(long)]
    pub window_s: Option<f64>,
    /// Seed of initial weights and batches
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Largest number of epochs
    #[arg(long)]
    pub epochs: Option<usize>,
    /// Largest training time in seconds
    #[arg(long)]
    pub time_limit_s: Option<f64>,
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
