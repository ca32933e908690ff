//! An S3 server of our own: `moto` from PyPI, found by `HYDROFLEX_MOTO` (its `moto_server` program) or
//! in the virtual environment that `tests/run.sh` makes. Where it is not, its tests pass with a note.

use super::{free_port, when_we_are_gone};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// A server that keeps its buckets in memory.
pub struct Moto {
    port: u16,
}

/// The server that the tests of one process share; `None` where moto is not installed.
pub fn shared() -> Option<&'static Moto> {
    static SERVER: OnceLock<Option<Moto>> = OnceLock::new();
    SERVER.get_or_init(Moto::start).as_ref()
}

impl Moto {
    /// Starts a server; `None` where moto is not installed.
    #[allow(clippy::zombie_processes, reason = "it serves until this process is gone")]
    pub fn start() -> Option<Self> {
        let Some(program) = program() else {
            eprintln!("moto is not installed: its part of the suite is left out (tests/run.sh installs it)");
            return None;
        };
        let port = free_port();
        let mut server = Command::new(program);
        server
            .args(["-H", "127.0.0.1", "-p", &port.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let process = server.spawn().expect("moto's own program");
        let nothing = tempfile::tempdir().expect("a temporary directory").keep();
        when_we_are_gone(&format!("kill -9 {}", process.id()), &nothing);
        let start = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(start.elapsed() < Duration::from_mins(1), "moto does not start");
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(Self { port })
    }

    /// Its port on this machine.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Makes a bucket, empty if it is new.
    pub fn bucket(&self, name: &str) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("moto listens");
        let request = format!(
            "PUT /{name} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n",
            self.port
        );
        stream.write_all(request.as_bytes()).expect("moto reads");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("moto answers");
        assert!(answer.starts_with("HTTP/1.1 200"), "bucket {name}: {answer}");
    }
}

/// The variables by which a process finds an S3 server on a port of this machine.
pub fn environment(port: u16) -> Vec<(&'static str, String)> {
    environment_at("127.0.0.1", port)
}

/// The same for a server of another machine.
pub fn environment_at(host: &str, port: u16) -> Vec<(&'static str, String)> {
    vec![
        ("AWS_ENDPOINT_URL", format!("http://{host}:{port}")),
        ("AWS_REGION", "us-east-1".to_owned()),
        ("AWS_ACCESS_KEY_ID", "testing".to_owned()),
        ("AWS_SECRET_ACCESS_KEY", "testing".to_owned()),
    ]
}

fn program() -> Option<PathBuf> {
    let named = std::env::var_os("HYDROFLEX_MOTO").map(PathBuf::from);
    let beside = || {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .ancestors()
            .map(|folder| folder.join("target/test-venv/bin/moto_server"))
            .find(|program| program.is_file())
    };
    named.or_else(beside)
}
