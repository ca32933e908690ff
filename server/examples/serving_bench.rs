#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "a benchmark prints, and stops at what it did not expect"
)]
#![allow(
    clippy::print_stdout,
    reason = "its output is read by the script that drives it"
)]
//! The moving parts of the serving benchmark, driven by `tests/bench/serving.py`: models with random
//! weights, the kernel alone, a service around a model, load over HTTP, live sessions over WebSocket.

#[path = "../tests/common/register.rs"]
mod register;

use anyhow::{Context, bail, ensure};
use hydroflex_ledger::Ledger;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ml::model::Model;
use hydroflex_ml::predict::synthetic::{SyntheticModel, SyntheticSpec, signal};
use hydroflex_openapi::stream::StreamOpened;
use hydroflex_server::coordinator::{Coordinator, CoordinatorConfig};
use hydroflex_server::http::AppState;
use serde_json::json;
use std::collections::HashMap;
use std::io::{BufRead, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket, client};
use tokio_util::sync::CancellationToken;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments.as_slice() {
        ["write", structure, folder] => write(structure, Path::new(folder)),
        ["kernel"] => kernel(),
        ["series", folder, rows, calls] => series(Path::new(folder), rows.parse()?, calls.parse()?),
        ["serve", folder] => run(serve(PathBuf::from(folder))),
        ["echo", request] => run(echo(std::fs::metadata(request)?.len().try_into()?)),
        ["register", folder, data] => run(register_into(PathBuf::from(folder), PathBuf::from(data))),
        ["open-loop", address, connections, seconds, rate, request] => {
            let request = std::fs::read(request).context("the request file")?;
            open_loop(
                address,
                connections.parse()?,
                seconds.parse()?,
                rate.parse()?,
                &request,
            )
        }
        ["load", address, connections, seconds, request] => {
            let request = std::fs::read(request).context("the request file")?;
            run(load(
                (*address).to_owned(),
                connections.parse()?,
                seconds.parse()?,
                request,
            ))
        }
        ["stream", address, model, sessions, rate, seconds] => {
            stream(address, model, sessions.parse()?, rate.parse()?, seconds.parse()?)
        }
        other => bail!(
            "unknown arguments {other:?}: write, kernel, series, serve, echo, register, load, open-loop or stream"
        ),
    }
}

fn run(work: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Runtime::new()?.block_on(work)
}

/// A model as in the paper's examples: 60 steps of five sensors, one target.
fn write(structure: &str, folder: &Path) -> anyhow::Result<()> {
    let model = SyntheticModel::new(&SyntheticSpec {
        structure: structure.to_owned(),
        window_steps: 60,
        targets: 1,
        seed: 1,
    })?;
    Ok(model.write(folder)?)
}

/// Time that this thread has computed. Unlike the time of day it does not count what others compute
/// meanwhile.
fn computed() -> anyhow::Result<Duration> {
    // Brings the system's count up to date, which otherwise happens every few milliseconds.
    std::thread::yield_now();
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    let nanoseconds = text.split(' ').next().context("a time")?;
    Ok(Duration::from_nanos(nanoseconds.parse()?))
}

/// Lines `FOLDER BATCH CALLS` in; lines of two times out, µs of CPU per call: the network alone on
/// scaled f32 windows, and the whole prediction from samples in f64.
fn kernel() -> anyhow::Result<()> {
    let mut models: HashMap<String, Model> = HashMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let [folder, batch, calls] = line.split(' ').collect::<Vec<_>>()[..] else {
            bail!("{line:?} is not FOLDER BATCH CALLS");
        };
        let (batch, calls): (usize, u32) = (batch.parse()?, calls.parse()?);
        if !models.contains_key(folder) {
            models.insert(folder.to_owned(), Model::load(Path::new(folder))?);
        }
        let predictor = models[folder].predictor();
        let mut workspace = predictor.workspace();
        let (size, targets) = (predictor.window_len(), predictor.target_count());
        let windows = signal(0, batch * predictor.window_steps());
        let scaled: Vec<f32> = windows
            .iter()
            .enumerate()
            .map(|(i, _)| (i as f32 * 0.37).sin())
            .collect();
        let mut out = vec![0.0_f32; batch * targets];
        let begun = computed()?;
        for _ in 0..calls {
            predictor.predict_scaled(
                std::hint::black_box(&scaled),
                size,
                batch,
                &mut out,
                &mut workspace,
            );
            std::hint::black_box(&out);
        }
        let network = computed()?.saturating_sub(begun);
        let mut out = vec![0.0_f64; batch * targets];
        let begun = computed()?;
        for _ in 0..calls {
            predictor.predict_windows(std::hint::black_box(&windows), &mut out, &mut workspace);
            std::hint::black_box(&out);
        }
        let whole = computed()?.saturating_sub(begun);
        let us = |time: Duration| time.as_secs_f64() * 1e6 / f64::from(calls);
        println!("{} {}", us(network), us(whole));
        std::io::stdout().flush()?;
    }
    Ok(())
}

/// A recording through the network, as a user has it: columns in, columns out; µs of CPU per call.
fn series(folder: &Path, rows: usize, calls: u32) -> anyhow::Result<()> {
    let model = Model::load(folder)?;
    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let samples = signal(0, rows);
    let width = predictor.input_count();
    let columns: Vec<Vec<f64>> = (0..width)
        .map(|input| samples.iter().skip(input).step_by(width).copied().collect())
        .collect();
    let columns: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    let mut estimates = 0;
    let begun = computed()?;
    for _ in 0..calls {
        let found = predictor.predict_series_with(std::hint::black_box(&columns), &mut workspace);
        estimates = found.columns[0].len();
    }
    let us = computed()?.saturating_sub(begun).as_secs_f64() * 1e6 / f64::from(calls);
    println!("{}", json!({ "us": us, "estimates": estimates }));
    Ok(())
}

/// A data directory of `hydroflex serve` with one model in it.
async fn register_into(folder: PathBuf, data: PathBuf) -> anyhow::Result<()> {
    std::fs::create_dir_all(&data)?;
    let url = format!("sqlite:{}", data.join("ledger.sqlite").display());
    let ledger = Ledger::create(&url).await?;
    let blobs = Blobs::directory(&data.join("store"))?;
    let model = register::register_folder(&ledger, &blobs, &folder).await;
    println!("{}", json!({ "model": model }));
    Ok(())
}

/// Answers 200 to every `length` bytes without looking at them: what loopback, the scheduler and the
/// machine take, of which no service is free.
async fn echo(length: usize) -> anyhow::Result<()> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!(
        "{}",
        json!({ "address": listener.local_addr()?, "model": "echo", "pid": std::process::id() })
    );
    std::io::stdout().flush()?;
    loop {
        let (mut socket, _) = listener.accept().await?;
        socket.set_nodelay(true)?;
        tokio::spawn(async move {
            let mut request = vec![0; length];
            while socket.read_exact(&mut request).await.is_ok()
                && socket
                    .write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\nok")
                    .await
                    .is_ok()
            {}
        });
    }
}

/// A service around one model, without workers, until standard input ends.
async fn serve(folder: PathBuf) -> anyhow::Result<()> {
    let data = tempfile::tempdir()?;
    let url = format!("sqlite:{}", data.path().join("ledger.sqlite").display());
    let ledger = Ledger::create(&url).await?;
    let blobs = Blobs::directory(&data.path().join("store"))?;
    let model = register::register_folder(&ledger, &blobs, &folder).await;
    let config = CoordinatorConfig {
        scratch: data.path().join("scratch"),
        cache: data.path().join("cache"),
        workers: 1,
        lease: Duration::from_secs(10),
        most_jobs: 1000,
        orphan_grace: Duration::from_mins(10),
    };
    let router = hydroflex_server::app(AppState::new(Coordinator::new(ledger, blobs, config)));
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!(
        "{}",
        json!({ "address": listener.local_addr()?, "model": model, "pid": std::process::id() })
    );
    std::io::stdout().flush()?;
    let stop = CancellationToken::new();
    let server = tokio::spawn(hydroflex_server::http::serve::serve(
        listener,
        router,
        stop.clone(),
    ));
    tokio::task::spawn_blocking(|| std::io::stdin().lock().lines().for_each(drop)).await?;
    stop.cancel();
    server.await??;
    Ok(())
}

/// What a connection saw.
#[derive(Default)]
struct Seen {
    latencies_us: Vec<f32>,
    /// How late this program itself was, where it keeps to a schedule.
    late_us: Vec<f32>,
    statuses: HashMap<u16, u64>,
    /// When the last answer came that was no refusal.
    last: Option<Instant>,
}

impl Seen {
    fn add(&mut self, other: Self) {
        self.latencies_us.extend(other.latencies_us);
        self.late_us.extend(other.late_us);
        self.last = self.last.max(other.last);
        for (status, count) in other.statuses {
            *self.statuses.entry(status).or_default() += count;
        }
    }

    fn note(&mut self, status: u16, begun: Instant) {
        *self.statuses.entry(status).or_default() += 1;
        if status == 200 {
            self.latencies_us.push(begun.elapsed().as_secs_f32() * 1e6);
            self.last = Some(Instant::now());
        }
    }
}

/// Sends one request over and over on every connection.
async fn load(address: String, connections: u32, seconds: f64, request: Vec<u8>) -> anyhow::Result<()> {
    let request = Arc::new(request);
    let mut sockets = Vec::new();
    for _ in 0..connections {
        let socket = TcpStream::connect(&address).await?;
        socket.set_nodelay(true)?;
        sockets.push(socket);
    }
    let begun = Instant::now();
    let end = begun + Duration::from_secs_f64(seconds);
    let tasks: Vec<_> = sockets
        .into_iter()
        .map(|mut socket| {
            let (request, address) = (request.clone(), address.clone());
            tokio::spawn(async move {
                let mut seen = Seen::default();
                let mut buffer = Vec::with_capacity(1 << 14);
                loop {
                    let begun = Instant::now();
                    if begun >= end {
                        return anyhow::Ok(seen);
                    }
                    let status = exchange(&mut socket, &request, &mut buffer).await?;
                    seen.note(status, begun);
                    if status == 429 {
                        // A client that asks again at once is no client.
                        tokio::time::sleep(Duration::from_millis(20)).await;
                    }
                    // What the service refuses before it has read it ends the connection.
                    if says_close(&buffer) {
                        socket = TcpStream::connect(&address).await?;
                        socket.set_nodelay(true)?;
                    }
                }
            })
        })
        .collect();
    let mut all = Seen::default();
    for task in tasks {
        all.add(task.await??);
    }
    // Refused clients may hear it late, when nothing is answered any more.
    let elapsed = all.last.map_or(seconds, |last| (last - begun).as_secs_f64());
    println!("{}", report(all, elapsed));
    Ok(())
}

fn quantile(sorted: &[f32], q: f64) -> f32 {
    let place = (q * sorted.len() as f64) as usize;
    sorted
        .get(place.min(sorted.len().saturating_sub(1)))
        .copied()
        .unwrap_or(f32::NAN)
}

fn report(mut all: Seen, elapsed: f64) -> serde_json::Value {
    all.latencies_us.sort_by(f32::total_cmp);
    all.late_us.sort_by(f32::total_cmp);
    let count = all.latencies_us.len();
    let latency = |q: f64| quantile(&all.latencies_us, q);
    json!({
        "seconds": elapsed, "answers": count, "per_second": count as f64 / elapsed,
        "p50_us": latency(0.5), "p99_us": latency(0.99), "p999_us": latency(0.999),
        "late_p50_us": quantile(&all.late_us, 0.5), "late_p99_us": quantile(&all.late_us, 0.99),
        "statuses": all.statuses.into_iter().map(|(s, n)| (s.to_string(), json!(n))).collect::<serde_json::Map<_, _>>(),
    })
}

/// One request and its whole answer; returns the status.
async fn exchange(socket: &mut TcpStream, request: &[u8], buffer: &mut Vec<u8>) -> anyhow::Result<u16> {
    socket.write_all(request).await?;
    buffer.clear();
    loop {
        ensure!(
            socket.read_buf(buffer).await? > 0,
            "the server closed the connection"
        );
        if let Some(status) = whole_answer(buffer)? {
            return Ok(status);
        }
    }
}

/// Whether the head of an answer says that the connection ends with it.
fn says_close(answer: &[u8]) -> bool {
    answer
        .split(|byte| *byte == b'\n')
        .take_while(|line| line.len() > 1)
        .any(|line| line.eq_ignore_ascii_case(b"connection: close\r"))
}

/// The status of an answer that has come whole.
fn whole_answer(buffer: &[u8]) -> anyhow::Result<Option<u16>> {
    let Some(head) = buffer.windows(4).position(|four| four == b"\r\n\r\n") else {
        return Ok(None);
    };
    let text = std::str::from_utf8(&buffer[..head])?.to_ascii_lowercase();
    let status: u16 = text.get(9..12).context("a status")?.parse()?;
    let length: usize = text
        .lines()
        .find_map(|line| line.strip_prefix("content-length:"))
        .context("an answer with content-length")?
        .trim()
        .parse()?;
    Ok((buffer.len() >= head + 4 + length).then_some(status))
}

/// A connection of an open loop.
struct Turn {
    socket: std::net::TcpStream,
    due: Instant,
    /// When it was both due and free, once the answer before it had come.
    ready: Instant,
    /// When its open request was due.
    open: Option<Instant>,
    buffer: Vec<u8>,
}

/// Requests on a schedule (`rate` per second of all connections, evenly spread), from one thread that never sleeps:
/// a timer would be late by more than the service takes. Latencies count from when a request was due, so a connection
/// that still waits for an answer makes its next one wait too; how late this program itself was is counted apart.
fn open_loop(address: &str, connections: u32, seconds: f64, rate: f64, request: &[u8]) -> anyhow::Result<()> {
    let period = Duration::from_secs_f64(f64::from(connections) / rate);
    let begun = Instant::now() + Duration::from_millis(20);
    let end = begun + Duration::from_secs_f64(seconds);
    let mut turns = Vec::new();
    for number in 0..connections {
        let socket = std::net::TcpStream::connect(address)?;
        socket.set_nodelay(true)?;
        socket.set_nonblocking(true)?;
        let due = begun + period.mul_f64(f64::from(number) / f64::from(connections));
        turns.push(Turn {
            socket,
            due,
            ready: due,
            open: None,
            buffer: Vec::new(),
        });
    }
    let mut seen = Seen::default();
    let mut piece = [0; 1 << 14];
    loop {
        let mut is_open = false;
        for turn in &mut turns {
            if let Some(due) = turn.open {
                is_open = true;
                let count = match turn.socket.read(&mut piece) {
                    Ok(0) => bail!("the server closed the connection"),
                    Ok(count) => count,
                    Err(error) if error.kind() == ErrorKind::WouldBlock => continue,
                    Err(error) => return Err(error.into()),
                };
                turn.buffer.extend_from_slice(&piece[..count]);
                if let Some(status) = whole_answer(&turn.buffer)? {
                    seen.note(status, due);
                    turn.open = None;
                    turn.ready = turn.due.max(Instant::now());
                }
            } else if turn.due < end {
                is_open = true;
                let now = Instant::now();
                if now >= turn.due {
                    seen.late_us.push((now - turn.ready).as_secs_f32() * 1e6);
                    turn.open = Some(turn.due);
                    turn.due += period;
                    turn.buffer.clear();
                    write_whole(&mut turn.socket, request)?;
                }
            }
        }
        if !is_open {
            println!("{}", report(seen, seconds));
            return Ok(());
        }
    }
}

/// Writes to a socket that does not block.
fn write_whole(socket: &mut std::net::TcpStream, mut rest: &[u8]) -> anyhow::Result<()> {
    while !rest.is_empty() {
        match socket.write(rest) {
            Ok(count) => rest = &rest[count..],
            Err(error) if error.kind() == ErrorKind::WouldBlock => std::hint::spin_loop(),
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}

struct Live<'s> {
    socket: WebSocket<std::net::TcpStream>,
    samples: &'s [f64],
    width: usize,
    step: u64,
}

impl Live<'_> {
    fn send(&mut self) -> anyhow::Result<()> {
        let mut frame = self.step.to_le_bytes().to_vec();
        let row = usize::try_from(self.step % 512)? * self.width;
        let sample = &self.samples[row..row + self.width];
        frame.extend(sample.iter().flat_map(|v| v.to_le_bytes()));
        Ok(self.socket.send(Message::binary(frame))?)
    }

    /// The answer's status, once it is there.
    fn poll(&mut self) -> anyhow::Result<Option<u16>> {
        let answer = match self.socket.read() {
            Ok(answer) => answer.into_data(),
            Err(tungstenite::Error::Io(error)) if error.kind() == ErrorKind::WouldBlock => return Ok(None),
            Err(error) => return Err(error.into()),
        };
        ensure!(
            answer.get(..8) == Some(&self.step.to_le_bytes()),
            "the answer is for another step"
        );
        self.step += 1;
        Ok(Some(u16::from(answer[8])))
    }
}

/// Live sessions, each with its own schedule, evenly spread, from one thread that never sleeps: with so many,
/// timers would send all that is due at a tick at once. Round trips count from when a sample was sent.
fn stream(address: &str, model: &str, sessions: u32, rate: f64, seconds: f64) -> anyhow::Result<()> {
    let url = format!("ws://{address}/v1/models/{model}/stream");
    let samples = signal(0, 512);
    let mut live = Vec::new();
    for _ in 0..sessions {
        let socket = std::net::TcpStream::connect(address)?;
        socket.set_nodelay(true)?;
        let (mut socket, _) = client(url.as_str(), socket).map_err(|error| anyhow::anyhow!("{error}"))?;
        let opened = socket.read()?;
        let opened: StreamOpened = serde_json::from_str(opened.to_text()?)?;
        socket.get_ref().set_nonblocking(true)?;
        live.push(Live {
            socket,
            samples: &samples,
            width: opened.inputs.len(),
            step: 0,
        });
    }
    let period = Duration::from_secs_f64(1.0 / rate);
    let begun = Instant::now() + Duration::from_millis(10);
    let end = begun + Duration::from_secs_f64(seconds);
    // Each with when it is due next, and when an open one was sent.
    let mut turns: Vec<(Live<'_>, Instant, Option<Instant>)> = live
        .into_iter()
        .enumerate()
        .map(|(number, session)| {
            let share = number as f64 / f64::from(sessions);
            (session, begun + period.mul_f64(share), None)
        })
        .collect();
    let mut seen = Seen::default();
    loop {
        let mut is_open = false;
        for (session, due, open) in &mut turns {
            if let Some(since) = *open {
                is_open = true;
                if let Some(status) = session.poll()? {
                    *seen.statuses.entry(status).or_default() += 1;
                    seen.latencies_us.push(since.elapsed().as_secs_f32() * 1e6);
                    *open = None;
                }
            } else if *due < end {
                is_open = true;
                let now = Instant::now();
                if now >= *due {
                    *open = Some(now);
                    *due += period;
                    session.send()?;
                }
            }
        }
        if !is_open {
            println!("{}", report(seen, seconds));
            return Ok(());
        }
    }
}
