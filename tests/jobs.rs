//! What a job asks of its data set is what the data set has.

#![allow(clippy::unwrap_used, reason = "a test stops at what it did not expect")]

use arrow::datatypes::DataType;
use hydroflex_openapi::status::JobState;
use hydroflex_tests::{ServiceUnderTest, Start};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::file::reader::{FileReader, SerializedFileReader};

#[test]
fn columns_sample_type_and_file_size_are_choices() {
    let folder = tempfile::tempdir().unwrap();
    let start = Start {
        workers: 2,
        ..Start::default()
    };
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    // 240 training runs of 201 rows are three row groups, each larger than 1 MB on disk: files are cut between
    // row groups, so there are three where a file may have 1 MB, and one where it may have 128.
    let mut job = serde_json::json!({ "runs": 300, "seed": 3, "settling_runs": 2 });
    let whole = publish(&service, &job);
    job["columns"] = serde_json::json!([
        "deflection_tip_y_m",
        "valve_lift_ratio",
        "pressure_lift_piston_pa"
    ]);
    job["sample_type"] = serde_json::json!("float32");
    let chosen = publish(&service, &job);
    job["columns"] = serde_json::json!([]);
    job["sample_type"] = serde_json::json!("float64");
    job["file_size_mb"] = serde_json::json!(1);
    let small = publish(&service, &job);

    assert_eq!(names(&small[0]), names(&whole[0]));
    assert!(
        small.len() > whole.len(),
        "{} and {} files",
        small.len(),
        whole.len()
    );
    let column = |files: &[Vec<u8>], name: &str| -> Vec<f64> {
        files.iter().flat_map(|file| values(file, name)).collect()
    };
    let deflection = column(&whole, "deflection_tip_y_m");
    assert!(deflection.len() == 240 * 201 && deflection.iter().any(|y| *y < -1e-4));
    assert_eq!(deflection, column(&small, "deflection_tip_y_m"));

    // The machine's order, whatever the order in the request.
    let samples: Vec<String> = names(&chosen[0])
        .into_iter()
        .filter(|name| !["run_id", "step", "time_s"].contains(&name.as_str()))
        .collect();
    assert_eq!(
        samples,
        [
            "valve_lift_ratio",
            "pressure_lift_piston_pa",
            "deflection_tip_y_m"
        ]
    );
    for (single, double) in column(&chosen, "deflection_tip_y_m").into_iter().zip(deflection) {
        assert!(
            (single - double).abs() <= 6e-8 * double.abs(),
            "{single} for {double}"
        );
    }

    job["columns"] = serde_json::json!(["deflection_tip_y_mm"]);
    let refused = service.submit(&job).unwrap_err().to_string();
    assert!(
        refused.contains("/columns/0") && refused.contains("deflection_tip_y_m,"),
        "{refused}"
    );
    job["columns"] = serde_json::json!(["valve_lift_ratio"]);
    job["train"] = serde_json::json!([{ "targets": ["deflection_tip_y_m"] }]);
    let refused = service.submit(&job).unwrap_err().to_string();
    assert!(
        refused.contains("/train/0/targets/0") && refused.contains("/columns"),
        "{refused}"
    );
    service.terminate().unwrap();
}

/// A window from the machine's eigenvalues needs no settling run: the data set says how long it is.
#[test]
fn a_network_takes_its_window_from_eigenvalues() {
    let folder = tempfile::tempdir().unwrap();
    let start = Start {
        workers: 1,
        ..Start::default()
    };
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    let job = serde_json::json!({
        "runs": 40, "settling_runs": 0, "payload_kg": 50, "duration_s": 2.0,
        "train": [{ "structure": "L", "window": { "rule": "eigenvalues" }, "targets": ["deflection_tip_y_m"], "epochs": 2 }],
    });
    let id = service.submit(&job).unwrap().job_id.to_string();
    let status = service.wait_for(&id, |status| status.state.is_final()).unwrap();
    assert_eq!(status.state, JobState::Succeeded, "{status:?}");
    let json =
        |path: String| -> serde_json::Value { serde_json::from_slice(&service.get(&path).unwrap()).unwrap() };
    let dataset = status.dataset_id.unwrap();
    let facts = json(format!("/v1/datasets/{dataset}/files/meta/window.json"));
    let window_s = facts["eigenvalues_s"].as_f64().unwrap();
    assert!((0.05..1.0).contains(&window_s), "{facts}");
    let models = json("/v1/models".to_owned());
    let model = models["models"][0]["model_id"].as_str().unwrap();
    let steps = json(format!("/v2/models/{model}"))["inputs"][0]["shape"][1]
        .as_f64()
        .unwrap();
    assert!(
        (steps * 0.005 - window_s).abs() <= 0.005,
        "{steps} steps for {window_s} s"
    );
    service.terminate().unwrap();
}

/// Training files of a job's data set, in order.
fn publish(service: &ServiceUnderTest, job: &serde_json::Value) -> Vec<Vec<u8>> {
    let id = service.submit(job).unwrap().job_id.to_string();
    let status = service.wait_for(&id, |status| status.state.is_final()).unwrap();
    assert_eq!(status.state, JobState::Succeeded, "{status:?}");
    let dataset = status.dataset_id.unwrap();
    let listed = service.get(&format!("/v1/datasets/{dataset}")).unwrap();
    let listed: serde_json::Value = serde_json::from_slice(&listed).unwrap();
    let mut paths: Vec<&str> = listed["files"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|file| file["path"].as_str())
        .filter(|path| path.starts_with("data/train-"))
        .collect();
    paths.sort_unstable();
    paths
        .into_iter()
        .map(|path| {
            service
                .get(&format!("/v1/datasets/{dataset}/files/{path}"))
                .unwrap()
        })
        .collect()
}

fn names(file: &[u8]) -> Vec<String> {
    let reader = SerializedFileReader::new(bytes::Bytes::copy_from_slice(file)).unwrap();
    let schema = reader.metadata().file_metadata().schema_descr();
    schema
        .columns()
        .iter()
        .map(|column| column.name().to_owned())
        .collect()
}

fn values(file: &[u8], name: &str) -> Vec<f64> {
    let reader = ParquetRecordBatchReaderBuilder::try_new(bytes::Bytes::copy_from_slice(file)).unwrap();
    let mut all = Vec::new();
    for batch in reader.build().unwrap() {
        let column =
            arrow::compute::cast(batch.unwrap().column_by_name(name).unwrap(), &DataType::Float64).unwrap();
        all.extend_from_slice(
            arrow::array::AsArray::as_primitive::<arrow::datatypes::Float64Type>(&column).values(),
        );
    }
    all
}

/// A job of ten million runs costs its coordinator what a small one does: shards are cut as they are needed, and its
/// data set is written as they come.
#[test]
fn a_job_of_ten_million_runs_is_accepted_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let service = |workers| {
        let start = Start {
            workers,
            ..Start::default()
        };
        ServiceUnderTest::start(folder.path(), &start).unwrap()
    };
    // Columns are few so that the test writes little; how many runs a shard has does not depend on them.
    let job = serde_json::json!({
        "runs": 10_000_000_u64, "seed": 3, "settling_runs": 2,
        "columns": ["valve_lift_ratio"], "sample_type": "float32"
    });
    let id = {
        let service = service(0);
        let accepted = service.submit(&job).unwrap();
        let id = accepted.job_id.to_string();
        assert_eq!(
            (accepted.state, accepted.progress.runs_total),
            (JobState::Queued, 10_000_000)
        );
        assert!(open_shards(&service) <= 4, "{}", open_shards(&service));
        service.terminate().unwrap();
        id
    };
    let service = service(2);
    let simulated = |runs: u64| {
        let status = service
            .wait_for(&id, |status| {
                status.progress.runs_done >= runs || status.state.is_final()
            })
            .unwrap();
        assert_eq!(status.state, JobState::Simulating, "{status:?}");
    };
    simulated(2_000);
    let before_kib = resident_kib(service.pid());
    simulated(8_000);
    let after_kib = resident_kib(service.pid());
    // Four thousand times as many runs as now may still come: a job that cost as little as 10 bytes of memory for each
    // run planned would show in the first figure, one that kept its samples (1.6 kB a run) in the second.
    assert!(before_kib < 400 << 10, "{before_kib} KiB");
    assert!(
        after_kib < before_kib + (48 << 10),
        "{before_kib} KiB, then {after_kib} KiB"
    );
    // Four to a worker, and those that a coordinator without workers had cut.
    assert!(open_shards(&service) <= 12, "{}", open_shards(&service));
    service.post(&format!("/v1/jobs/{id}/cancel")).unwrap();
    let ended = service.wait_for(&id, |status| status.state.is_final()).unwrap();
    assert_eq!(ended.state, JobState::Cancelled);
    service.terminate().unwrap();
}

/// Shards that wait or run.
fn open_shards(service: &ServiceUnderTest) -> u64 {
    let metrics = String::from_utf8(service.get("/metrics").unwrap()).unwrap();
    metrics
        .lines()
        .filter(|line| {
            line.contains(r#"hydroflex_shards{state="open"}"#)
                || line.contains(r#"hydroflex_shards{state="running"}"#)
        })
        .filter_map(|line| line.rsplit(' ').next()?.parse::<u64>().ok())
        .sum()
}

/// Memory of a process that is in use.
fn resident_kib(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}
