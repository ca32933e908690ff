//! Live signals over WebSocket, on a real socket.

#![allow(
    clippy::cast_possible_truncation,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use common::Desk;
use common::models::{interval, synthetic};
use futures::{SinkExt, StreamExt};
use hydroflex_ml::predict::synthetic::{SyntheticModel, signal};
use hydroflex_openapi::stream::{SampleStatus, StreamEstimate, StreamOpened};
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};

const STEPS: usize = 12;

struct Client(WebSocketStream<TcpStream>);

impl Client {
    async fn open(desk: &Desk, model: &str) -> (Self, StreamOpened) {
        let address = desk.listen().await;
        let socket = TcpStream::connect(address).await.unwrap();
        let url = format!("ws://{address}/v1/models/{model}/stream");
        let (mut socket, _) = client_async(url, socket).await.unwrap();
        let opened = socket.next().await.unwrap().unwrap();
        (
            Self(socket),
            serde_json::from_str(opened.to_text().unwrap()).unwrap(),
        )
    }

    async fn text(&mut self, text: String) -> String {
        self.0.send(Message::text(text)).await.unwrap();
        self.0
            .next()
            .await
            .unwrap()
            .unwrap()
            .into_text()
            .unwrap()
            .to_string()
    }

    /// Sends a sample of the test signal under a step, some sensors silent.
    async fn sample(
        &mut self,
        opened: &StreamOpened,
        step: u64,
        row: usize,
        silent: &[usize],
    ) -> StreamEstimate {
        let values = signal(row, 1);
        let inputs: serde_json::Map<String, serde_json::Value> = opened
            .inputs
            .iter()
            .enumerate()
            .map(|(i, name)| {
                (
                    name.clone(),
                    if silent.contains(&i) {
                        json!(null)
                    } else {
                        json!(values[i])
                    },
                )
            })
            .collect();
        let answer = self
            .text(json!({ "step": step, "inputs": inputs }).to_string())
            .await;
        serde_json::from_str(&answer).unwrap_or_else(|error| panic!("{error}: {answer}"))
    }
}

/// What the model says at the last of these rows.
fn truth(model: &SyntheticModel, rows: std::ops::Range<usize>) -> Vec<f64> {
    let predictor = model.predictor();
    let mut out = vec![0.0; predictor.target_count()];
    let window = signal(rows.start, rows.len());
    predictor.predict_window(&window, &mut out, &mut predictor.workspace());
    out
}

/// Payload that the model tells from the window that ends at this row, kg.
fn payload_kg(model: &SyntheticModel, row: usize) -> Option<f64> {
    let samples = signal(row + 1 - STEPS, STEPS);
    let columns: Vec<Vec<f64>> = (0..5)
        .map(|i| samples.iter().skip(i).step_by(5).copied().collect())
        .collect();
    let views: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    model
        .predictor()
        .predict_series(&views)
        .payload_kg
        .first()
        .copied()
}

#[tokio::test(flavor = "multi_thread")]
async fn each_sample_brings_the_estimate_that_a_recording_gives() {
    let desk = Desk::new().await;
    let model = synthetic("RLR", 1).following_payload();
    let id = desk.register(&model).await;
    let (mut client, opened) = Client::open(&desk, id.as_str()).await;
    assert_eq!((opened.window_steps, opened.model_id.clone()), (STEPS as u64, id));
    let mut light = 0;
    for row in 0..400 {
        let estimate = client.sample(&opened, 100 + row as u64, row, &[]).await;
        assert_eq!((estimate.step, estimate.filled), (100 + row as u64, 0));
        if row + 1 < STEPS {
            assert_eq!(
                (estimate.status, estimate.estimates),
                (SampleStatus::Filling, None)
            );
            continue;
        }
        assert_eq!(estimate.status, SampleStatus::Ok);
        let payload_kg = payload_kg(&model, row);
        light += usize::from(payload_kg.unwrap() <= 50.0);
        let truth = truth(&model, row + 1 - STEPS..row + 1);
        for (target, channel) in model.config.targets.iter().enumerate() {
            let found = estimate.estimates.as_ref().unwrap()[&channel.name];
            assert!((found - truth[target]).abs() <= 1e-6 * channel.scale);
            let [lower, upper] = interval(&model, target, found, payload_kg);
            let tolerance = 1e-12 * channel.scale.max(1.0);
            assert!((estimate.lower.as_ref().unwrap()[&channel.name] - lower).abs() < tolerance);
            assert!((estimate.upper.as_ref().unwrap()[&channel.name] - upper).abs() < tolerance);
        }
        assert!(estimate.inside_envelope.is_some());
    }
    assert!((1..300).contains(&light), "{light} windows are of light machines");
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_say_the_same_as_text() {
    let desk = Desk::new().await;
    let model = synthetic("best", 1).following_payload();
    let id = desk.register(&model).await;
    let (mut client, _) = Client::open(&desk, id.as_str()).await;
    let mut light = 0;
    for row in 0..400 {
        let mut frame = (row as u64).to_le_bytes().to_vec();
        let single = row == 399;
        for value in signal(row, 1) {
            if single {
                frame.extend((value as f32).to_le_bytes());
            } else {
                frame.extend(value.to_le_bytes());
            }
        }
        client.0.send(Message::binary(frame)).await.unwrap();
        let answer = client.0.next().await.unwrap().unwrap().into_data();
        assert_eq!(answer.len(), 16 + 3 * 24);
        assert_eq!(answer[..8], (row as u64).to_le_bytes());
        let numbers: Vec<f64> = answer[16..]
            .as_chunks()
            .0
            .iter()
            .map(|b| f64::from_le_bytes(*b))
            .collect();
        if row + 1 < STEPS {
            assert_eq!(answer[8..12], [SampleStatus::Filling.code(), 255, 0, 0]);
            assert!(numbers.iter().all(|number| number.is_nan()));
            continue;
        }
        assert_eq!(answer[8], SampleStatus::Ok.code());
        let payload_kg = payload_kg(&model, row);
        light += usize::from(payload_kg.unwrap() <= 50.0);
        let truth = truth(&model, row + 1 - STEPS..row + 1);
        for (target, channel) in model.config.targets.iter().enumerate() {
            // The last sample came in single precision.
            let tolerance = if single { 1e-5 } else { 1e-6 } * channel.scale;
            assert!((numbers[3 * target] - truth[target]).abs() <= tolerance);
            let ends = [numbers[3 * target + 1], numbers[3 * target + 2]];
            let wanted = interval(&model, target, numbers[3 * target], payload_kg);
            if !single {
                for (end, wanted) in ends.into_iter().zip(wanted) {
                    assert!((end - wanted).abs() < 1e-12 * channel.scale.max(1.0), "row {row}");
                }
            }
        }
    }
    assert!((1..300).contains(&light), "{light} windows are of light machines");
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_late_and_repeated_samples_are_handled_and_told() {
    let desk = Desk::new().await;
    let model = synthetic("RLR", 1);
    let id = desk.register(&model).await;
    let (mut client, opened) = Client::open(&desk, id.as_str()).await;
    for row in 0..STEPS {
        client.sample(&opened, row as u64, row, &[]).await;
    }
    // Step 12 is lost; 13 comes, then 12 late, then 13 again.
    let filled = client.sample(&opened, 13, 13, &[]).await;
    assert_eq!((filled.status, filled.filled), (SampleStatus::Filled, 1));
    let late = client.sample(&opened, 12, 12, &[]).await;
    assert_eq!(
        (late.status, late.filled, late.estimates),
        (SampleStatus::Late, 0, None)
    );
    let repeated = client.sample(&opened, 13, 13, &[]).await;
    assert_eq!(
        (repeated.status, repeated.estimates),
        (SampleStatus::Repeated, filled.estimates)
    );
    let too_late = client.sample(&opened, 12, 12, &[]).await;
    assert_eq!(too_late.status, SampleStatus::TooLate);
    // With the late sample in its place, the window is what it would have been.
    let next = client.sample(&opened, 14, 14, &[]).await;
    assert_eq!((next.status, next.filled), (SampleStatus::Ok, 0));
    let expected = truth(&model, 3..15);
    let name = &model.config.targets[0].name;
    assert!((next.estimates.unwrap()[name] - expected[0]).abs() <= 1e-6 * model.config.targets[0].scale);
    // A silent sensor is held, and counts until it has left the window.
    let silent = client.sample(&opened, 15, 15, &[2]).await;
    assert_eq!((silent.status, silent.filled), (SampleStatus::Filled, 1));
    // More than a quarter of the window: no estimate.
    let gap = client.sample(&opened, 20, 20, &[]).await;
    assert_eq!((gap.status, gap.filled), (SampleStatus::Gap, 5));
    assert!(gap.estimates.is_none());
    let mut last = gap;
    for row in 21..40 {
        last = client.sample(&opened, row as u64, row, &[]).await;
    }
    assert_eq!((last.status, last.filled), (SampleStatus::Ok, 0));
    // Silence of a whole window is a new beginning, which needs a whole sample.
    let nothing = client.sample(&opened, 1000, 0, &[1]).await;
    assert_eq!(nothing.status, SampleStatus::Filling);
    let begun = client.sample(&opened, 1001, 1, &[]).await;
    assert_eq!((begun.status, begun.filled), (SampleStatus::Filling, 0));
    // As far apart as steps can be.
    let last = client.sample(&opened, u64::MAX, 2, &[]).await;
    assert_eq!(last.status, SampleStatus::Filling);
    let first = client.sample(&opened, 0, 3, &[]).await;
    assert_eq!(first.status, SampleStatus::TooLate);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_not_a_sample_is_told_and_changes_nothing() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let (mut client, opened) = Client::open(&desk, id.as_str()).await;
    client.sample(&opened, 0, 0, &[]).await;
    let deep = "[".repeat(50_000);
    for (text, says) in [
        ("", "not a sample"),
        (deep.as_str(), "not a sample"),
        (r#"{"step": -1, "inputs": {}}"#, "not a sample"),
        (r#"{"step": 1, "inputs": {}}"#, "valve_lift_ratio"),
        (r#"{"step": 1, "inputs": {"wind": 1.0}}"#, "wind"),
        (r#"{"step": 1, "inputs": {}, "x": 1}"#, "unknown field"),
    ] {
        let answer = client.text(text.to_owned()).await;
        assert!(
            answer.contains("\"error\"") && answer.contains(says),
            "{text:.40}: {answer}"
        );
    }
    for frame in [
        vec![],
        vec![0; 7],
        vec![0; 8],
        vec![0; 47],
        vec![0; 49],
        vec![255; 1000],
    ] {
        client.0.send(Message::binary(frame)).await.unwrap();
        let answer = client.0.next().await.unwrap().unwrap();
        assert!(answer.to_text().unwrap().contains("\"error\""), "{answer}");
    }
    let mut infinite = 1_u64.to_le_bytes().to_vec();
    infinite.extend([f64::INFINITY; 5].iter().flat_map(|v| v.to_le_bytes()));
    client.0.send(Message::binary(infinite)).await.unwrap();
    assert!(
        client
            .0
            .next()
            .await
            .unwrap()
            .unwrap()
            .to_text()
            .unwrap()
            .contains("infinite")
    );
    let next = client.sample(&opened, 1, 1, &[]).await;
    assert_eq!((next.status, next.filled), (SampleStatus::Filling, 0));
    // A message that no sample could be ends the session.
    let sent = client.0.send(Message::binary(vec![0; 200_000])).await;
    let answer = client.0.next().await;
    assert!(
        sent.is_err() || !matches!(answer, Some(Ok(Message::Text(_)))),
        "{answer:?}"
    );
    let plain = desk.get(&format!("/v1/models/{id}/stream")).await;
    assert_eq!(plain.problem(426).kind, "/problems/upgrade-required");
}

/// Every message gets one answer, and the session goes on.
#[tokio::test(flavor = "multi_thread")]
async fn damaged_samples_are_answered_one_by_one() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let (mut client, opened) = Client::open(&desk, id.as_str()).await;
    let inputs: serde_json::Map<String, serde_json::Value> = opened
        .inputs
        .iter()
        .zip(signal(0, 1))
        .map(|(name, value)| (name.clone(), json!(value)))
        .collect();
    let text = json!({ "step": 7, "inputs": inputs }).to_string();
    let mut bytes = 7_u64.to_le_bytes().to_vec();
    bytes.extend(signal(0, 1).iter().flat_map(|value| value.to_le_bytes()));
    for seed in 0..300 {
        let text = common::damaged(text.as_bytes(), seed);
        let answer = client.text(String::from_utf8_lossy(&text).into_owned()).await;
        assert!(answer.starts_with('{'), "seed {seed}: {answer}");
        client
            .0
            .send(Message::binary(common::damaged(&bytes, seed)))
            .await
            .unwrap();
        let answer = client.0.next().await.unwrap().unwrap();
        assert!(answer.is_text() || answer.is_binary(), "seed {seed}: {answer:?}");
    }
    // After silence of more than a window the session begins anew.
    for row in 0..STEPS {
        let estimate = client
            .sample(&opened, u64::MAX - 100 + row as u64, row, &[])
            .await;
        assert_eq!(estimate.estimates.is_some(), row + 1 == STEPS, "row {row}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn strange_bytes_and_huge_heads_end_their_connection_only() {
    let desk = Desk::new().await;
    let address = desk.listen().await;
    let huge = format!(
        "GET /v2 HTTP/1.1\r\nhost: x\r\nx: {}\r\n\r\n",
        "y".repeat(1 << 20)
    );
    let many = format!("GET /v2 HTTP/1.1\r\nhost: x\r\n{}\r\n", "a: b\r\n".repeat(5000));
    for bytes in [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(),
        vec![0; 4096],
        b"GET / HTTP/9.9\r\n\r\n".to_vec(),
        b"POST /v2/models/x/infer HTTP/1.1\r\nhost: x\r\ncontent-length: -5\r\n\r\n".to_vec(),
        b"POST /v2/models/x/infer HTTP/1.1\r\nhost: x\r\ncontent-length: 5\r\ncontent-length: 6\r\n\r\nhello"
            .to_vec(),
        huge.into_bytes(),
        many.into_bytes(),
    ] {
        let mut socket = TcpStream::connect(address).await.unwrap();
        // The service may close before it has read everything.
        let _ = socket.write_all(&bytes).await;
        let _ = socket.shutdown().await;
        let mut answer = Vec::new();
        let _ = socket.read_to_end(&mut answer).await;
        let text = String::from_utf8_lossy(&answer);
        assert!(text.is_empty() || text.starts_with("HTTP/1.1 4"), "{text:.200}");
    }
    // Half a request holds nobody up.
    let mut half = TcpStream::connect(address).await.unwrap();
    half.write_all(b"POST /v2/models/x/infer HTTP/1.1\r\nhost: x\r\ncontent-le")
        .await
        .unwrap();
    let mut socket = TcpStream::connect(address).await.unwrap();
    socket
        .write_all(b"GET /v2 HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n")
        .await
        .unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
}
