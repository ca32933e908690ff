//! The `hydroflex` binary: arguments, wiring, exit status.

use clap::{Parser, Subcommand};
use hydroflex_server::commands;

/// Real-time structural estimation for hydraulically driven flexible booms: simulate, store, train, predict.
#[derive(Parser)]
#[command(name = "hydroflex", version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run the whole chain on the built-in boom: simulate, train, evaluate, draw, then serve
    Demo(commands::demo::Args),
    /// Start the coordinator with its REST interface, and local workers
    Serve(commands::serve::Args),
    /// Start one worker that pulls shards from a coordinator's database
    Worker(commands::worker::Args),
    /// Simulate the runs of a table and write a data set
    Simulate(commands::simulate::Args),
    /// Inspect machine files
    #[command(subcommand)]
    Machine(commands::machine::Command),
    /// Submit and follow jobs of a running service
    #[command(subcommand)]
    Job(commands::job::Command),
    /// Train many networks on one data set, and compare them
    #[command(subcommand)]
    Sweep(commands::sweep::Command),
    /// Replay one run of a job and show it
    Rerun(commands::rerun::Args),
    /// Make a data set again from its manifest, and compare the hashes
    Reproduce(commands::reproduce::Args),
    /// Download data sets from a running service
    #[command(subcommand)]
    Dataset(commands::dataset::Command),
    /// Make, list and revoke API keys
    #[command(subcommand)]
    Key(commands::key::Command),
    /// Train a network on a data set
    Train(commands::train::Args),
    /// Evaluate a model on a data set it has not seen
    Evaluate(commands::evaluate::Args),
    /// List the models of a running service
    #[command(subcommand)]
    Model(commands::model::Command),
    /// Estimate deflection, strain and stress from recorded sensor signals
    Predict(commands::predict::Args),
    /// Repeat the published study: simulate, train the grid, evaluate, write the report
    ReproducePaper(commands::paper::Args),
}

fn main() -> std::process::ExitCode {
    let cli = Cli::parse();
    let result = match cli.command {
        Command::Demo(args) => commands::demo::run(args),
        Command::Serve(args) => commands::serve::run(args),
        Command::Worker(args) => commands::worker::run(args),
        Command::Simulate(args) => commands::simulate::run(args),
        Command::Machine(command) => commands::machine::run(command),
        Command::Job(command) => commands::job::run(command),
        Command::Sweep(command) => commands::sweep::run(command),
        Command::Rerun(args) => commands::rerun::run(args),
        Command::Reproduce(args) => commands::reproduce::run(args),
        Command::Dataset(command) => commands::dataset::run(command),
        Command::Key(command) => commands::key::run(command),
        Command::Train(args) => commands::train::run(args),
        Command::Evaluate(args) => commands::evaluate::run(args),
        Command::Model(command) => commands::model::run(command),
        Command::Predict(args) => commands::predict::run(args),
        Command::ReproducePaper(args) => commands::paper::run(args),
    };
    match result {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", one_line(&error));
            std::process::ExitCode::FAILURE
        }
    }
}

/// An error and its causes, outermost first. A cause that the text before it quotes already is left out: some libraries
/// print theirs, and name it too.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line.push_str(": ");
            line.push_str(&cause);
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;

    #[test]
    fn a_cause_that_was_quoted_is_not_printed_again() {
        let inner = std::io::Error::other("refused");
        let quoting = anyhow::anyhow!("GET failed: {inner}");
        let error = Err::<(), _>(inner)
            .context(quoting.to_string())
            .context("the store does not answer")
            .unwrap_err();
        assert_eq!(
            super::one_line(&error),
            "the store does not answer: GET failed: refused"
        );
        let error = Err::<(), _>(std::io::Error::other("no space"))
            .context("cannot write x")
            .unwrap_err();
        assert_eq!(super::one_line(&error), "cannot write x: no space");
    }
}
