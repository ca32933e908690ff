//! Names of workers: unique for every process start, and readable where the process runs.
//!
//! `HOST.BOOT.PIDNS.PID.START` names the boot, the pid namespace, the pid and its start time, so that
//! a coordinator on the same machine sees at once that a process has ended, however it ended.

use std::fs;
use std::sync::OnceLock;

/// What tells processes of this machine, boot and container apart from all others.
fn home() -> Option<&'static str> {
    static HOME: OnceLock<Option<String>> = OnceLock::new();
    HOME.get_or_init(|| {
        let host = fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
        let namespace = fs::read_link("/proc/self/ns/pid").ok()?;
        let namespace: String = namespace
            .to_string_lossy()
            .chars()
            .filter(char::is_ascii_digit)
            .collect();
        // The dot separates: a host name may not bring its own.
        let host = host.trim().replace('.', "-");
        Some(format!("{host}.{}.{namespace}", boot.trim().get(..8)?))
    })
    .as_deref()
}

/// Start time of a process in clock ticks since boot; `None` if there is no such process, or only
/// its remains wait for their parent.
fn start_of(pid: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The second field, the command, is in parentheses and may hold anything.
    let mut fields = stat.rsplit_once(')')?.1.split_ascii_whitespace();
    match fields.next()? {
        "Z" | "X" => None,
        // State is field 3, the start time field 22.
        _ => fields.nth(18)?.parse().ok(),
    }
}

/// A name for this process; `life` tells apart lives of one process under several names.
#[must_use]
pub fn worker_name(role: &str, life: u64) -> String {
    let pid = std::process::id();
    match (home(), start_of(pid)) {
        (Some(home), Some(start)) => format!("{role}.{home}.{pid}.{start}.{life}"),
        // Not Linux, or no /proc: only the beat tells whether such a worker lives.
        _ => format!("{role}.{}", uuid::Uuid::now_v7()),
    }
}

/// True if the name is that of a process of this machine and container that has ended.
#[must_use]
pub fn is_dead_here(name: &str) -> bool {
    let Some(home) = home() else { return false };
    let Some((_, rest)) = name.split_once('.') else {
        return false;
    };
    let Some(process) = rest.strip_prefix(home).and_then(|rest| rest.strip_prefix('.')) else {
        return false;
    };
    let mut parts = process.split('.');
    let pid: Option<u32> = parts.next().and_then(|pid| pid.parse().ok());
    let start: Option<u64> = parts.next().and_then(|start| start.parse().ok());
    match (pid, start) {
        (Some(pid), Some(start)) => start_of(pid) != Some(start),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_living_process_is_not_dead_and_an_ended_one_is() {
        let name = worker_name("worker", 1);
        assert!(!is_dead_here(&name), "{name}");
        assert!(!is_dead_here("worker.another-host.0a1b2c3d.4026531836.12.3456.1"));
        assert!(!is_dead_here("anything"));
        if let Some(home) = home() {
            let mut child = std::process::Command::new("true").spawn().unwrap();
            let pid = child.id();
            child.wait().unwrap();
            assert!(is_dead_here(&format!("worker.{home}.{pid}.1.1")));
        }
    }
}
