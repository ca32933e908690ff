//! `hydroflex job`: jobs of a running service.

/// Where the service is.
#[derive(Debug, Clone, clap::Args)]
pub struct ServiceArgs {
    /// Address of the service
    #[arg(long, default_value = "http://127.0.0.1:8080", env = "HYDROFLEX_URL")]
    pub url: String,
    /// Print machine-readable output
    #[arg(long)]
    pub json: bool,
}

/// Subcommands of `hydroflex job`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Submit a job from a JSON file (`-` for standard input)
    Submit {
        /// Job as JSON
        file: std::path::PathBuf,
        /// Wait until the data set is published and the networks are trained
        #[arg(long)]
        wait: bool,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// List jobs
    List {
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Show one job
    Show {
        /// Job id
        job: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Follow one job until it ends
    Watch {
        /// Job id
        job: String,
        /// Service
        #[command(flatten)]
        service: ServiceArgs,
    },
    /// Cancel a job
    Cancel {
        /// Job id
        job: String,
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
