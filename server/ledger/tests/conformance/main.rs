//! One suite for every engine and every store: what the ledger and its blobs promise, whatever stands
//! below them.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

#[allow(
    dead_code,
    unreachable_pub,
    reason = "shared with the end-to-end tests, which use more of it"
)]
#[path = "../servers/mod.rs"]
mod servers;

use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::{Ledger, NewDataset, NewJob, ShardResult};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::id::{DatasetId, JobId};
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::status::TimeSplit;

const HASH: &str = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08";

/// Every test of the suite on every engine.
macro_rules! on_every_engine {
    ($($name:ident),* $(,)?) => {
        mod on_sqlite {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    super::$name(crate::sqlite(&folder).await).await;
                }
            )*
        }
        mod on_postgres {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let Some(url) = crate::servers::postgres::fresh_database(stringify!($name)) else { return };
                    let ledger = hydroflex_ledger::Ledger::create(&url).await.unwrap();
                    super::$name(crate::with_workers(ledger).await).await;
                }
            )*
        }
    };
}

/// Every test of the suite on every store.
macro_rules! on_every_store {
    ($($name:ident),* $(,)?) => {
        mod on_a_directory {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    super::$name(crate::directory(&folder)).await;
                }
            )*
        }
        mod on_s3 {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let Some(blobs) = crate::s3(stringify!($name)) else { return };
                    super::$name(blobs).await;
                }
            )*
        }
    };
}

/// Every test of the suite on every pair of engine and store.
macro_rules! on_every_pair {
    ($($name:ident),* $(,)?) => {
        mod on_every_pair {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    let mut ledgers = vec![crate::sqlite(&folder).await];
                    if let Some(url) = crate::servers::postgres::fresh_database(concat!("pair_", stringify!($name))) {
                        let ledger = hydroflex_ledger::Ledger::create(&url).await.unwrap();
                        ledgers.push(crate::with_workers(ledger).await);
                    }
                    let mut stores = vec![crate::directory(&folder)];
                    stores.extend(crate::s3(concat!("pair-", stringify!($name))));
                    for ledger in &ledgers {
                        for blobs in &stores {
                            super::$name(ledger, blobs).await;
                        }
                    }
                }
            )*
        }
    };
}

// After the macros, which they use.
mod artefacts;
mod jobs;
mod shards;
mod stores;
mod together;

fn spec(runs: u64, settling_runs: u64) -> JobSpec {
    serde_json::from_value(serde_json::json!({ "runs": runs, "settling_runs": settling_runs })).unwrap()
}

fn new_job(run_shards: &[u64]) -> NewJob {
    NewJob {
        spec: spec(run_shards.iter().sum(), 0),
        machine_sha256: HASH.to_owned(),
        settling_shards: Vec::new(),
        run_shards: run_shards.to_vec(),
        notices: Vec::new(),
    }
}

fn result(object: &str) -> ShardResult {
    ShardResult {
        object: object.to_owned(),
        sha256: HASH.to_owned(),
        size_bytes: 10,
        failed_runs: 1,
        spent: TimeSplit {
            simulate_s: 0.5,
            encode_s: 0.25,
            put_s: 0.125,
            wait_s: 0.0625,
        },
    }
}

fn new_dataset() -> NewDataset {
    NewDataset {
        round: 0,
        id: DatasetId::of_sha256(HASH).unwrap(),
        sha256: HASH.to_owned(),
        spec: spec(4, 0),
        runs: 4,
        files: vec![FileEntry {
            path: "README.md".to_owned(),
            size_bytes: 3,
            sha256: HASH.to_owned(),
        }],
    }
}

async fn sqlite(folder: &tempfile::TempDir) -> Ledger {
    let url = format!("sqlite:{}", folder.path().join("ledger.sqlite").display());
    with_workers(Ledger::create(&url).await.unwrap()).await
}

async fn with_workers(ledger: Ledger) -> Ledger {
    for worker in ["a", "b"] {
        ledger.register_worker(worker, Some("x86-64-v3")).await.unwrap();
    }
    ledger
}

/// A directory, and a bucket of a name of its own; `None` where there is no S3 server.
fn directory(folder: &tempfile::TempDir) -> Blobs {
    Blobs::open(&format!("file://{}", folder.path().join("store").display())).unwrap()
}

fn s3(name: &str) -> Option<Blobs> {
    let server = servers::moto::shared()?;
    let bucket: String = format!("b-{}", name.replace('_', "-")).chars().take(60).collect();
    server.bucket(bucket.trim_end_matches('-'));
    let variables = servers::moto::environment(server.port())
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value));
    let url = format!("s3://{}/some/prefix", bucket.trim_end_matches('-'));
    Some(Blobs::open_with(&url, variables).unwrap())
}

fn sha256(content: &[u8]) -> String {
    use sha2::Digest;
    hex::encode(sha2::Sha256::digest(content))
}

async fn finish_runs(ledger: &Ledger, id: JobId) {
    while let Some(claim) = ledger.begin_shard("a").await.unwrap() {
        ledger
            .commit_shard(&claim, &result(&claim.object()))
            .await
            .unwrap();
    }
    assert!(ledger.begin_publishing(id).await.unwrap());
    assert!(!ledger.begin_publishing(id).await.unwrap());
}
