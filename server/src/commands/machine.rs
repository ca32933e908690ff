//! `hydroflex machine`: inspect machine files.

/// Subcommands of `hydroflex machine`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Mass, inertia, interfaces, frequencies, equilibrium over the range of angles
    Show {
        /// Built-in machine or machine file
        #[arg(default_value = "lift-boom")]
        machine: String,
        /// Mesh file, or BODY=FILE; may be repeated
        #[arg(long)]
        mesh: Vec<String>,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
}

/// Runs the command.
///
/// # Errors
/// Every failure ends the command with its reason.
pub fn run(_command: Command) -> anyhow::Result<()> {
    anyhow::bail!("not wired yet")
}
