//! The memory of a worker: watched, so that a run that eats it is named, and limited, so that one that
//! eats faster than we look takes nobody else with it.

use nix::sys::resource::{Resource, setrlimit};
use std::time::Duration;

/// How often the memory is looked at.
const LOOK: Duration = Duration::from_millis(20);

/// Lets the kernel refuse this process memory beyond a quarter more than `bytes`: the process then
/// ends, and whatever it had is simulated elsewhere. 0 sets no limit.
pub(crate) fn limit(bytes: u64) {
    if bytes == 0 {
        return;
    }
    let hard = bytes + bytes / 4;
    if let Err(error) = setrlimit(Resource::RLIMIT_DATA, hard, hard) {
        tracing::warn!(%error, "the memory of this process cannot be limited; it is only watched");
    }
}

/// Ends when this process holds more than `bytes`; never for 0.
pub(crate) async fn exceeded(bytes: u64) {
    if bytes == 0 {
        return std::future::pending().await;
    }
    while resident_bytes().is_none_or(|resident| resident <= bytes) {
        tokio::time::sleep(LOOK).await;
    }
}

/// Memory in use, as the kernel counts it; `None` where it does not tell.
fn resident_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: u64 = line.trim().strip_suffix(" kB")?.parse().ok()?;
    Some(kilobytes << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_touched_is_counted() {
        let before = resident_bytes().unwrap();
        // Used, or the compiler leaves it out.
        let touched = std::hint::black_box(vec![1_u8; 64 << 20]);
        let after = resident_bytes().unwrap();
        assert!(
            after >= before + (60 << 20),
            "{before} bytes before, {after} after {} more",
            touched.len()
        );
    }
}
