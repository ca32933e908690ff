//! One file per subcommand.

#![allow(
    clippy::needless_pass_by_value,
    reason = "a command owns the arguments it was called with"
)]

pub mod demo;
pub mod serve;
pub mod worker;
pub mod simulate;
pub mod machine;
pub mod job;
pub mod sweep;
pub mod rerun;
pub mod reproduce;
pub mod dataset;
pub mod key;
pub mod train;
pub mod evaluate;
pub mod model;
pub mod predict;
pub mod paper;
mod log;

use anyhow::Context as _;
use clap::builder::RangedU64ValueParser;
use hydroflex_dataset::Dataset;
use std::io::Write as _;
use std::path::Path;

/// Threads or processes at once: more than any one machine has use for would only take its memory.
const MOST_AT_ONCE: u64 = 1024;

/// Reads a number of threads or processes, `least` to [`MOST_AT_ONCE`].
fn at_once(least: u64) -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(least..=MOST_AT_ONCE)
}

/// The text of a file, or of standard input for `-`; `what` says in an error what it is.
///
/// # Errors
/// If it cannot be read.
pub(crate) fn read_text(file: &Path, what: &str) -> anyhow::Result<String> {
    if file == Path::new("-") {
        return std::io::read_to_string(std::io::stdin())
            .with_context(|| format!("cannot read the {what} from standard input"));
    }
    std::fs::read_to_string(file).with_context(|| format!("cannot read the {what} {}", file.display()))
}

/// A data set in a directory, every file as its hash says.
///
/// # Errors
/// If it is damaged or cannot be read.
pub(crate) fn open_dataset(folder: &Path) -> anyhow::Result<Dataset> {
    let opened = Dataset::open(folder).and_then(|dataset| dataset.verify().map(|()| dataset));
    opened.with_context(|| format!("cannot open {}", folder.display()))
}

/// Prints a line for people to standard output. A closed pipe ends the command instead of a panic.
///
/// # Errors
/// If standard output cannot be written.
pub(crate) fn print_line(line: std::fmt::Arguments<'_>) -> anyhow::Result<()> {
    writeln!(std::io::stdout().lock(), "{line}").context("cannot write to standard output")
}

/// Prints a value as one JSON document, for scripts.
///
/// # Errors
/// If standard output cannot be written.
pub(crate) fn print_json(value: &impl serde::Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(value).context("cannot write as JSON")?;
    print_line(format_args!("{text}"))
}
