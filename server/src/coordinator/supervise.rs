//! Local processes: workers and trainers, started, restarted, stopped, never left behind.
//!
//! One thread of its own starts them all: the kernel ties a child to the *thread* that started it, and
//! threads of an async runtime come and go.

use hydroflex_ledger::crash;
use hydroflex_worker::shard_loop::RunLimits;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use std::ffi::OsString;
use std::fs::OpenOptions;
use std::io;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How often children are looked at.
const LOOK: Duration = Duration::from_millis(50);
/// Pause before a child that ended early is started again; doubled each time up to the longest.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// A child that lived this long has started well: the next pause is the first one again.
const SETTLED: Duration = Duration::from_secs(5);
/// Time to give a shard back before a child is killed.
const GRACE: Duration = Duration::from_secs(5);

/// What to start.
#[derive(Debug, Clone)]
pub struct SuperviseConfig {
    /// The hydroflex binary.
    pub executable: PathBuf,
    /// Database URL.
    pub database: String,
    /// Store URL.
    pub store: String,
    /// Directory for caches.
    pub cache: PathBuf,
    /// Worker processes.
    pub workers: usize,
    /// Trainer processes: trainings that go on at once.
    pub trainers: usize,
    /// Threads of each of them.
    pub trainer_threads: usize,
    /// File for what children say; ours if absent.
    pub log: Option<PathBuf>,
    /// A child that is stopped (SIGSTOP) for longer is killed: it may hold the embedded database's
    /// write lock, and with it everybody else. Longer than a lease, so that its shard is given up first
    /// where that is possible.
    pub longest_stop: Duration,
    /// What a worker's run may take.
    pub limits: RunLimits,
}

/// Running children. Dropping the handle stops them.
pub struct Supervisor {
    stop: Arc<AtomicBool>,
    restarts: Arc<AtomicU64>,
    thread: Option<std::thread::JoinHandle<()>>,
}

struct Slot {
    role: &'static str,
    child: Option<(Child, Instant)>,
    pause: Duration,
    due: Instant,
    stopped_since: Option<Instant>,
}

impl Supervisor {
    /// Starts the children.
    ///
    /// # Errors
    /// If the supervising thread cannot be started.
    pub fn start(config: SuperviseConfig) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let restarts = Arc::new(AtomicU64::new(0));
        let thread = std::thread::Builder::new().name("supervisor".to_owned()).spawn({
            let (stop, restarts) = (stop.clone(), restarts.clone());
            move || supervise(&config, &stop, &restarts)
        })?;
        Ok(Self {
            stop,
            restarts,
            thread: Some(thread),
        })
    }

    /// Children started again because they had ended.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        self.restarts.load(Ordering::Relaxed)
    }

    /// Stops every child and waits until all are gone.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.end();
    }
}

fn supervise(config: &SuperviseConfig, stop: &AtomicBool, restarts: &AtomicU64) {
    let now = Instant::now();
    let slot = |role| Slot {
        role,
        child: None,
        pause: FIRST_PAUSE,
        due: now,
        stopped_since: None,
    };
    let mut slots: Vec<Slot> = (0..config.workers).map(|_| slot("simulate")).collect();
    slots.extend((0..config.trainers).map(|_| slot("train")));
    let mut started = 0_u64;
    let initial = slots.len() as u64;
    while !stop.load(Ordering::Relaxed) {
        for slot in &mut slots {
            // To start many takes a while, and may be what somebody wants to end.
            if stop.load(Ordering::Relaxed) {
                break;
            }
            tend(slot, config, &mut started);
        }
        restarts.store(started.saturating_sub(initial), Ordering::Relaxed);
        std::thread::sleep(LOOK);
    }
    stop_all(&mut slots);
}

fn tend(slot: &mut Slot, config: &SuperviseConfig, started: &mut u64) {
    match &mut slot.child {
        Some((child, since)) => match child.try_wait() {
            Ok(None) if is_stopped(child.id()) => {
                let since = *slot.stopped_since.get_or_insert_with(Instant::now);
                if since.elapsed() > config.longest_stop {
                    tracing::warn!(
                        role = slot.role,
                        pid = child.id(),
                        "a local process stands still; killing it"
                    );
                    let _ = child.kill();
                }
            }
            Ok(None) => slot.stopped_since = None,
            Ok(Some(status)) => {
                slot.stopped_since = None;
                tracing::warn!(role = slot.role, pid = child.id(), %status, "a local process ended");
                slot.pause = if since.elapsed() > SETTLED {
                    FIRST_PAUSE
                } else {
                    (slot.pause * 2).min(LONGEST_PAUSE)
                };
                slot.due = Instant::now() + slot.pause;
                slot.child = None;
            }
            Err(error) => tracing::error!(role = slot.role, %error, "a local process cannot be waited for"),
        },
        None if Instant::now() >= slot.due => match spawn(slot.role, config) {
            Ok(child) => {
                tracing::debug!(role = slot.role, pid = child.id(), "local process started");
                slot.child = Some((child, Instant::now()));
                *started += 1;
            }
            Err(error) => {
                tracing::error!(role = slot.role, %error, "a local process cannot be started; trying again");
                slot.pause = (slot.pause * 2).min(LONGEST_PAUSE);
                slot.due = Instant::now() + slot.pause;
            }
        },
        None => {}
    }
}

/// Whether a process was stopped by a signal: state `T` of `/proc/PID/stat`, the first field after the
/// name in parentheses. A process that cannot be looked at counts as running.
fn is_stopped(pid: u32) -> bool {
    std::fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| {
        stat.rsplit_once(") ")
            .is_some_and(|(_, rest)| rest.starts_with('T'))
    })
}

fn spawn(role: &str, config: &SuperviseConfig) -> io::Result<Child> {
    let threads = if role == "train" {
        config.trainer_threads
    } else {
        1
    };
    let mut cache = OsString::from("--cache=");
    cache.push(&config.cache);
    let mut command = Command::new(&config.executable);
    command
        .args(["worker", "--role", role, "--threads", &threads.to_string()])
        .arg(cache)
        .args(["--parent", &std::process::id().to_string()])
        .args(["--run-limit", &config.limits.time.as_secs().to_string()])
        .args(["--memory-limit", &(config.limits.memory_bytes >> 20).to_string()])
        // Not as arguments: a URL may hold a password, and everybody may read those.
        .env("HYDROFLEX_DATABASE", &config.database)
        .env("HYDROFLEX_STORE", &config.store)
        .stdin(Stdio::null())
        .stdout(Stdio::null());
    // Crash points are for the process they were given to; workers have their own variable.
    command.env_remove(crash::CRASH_AT);
    if let Some(point) = std::env::var_os("HYDROFLEX_CRASH_WORKER_AT") {
        command.env(crash::CRASH_AT, point);
    }
    if let Some(path) = &config.log {
        command.stderr(OpenOptions::new().create(true).append(true).open(path)?);
    }
    command.spawn()
}

fn stop_all(slots: &mut [Slot]) {
    for (child, _) in slots.iter().filter_map(|slot| slot.child.as_ref()) {
        if let Ok(pid) = i32::try_from(child.id()) {
            let _ = kill(Pid::from_raw(pid), Signal::SIGTERM);
        }
    }
    let deadline = Instant::now() + GRACE;
    for slot in slots.iter_mut() {
        let Some((child, _)) = &mut slot.child else {
            continue;
        };
        while Instant::now() < deadline && matches!(child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = child.kill();
        let _ = child.wait();
    }
}
