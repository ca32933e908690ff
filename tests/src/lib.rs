//! Harness of the end-to-end tests: a real service with real worker processes, driven over its REST
//! interface, killed where and when a story wants it.

#[allow(
    clippy::missing_panics_doc,
    clippy::must_use_candidate,
    reason = "for tests, where a panic is the answer"
)]
#[path = "../../server/ledger/tests/servers/mod.rs"]
pub mod servers;
pub mod proxy;
pub mod network;
pub mod clock;

use anyhow::{Context, bail, ensure};
use hydroflex_openapi::status::JobStatus;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use sha2::{Digest, Sha256};
use std::io::{BufRead, BufReader};
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Longest wait for anything. Tests wait for conditions; this only ends one that hangs.
const PATIENCE: Duration = Duration::from_mins(4);

/// The hydroflex binary: `HYDROFLEX_BIN`, or the one built beside this test.
///
/// # Errors
/// If there is none and it cannot be built.
pub fn binary() -> anyhow::Result<PathBuf> {
    if let Some(path) = std::env::var_os("HYDROFLEX_BIN") {
        return Ok(path.into());
    }
    let test = std::env::current_exe()?;
    let profile = test
        .parent()
        .and_then(Path::parent)
        .context("a test lies in target/PROFILE/deps")?;
    let path = profile.join("hydroflex");
    if !path.is_file() {
        let mut build = Command::new(env!("CARGO"));
        build.args(["build", "--package", "hydroflex-server", "--bin", "hydroflex"]);
        if profile.ends_with("release") {
            build.arg("--release");
        }
        ensure!(build.status()?.success(), "cannot build the hydroflex binary");
    }
    Ok(path)
}

/// The program, in a network namespace or on this machine. `ip` becomes the program: the process is the same.
fn program(namespace: Option<&str>) -> anyhow::Result<Command> {
    let binary = binary()?;
    Ok(match namespace {
        Some(name) => {
            let mut command = Command::new("ip");
            command.args(["netns", "exec", name]).arg(binary);
            command
        }
        None => Command::new(binary),
    })
}

/// How a service under test is started.
#[derive(Debug, Clone, Default)]
pub struct Start {
    /// Worker processes.
    pub workers: usize,
    /// Environment beside ours.
    pub environment: Vec<(&'static str, String)>,
    /// Database URL; embedded if absent.
    pub database: Option<String>,
    /// Store URL; a directory if absent.
    pub store: Option<String>,
    /// Network namespace in which it runs; this machine's if absent.
    pub namespace: Option<String>,
}

/// A running `hydroflex serve`; killed when dropped.
pub struct ServiceUnderTest {
    child: Child,
    url: String,
    http: reqwest::blocking::Client,
    log: Arc<Mutex<Vec<String>>>,
}

impl ServiceUnderTest {
    /// Starts a service on a data directory and waits until it answers.
    ///
    /// # Errors
    /// If it does not, with what it said.
    pub fn start(data: &Path, start: &Start) -> anyhow::Result<Self> {
        let mut command = program(start.namespace.as_deref())?;
        command
            .args([
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--workers",
                &start.workers.to_string(),
                "--data",
            ])
            .arg(data)
            .envs(start.environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        for (option, value) in [("--database", &start.database), ("--store", &start.store)] {
            if let Some(value) = value {
                command.args([option, value]);
            }
        }
        let mut child = command.spawn()?;
        let errors = child.stderr.take().context("standard error is piped")?;
        let log: Arc<Mutex<Vec<String>>> = Arc::default();
        let (told, url) = std::sync::mpsc::channel();
        std::thread::spawn({
            let log = log.clone();
            move || {
                for line in BufReader::new(errors).lines().map_while(Result::ok) {
                    if line.contains("serving")
                        && let Some(url) = line
                            .split("url=\"")
                            .nth(1)
                            .and_then(|rest| rest.split('"').next())
                    {
                        let _ = told.send(url.to_owned());
                    }
                    if let Ok(mut log) = log.lock() {
                        log.push(line);
                    }
                }
            }
        });
        let Ok(url) = url.recv_timeout(PATIENCE) else {
            let _ = child.kill();
            let _ = child.wait();
            let said = log.lock().map(|log| log.join("\n")).unwrap_or_default();
            bail!("the service does not serve; it said:\n{said}");
        };
        let url = match &start.namespace {
            Some(name) => {
                let port = url.rsplit(':').next().and_then(|port| port.parse().ok());
                let port = port.with_context(|| format!("{url} has no port"))?;
                let here = network::forward(Ipv4Addr::LOCALHOST, port, Some(name.clone()))?;
                format!("http://127.0.0.1:{here}")
            }
            None => url,
        };
        hydroflex_ledger::tls::ready();
        let http = reqwest::blocking::Client::builder()
            .tls_certs_only([])
            .timeout(PATIENCE)
            .build()?;
        Ok(Self {
            child,
            url,
            http,
            log,
        })
    }

    /// Base of its URLs.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Its process.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Whether it runs, stopped or not.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// What it has said so far.
    #[must_use]
    pub fn log(&self) -> String {
        self.log.lock().map(|log| log.join("\n")).unwrap_or_default()
    }

    /// Submits a job.
    ///
    /// # Errors
    /// What the service says.
    pub fn submit(&self, spec: &serde_json::Value) -> anyhow::Result<JobStatus> {
        let response = self
            .http
            .post(format!("{}/v1/jobs", self.url))
            .json(spec)
            .send()?;
        let (status, text) = (response.status(), response.text()?);
        ensure!(status.as_u16() == 202, "{status}: {text}");
        Ok(serde_json::from_str(&text)?)
    }

    /// A job as it is.
    ///
    /// # Errors
    /// What the service says.
    pub fn job(&self, job: &str) -> anyhow::Result<JobStatus> {
        Ok(self
            .http
            .get(format!("{}/v1/jobs/{job}", self.url))
            .send()?
            .error_for_status()?
            .json()?)
    }

    /// Bytes of a path.
    ///
    /// # Errors
    /// What the service says.
    pub fn get(&self, path: &str) -> anyhow::Result<Vec<u8>> {
        let response = self
            .http
            .get(format!("{}{path}", self.url))
            .send()?
            .error_for_status()?;
        Ok(response.bytes()?.to_vec())
    }

    /// Asks for the bytes of a path from `first` on, unless they are as `known` says.
    ///
    /// # Errors
    /// If the service does not answer.
    pub fn get_range(&self, path: &str, first: u64, known: Option<&str>) -> anyhow::Result<Part> {
        let mut request = self
            .http
            .get(format!("{}{path}", self.url))
            .header("Range", format!("bytes={first}-"));
        if let Some(known) = known {
            request = request.header("If-None-Match", known);
        }
        let response = request.send()?;
        let etag = response.headers().get("etag").and_then(|etag| etag.to_str().ok());
        Ok(Part {
            status: response.status().as_u16(),
            etag: etag.unwrap_or_default().to_owned(),
            body: response.bytes()?.to_vec(),
        })
    }

    /// Posts nothing to a path.
    ///
    /// # Errors
    /// What the service says.
    pub fn post(&self, path: &str) -> anyhow::Result<Vec<u8>> {
        let response = self
            .http
            .post(format!("{}{path}", self.url))
            .send()?
            .error_for_status()?;
        Ok(response.bytes()?.to_vec())
    }

    /// Posts JSON to a path and reads JSON.
    ///
    /// # Errors
    /// What the service says.
    pub fn post_json(&self, path: &str, body: &serde_json::Value) -> anyhow::Result<serde_json::Value> {
        let response = self.http.post(format!("{}{path}", self.url)).json(body).send()?;
        let (status, text) = (response.status(), response.text()?);
        ensure!(status.is_success(), "{status}: {text}");
        Ok(serde_json::from_str(&text)?)
    }

    /// Waits until a job is as wanted.
    ///
    /// # Errors
    /// If that takes too long, or the service goes away; with what it said.
    pub fn wait_for(&self, job: &str, wanted: impl Fn(&JobStatus) -> bool) -> anyhow::Result<JobStatus> {
        let start = Instant::now();
        loop {
            let status = self
                .job(job)
                .with_context(|| format!("the service said:\n{}", self.log()))?;
            if wanted(&status) {
                return Ok(status);
            }
            ensure!(
                start.elapsed() < PATIENCE,
                "waited in vain: {status:?}; the service said:\n{}",
                self.log()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Processes that it started, by role (`simulate`, `train`).
    #[must_use]
    pub fn children(&self, role: &str) -> Vec<u32> {
        children_of(self.pid())
            .into_iter()
            .filter(|pid| command_line(*pid).iter().any(|part| part == role))
            .collect()
    }

    /// Waits until `count` processes of a role run.
    ///
    /// # Errors
    /// If that takes too long.
    pub fn wait_for_children(&self, role: &str, count: usize) -> anyhow::Result<Vec<u32>> {
        let start = Instant::now();
        loop {
            let children = self.children(role);
            if children.len() >= count {
                return Ok(children);
            }
            ensure!(
                start.elapsed() < PATIENCE,
                "{count} processes with role {role} never ran"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits until the service's process has ended by itself.
    ///
    /// # Errors
    /// If it does not.
    pub fn wait_for_end(&mut self) -> anyhow::Result<()> {
        let start = Instant::now();
        while self.child.try_wait()?.is_none() {
            ensure!(start.elapsed() < PATIENCE, "the service did not end");
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }

    /// Kills the service as a power cut would, and waits until its workers are gone too.
    ///
    /// # Errors
    /// If a worker stays.
    pub fn kill(mut self) -> anyhow::Result<()> {
        let children = children_of(self.pid());
        self.child.kill()?;
        self.child.wait()?;
        all_gone(&children)
    }

    /// Stops the service with SIGTERM, and checks that nothing of it stays.
    ///
    /// # Errors
    /// If it does not end, or a worker stays.
    pub fn terminate(mut self) -> anyhow::Result<()> {
        let children = children_of(self.pid());
        kill(Pid::from_raw(i32::try_from(self.pid())?), Signal::SIGTERM)?;
        self.wait_for_end()?;
        all_gone(&children)
    }
}

impl Drop for ServiceUnderTest {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Answer to a request for a part of a file.
#[derive(Debug)]
pub struct Part {
    /// Status.
    pub status: u16,
    /// ETag with its quotes.
    pub etag: String,
    /// Bytes.
    pub body: Vec<u8>,
}

/// Runs a command of the program; returns what it printed.
///
/// # Errors
/// If it fails, with what it said.
pub fn command(arguments: &[&str]) -> anyhow::Result<String> {
    let output = Command::new(binary()?)
        .args(arguments)
        .stdin(Stdio::null())
        .output()?;
    ensure!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(String::from_utf8(output.stdout)?)
}

/// A worker that nobody supervises, as it runs on another machine; killed when dropped.
pub struct Pilot(Child);

impl Pilot {
    /// Starts one.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn start(
        database: &str,
        store: &str,
        cache: &Path,
        environment: &[(&'static str, String)],
        arguments: &[&str],
    ) -> anyhow::Result<Self> {
        Self::start_in(None, database, store, cache, environment, arguments)
    }

    /// Starts one in a network namespace.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn start_in(
        namespace: Option<&str>,
        database: &str,
        store: &str,
        cache: &Path,
        environment: &[(&'static str, String)],
        arguments: &[&str],
    ) -> anyhow::Result<Self> {
        let child = program(namespace)?
            .args(["worker", "--database", database, "--store", store])
            .arg("--cache")
            .arg(cache)
            .args(arguments)
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        Ok(Self(child))
    }

    /// Its process.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.0.id()
    }

    /// Whether it runs, stopped or not.
    pub fn is_running(&mut self) -> bool {
        matches!(self.0.try_wait(), Ok(None))
    }

    /// Waits until it has ended by itself, and without an error.
    ///
    /// # Errors
    /// If it does not end, or with an error.
    pub fn wait(mut self) -> anyhow::Result<()> {
        let start = Instant::now();
        loop {
            match self.0.try_wait()? {
                Some(status) => {
                    ensure!(status.success(), "the worker ended with {status}");
                    return Ok(());
                }
                None => ensure!(start.elapsed() < PATIENCE, "the worker did not end"),
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Stops it with SIGTERM.
    ///
    /// # Errors
    /// If it does not end, or with an error.
    pub fn terminate(self) -> anyhow::Result<()> {
        signal(self.pid(), Signal::SIGTERM)?;
        self.wait()
    }
}

impl Drop for Pilot {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// SHA-256, hexadecimal.
#[must_use]
pub fn sha256(content: &[u8]) -> String {
    hex::encode(Sha256::digest(content))
}

/// Sends a signal.
///
/// # Errors
/// If there is no such process.
pub fn signal(pid: u32, signal: Signal) -> anyhow::Result<()> {
    Ok(kill(Pid::from_raw(i32::try_from(pid)?), signal)?)
}

fn all_gone(processes: &[u32]) -> anyhow::Result<()> {
    let start = Instant::now();
    while let Some(left) = processes.iter().find(|pid| is_running(**pid)) {
        ensure!(
            start.elapsed() < Duration::from_secs(20),
            "process {left} outlived its parent"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}

/// Fields of `/proc/PID/stat` after the command: state, parent, …
fn stat(pid: u32) -> Option<Vec<String>> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    Some(
        text.rsplit_once(')')?
            .1
            .split_ascii_whitespace()
            .map(str::to_owned)
            .collect(),
    )
}

fn is_running(pid: u32) -> bool {
    stat(pid).is_some_and(|fields| fields[0] != "Z" && fields[0] != "X")
}

fn children_of(parent: u32) -> Vec<u32> {
    let Ok(entries) = std::fs::read_dir("/proc") else {
        return Vec::new();
    };
    entries
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter(|pid| {
            stat(*pid).is_some_and(|fields| fields[0] != "Z" && fields.get(1) == Some(&parent.to_string()))
        })
        .collect()
}

fn command_line(pid: u32) -> Vec<String> {
    let bytes = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    bytes
        .split(|byte| *byte == 0)
        .map(|part| String::from_utf8_lossy(part).into_owned())
        .collect()
}
