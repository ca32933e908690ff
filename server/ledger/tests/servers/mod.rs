//! Servers that tests start for themselves: each with its own directory and port, gone with the test.

pub mod moto;
pub mod postgres;

use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};

/// A port that was free a moment ago.
#[must_use]
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a loopback interface");
    listener.local_addr().expect("an address").port()
}

/// Runs a shell command as soon as this process is gone, however it ends: a test process runs no
/// destructors of statics, and none at all when it is killed.
#[allow(
    clippy::zombie_processes,
    reason = "it waits for our end, so we cannot wait for its"
)]
fn when_we_are_gone(command: &str, folder: &Path) {
    let script = format!(
        "while kill -0 {} 2>/dev/null; do sleep 0.2; done; {command}; sleep 0.5; rm -rf '{}'",
        std::process::id(),
        folder.display()
    );
    Command::new("sh")
        .args(["-c", &script])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("a shell");
}
