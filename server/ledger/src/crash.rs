//! Places where a test lets a process die, as by `kill -9`.
//!
//! `HYDROFLEX_CRASH_AT=commit` kills the process when it first passes the point `commit`,
//! `HYDROFLEX_CRASH_AT=commit:3` when it passes it for the third time. With `HYDROFLEX_CRASH_ONCE=FILE`
//! only one process dies: the first to create that file. `HYDROFLEX_CRASH_HOW` says what happens there:
//! `kill` (default), `hang`, or `eat` memory.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// Environment variable that names the point.
pub const CRASH_AT: &str = "HYDROFLEX_CRASH_AT";
/// Environment variable that says how to die.
pub const CRASH_HOW: &str = "HYDROFLEX_CRASH_HOW";
/// Environment variable that names the marker file.
pub const CRASH_ONCE: &str = "HYDROFLEX_CRASH_ONCE";

struct Plan {
    point: String,
    remaining: AtomicU64,
    marker: Option<std::path::PathBuf>,
}

fn plan() -> Option<&'static Plan> {
    static PLAN: OnceLock<Option<Plan>> = OnceLock::new();
    PLAN.get_or_init(|| {
        let text = std::env::var(CRASH_AT).ok()?;
        let (point, times) = text.split_once(':').unwrap_or((&text, "1"));
        Some(Plan {
            point: point.to_owned(),
            remaining: AtomicU64::new(times.parse().unwrap_or(1)),
            marker: std::env::var_os(CRASH_ONCE).map(Into::into),
        })
    })
    .as_ref()
}

/// Passes the point `NAME-NUMBER`, such as the beginning of a run.
pub fn crash_point_of(name: &str, number: u64) {
    // Formatted only where a test has set a plan: this is called for every run.
    if plan().is_some() {
        crash_point(&format!("{name}-{number}"));
    }
}

/// Passes a point; returns unless the environment asks for a death here.
pub fn crash_point(point: &str) {
    let Some(plan) = plan().filter(|plan| plan.point == point) else {
        return;
    };
    if plan.remaining.fetch_sub(1, Ordering::SeqCst) != 1 {
        return;
    }
    if let Some(marker) = &plan.marker
        && std::fs::File::create_new(marker).is_err()
    {
        return;
    }
    tracing::warn!(point, "dying here because {CRASH_AT} asks for it");
    match std::env::var(CRASH_HOW).as_deref() {
        Ok("hang") => loop {
            std::thread::sleep(std::time::Duration::from_hours(1));
        },
        Ok("eat") => {
            let mut eaten: Vec<Vec<u8>> = Vec::new();
            loop {
                // Slowly enough to be seen on a busy machine: the kernel's limit says no reason.
                eaten.push(vec![1; 4 << 20]);
                std::thread::sleep(std::time::Duration::from_millis(10));
            }
        }
        _ => {}
    }
    // SIGKILL cannot be caught, so no destructor, flush or handler runs: the honest kind of crash.
    let _ = nix::sys::signal::kill(nix::unistd::Pid::this(), nix::sys::signal::Signal::SIGKILL);
}
