//! The published bytes are a function of what was asked for, not of how the work was divided.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use common::{STEPS, failed, job, publish_spec, record};
use hydroflex_dataset::{
    Dataset, DirectorySink, MemorySink, PublishError, Published, Publisher, RunKind, RunRecord, ShardReader,
    ShardWriter,
};
use hydroflex_openapi::dataset::SplitName;
use hydroflex_openapi::job::RunStatus;
use proptest::prelude::*;
use std::collections::BTreeMap;

type Files = BTreeMap<String, Vec<u8>>;

/// Runs of a job: every tenth fails, two settling runs after the sixth.
fn records(runs: u64, steps: usize) -> Vec<RunRecord> {
    let mut records: Vec<RunRecord> = (0..runs)
        .map(|run| match run % 10 {
            9 => failed(run),
            _ => record(RunKind::Job, run, steps),
        })
        .collect();
    for settling in 0..2 {
        let at = records.len().min(6 + settling);
        records.insert(at, record(RunKind::Settling, settling as u64, steps));
    }
    records
}

/// Through shards that end after the given numbers of records.
fn publish(json: &str, records: &[RunRecord], cuts: &[usize]) -> (Published, Files) {
    publish_on(0, json, records, cuts)
}

/// The same, with this many threads that encode.
fn publish_on(encoders: usize, json: &str, records: &[RunRecord], cuts: &[usize]) -> (Published, Files) {
    let spec = publish_spec(job(json));
    let schema = spec.shard_schema();
    let mut publisher = Publisher::with_encoders(spec, MemorySink::default(), encoders).unwrap();
    let mut rest = records;
    for &cut in cuts.iter().chain([&usize::MAX]) {
        let (shard, later) = rest.split_at(cut.min(rest.len()));
        rest = later;
        let mut writer = ShardWriter::new(schema.clone(), Vec::new()).unwrap();
        for record in shard {
            writer.push(record).unwrap();
        }
        let bytes = writer.finish().unwrap();
        for record in ShardReader::open(bytes.as_slice()).unwrap() {
            publisher.push(&record.unwrap()).unwrap();
        }
    }
    let (published, sink) = publisher.finish().unwrap();
    (published, sink.files())
}

#[test]
fn shards_give_back_what_they_were_given() {
    let records = records(30, STEPS);
    let spec = publish_spec(job(r#"{"runs": 30}"#));
    let mut writer = ShardWriter::new(spec.shard_schema(), Vec::new()).unwrap();
    for record in &records {
        writer.push(record).unwrap();
    }
    let bytes = writer.finish().unwrap();
    let reader = ShardReader::open(bytes.as_slice()).unwrap();
    assert_eq!(reader.schema(), &spec.shard_schema());
    let back: Vec<RunRecord> = reader.map(Result::unwrap).collect();
    assert_eq!(back, records);
    assert!(ShardReader::open(&bytes[..bytes.len() / 2]).is_ok_and(|r| r.last().unwrap().is_err()));
    assert!(ShardReader::open(&b"no shard"[..]).is_err());
}

#[test]
fn a_data_set_is_read_back_whole() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let records = records(20, STEPS);
    let spec = publish_spec(job(r#"{"runs": 20, "seed": 5}"#));
    let mut publisher = Publisher::new(spec, DirectorySink::create(&out).unwrap()).unwrap();
    for record in &records {
        publisher.push(record).unwrap();
    }
    let (published, sink) = publisher.finish().unwrap();
    sink.commit().unwrap();

    let dataset = Dataset::open(&out).unwrap();
    dataset.verify().unwrap();
    assert_eq!(dataset.manifest(), &published.manifest);
    assert_eq!(dataset.dataset_sha256(), published.dataset_sha256);
    assert_eq!(dataset.window().unwrap(), Some(published.window));
    assert_eq!(dataset.statistics().unwrap(), published.statistics);
    assert_eq!(published.manifest.runs.failed, 2);
    assert_eq!(
        (published.manifest.runs.train, published.manifest.runs.validation),
        (16, 4)
    );

    let names: Vec<&str> = dataset.channels().iter().map(|c| c.name.as_str()).collect();
    let job_runs: Vec<&RunRecord> = records.iter().filter(|r| r.kind == RunKind::Job).collect();
    for (record, row) in job_runs.iter().zip(dataset.runs()) {
        assert_eq!(record.run_id, row.run_id);
        assert_eq!(record.seed, row.seed);
        assert_eq!(record.flags, row.flags);
        assert_eq!(record.statistics.path, row.solver_path);
        assert_eq!(record.material, row.material);
        assert_eq!(record.status(), row.status);
        assert_eq!(record.reason(), row.reason.as_deref());
        let loaded = dataset.load_run(row.run_id, &names).unwrap();
        assert_eq!(loaded.is_some(), row.status == RunStatus::Ok);
        if let (Some(loaded), Some(samples)) = (loaded, record.samples()) {
            assert_eq!(loaded.columns, samples.columns);
        }
    }
    let one = dataset
        .load(SplitName::Validation, &["deflection_tip_y_m"])
        .unwrap();
    assert_eq!(
        one.iter().map(|run| run.run_id).collect::<Vec<_>>(),
        [2, 7, 12, 17]
    );
    assert_eq!(dataset.load_all(&names).unwrap().len(), 18);
    let settling: Vec<_> = dataset.settling(&names).unwrap().collect();
    assert_eq!(settling.len(), 2);
    let unknown = dataset
        .load(SplitName::Train, &["deflection_top_y_m"])
        .unwrap_err();
    assert!(unknown.to_string().contains("deflection_tip_y_m"), "{unknown}");
}

#[test]
fn damage_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let spec = publish_spec(job(r#"{"runs": 2}"#));
    let mut publisher = Publisher::new(spec, DirectorySink::create(&out).unwrap()).unwrap();
    for run in 0..2 {
        publisher.push(&record(RunKind::Job, run, STEPS)).unwrap();
    }
    publisher.finish().unwrap().1.commit().unwrap();
    let dataset = Dataset::open(&out).unwrap();
    let file = out.join(&dataset.manifest().files[1].path);
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file, &bytes).unwrap();
    assert!(dataset.verify().unwrap_err().to_string().contains("sha256"));
    std::fs::write(&file, &bytes[1..]).unwrap();
    assert!(Dataset::open(&out).unwrap_err().to_string().contains("length"));
}

#[test]
fn runs_out_of_order_missing_doubled_or_not_finite_are_refused() {
    let publisher = || {
        let spec = publish_spec(job(r#"{"runs": 3}"#));
        Publisher::new(spec, MemorySink::default()).unwrap()
    };
    let run = |id| record(RunKind::Job, id, STEPS);
    let mut doubled = publisher();
    doubled.push(&run(0)).unwrap();
    let order = doubled.push(&run(0)).unwrap_err();
    assert!(matches!(
        order,
        PublishError::Order {
            expected: 1,
            found: 0
        }
    ));
    let mut missing = publisher();
    missing.push(&run(0)).unwrap();
    assert!(matches!(
        missing.finish(),
        Err(PublishError::Missing {
            expected: 3,
            found: 1
        })
    ));
    let mut nan = run(0);
    if let hydroflex_dataset::RunOutcome::Ok(samples) = &mut nan.outcome {
        samples.columns[3][7] = f64::NAN;
    }
    let refused = publisher().push(&nan).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "channel pressure_lift_piston_pa of run 0 is NaN at step 7"
    );
}

#[test]
fn nothing_in_the_files_but_what_was_asked_for() {
    let records = records(12, 20);
    let json = r#"{"runs": 12, "duration_s": 0.1}"#;
    let (first, files) = publish(json, &records, &[3, 4]);
    let (second, same) = publish(json, &records, &[]);
    assert_eq!(first, second);
    assert_eq!(files, same);
    // seed and title are part of what was asked for
    let (other, _) = publish(r#"{"runs": 12, "duration_s": 0.1, "seed": 1}"#, &records, &[]);
    assert_ne!(first.dataset_sha256, other.dataset_sha256);
}

#[test]
fn same_bytes_for_any_number_of_encoders() {
    // Two files of training runs, several row groups each, and a settling file beside them.
    let records = records(900, 60);
    let json = r#"{"runs": 900, "seed": 3, "duration_s": 0.3, "settling_runs": 2, "file_size_mb": 1,
        "split": {"train": 0.7, "validation": 0.2, "test": 0.1}}"#;
    let (published, files) = publish(json, &records, &[400]);
    assert!(
        files.contains_key("data/train-00002-of-00003.parquet"),
        "{:?}",
        files.keys()
    );
    for encoders in [1, 3] {
        let (other, other_files) = publish_on(encoders, json, &records, &[17]);
        assert_eq!(other, published);
        assert!(other_files == files, "{encoders} encoders");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn same_bytes_for_any_sharding(
        cuts in prop::collection::vec(0_usize..40, 0..12),
        float32 in any::<bool>(),
    ) {
        let sample_type = if float32 { "float32" } else { "float64" };
        let json = format!(r#"{{"runs": 100, "sample_type": "{sample_type}"}}"#);
        let records = records(100, STEPS);
        let (_, whole) = publish(&json, &records, &[]);
        let (_, files) = publish(&json, &records, &cuts);
        prop_assert_eq!(whole, files);
    }
}
