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
use futures::{SinkExt, StreamExt};
use hydroflex_ledger::Ledger;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ml::model::Model;
use hydroflex_ml::predict::synthetic::{SyntheticModel, SyntheticSpec, signal};
use hydroflex_openapi::stream::StreamOpened;
use hydroflex_server::coordinator::{Coordinator, CoordinatorConfig};
use hydroflex_server::http::AppState;
use serde_json::json;
use std::collections::HashMap;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::client_async;
use tokio_tungstenite::tungstenite::Message;
use tokio_util::sync::CancellationToken;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments.as_slice() {
        ["write", structure, folder] => write(structure, Path::new(folder)),
        ["kernel"] => kernel(),
        ["serve", folder] => run(serve(PathBuf::from(folder))),
        ["load", address, connections, seconds, rate, request] => {
            let request = std::fs::read(request).context("the request file")?;
            run(load(
                (*address).to_owned(),
                connections.parse()?,
                seconds.parse()?,
                rate.parse()?,
                request,
            ))
        }
        ["stream", address, model, sessions, rate, seconds] => run(stream(
            address,
            model,
            sessions.parse()?,
            rate.parse()?,
            seconds.parse()?,
        )),
        other => bail!("unknown arguments {other:?}: write, kernel, serve, load or stream"),
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
        let network = computed()?.checked_sub(begun).unwrap();
        let mut out = vec![0.0_f64; batch * targets];
        let begun = computed()?;
        for _ in 0..calls {
            predictor.predict_windows(std::hint::black_box(&windows), &mut out, &mut workspace);
            std::hint::black_box(&out);
        }
        let whole = computed()?.checked_sub(begun).unwrap();
        let us = |time: Duration| time.as_secs_f64() * 1e6 / f64::from(calls);
        println!("{} {}", us(network), us(whole));
        std::io::stdout().flush()?;
    }
    Ok(())
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
    statuses: HashMap<u16, u64>,
}

/// Sends one request over and over on every connection; with a rate (requests per second of all
/// connections), on a schedule, and latencies count from when a request was due.
async fn load(
    address: String,
    connections: u32,
    seconds: f64,
    rate: f64,
    request: Vec<u8>,
) -> anyhow::Result<()> {
    let request = Arc::new(request);
    let begun = Instant::now();
    let end = begun + Duration::from_secs_f64(seconds);
    let tasks: Vec<_> = (0..connections)
        .map(|number| {
            let (address, request) = (address.clone(), request.clone());
            let period = (rate > 0.0).then(|| Duration::from_secs_f64(f64::from(connections) / rate));
            let first = begun
                + period
                    .unwrap_or_default()
                    .mul_f64(f64::from(number) / f64::from(connections));
            tokio::spawn(async move { connection(&address, &request, first, period, end).await })
        })
        .collect();
    let mut all = Seen::default();
    for task in tasks {
        let seen = task.await??;
        all.latencies_us.extend(seen.latencies_us);
        for (status, count) in seen.statuses {
            *all.statuses.entry(status).or_default() += count;
        }
    }
    let elapsed = begun.elapsed().as_secs_f64();
    println!("{}", report(all, elapsed));
    Ok(())
}

fn report(mut all: Seen, elapsed: f64) -> serde_json::Value {
    all.latencies_us.sort_by(f32::total_cmp);
    let count = all.latencies_us.len();
    let quantile = |q: f64| {
        let place = (q * count as f64) as usize;
        all.latencies_us
            .get(place.min(count.saturating_sub(1)))
            .copied()
            .unwrap_or(f32::NAN)
    };
    json!({
        "seconds": elapsed, "answers": count, "per_second": count as f64 / elapsed,
        "p50_us": quantile(0.5), "p99_us": quantile(0.99), "p999_us": quantile(0.999),
        "statuses": all.statuses.into_iter().map(|(s, n)| (s.to_string(), json!(n))).collect::<serde_json::Map<_, _>>(),
    })
}

async fn connection(
    address: &str,
    request: &[u8],
    first: Instant,
    period: Option<Duration>,
    end: Instant,
) -> anyhow::Result<Seen> {
    let mut socket = TcpStream::connect(address).await?;
    socket.set_nodelay(true)?;
    let mut seen = Seen::default();
    let mut buffer = Vec::with_capacity(1 << 16);
    let mut due = first;
    loop {
        if let Some(period) = period {
            tokio::time::sleep_until(due.into()).await;
            if Instant::now() >= end {
                return Ok(seen);
            }
            let begun = due;
            due += period;
            let status = exchange(&mut socket, request, &mut buffer).await?;
            note(&mut seen, status, begun);
        } else {
            let begun = Instant::now();
            if begun >= end {
                return Ok(seen);
            }
            let status = exchange(&mut socket, request, &mut buffer).await?;
            note(&mut seen, status, begun);
        }
    }
}

fn note(seen: &mut Seen, status: u16, begun: Instant) {
    *seen.statuses.entry(status).or_default() += 1;
    if status == 200 {
        seen.latencies_us.push(begun.elapsed().as_secs_f32() * 1e6);
    }
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
        let Some(head) = buffer.windows(4).position(|four| four == b"\r\n\r\n") else {
            continue;
        };
        let text = std::str::from_utf8(&buffer[..head])?.to_ascii_lowercase();
        let status: u16 = text.get(9..12).context("a status")?.parse()?;
        let length: usize = text
            .lines()
            .find_map(|line| line.strip_prefix("content-length:"))
            .context("an answer with content-length")?
            .trim()
            .parse()?;
        while buffer.len() < head + 4 + length {
            ensure!(
                socket.read_buf(buffer).await? > 0,
                "the server closed the connection"
            );
        }
        return Ok(status);
    }
}

/// Live sessions, each with its own schedule; round trips count from when a sample was sent.
async fn stream(address: &str, model: &str, sessions: u32, rate: f64, seconds: f64) -> anyhow::Result<()> {
    let period = Duration::from_secs_f64(1.0 / rate);
    let mut sockets = Vec::new();
    for _ in 0..sessions {
        let socket = TcpStream::connect(address).await?;
        socket.set_nodelay(true)?;
        let url = format!("ws://{address}/v1/models/{model}/stream");
        let (mut socket, _) = client_async(url, socket).await?;
        let opened = socket.next().await.context("the first message")??;
        let opened: StreamOpened = serde_json::from_str(opened.to_text()?)?;
        sockets.push((socket, opened.inputs.len()));
    }
    let begun = Instant::now() + Duration::from_millis(100);
    let end = begun + Duration::from_secs_f64(seconds);
    let tasks: Vec<_> = sockets
        .into_iter()
        .enumerate()
        .map(|(number, (mut socket, width))| {
            tokio::spawn(async move {
                let mut due = begun + period.mul_f64(number as f64 / f64::from(sessions));
                let mut seen = Seen::default();
                let samples = signal(0, 512);
                for step in 0_u64.. {
                    tokio::time::sleep_until(due.into()).await;
                    due += period;
                    let sent = Instant::now();
                    if sent >= end {
                        break;
                    }
                    let mut frame = step.to_le_bytes().to_vec();
                    let row = usize::try_from(step % 512)?;
                    frame.extend(
                        samples[row * width..(row + 1) * width]
                            .iter()
                            .flat_map(|v| v.to_le_bytes()),
                    );
                    socket.send(Message::binary(frame)).await?;
                    let answer = socket.next().await.context("an answer")??.into_data();
                    ensure!(
                        answer.get(..8) == Some(&step.to_le_bytes()),
                        "the answer is for another step"
                    );
                    *seen.statuses.entry(u16::from(answer[8])).or_default() += 1;
                    seen.latencies_us.push(sent.elapsed().as_secs_f32() * 1e6);
                }
                socket.close(None).await?;
                anyhow::Ok(seen)
            })
        })
        .collect();
    let mut all = Seen::default();
    for task in tasks {
        let seen = task.await??;
        all.latencies_us.extend(seen.latencies_us);
        for (status, count) in seen.statuses {
            *all.statuses.entry(status).or_default() += count;
        }
    }
    println!("{}", report(all, begun.elapsed().as_secs_f64()));
    Ok(())
}
