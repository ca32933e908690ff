//! Estimates over HTTP: JSON, tables, the Open Inference Protocol, aliases.

#![allow(
    clippy::cast_possible_truncation,
    clippy::type_complexity,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use axum::body::Body;
use common::Desk;
use common::models::{interval, register_folder, synthetic};
use hydroflex_ml::predict::PerWindow;
use hydroflex_ml::predict::synthetic::{SyntheticModel, signal};
use hydroflex_openapi::catalogue::{AliasInfo, AliasList};
use hydroflex_openapi::id::ModelId;
use hydroflex_openapi::inference::{InferError, InferResponse, ModelMetadata, ServerMetadata};
use hydroflex_openapi::prediction::PredictResponse;
use hydroflex_server::prediction::gate::{Gate, Work};
use serde_json::{Value, json};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

const INPUTS: [&str; 5] = [
    "valve_lift_ratio",
    "length_lift_m",
    "velocity_lift_m_per_s",
    "pressure_lift_piston_pa",
    "pressure_lift_rod_pa",
];

/// The columns of `rows` samples as a JSON request.
fn columns(rows: usize) -> Value {
    let samples = signal(0, rows);
    let inputs: serde_json::Map<String, Value> = INPUTS
        .iter()
        .enumerate()
        .map(|(i, name)| {
            let column: Vec<f64> = samples.iter().skip(i).step_by(5).copied().collect();
            ((*name).to_owned(), json!(column))
        })
        .collect();
    json!({ "inputs": inputs, "sample_time_s": 0.005 })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_as_json_gives_estimates_with_intervals_flags_and_provenance() {
    const ROWS: usize = 400;
    let desk = Desk::new().await;
    for model in [synthetic("best", 1), synthetic("best", 1).following_payload()] {
        let id = desk.register(&model).await;
        let path = format!("/v1/models/{id}/predict");
        let answer = desk.post(&path, &columns(ROWS).to_string()).await;
        assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
        let answer: PredictResponse = answer.json();
        assert_eq!((answer.first_step, answer.count), (11, ROWS as u64 - 11));
        assert_eq!(answer.provenance.model_sha256[..32], *id.as_str());
        let samples = signal(0, ROWS);
        let (lower, upper) = (answer.lower.unwrap(), answer.upper.unwrap());
        let mut light = 0;
        for window in 0..ROWS - 11 {
            let (expected, payload_kg) = alone(&model, &samples[window * 5..(window + 12) * 5]);
            light += usize::from(payload_kg.is_some_and(|kg| kg <= 50.0));
            for (target, channel) in model.config.targets.iter().enumerate() {
                let found = answer.estimates[&channel.name][window];
                assert!(
                    (found - expected[target]).abs() <= 1e-6 * channel.scale,
                    "{found} {}",
                    expected[target]
                );
                let ends = [&lower, &upper].map(|end| end[&channel.name][window]);
                let tolerance = 1e-12 * channel.scale.max(1.0);
                for (end, wanted) in ends.into_iter().zip(interval(&model, target, found, payload_kg)) {
                    assert!(
                        (end - wanted).abs() < tolerance,
                        "window {window}: {end} {wanted}"
                    );
                }
            }
        }
        // Windows of both widths, or of one.
        assert_eq!(light > 0 && light < ROWS - 11, model.config.payload.is_some());
        assert_eq!(answer.inside_envelope.unwrap().len(), ROWS - 11);
    }
}

/// A service that lets nothing wait, and one request that takes long.
#[tokio::test(flavor = "multi_thread")]
async fn a_busy_service_refuses_small_requests_at_once_and_says_when_to_ask_again() {
    let desk = Desk::changed(1000, |state| state.behind_gate(Gate::new(2, Duration::ZERO))).await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let path = format!("/v1/models/{id}/predict");
    let body = columns(20).to_string();
    assert_eq!(desk.post(&path, &body).await.status, 200);
    let other = desk.state.gate().inline(Work::Text, body.len()).await.unwrap();
    let refused = desk.post(&path, &body).await;
    assert_eq!(refused.status, 429);
    assert_eq!(refused.headers["retry-after"], "1");
    refused.problem(429);
    let windows = json!({"inputs": [{"name": "window", "datatype": "FP64", "shape": [1, 12, 5], "data": signal(0, 12)}]});
    let infer = format!("/v2/models/{id}/infer");
    let refused = desk.post(&infer, &windows.to_string()).await;
    assert_eq!(refused.status, 429);
    assert_eq!(refused.headers["retry-after"], "1");
    let said: InferError = refused.json();
    assert!(
        said.error.contains("as much as this machine can do"),
        "{}",
        said.error
    );
    drop(other);
    assert_eq!(desk.post(&path, &body).await.status, 200);
    assert_eq!(desk.post(&infer, &windows.to_string()).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_with_a_recording_is_said_with_name_and_place() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 2)).await;
    let path = format!("/v1/models/{id}/predict");
    let refused = async |change: &dyn Fn(&mut Value)| {
        let mut body = columns(20);
        change(&mut body);
        desk.post(&path, &body.to_string()).await.problem(422)
    };
    let missing = refused(&|body| {
        body["inputs"].as_object_mut().unwrap().remove("valve_lift_ratio");
    })
    .await;
    assert_eq!(missing.errors[0].pointer, "/inputs/valve_lift_ratio");
    let unit = refused(&|body| {
        let inputs = body["inputs"].as_object_mut().unwrap();
        let pressure = inputs.remove("pressure_lift_piston_pa").unwrap();
        inputs.insert("pressure_lift_piston_bar".to_owned(), pressure);
    })
    .await;
    assert_eq!(unit.errors.len(), 1, "{unit:?}");
    assert_eq!(unit.errors[0].pointer, "/inputs/pressure_lift_piston_bar");
    assert!(
        unit.errors[0].detail.contains("pressure_lift_piston_pa"),
        "{unit:?}"
    );
    let unknown = refused(&|body| body["inputs"]["wind_m_per_s"] = json!(1.0)).await;
    assert_eq!(unknown.errors[0].pointer, "/inputs/wind_m_per_s");
    let short = refused(&|body| {
        body["inputs"]["length_lift_m"].as_array_mut().unwrap().pop();
    })
    .await;
    assert!(
        short.errors.iter().any(|error| error.detail.contains("length")),
        "{short:?}"
    );
    // No f64: JSON has no other way to say infinite.
    let infinite = columns(20).to_string().replacen("0.0,", "1e999,", 1);
    let infinite = desk.post(&path, &infinite).await.problem(400);
    assert!(infinite.detail.contains("out of range"), "{infinite:?}");
    let time = refused(&|body| body["sample_time_s"] = json!(0.01)).await;
    assert_eq!(time.errors[0].pointer, "/sample_time_s");
    let text = refused(&|body| body["inputs"]["length_lift_m"][3] = json!("one")).await;
    assert!(
        text.errors[0].pointer.starts_with("/inputs/length_lift_m"),
        "{text:?}"
    );
    desk.post(&path, &"[".repeat(100_000)).await.problem(400);
    desk.send("POST", &path, &[("content-type", "text/csv")], "a,b")
        .await
        .problem(415);
    let picky = [("content-type", "application/json"), ("accept", "text/html")];
    desk.send("POST", &path, &picky, columns(20).to_string())
        .await
        .problem(406);
    let query = format!("{path}?sample_time_s=0.01");
    assert_eq!(
        desk.post(&query, &columns(20).to_string())
            .await
            .problem(422)
            .errors[0]
            .pointer,
        "?sample_time_s"
    );
}

/// A v2 request for `windows` windows that follow each other.
fn infer_request(windows: usize) -> (Value, Vec<f64>) {
    let samples = signal(0, 12 * windows);
    let request = json!({
        "id": "17",
        "inputs": [{"name": "window", "datatype": "FP64", "shape": [windows, 12, 5], "data": samples}],
    });
    (request, samples)
}

fn expected(model: &SyntheticModel, samples: &[f64]) -> Vec<f64> {
    let predictor = model.predictor();
    let mut out = vec![0.0; samples.len() / 60 * 3];
    predictor.predict_windows(samples, &mut out, &mut predictor.workspace());
    out
}

/// Estimates and payload of one window by itself.
fn alone(model: &SyntheticModel, window: &[f64]) -> ([f64; 3], Option<f64>) {
    let predictor = model.predictor();
    let (mut estimates, mut payload_kg) = ([0.0; 3], [0.0]);
    let asked = PerWindow {
        payload_kg: Some(&mut payload_kg),
        ..PerWindow::default()
    };
    predictor.predict_windows_with(window, &mut estimates, asked, &mut predictor.workspace());
    (estimates, Some(payload_kg[0]).filter(|kg| !kg.is_nan()))
}

fn binary(request: &Value, bytes: &[u8]) -> (Vec<u8>, String) {
    let mut body = request.to_string().into_bytes();
    let length = body.len().to_string();
    body.extend(bytes);
    (body, length)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_inference_protocols_intervals_follow_the_payload() {
    let desk = Desk::new().await;
    let model = synthetic("best", 1).following_payload();
    let id = desk.register(&model).await;
    let (request, samples) = infer_request(60);
    let answer: InferResponse = desk
        .post(&format!("/v2/models/{id}/infer"), &request.to_string())
        .await
        .json();
    let numbers = |output: usize| -> Vec<f64> {
        serde_json::from_value(answer.outputs[output].data.clone().unwrap()).unwrap()
    };
    let (lower, upper) = (numbers(1), numbers(2));
    let mut light = 0;
    for (window, samples) in samples.chunks(60).enumerate() {
        let (estimates, payload_kg) = alone(&model, samples);
        light += usize::from(payload_kg.unwrap() <= 50.0);
        for (target, estimate) in estimates.into_iter().enumerate() {
            let wanted = interval(&model, target, estimate, payload_kg);
            let place = 3 * window + target;
            let tolerance = 1e-12 * model.config.targets[target].scale.max(1.0);
            for (end, wanted) in [lower[place], upper[place]].into_iter().zip(wanted) {
                assert!((end - wanted).abs() < tolerance, "window {window}");
            }
        }
    }
    assert!(
        (10..50).contains(&light),
        "{light} of 60 windows are of light machines"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn the_inference_protocol_answers_in_json_and_in_bytes() {
    let desk = Desk::new().await;
    let model = synthetic("RLR", 3);
    let id = desk.register(&model).await;
    let server: ServerMetadata = desk.get("/v2").await.json();
    assert_eq!(server.name, "hydroflex");
    for path in [
        "/v2/health/live".to_owned(),
        "/v2/health/ready".to_owned(),
        format!("/v2/models/{id}/ready"),
    ] {
        assert_eq!(desk.get(&path).await.status, 200, "{path}");
    }
    let metadata: ModelMetadata = desk.get(&format!("/v2/models/{id}")).await.json();
    assert_eq!(metadata.inputs[0].shape, [-1, 12, 5]);
    let names: Vec<&str> = metadata
        .outputs
        .iter()
        .map(|output| output.name.as_str())
        .collect();
    assert_eq!(names, ["estimates", "lower", "upper", "inside_envelope"]);
    assert_eq!(metadata.parameters.inputs, INPUTS);

    let path = format!("/v2/models/{id}/infer");
    let (request, samples) = infer_request(3);
    let truth = expected(&model, &samples);
    let answer: InferResponse = desk.post(&path, &request.to_string()).await.json();
    assert_eq!(answer.id.as_deref(), Some("17"));
    assert_eq!(answer.outputs[0].shape, [3, 3]);
    assert_eq!(answer.outputs[0].data, Some(json!(truth)));
    assert_eq!(answer.outputs[3].shape, [3]);

    // Nested data, one output.
    let mut nested = request.clone();
    let rows: Vec<&[f64]> = samples.chunks(5).collect();
    let windows: Vec<&[&[f64]]> = rows.chunks(12).collect();
    nested["inputs"][0]["data"] = json!(windows);
    nested["outputs"] = json!([{"name": "estimates"}]);
    let answer: InferResponse = desk.post(&path, &nested.to_string()).await.json();
    assert_eq!(answer.outputs.len(), 1);
    assert_eq!(answer.outputs[0].data, Some(json!(truth)));

    // Bytes both ways, in both precisions.
    for (datatype, bytes) in [
        (
            "FP64",
            samples.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        ),
        (
            "FP32",
            samples.iter().flat_map(|v| (*v as f32).to_le_bytes()).collect(),
        ),
    ] {
        let request = json!({
            "parameters": {"binary_data_output": true},
            "inputs": [{"name": "window", "datatype": datatype, "shape": [3, 12, 5],
                        "parameters": {"binary_data_size": bytes.len()}}],
            "outputs": [{"name": "inside_envelope"}, {"name": "estimates"}],
        });
        let (body, length) = binary(&request, &bytes);
        let headers = [("inference-header-content-length", length.as_str())];
        let answer = desk.send("POST", &path, &headers, body).await;
        assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
        let json_length: usize = answer.header("inference-header-content-length").parse().unwrap();
        let (head, tail) = answer.body.split_at(json_length);
        let head: InferResponse = serde_json::from_slice(head).unwrap();
        assert_eq!(head.outputs[1].parameters["binary_data_size"], 72);
        assert_eq!(tail.len(), 3 + 72);
        for (found, (truth, target)) in tail[3..]
            .as_chunks()
            .0
            .iter()
            .zip(truth.iter().zip(model.config.targets.iter().cycle()))
        {
            // Samples in single precision: 6e-8 of pressures of 2.5 scales, through a network.
            let tolerance = if datatype == "FP64" {
                0.0
            } else {
                1e-5 * target.scale
            };
            assert!(
                (f64::from_le_bytes(*found) - truth).abs() <= tolerance,
                "{datatype}"
            );
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn protocol_errors_name_what_is_wrong() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 3)).await;
    let path = format!("/v2/models/{id}/infer");
    let refused = async |change: &dyn Fn(&mut Value), says: &str| {
        let (mut request, _) = infer_request(2);
        change(&mut request);
        let text = request.to_string().replace("\"1e999\"", "1e999");
        let answer = desk.post(&path, &text).await;
        assert_eq!(answer.status, 400, "{says}");
        let error: InferError = answer.json();
        assert!(
            error.error.contains(says),
            "{} does not say {says:?}",
            error.error
        );
    };
    refused(&|r| r["inputs"][0]["name"] = json!("x"), "\"window\"").await;
    refused(&|r| r["inputs"] = json!([]), "takes one").await;
    refused(&|r| r["inputs"][0]["shape"] = json!([2, 11, 5]), "[batch, 12, 5]").await;
    refused(&|r| r["inputs"][0]["shape"] = json!([0, 12, 5]), "at least 1").await;
    refused(&|r| r["inputs"][0]["shape"] = json!([u64::MAX, 12, 5]), "values").await;
    refused(&|r| r["inputs"][0]["datatype"] = json!("INT8"), "FP32").await;
    refused(&|r| r["inputs"][0]["data"] = json!([1.0]), "1 values").await;
    refused(&|r| r["inputs"][0]["data"] = json!([[[[1.0]]]]), "nested").await;
    refused(&|r| r["inputs"][0]["data"] = json!("x"), "array of numbers").await;
    refused(
        &|r| {
            r["inputs"][0].as_object_mut().unwrap().remove("data");
        },
        "no values",
    )
    .await;
    refused(
        &|r| r["inputs"][0]["parameters"] = json!({"binary_data_size": 8}),
        "both",
    )
    .await;
    refused(&|r| r["outputs"] = json!([{"name": "wind"}]), "estimates").await;
    refused(
        &|r| r["outputs"] = json!([{"name": "lower"}, {"name": "lower"}]),
        "twice",
    )
    .await;
    refused(
        &|r| r["inputs"][0]["data"][68] = json!("1e999"),
        "number out of range",
    )
    .await;
    // A NaN can only come as bytes.
    let mut samples = infer_request(2).1;
    samples[68] = f64::NAN;
    let bytes: Vec<u8> = samples.iter().flat_map(|v| v.to_le_bytes()).collect();
    let request = json!({"inputs": [{"name": "window", "datatype": "FP64", "shape": [2, 12, 5],
                                     "parameters": {"binary_data_size": bytes.len()}}]});
    let (body, length) = binary(&request, &bytes);
    let nan = desk
        .send(
            "POST",
            &path,
            &[("inference-header-content-length", &length)],
            body.clone(),
        )
        .await;
    let nan: InferError = nan.json();
    assert!(
        nan.error
            .contains("NaN at [1, 1, 3], \"pressure_lift_piston_pa\""),
        "{}",
        nan.error
    );
    for (length, says) in [
        ("x", "not a number"),
        ("99999999", "has"),
        ("-1", "not a number"),
        ("3", "protocol"),
    ] {
        let answer = desk
            .send(
                "POST",
                &path,
                &[("inference-header-content-length", length)],
                body.clone(),
            )
            .await;
        assert_eq!(answer.status, 400);
        assert!(answer.json::<InferError>().error.contains(says), "{length}");
    }
    for (path, says) in [
        ("/v2/models/boom", "alias"),
        ("/v2/models/boom@stable", "no alias"),
        ("/v2/models/9f86d081884c7d659a2feaa0c55ad015", "no model"),
        (&format!("/v2/models/{id}/versions/2"), "version"),
        ("/v2/models/%ff/ready", "UTF-8"),
    ] {
        let answer = desk.get(path).await;
        assert_eq!(answer.status, 404, "{path}");
        let error: InferError = answer.json();
        assert!(error.error.contains(says), "{path}: {}", error.error);
    }
}

/// Whatever comes: an answer or a refusal, never a failure of the service.
#[tokio::test(flavor = "multi_thread")]
async fn damaged_requests_are_answered_or_refused_and_harm_nobody() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 2)).await;
    let (request, samples) = infer_request(2);
    let bytes: Vec<u8> = samples.iter().flat_map(|v| v.to_le_bytes()).collect();
    let mut with_bytes = request.clone();
    with_bytes["inputs"][0].as_object_mut().unwrap().remove("data");
    with_bytes["inputs"][0]["parameters"] = json!({ "binary_data_size": bytes.len() });
    let (body, length) = binary(&with_bytes, &bytes);
    let (predict, infer) = (
        format!("/v1/models/{id}/predict"),
        format!("/v2/models/{id}/infer"),
    );
    let length = [("inference-header-content-length", length.as_str())];
    let json = [("content-type", "application/json")];
    let gzip = [("content-type", "application/json"), ("content-encoding", "gzip")];
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut packed, request.to_string().as_bytes()).unwrap();
    let packed = packed.finish().unwrap();
    let kinds: [(&str, &[(&str, &str)], Vec<u8>); 4] = [
        (&predict, &json, columns(20).to_string().into_bytes()),
        (&infer, &json, request.to_string().into_bytes()),
        (&infer, &length, body),
        (&infer, &gzip, packed),
    ];
    for (path, headers, whole) in kinds {
        let mut refused = 0;
        for seed in 0..400 {
            let answer = desk
                .send("POST", path, headers, common::damaged(&whole, seed))
                .await;
            assert!(
                answer.status == 200 || answer.status.is_client_error(),
                "{path} {headers:?} seed {seed}: {}",
                answer.status
            );
            refused += usize::from(answer.status != 200);
        }
        assert!(refused > 100, "{path} {headers:?}: only {refused} were refused");
        let answer = desk.send("POST", path, headers, whole).await;
        assert_eq!(answer.status, 200, "{path} {headers:?} afterwards");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn bodies_come_and_go_compressed() {
    use std::io::{Read, Write};
    let desk = Desk::new().await;
    let model = synthetic("RLR", 3);
    let id = desk.register(&model).await;
    let path = format!("/v2/models/{id}/infer");
    let (request, samples) = infer_request(64);
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(request.to_string().as_bytes()).unwrap();
    let headers = [("content-encoding", "gzip"), ("accept-encoding", "gzip")];
    let answer = desk
        .send("POST", &path, &headers, encoder.finish().unwrap())
        .await;
    assert_eq!(
        (answer.status.as_u16(), answer.header("content-encoding")),
        (200, "gzip")
    );
    let mut text = String::new();
    flate2::read::GzDecoder::new(answer.body.as_slice())
        .read_to_string(&mut text)
        .unwrap();
    let answer: InferResponse = serde_json::from_str(&text).unwrap();
    assert_eq!(answer.outputs[0].data, Some(json!(expected(&model, &samples))));
    // A small body that becomes a large one is refused at the limit, not unpacked.
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    for _ in 0..80 {
        encoder.write_all(&vec![b' '; 1 << 20]).unwrap();
    }
    let bomb = encoder.finish().unwrap();
    assert!(bomb.len() < 1 << 20);
    let answer = desk
        .send("POST", &path, &[("content-encoding", "gzip")], bomb)
        .await;
    assert_eq!(answer.status, 413);
    let garbage = desk
        .send("POST", &path, &[("content-encoding", "gzip")], vec![7; 100])
        .await;
    assert_eq!(garbage.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_alias_moves_between_models_and_earlier_ones_stay() {
    let desk = Desk::new().await;
    let (first, second) = (synthetic("RLR", 4), synthetic("RLR", 5));
    let (a, b) = (desk.register(&first).await, desk.register(&second).await);
    let path = "/v1/aliases/boom@stable";
    desk.get(path).await.problem(404);
    let json = ("content-type", "application/json");
    let to = |id: &hydroflex_openapi::id::ModelId| json!({ "model_id": id }).to_string();
    let made = desk
        .send("PUT", path, &[json, ("if-none-match", "*")], to(&a))
        .await;
    assert_eq!((made.status.as_u16(), made.header("etag")), (201, "\"1\""));
    desk.send("PUT", path, &[json, ("if-none-match", "*")], to(&b))
        .await
        .problem(412);
    desk.send("PUT", path, &[json, ("if-match", "\"7\"")], to(&b))
        .await
        .problem(412);
    let (request, samples) = infer_request(1);
    let infer = async |path: &str| -> (String, Value) {
        let answer = desk.post(path, &request.to_string()).await;
        assert_eq!(
            answer.status,
            200,
            "{path}: {}",
            String::from_utf8_lossy(&answer.body)
        );
        let answer: InferResponse = answer.json();
        (answer.model_version, answer.outputs[0].data.clone().unwrap())
    };
    let (of_first, of_second) = (
        json!(expected(&first, &samples)),
        json!(expected(&second, &samples)),
    );
    assert_ne!(of_first, of_second);
    let by_alias = "/v2/models/boom@stable/infer";
    assert_eq!(infer(by_alias).await, ("1".to_owned(), of_first.clone()));
    let moved = desk
        .send("PUT", path, &[json, ("if-match", "\"1\"")], to(&b))
        .await;
    assert_eq!((moved.status.as_u16(), moved.header("etag")), (200, "\"2\""));
    let same = desk.send("PUT", path, &[json], to(&b)).await;
    assert_eq!(
        same.json::<AliasInfo>().generation,
        2,
        "a repeated move is no move"
    );
    assert_eq!(infer(by_alias).await, ("2".to_owned(), of_second.clone()));
    assert_eq!(infer("/v2/models/boom%40stable/infer").await.1, of_second);
    assert_eq!(infer("/v2/models/boom/versions/stable/infer").await.1, of_second);
    assert_eq!(
        infer("/v2/models/boom@stable/versions/1/infer").await,
        ("1".to_owned(), of_first.clone())
    );
    assert_eq!(infer(&format!("/v2/models/{a}/infer")).await.1, of_first);
    let metadata: ModelMetadata = desk.get("/v2/models/boom@stable").await.json();
    assert_eq!(metadata.versions, ["1", "2"]);
    let listed: AliasList = desk.get("/v1/aliases").await.json();
    assert_eq!(listed.aliases.len(), 1);
    assert_eq!(listed.aliases[0].model_id, b);
    let predicted: PredictResponse = desk
        .post("/v1/models/boom@stable/predict", &columns(12).to_string())
        .await
        .json();
    assert_eq!(predicted.model_id, b);
    desk.send("PUT", "/v1/aliases/Boom", &[json], to(&a))
        .await
        .problem(404);
    let nobody = r#"{"model_id": "9f86d081884c7d659a2feaa0c55ad015"}"#;
    desk.send("PUT", path, &[json], nobody).await.problem(422);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_waits_for_the_store_rather_than_forget_its_simulator() {
    let desk = Desk::new().await;
    let id = desk.register(&synthetic("RLR", 6)).await;
    let predict = async || {
        desk.send(
            "POST",
            &format!("/v1/models/{id}/predict"),
            &[("content-type", "application/json")],
            Body::from(columns(12).to_string()),
        )
        .await
    };
    // A file in place of the directory: the store neither has the data sets nor says that it has none.
    let in_the_way = desk.blobs.local_path("datasets").unwrap();
    std::fs::write(&in_the_way, "").unwrap();
    predict().await.problem(503);
    std::fs::remove_file(&in_the_way).unwrap();
    assert_eq!(predict().await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bad_model_never_replaces_a_good_one() {
    let desk = Desk::new().await;
    let good = desk.register(&synthetic("RLR", 6)).await;
    let put = async |id: &hydroflex_openapi::id::ModelId| {
        let body = json!({ "model_id": id }).to_string();
        desk.send(
            "PUT",
            "/v1/aliases/boom@stable",
            &[("content-type", "application/json")],
            body,
        )
        .await
    };
    assert_eq!(put(&good).await.status, 201);
    // Hashes agree, golden predictions do not.
    let mut wrong = synthetic("RLR", 7);
    wrong.config.golden[1].estimates[0] += 0.1 * wrong.config.targets[0].scale;
    let wrong = desk.register(&wrong).await;
    let problem = put(&wrong).await.problem(409);
    assert!(problem.detail.contains("golden"), "{problem:?}");
    // A file was changed after it was hashed.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model");
    synthetic("RLR", 8).write(&path).unwrap();
    let tensors = path.join("model.safetensors");
    let mut content = std::fs::read(&tensors).unwrap();
    *content.last_mut().unwrap() ^= 1;
    std::fs::write(&tensors, content).unwrap();
    let damaged = register_folder(&desk.ledger, &desk.blobs, &path).await;
    assert!(put(&damaged).await.problem(409).detail.contains("hash"));
    let shown: AliasInfo = desk.get("/v1/aliases/boom@stable").await.json();
    assert_eq!((shown.model_id, shown.generation), (good, 1));
    assert_eq!(desk.get("/v2/models/boom@stable/ready").await.status, 200);
    assert_eq!(desk.get(&format!("/v2/models/{wrong}/ready")).await.status, 503);
    desk.send(
        "POST",
        &format!("/v1/models/{damaged}/predict"),
        &[("content-type", "application/json")],
        Body::from(columns(12).to_string()),
    )
    .await
    .problem(500);
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_by_alias_never_fail_while_it_moves() {
    let desk = std::sync::Arc::new(Desk::new().await);
    let ids = [
        desk.register(&synthetic("L", 1)).await,
        desk.register(&synthetic("L", 2)).await,
    ];
    let json = [("content-type", "application/json")];
    let to = |id: &hydroflex_openapi::id::ModelId| json!({ "model_id": id }).to_string();
    desk.send("PUT", "/v1/aliases/boom@stable", &json, to(&ids[0]))
        .await;
    let body = infer_request(1).0.to_string();
    let asking: Vec<_> = (0..4)
        .map(|_| {
            let (desk, body) = (desk.clone(), body.clone());
            tokio::spawn(async move {
                let mut seen = std::collections::BTreeSet::new();
                for _ in 0..200 {
                    let answer = desk.post("/v2/models/boom@stable/infer", &body).await;
                    assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
                    seen.insert(answer.json::<InferResponse>().model_version);
                }
                seen
            })
        })
        .collect();
    for turn in 1..40 {
        let moved = desk
            .send("PUT", "/v1/aliases/boom@stable", &json, to(&ids[turn % 2]))
            .await;
        assert_eq!(moved.status, 200);
    }
    for task in asking {
        assert!(!task.await.unwrap().is_empty());
    }
}

/// What a connection says from now on: the head of an answer, and the answer with its body.
async fn heard(socket: &mut TcpStream) -> String {
    let mut answer = Vec::new();
    loop {
        let text = String::from_utf8_lossy(&answer).into_owned();
        if let Some((head, body)) = text.split_once("\r\n\r\n") {
            let length = head.lines().find_map(|line| {
                let (name, value) = line.split_once(": ")?;
                name.eq_ignore_ascii_case("content-length")
                    .then(|| value.parse::<usize>().unwrap())
            });
            if body.len() >= length.unwrap_or(0) {
                return text;
            }
        }
        assert!(
            socket.read_buf(&mut answer).await.unwrap() > 0,
            "closed after {text:?}"
        );
    }
}

/// A request of 1,000 windows in bytes, 480 kB: its head with more lines, and its body.
fn large(id: &ModelId, more: &str) -> (String, Vec<u8>) {
    let samples: Vec<u8> = signal(0, 12_000)
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let request = json!({
        "inputs": [{"name": "window", "datatype": "FP64", "shape": [1000, 12, 5],
            "parameters": {"binary_data_size": samples.len()}}],
        "outputs": [{"name": "estimates", "parameters": {"binary_data": false}}],
    });
    let (body, length) = binary(&request, &samples);
    let head = format!(
        "POST /v2/models/{id}/infer HTTP/1.1\r\nhost: x\r\ninference-header-content-length: {length}\r\n{more}\r\n"
    );
    (head, body)
}

fn is_refusal(answer: &str) -> bool {
    let head = answer.to_ascii_lowercase();
    head.starts_with("http/1.1 429")
        && head.contains("retry-after: 1\r\n")
        && head.contains("connection: close\r\n")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_large_body_is_refused_before_it_is_received_and_every_client_sees_it() {
    let desk = Desk::changed(1000, |state| state.behind_gate(Gate::new(1, Duration::ZERO))).await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let address = desk.listen().await;
    let connect = async || TcpStream::connect(address).await.unwrap();
    let places = (
        desk.state.gate().large().await.unwrap(),
        desk.state.gate().large().await.unwrap(),
    );

    // Nothing of the body is sent, asked about or not.
    let length = format!("content-length: {}\r\n", large(&id, "").1.len());
    let asking = format!("{length}expect: 100-continue\r\n");
    for more in [&length, &asking] {
        let mut socket = connect().await;
        let (head, _) = large(&id, more);
        socket.write_all(head.as_bytes()).await.unwrap();
        let answer = heard(&mut socket).await;
        assert!(is_refusal(&answer), "{answer}");
        assert!(answer.contains("as much as this machine can do"), "{answer}");
    }
    // As Python's http.client: nothing is read before everything is sent, here 32 MB.
    let mut socket = connect().await;
    let (head, _) = large(&id, "content-length: 33554432\r\n");
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(&vec![0; 33_554_432]).await.unwrap();
    let answer = heard(&mut socket).await;
    assert!(is_refusal(&answer), "{answer}");
    // A length that nobody has told: refused as soon as the body is large.
    let mut socket = connect().await;
    let (head, body) = large(&id, "transfer-encoding: chunked\r\n");
    socket.write_all(head.as_bytes()).await.unwrap();
    for chunk in body.chunks(10_000) {
        let chunk = [format!("{:x}\r\n", chunk.len()).as_bytes(), chunk, b"\r\n"].concat();
        socket.write_all(&chunk).await.unwrap();
    }
    let answer = heard(&mut socket).await;
    assert!(is_refusal(&answer), "{answer}");
    // Engineering units the same way; small requests are answered meanwhile.
    let path = format!("/v1/models/{id}/predict");
    let long = columns(20_000).to_string();
    let told = long.len().to_string();
    let json = [("content-type", "application/json"), ("content-length", &told)];
    let refused = desk.send("POST", &path, &json, long.clone()).await;
    refused.problem(429);
    assert_eq!(refused.header("connection"), "close");
    assert_eq!(desk.post(&path, &columns(20).to_string()).await.status, 200);

    drop(places);
    assert_eq!(desk.send("POST", &path, &json, long).await.status, 200);
    let mut socket = connect().await;
    let (head, body) = large(&id, &asking);
    socket.write_all(head.as_bytes()).await.unwrap();
    assert_eq!(heard(&mut socket).await, "HTTP/1.1 100 Continue\r\n\r\n");
    socket.write_all(&body).await.unwrap();
    let answer = heard(&mut socket).await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer:.300}");
}

#[tokio::test(flavor = "multi_thread")]
async fn many_large_bodies_at_once_are_answered_or_refused_and_small_ones_answered() {
    let desk = Desk::changed(1000, |state| {
        state.behind_gate(Gate::new(1, Duration::from_millis(25)))
    })
    .await;
    let id = desk.register(&synthetic("best", 1)).await;
    let address = desk.listen().await;
    let (head, body) = large(&id, &format!("content-length: {}\r\n", large(&id, "").1.len()));
    let request = Arc::new([head.as_bytes(), &body].concat());
    let clients: Vec<_> = (0..32)
        .map(|_| {
            let request = request.clone();
            tokio::spawn(async move {
                let mut answered = 0;
                for _ in 0..4 {
                    let mut socket = TcpStream::connect(address).await.unwrap();
                    socket.write_all(&request).await.unwrap();
                    let answer = heard(&mut socket).await;
                    let is_answer = answer.starts_with("HTTP/1.1 200");
                    assert!(is_answer || is_refusal(&answer), "{answer:.300}");
                    answered += u32::from(is_answer);
                }
                answered
            })
        })
        .collect();
    let path = format!("/v1/models/{id}/predict");
    for _ in 0..50 {
        assert_eq!(desk.post(&path, &columns(20).to_string()).await.status, 200);
    }
    let mut answered = 0;
    for client in clients {
        answered += client.await.unwrap();
    }
    assert!(answered > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sender_that_falls_silent_does_not_keep_its_place() {
    let desk = Desk::changed(1000, |state| state.behind_gate(Gate::new(1, Duration::ZERO))).await;
    let id = desk.register(&synthetic("RLR", 1)).await;
    let address = desk.listen().await;
    let (head, body) = large(&id, &format!("content-length: {}\r\n", large(&id, "").1.len()));
    let mut silent = Vec::new();
    for _ in 0..2 {
        let mut socket = TcpStream::connect(address).await.unwrap();
        socket.write_all(head.as_bytes()).await.unwrap();
        socket.write_all(&body[..1000]).await.unwrap();
        silent.push(socket);
    }
    loop {
        let mut socket = TcpStream::connect(address).await.unwrap();
        socket.write_all(head.as_bytes()).await.unwrap();
        socket.write_all(&body).await.unwrap();
        let answer = heard(&mut socket).await;
        if answer.starts_with("HTTP/1.1 200") {
            break;
        }
        assert!(is_refusal(&answer), "{answer}");
    }
    // The silent ones are answered when they go on.
    for mut socket in silent {
        socket.write_all(&body[1000..]).await.unwrap();
        let answer = heard(&mut socket).await;
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer:.300}");
    }
}
