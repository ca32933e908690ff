//! Ledger and blobs together, and a full disk below both.

use crate::{finish_runs, new_dataset, new_job, result, sha256, sqlite};
use bytes::Bytes;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::orphans::Orphans;
use hydroflex_ledger::{CommitOutcome, Ledger, NewDataset, ShardKind, ShardResult};
use hydroflex_openapi::id::DatasetId;
use std::time::Duration;

on_every_pair![from_claim_to_collection, what_nobody_publishes_is_deleted];

async fn from_claim_to_collection(ledger: &Ledger, blobs: &Blobs) {
    let id = ledger.create_job(&new_job(&[2, 2, 2]), None).await.unwrap().id();
    let slow = ledger.begin_shard("a").await.unwrap().unwrap();
    let content = Bytes::from_static(b"what the slow one made");
    blobs.create(&slow.object(), content).await.unwrap();
    ledger
        .lose_shard(slow.shard.id, slow.shard.epoch, "stopped")
        .await
        .unwrap();
    while let Some(claim) = ledger.begin_shard("b").await.unwrap() {
        let content = Bytes::from(format!("runs from {}", claim.shard.first_run));
        let sha256 = sha256(&content);
        blobs.create(&claim.object(), content).await.unwrap();
        let result = ShardResult {
            sha256,
            ..result(&claim.object())
        };
        assert_eq!(
            ledger.commit_shard(&claim, &result).await.unwrap(),
            CommitOutcome::Committed
        );
    }
    let late = ledger.commit_shard(&slow, &result(&slow.object())).await.unwrap();
    assert_eq!(late, CommitOutcome::Fenced);
    // What is committed is there and whole; the orphan beside it is nobody's.
    let settled = ledger.settled_shards(id, ShardKind::Runs, 0, 10).await.unwrap();
    assert_eq!(settled.len(), 3);
    for shard in &settled {
        let content = blobs
            .read(shard.object.as_deref().unwrap(), shard.sha256.as_deref().unwrap())
            .await
            .unwrap();
        assert_eq!(content, format!("runs from {}", shard.first_run));
    }
    let below = format!("shards/{id}");
    assert_eq!(blobs.list(&below).await.unwrap().len(), 4);
    assert!(ledger.cancel_job(id).await.unwrap());
    for job in ledger.uncollected_jobs(10).await.unwrap() {
        blobs.delete_below(&format!("shards/{job}")).await.unwrap();
        ledger.mark_collected(job).await.unwrap();
    }
    assert_eq!(blobs.list(&below).await.unwrap(), Vec::<String>::new());
}

async fn what_nobody_publishes_is_deleted(ledger: &Ledger, blobs: &Blobs) {
    // A name of its own for each pair: the ledgers and the stores are shared by all.
    let unique = sha256(uuid_of(ledger, blobs).await.as_bytes());
    let dataset = NewDataset {
        round: 0,
        id: DatasetId::of_sha256(&unique).unwrap(),
        sha256: unique,
        ..new_dataset()
    };
    let folder = format!("datasets/{}", dataset.id);
    let put = async || {
        for path in ["README.md", "data/train-00000-of-00001.parquet"] {
            let _ = blobs
                .create(&format!("{folder}/{path}"), Bytes::from_static(b"abc"))
                .await;
        }
    };
    let count = async || blobs.list(&folder).await.unwrap().len();
    let mut hasty = Orphans::new(Duration::ZERO);

    // Put by an attempt whose job is then cancelled: kept before, kept for the grace time, deleted after.
    let cancelled = ledger.create_job(&new_job(&[2]), None).await.unwrap().id();
    ledger.announce_upload(cancelled, &dataset.id).await.unwrap();
    put().await;
    hasty.sweep(ledger, blobs).await.unwrap();
    assert_eq!(count().await, 2, "its job is not over");
    ledger.cancel_job(cancelled).await.unwrap();
    let mut patient = Orphans::new(Duration::from_hours(1));
    patient.sweep(ledger, blobs).await.unwrap();
    assert_eq!(count().await, 2, "a patient collector");
    // Another job with the same data set comes just in time.
    let twin = ledger.create_job(&new_job(&[2]), None).await.unwrap().id();
    ledger.announce_upload(twin, &dataset.id).await.unwrap();
    hasty.sweep(ledger, blobs).await.unwrap();
    assert_eq!(count().await, 2, "the twin is not over");
    ledger.cancel_job(twin).await.unwrap();
    let folder = blobs.local_path(&format!("datasets/{}", dataset.id));
    let interrupt = || {
        if let Some(folder) = &folder {
            std::fs::write(folder.join("manifest.json#1"), b"half").unwrap();
        }
    };
    interrupt();
    assert!(hasty.sweep(ledger, blobs).await.unwrap() >= 2);
    assert_eq!(count().await, 0);
    assert!(
        !blobs
            .folders("datasets")
            .await
            .unwrap()
            .contains(&dataset.id.to_string())
    );

    // Published: never an orphan, whatever becomes of its job.
    let job = ledger.create_job(&new_job(&[2]), None).await.unwrap().id();
    finish_runs(ledger, job).await;
    ledger.announce_upload(job, &dataset.id).await.unwrap();
    put().await;
    interrupt();
    assert!(ledger.publish_dataset(job, &dataset, &[]).await.unwrap());
    hasty.sweep(ledger, blobs).await.unwrap();
    assert_eq!(count().await, 2);
    if let Some(folder) = &folder {
        assert!(!folder.join("manifest.json#1").exists());
    }
    assert!(ledger.abandoned(&dataset.id).await.unwrap().is_none());
}

/// A text that differs for every pair of ledger and store.
async fn uuid_of(ledger: &Ledger, blobs: &Blobs) -> String {
    let job = ledger.create_job(&new_job(&[1]), None).await.unwrap().id();
    ledger.cancel_job(job).await.unwrap();
    format!("{job} {}", blobs.local_path("").is_some())
}

/// SQLite ends a transaction by itself when the disk is full, and sqlx does not notice: once the disk has
/// room again, no connection may be left that refuses to work.
#[tokio::test(flavor = "multi_thread")]
async fn a_disk_that_was_full_spoils_no_connection() {
    let folder = tempfile::tempdir().unwrap();
    let run = |program: &str, arguments: &[&str]| {
        let done = std::process::Command::new(program)
            .args(arguments)
            .arg(folder.path())
            .status();
        done.is_ok_and(|status| status.success())
    };
    if !run("mount", &["-t", "tmpfs", "-o", "size=3m", "hydroflex-test"]) {
        eprintln!("only root can make a small disk: left out");
        return;
    }
    let ledger = sqlite(&folder).await;
    let filler = folder.path().join("filler");
    for round in 0..5 {
        // Writes as much as there is room for, and then fails.
        assert!(std::fs::write(&filler, vec![1_u8; 4 << 20]).is_err());
        let mut refused = 0;
        for _ in 0..40 {
            match ledger.create_job(&new_job(&[1; 50]), None).await {
                Ok(_) => {}
                Err(error) => {
                    assert!(error.is_transient(), "{error}");
                    refused += 1;
                }
            }
        }
        assert!(refused > 0, "round {round}: the disk was not full");
        std::fs::remove_file(&filler).unwrap();
        for _ in 0..10 {
            let made = ledger.create_job(&new_job(&[1]), None).await;
            assert!(made.is_ok(), "round {round}: {made:?}");
        }
    }
    ledger.close().await;
    assert!(run("umount", &[]));
}
