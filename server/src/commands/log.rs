//! Structured logs on standard error: the commands that run for long share one form.

use std::io::IsTerminal;
use tracing_subscriber::EnvFilter;

/// Starts logging at `level`, or as `RUST_LOG` says.
pub(super) fn start(json: bool, level: &str) {
    let filter = EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| EnvFilter::new(format!("warn,hydroflex={level},{}", ours(level))));
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr);
    // Fails only if a logger is there already, as in tests; that one is then used.
    let _ = if json {
        builder.json().try_init()
    } else {
        builder
            .with_ansi(std::io::stderr().is_terminal())
            .with_target(false)
            .try_init()
    };
}

fn ours(level: &str) -> String {
    ["server", "worker", "ledger", "sim", "ml", "dataset"]
        .map(|part| format!("hydroflex_{part}={level}"))
        .join(",")
}
