//! A worker beside a store that is away, and one whose machine is another than the job's.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use super::*;
use hydroflex_ledger::transition::ATTEMPT_LIMIT;
use hydroflex_ledger::{NewJob, ShardKind};
use hydroflex_openapi::status::JobState;
use hydroflex_sim::machine::Machine;
use std::path::Path;

/// How long the store may be away before a shard is given back.
const PATIENCE_HERE: Duration = Duration::from_millis(200);

/// A worker that loses its patience in a moment, and what stops it.
async fn worker_in(folder: &Path) -> (Worker, watch::Sender<bool>) {
    let url = format!("sqlite:{}", folder.join("ledger.sqlite").display());
    let ledger = Ledger::create(&url).await.unwrap();
    let (stop, told) = watch::channel(false);
    let worker = Worker {
        ledger,
        blobs: Blobs::directory(&folder.join("store")).unwrap(),
        machines: Arc::new(Machines::new(std::env::temp_dir().join("hydroflex-test-cache"))),
        pool: Arc::new(rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap()),
        limits: RunLimits::default(),
        patience: PATIENCE_HERE,
        stop: told,
    };
    (worker, stop)
}

/// Two shards of one run each: of one run no half is left to try.
async fn two_runs(ledger: &Ledger, machine_sha256: String) -> JobId {
    let new = NewJob {
        spec: serde_json::from_str(r#"{"runs": 2, "settling_runs": 0, "duration_s": 0.2}"#).unwrap(),
        machine_sha256,
        settling_shards: Vec::new(),
        run_shards: vec![1, 1],
        notices: Vec::new(),
    };
    ledger.create_job(&new, None).await.unwrap().id()
}

fn machine_sha256() -> String {
    hex::encode(Machine::load("lift-boom", &[]).unwrap().content_hash())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_that_is_away_costs_no_run() {
    let folder = tempfile::tempdir().unwrap();
    let (worker, stop) = worker_in(folder.path()).await;
    let ledger = worker.ledger.clone();
    let id = two_runs(&ledger, machine_sha256()).await;
    // A file in place of the directory: no object can be put below it, by whomever.
    let in_the_way = folder.path().join("store/shards");
    std::fs::write(&in_the_way, "").unwrap();
    let outage = async {
        // Each attempt takes the patience at a put and at most as much of a pause.
        let attempts = u32::try_from(2 * 2 * ATTEMPT_LIMIT).unwrap();
        tokio::time::sleep(2 * PATIENCE_HERE * attempts).await;
        std::fs::remove_file(&in_the_way).unwrap();
        let start = Instant::now();
        while !ledger.job(id).await.unwrap().unwrap().is_complete() {
            assert!(start.elapsed() < Duration::from_mins(1), "the store is back");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        stop.send_replace(true);
    };
    let (ended, ()) = tokio::join!(worker.live("worker", None), outage);
    assert_eq!(ended.unwrap(), Some(Ended::Drained));
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!((job.progress.runs_done, job.progress.runs_failed), (2, 0));
    let shards = ledger.settled_shards(id, ShardKind::Runs, 0, 10).await.unwrap();
    assert!(shards.iter().all(|shard| shard.attempt == 1), "{shards:?}");
    assert!(
        shards.iter().any(|shard| shard.epoch > ATTEMPT_LIMIT),
        "begun more often than attempts would last: {shards:?}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_was_accepted_with_another_machine_fails_with_both_hashes() {
    let folder = tempfile::tempdir().unwrap();
    let (worker, stop) = worker_in(folder.path()).await;
    let accepted = "0".repeat(64);
    let id = two_runs(&worker.ledger, accepted.clone()).await;
    let ledger = worker.ledger.clone();
    let watched = async {
        while ledger.job(id).await.unwrap().unwrap().state != JobState::Failed {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        stop.send_replace(true);
    };
    let (ended, ()) = tokio::join!(worker.live("worker", None), watched);
    assert_eq!(ended.unwrap(), Some(Ended::Drained));
    let reason = ledger.job(id).await.unwrap().unwrap().reason.unwrap();
    assert!(
        reason.contains(&machine_sha256()) && reason.contains(&accepted),
        "{reason}"
    );
}
