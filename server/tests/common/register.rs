//! A model folder into a ledger, as a training would have put it there; also for benchmarks.

use hydroflex_ledger::{Ledger, NewDataset, NewJob, NewModel, ShardResult, blobs::Blobs};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::id::{DatasetId, ModelId};
use hydroflex_openapi::job::{JobSpec, TrainingSpec};
use hydroflex_openapi::status::TimeSplit;
use sha2::{Digest, Sha256};
use std::path::Path;

/// Registers a model folder as it is, damaged or not.
pub(crate) async fn register_folder(ledger: &Ledger, blobs: &Blobs, path: &Path) -> ModelId {
    let hash = |content: &[u8]| hex::encode(Sha256::digest(content));
    let sha256 = hash(&std::fs::read(path.join("SHA256SUMS")).unwrap());
    let id = ModelId::of_sha256(&sha256).unwrap();
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let content = std::fs::read(entry.path()).unwrap();
        blobs
            .upload(&entry.path(), &format!("models/{id}/{name}"))
            .await
            .unwrap();
        files.push(FileEntry {
            path: name,
            size_bytes: content.len() as u64,
            sha256: hash(&content),
        });
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    let spec: JobSpec = serde_json::from_value(serde_json::json!({"runs": 1, "settling_runs": 0})).unwrap();
    let new = NewJob {
        spec: spec.clone(),
        machine_sha256: hash(b""),
        settling_shards: Vec::new(),
        run_shards: vec![1],
        notices: Vec::new(),
    };
    let job = ledger.create_job(&new, None).await.unwrap().id();
    let worker = format!("worker.{job}");
    ledger.register_worker(&worker, Some("x86-64-v3")).await.unwrap();
    let claim = ledger.begin_shard(&worker).await.unwrap().unwrap();
    let result = ShardResult {
        object: claim.object(),
        sha256: hash(b""),
        size_bytes: 0,
        failed_runs: 0,
        spent: TimeSplit::default(),
    };
    ledger.commit_shard(&claim, &result).await.unwrap();
    assert!(ledger.begin_publishing(job).await.unwrap());
    let dataset_sha256 = hash(job.to_string().as_bytes());
    let dataset = NewDataset {
        round: 0,
        id: DatasetId::of_sha256(&dataset_sha256).unwrap(),
        sha256: dataset_sha256,
        spec,
        runs: 1,
        // Named, and not there: a model can do without.
        files: vec![FileEntry {
            path: "manifest.json".to_owned(),
            size_bytes: 2,
            sha256: hash(b"{}"),
        }],
    };
    let trainings = [TrainingSpec::default()];
    assert!(ledger.publish_dataset(job, &dataset, &trainings).await.unwrap());
    let claim = ledger.begin_training(&worker).await.unwrap().unwrap();
    let model = NewModel {
        id: id.clone(),
        sha256,
        metrics: serde_json::json!([]),
        files,
    };
    assert!(ledger.commit_training(&claim, &model).await.unwrap());
    id
}
