//! A PostgreSQL server of our own, with its own directory and port, for as long as this process lives.
//! Where PostgreSQL is not installed, its tests pass with a note.

use std::net::TcpListener;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

struct Server {
    port: u16,
    programs: PathBuf,
    folder: PathBuf,
}

/// URL of a new, empty database.
pub(crate) fn fresh_database(name: &str) -> Option<String> {
    static SERVER: OnceLock<Option<Server>> = OnceLock::new();
    let server = SERVER.get_or_init(start).as_ref()?;
    // PostgreSQL cuts names at 63 bytes; ours differ before.
    let name: String = name.chars().take(60).collect();
    let made = as_postgres(&server.programs.join("createdb"))
        .args([
            "--host",
            &server.folder.display().to_string(),
            "--port",
            &server.port.to_string(),
        ])
        .args(["--username=postgres", &name])
        .status()
        .unwrap();
    assert!(made.success(), "createdb {name}");
    Some(format!("postgres://postgres@127.0.0.1:{}/{name}", server.port))
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

fn start() -> Option<Server> {
    let Some(programs) = programs() else {
        eprintln!("PostgreSQL is not installed: its part of the suite is left out");
        return None;
    };
    let folder = tempfile::tempdir().unwrap().keep();
    if is_root() {
        let owned = Command::new("chown")
            .arg("postgres")
            .arg(&folder)
            .status()
            .unwrap();
        assert!(owned.success());
    }
    let data = folder.join("data");
    let made = as_postgres(&programs.join("initdb"))
        .args([
            "--username=postgres",
            "--auth=trust",
            "--encoding=UTF8",
            "--no-sync",
            "--pgdata",
        ])
        .arg(&data)
        .stdout(Stdio::null())
        .status()
        .unwrap();
    assert!(made.success(), "initdb");
    let port = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let mut server = as_postgres(&programs.join("postgres"));
    server
        .arg("-D")
        .arg(&data)
        .args(["-p", &port.to_string(), "-k", &folder.display().to_string()])
        .args(["-c", "listen_addresses=127.0.0.1", "-c", "max_connections=300"])
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let process = server.spawn().unwrap().id();
    end_with_us(process, &folder);
    let start = Instant::now();
    loop {
        let ready = Command::new(programs.join("pg_isready"))
            .args(["--host=127.0.0.1", &format!("--port={port}")])
            .stdout(Stdio::null())
            .status()
            .unwrap();
        if ready.success() {
            return Some(Server {
                port,
                programs,
                folder,
            });
        }
        assert!(
            start.elapsed() < Duration::from_secs(60),
            "PostgreSQL does not start"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A test process ends without running destructors, so a small watcher ends the server after it.
fn end_with_us(server: u32, folder: &Path) {
    let script = format!(
        "while kill -0 {} 2>/dev/null; do sleep 0.2; done; kill -QUIT {server}; rm -rf '{}'",
        std::process::id(),
        folder.display()
    );
    Command::new("sh")
        .args(["-c", &script])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
}
