//! The published document is the one that the types make, and every example in it is true.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use common::Desk;
use hydroflex_openapi::event::JobEvent;
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::prediction::{PredictRequest, PredictResponse};
use hydroflex_openapi::problem::Problem;
use hydroflex_openapi::status::{JobStatus, TrainingRequest};
use hydroflex_openapi::sweep::SweepRequest;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};

fn contract() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../openapi")
}

/// `HYDROFLEX_UPDATE_OPENAPI=1 cargo test --release -p hydroflex-server --test openapi` rewrites it.
#[test]
fn the_published_document_is_up_to_date() {
    let mut text = serde_json::to_string_pretty(&hydroflex_server::http::openapi()).unwrap();
    text.push('\n');
    let path = contract().join("openapi.json");
    if std::env::var_os("HYDROFLEX_UPDATE_OPENAPI").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let published = std::fs::read_to_string(&path).unwrap();
    let first = published
        .lines()
        .zip(text.lines())
        .position(|(published, made)| published != made);
    assert!(
        published == text,
        "openapi.json differs from the types, first in line {:?}",
        first.map(|line| line + 1)
    );
}

#[test]
fn every_operation_has_a_name_a_summary_and_a_tag() {
    let document = serde_json::to_value(hydroflex_server::http::openapi()).unwrap();
    let mut names = std::collections::BTreeSet::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            let place = format!("{method} {path}");
            assert!(
                operation["summary"].as_str().is_some_and(|text| !text.is_empty()),
                "{place}"
            );
            assert!(
                operation["tags"].as_array().is_some_and(|tags| tags.len() == 1),
                "{place}"
            );
            assert!(
                names.insert(operation["operationId"].as_str().unwrap().to_owned()),
                "{place}"
            );
        }
    }
    assert!(names.len() >= 20, "{names:?}");
}

fn example(name: &str) -> String {
    std::fs::read_to_string(contract().join("examples").join(name)).unwrap()
}

/// The example parses, and says nothing that the type does not hold.
fn round_trip<T: DeserializeOwned + Serialize>(name: &str) {
    let text = example(name);
    let value: T = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{name}: {error}"));
    let written = serde_json::to_value(&value).unwrap();
    let given: serde_json::Value = serde_json::from_str(&text).unwrap();
    contains(name, &written, &given);
}

fn contains(place: &str, written: &serde_json::Value, given: &serde_json::Value) {
    match (written, given) {
        (serde_json::Value::Object(written), serde_json::Value::Object(given)) => {
            for (key, value) in given {
                let place = format!("{place}/{key}");
                contains(
                    &place,
                    written.get(key).unwrap_or_else(|| panic!("{place} is lost")),
                    value,
                );
            }
        }
        (serde_json::Value::Array(written), serde_json::Value::Array(given)) => {
            assert_eq!(written.len(), given.len(), "{place}");
            for (written, given) in written.iter().zip(given) {
                contains(place, written, given);
            }
        }
        _ => assert_eq!(written, given, "{place}"),
    }
}

#[test]
fn examples_are_what_the_types_say() {
    round_trip::<JobSpec>("job-request.json");
    round_trip::<JobSpec>("job-request-full.json");
    round_trip::<JobStatus>("job-status.json");
    round_trip::<TrainingRequest>("training-request.json");
    round_trip::<SweepRequest>("sweep-request.json");
    round_trip::<PredictRequest>("predict-request.json");
    round_trip::<PredictResponse>("predict-response.json");
    round_trip::<Problem>("problem.json");
    round_trip::<JobEvent>("event.json");
    assert_eq!(
        std::fs::read_dir(contract().join("examples")).unwrap().count(),
        9,
        "an example is not tested"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn example_jobs_are_accepted() {
    let desk = Desk::new().await;
    for name in ["job-request.json", "job-request-full.json"] {
        let answer = desk.post("/v1/jobs", &example(name)).await;
        assert_eq!(
            answer.status,
            202,
            "{name}: {}",
            String::from_utf8_lossy(&answer.body)
        );
    }
}
