//! A PostgreSQL server of our own. Where PostgreSQL is not installed, its tests pass with a note.

use super::{free_port, when_we_are_gone};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

/// How long a server may take to start on a machine with much else to do.
const PATIENCE: Duration = Duration::from_mins(3);

/// A server with its own data directory; the operating system's programs, our port.
pub struct Postgres {
    port: u16,
    programs: PathBuf,
    folder: PathBuf,
    process: Mutex<Child>,
}

/// The server that the tests of one process share; `None` where PostgreSQL is not installed.
pub fn shared() -> Option<&'static Postgres> {
    static SERVER: OnceLock<Option<Postgres>> = OnceLock::new();
    SERVER.get_or_init(Postgres::start).as_ref()
}

/// URL of a new, empty database of the shared server.
pub fn fresh_database(name: &str) -> Option<String> {
    Some(shared()?.database(name))
}

impl Postgres {
    /// Starts a server; `None` where PostgreSQL is not installed.
    pub fn start() -> Option<Self> {
        let Some(programs) = programs() else {
            eprintln!("PostgreSQL is not installed: its part of the suite is left out");
            return None;
        };
        let folder = tempfile::tempdir().expect("a temporary directory").keep();
        if is_root() {
            let owned = Command::new("chown").arg("postgres").arg(&folder).status();
            assert!(owned.expect("chown").success());
        }
        let made = as_postgres(&programs.join("initdb"))
            .args([
                "--username=postgres",
                "--auth=trust",
                "--encoding=UTF8",
                "--no-sync",
            ])
            .arg("--pgdata")
            .arg(folder.join("data"))
            .stdout(Stdio::null())
            .status();
        assert!(made.expect("initdb").success(), "initdb");
        let port = free_port();
        let process = Mutex::new(launch(&programs, &folder, port));
        when_we_are_gone(
            &format!("kill -QUIT $(head -1 '{}/data/postmaster.pid')", folder.display()),
            &folder,
        );
        let server = Self {
            port,
            programs,
            folder,
            process,
        };
        server.wait_until_ready();
        Some(server)
    }

    /// Its port on this machine.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// URL of a new, empty database.
    pub fn database(&self, name: &str) -> String {
        // PostgreSQL cuts names at 63 bytes; ours differ before.
        let name: String = name.chars().take(60).collect();
        let made = as_postgres(&self.programs.join("createdb"))
            .args(["--host", &self.folder.display().to_string()])
            .args(["--port", &self.port.to_string(), "--username=postgres", &name])
            .status();
        assert!(made.expect("createdb").success(), "createdb {name}");
        format!("postgres://postgres@127.0.0.1:{}/{name}", self.port)
    }

    /// Kills the server as a power cut would, and starts it again on the same port.
    pub fn kill_and_restart(&self, pause: Duration) {
        let mut process = self.process.lock().expect("nobody panics with the lock");
        process.kill().expect("our own process");
        process.wait().expect("our own process");
        std::thread::sleep(pause);
        *process = launch(&self.programs, &self.folder, self.port);
        let start = Instant::now();
        while !self.is_ready() {
            assert!(start.elapsed() < PATIENCE, "PostgreSQL does not restart");
            std::thread::sleep(Duration::from_millis(50));
            // Until the old server's last process has gone, a new one refuses to start.
            if !matches!(process.try_wait(), Ok(None)) {
                *process = launch(&self.programs, &self.folder, self.port);
            }
        }
    }

    fn wait_until_ready(&self) {
        let start = Instant::now();
        while !self.is_ready() {
            assert!(start.elapsed() < PATIENCE, "PostgreSQL does not start");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    fn is_ready(&self) -> bool {
        let ready = Command::new(self.programs.join("pg_isready"))
            .args(["--host=127.0.0.1", &format!("--port={}", self.port)])
            .stdout(Stdio::null())
            .status();
        ready.expect("pg_isready").success()
    }
}

fn launch(programs: &Path, folder: &Path, port: u16) -> Child {
    as_postgres(&programs.join("postgres"))
        .arg("-D")
        .arg(folder.join("data"))
        .args(["-p", &port.to_string(), "-k", &folder.display().to_string()])
        .args(["-c", "listen_addresses=127.0.0.1", "-c", "max_connections=300"])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("PostgreSQL's own program")
}

/// PostgreSQL refuses to run as root: then it runs as the user that its package made.
fn as_postgres(program: &Path) -> Command {
    if is_root() {
        let mut command = Command::new("setpriv");
        command
            .args(["--reuid=postgres", "--regid=postgres", "--init-groups", "--"])
            .arg(program);
        command
    } else {
        Command::new(program)
    }
}

fn is_root() -> bool {
    std::fs::metadata("/proc/self").is_ok_and(|own| own.uid() == 0)
}

fn programs() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").ok()?;
    versions
        .flatten()
        .map(|version| version.path().join("bin"))
        .find(|bin| bin.join("initdb").is_file())
}
