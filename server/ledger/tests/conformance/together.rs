//! Ledger and blobs together, and a full disk below both.

use crate::{new_job, result, sha256, sqlite};
use bytes::Bytes;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::{CommitOutcome, Ledger, ShardKind, ShardResult};

on_every_pair![from_claim_to_collection];

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
    if !run("mount", &["-t", "tmpfs", "-o", "size=2m", "hydroflex-test"]) {
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
