//! `hydroflex model`: models of a running service.

use super::job::ServiceArgs;
use crate::client::Client;
use hydroflex_openapi::catalogue::ModelPage;

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
/// If the service cannot be reached or refuses.
pub fn run(command: Command) -> anyhow::Result<()> {
    let Command::List { service } = command;
    let client = Client::new(&service.url)?;
    let mut path = "/v1/models".to_owned();
    let mut all = Vec::new();
    loop {
        let page: ModelPage = client.get(&path)?;
        all.extend(page.models);
        match page.next_cursor {
            Some(cursor) => path = format!("/v1/models?cursor={cursor}"),
            None => break,
        }
    }
    if service.json {
        return super::print_json(&all);
    }
    super::print_line(format_args!(
        "{:32}  {:10}  {:32}  created",
        "model", "structure", "data set"
    ))?;
    for model in &all {
        super::print_line(format_args!(
            "{}  {:10}  {}  {}",
            model.model_id, model.spec.structure, model.dataset_id, model.created_at
        ))?;
    }
    Ok(())
}
