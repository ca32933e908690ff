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
mod servers;

use bytes::Bytes;
use futures::TryStreamExt;
use hydroflex_ledger::blobs::{BlobError, Blobs};
use hydroflex_ledger::keys::{self, Scope};
use hydroflex_ledger::transition::{ATTEMPT_LIMIT, ShardState};
use hydroflex_ledger::{
    AliasCondition, AliasMove, CommitOutcome, Created, IdempotencyKey, Ledger, LedgerError, NewDataset,
    NewJob, NewModel, ShardKind, ShardResult,
};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::{AliasName, DatasetId, JobId, ModelId};
use hydroflex_openapi::job::{JobSpec, TrainingSpec};
use hydroflex_openapi::status::{JobState, TimeSplit, TrainingProgress, TrainingState};

const HASH: &str = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08";

fn spec(runs: u64, settling_runs: u64) -> JobSpec {
    serde_json::from_value(serde_json::json!({ "runs": runs, "settling_runs": settling_runs })).unwrap()
}

fn new_job(run_shards: &[u64]) -> NewJob {
    NewJob {
        spec: spec(run_shards.iter().sum(), 0),
        machine_sha256: HASH.to_owned(),
        settling_shards: Vec::new(),
        run_shards: run_shards.to_vec(),
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

/// Every test of the suite on every engine.
macro_rules! on_every_engine {
    ($($name:ident),* $(,)?) => {
        mod on_sqlite {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    super::$name(super::sqlite(&folder).await).await;
                }
            )*
        }
        mod on_postgres {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let Some(url) = super::servers::postgres::fresh_database(stringify!($name)) else { return };
                    let ledger = hydroflex_ledger::Ledger::create(&url).await.unwrap();
                    super::$name(super::with_workers(ledger).await).await;
                }
            )*
        }
    };
}

on_every_engine![
    a_job_its_shards_and_its_event_appear_together,
    the_same_key_makes_one_job,
    shards_are_handed_out_once_in_order,
    a_commit_of_an_old_epoch_is_fenced,
    a_repeated_commit_is_the_same_commit,
    a_released_shard_loses_no_attempt,
    a_bad_run_is_isolated,
    a_cancelled_job_takes_nothing_more,
    a_worker_that_is_given_up_holds_nothing,
    of_two_planners_one_wins,
    a_shard_whose_object_is_lost_is_done_again,
    a_data_set_appears_once_with_its_trainings,
    a_failed_training_fails_its_job_and_keeps_the_data_set,
    many_workers_share_without_overlap,
    pages_of_jobs_are_newest_first,
    urgent_jobs_go_first,
    a_job_is_computed_on_one_instruction_set,
    given_up_runs_are_done_again_and_nothing_else,
    failed_trainings_are_done_again_and_nothing_else,
    a_key_is_found_by_its_hash_until_it_is_revoked,
    of_two_who_move_an_alias_one_wins,
];

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

/// Every test of the suite on every store.
macro_rules! on_every_store {
    ($($name:ident),* $(,)?) => {
        mod on_a_directory {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    super::$name(super::directory(&folder)).await;
                }
            )*
        }
        mod on_s3 {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let Some(blobs) = super::s3(stringify!($name)) else { return };
                    super::$name(blobs).await;
                }
            )*
        }
    };
}

on_every_store![
    a_store_that_is_there_answers,
    an_object_is_created_once,
    of_many_creators_one_wins,
    a_part_of_an_object_is_streamed,
    a_damaged_or_missing_object_is_a_loss,
    a_large_file_is_uploaded_in_parts,
    a_folder_is_there_to_read_as_files,
    what_is_below_a_key_is_listed_and_deleted_and_nothing_else,
];

/// Every test of the suite on every pair of engine and store.
macro_rules! on_every_pair {
    ($($name:ident),* $(,)?) => {
        mod on_every_pair {
            $(
                #[tokio::test(flavor = "multi_thread")]
                async fn $name() {
                    let folder = tempfile::tempdir().unwrap();
                    let mut ledgers = vec![super::sqlite(&folder).await];
                    if let Some(url) = super::servers::postgres::fresh_database(concat!("pair_", stringify!($name))) {
                        let ledger = hydroflex_ledger::Ledger::create(&url).await.unwrap();
                        ledgers.push(super::with_workers(ledger).await);
                    }
                    let mut stores = vec![super::directory(&folder)];
                    stores.extend(super::s3(concat!("pair-", stringify!($name))));
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

fn sha256(content: &[u8]) -> String {
    use sha2::Digest;
    hex::encode(sha2::Sha256::digest(content))
}

async fn a_store_that_is_there_answers(blobs: Blobs) {
    blobs.ping().await.unwrap();
    blobs
        .wait_until_there(std::time::Duration::from_secs(1))
        .await
        .unwrap();
}

async fn an_object_is_created_once(blobs: Blobs) {
    let first = Bytes::from_static(b"first");
    blobs.create("shards/j/a.parquet", first.clone()).await.unwrap();
    let second = blobs
        .create("shards/j/a.parquet", Bytes::from_static(b"second"))
        .await
        .unwrap_err();
    assert!(second.is_already_there() && !second.is_loss(), "{second}");
    let content = blobs.read("shards/j/a.parquet", &sha256(&first)).await.unwrap();
    assert_eq!(content, first);
    blobs.delete("shards/j/a.parquet").await.unwrap();
    blobs.delete("shards/j/a.parquet").await.unwrap();
    blobs.create("shards/j/a.parquet", first).await.unwrap();
}

async fn of_many_creators_one_wins(blobs: Blobs) {
    let creators = (0..8).map(|number| {
        let blobs = blobs.clone();
        tokio::spawn(async move {
            blobs
                .create("race", Bytes::from(format!("creator {number}")))
                .await
        })
    });
    let mut winners = 0;
    for creator in futures::future::join_all(creators).await {
        match creator.unwrap() {
            Ok(()) => winners += 1,
            Err(error) => assert!(error.is_already_there(), "{error}"),
        }
    }
    assert_eq!(winners, 1);
}

async fn a_part_of_an_object_is_streamed(blobs: Blobs) {
    let content: Vec<u8> = (0..=255).cycle().take(100_000).collect();
    blobs
        .create("object", Bytes::from(content.clone()))
        .await
        .unwrap();
    for range in [0..100_000, 0..1, 99_999..100_000, 12_345..54_321, 7..7] {
        let parts: Vec<Bytes> = blobs
            .stream("object", range.clone())
            .await
            .unwrap()
            .try_collect()
            .await
            .unwrap();
        let (start, end) = (range.start.try_into().unwrap(), range.end.try_into().unwrap());
        assert_eq!(parts.concat(), &content[start..end], "{range:?}");
    }
}

async fn a_damaged_or_missing_object_is_a_loss(blobs: Blobs) {
    blobs
        .create("object", Bytes::from_static(b"other"))
        .await
        .unwrap();
    let damaged = blobs.read("object", HASH).await.unwrap_err();
    assert!(
        matches!(damaged, BlobError::Damaged { .. }) && damaged.is_loss(),
        "{damaged}"
    );
    let missing = blobs.read("nothing", HASH).await.unwrap_err();
    assert!(missing.is_loss() && !missing.is_transient(), "{missing}");
}

async fn a_large_file_is_uploaded_in_parts(blobs: Blobs) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("large");
    let content: Vec<u8> = (0..20_000_000_u32).map(|index| (index % 251) as u8).collect();
    std::fs::write(&file, &content).unwrap();
    // Twice: the same content under the same name.
    for _ in 0..2 {
        blobs
            .upload(&file, "datasets/d/data/large.parquet")
            .await
            .unwrap();
        let read = blobs
            .read("datasets/d/data/large.parquet", &sha256(&content))
            .await
            .unwrap();
        assert_eq!(read.len(), content.len());
    }
    let nothing = blobs
        .upload(&folder.path().join("absent"), "absent")
        .await
        .unwrap_err();
    assert!(matches!(nothing, BlobError::File { .. }), "{nothing}");
}

async fn a_folder_is_there_to_read_as_files(blobs: Blobs) {
    let content = Bytes::from_static(b"read me");
    blobs
        .create("datasets/d/README.md", content.clone())
        .await
        .unwrap();
    blobs
        .create("datasets/d/data/a.parquet", content.clone())
        .await
        .unwrap();
    let files: Vec<FileEntry> = ["README.md", "data/a.parquet"]
        .iter()
        .map(|path| FileEntry {
            path: (*path).to_owned(),
            size_bytes: content.len() as u64,
            sha256: sha256(&content),
        })
        .collect();
    let (path, _temporary) = blobs.folder("datasets/d/", &files).await.unwrap();
    for file in &files {
        assert_eq!(std::fs::read(path.join(&file.path)).unwrap(), content);
    }
}

async fn what_is_below_a_key_is_listed_and_deleted_and_nothing_else(blobs: Blobs) {
    for key in ["shards/j/a", "shards/j/b", "shards/jj/a", "datasets/j/a"] {
        blobs.create(key, Bytes::from_static(b"x")).await.unwrap();
    }
    assert_eq!(
        blobs.list("shards/j").await.unwrap(),
        ["shards/j/a", "shards/j/b"]
    );
    assert_eq!(blobs.list("nothing").await.unwrap(), Vec::<String>::new());
    assert_eq!(blobs.folders("shards").await.unwrap(), ["j", "jj"]);
    assert_eq!(blobs.folders("shards/j").await.unwrap(), Vec::<String>::new());
    assert_eq!(blobs.delete_below("shards/j").await.unwrap(), 2);
    assert_eq!(blobs.delete_below("shards/j").await.unwrap(), 0);
    assert_eq!(blobs.list("shards").await.unwrap(), ["shards/jj/a"]);
    assert_eq!(blobs.list("datasets").await.unwrap(), ["datasets/j/a"]);
}

async fn a_job_its_shards_and_its_event_appear_together(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[3, 2]), None).await.unwrap().id();
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(job.state, JobState::Queued);
    assert_eq!((job.progress.runs_total, job.runs_planned), (5, 5));
    assert_eq!(ledger.open_shard_count(id).await.unwrap(), 2);
    let events = ledger.events(id, 0, 10).await.unwrap();
    assert_eq!(events.len(), 1);
    assert_eq!(events[0].sequence, 1);
    assert_eq!(
        events[0].what,
        EventKind::State {
            state: JobState::Queued,
            reason: None
        }
    );
    assert!(ledger.job(JobId::generate()).await.unwrap().is_none());
}

async fn the_same_key_makes_one_job(ledger: Ledger) {
    let key = IdempotencyKey::new("monday", b"{\"runs\": 4}");
    let first = ledger.create_job(&new_job(&[4]), Some(&key)).await.unwrap();
    let second = ledger.create_job(&new_job(&[4]), Some(&key)).await.unwrap();
    assert!(matches!(first, Created::New(_)));
    assert_eq!(second, Created::Before(first.id()));
    assert_eq!(ledger.jobs(None, 10).await.unwrap().len(), 1);
    let other = IdempotencyKey::new("monday", b"{\"runs\": 5}");
    let refused = ledger.create_job(&new_job(&[5]), Some(&other)).await;
    assert!(
        matches!(refused, Err(LedgerError::KeyReused { .. })),
        "{refused:?}"
    );
    assert_eq!(ledger.jobs(None, 10).await.unwrap().len(), 1);
}

async fn shards_are_handed_out_once_in_order(ledger: Ledger) {
    let mut new = new_job(&[3, 2]);
    new.spec.settling_runs = 1;
    new.settling_shards = vec![1];
    let id = ledger.create_job(&new, None).await.unwrap().id();
    let settling = ledger.begin_shard("a").await.unwrap().unwrap();
    assert_eq!(settling.shard.kind, ShardKind::Settling);
    assert_eq!(settling.job.state, JobState::Simulating);
    let first = ledger.begin_shard("b").await.unwrap().unwrap();
    let second = ledger.begin_shard("a").await.unwrap().unwrap();
    assert_eq!((first.shard.first_run, first.shard.run_count), (0, 3));
    assert_eq!((second.shard.first_run, second.shard.run_count), (3, 2));
    assert!(ledger.begin_shard("b").await.unwrap().is_none());
    for claim in [&settling, &first, &second] {
        let outcome = ledger
            .commit_shard(claim, &result(&claim.object()))
            .await
            .unwrap();
        assert_eq!(outcome, CommitOutcome::Committed);
    }
    let job = ledger.job(id).await.unwrap().unwrap();
    assert!(job.is_complete());
    assert_eq!(job.progress.runs_done, 5);
    assert_eq!(job.progress.runs_failed, 2);
    assert!((job.progress.spent.simulate_s - 1.5).abs() < 1e-12);
    let spent = ledger.time_spent().await.unwrap();
    assert_eq!(spent, job.progress.spent);
    assert!((spent.wait_s - 3.0 * 0.0625).abs() < 1e-12);
    assert!((ledger.run_cost_s(id).await.unwrap().unwrap() - 1.0 / 5.0).abs() < 1e-12);
    let settled = ledger.settled_shards(id, ShardKind::Runs, 0, 10).await.unwrap();
    assert_eq!(
        settled.iter().map(|shard| shard.first_run).collect::<Vec<_>>(),
        [0, 3]
    );
}

async fn a_commit_of_an_old_epoch_is_fenced(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    let slow = ledger.begin_shard("a").await.unwrap().unwrap();
    assert!(
        ledger
            .lose_shard(slow.shard.id, slow.shard.epoch, "stopped")
            .await
            .unwrap()
    );
    assert!(!ledger.holds(&slow).await.unwrap());
    let quick = ledger.begin_shard("b").await.unwrap().unwrap();
    assert_eq!(
        (quick.shard.id, quick.shard.epoch),
        (slow.shard.id, slow.shard.epoch + 1)
    );
    assert_ne!(quick.object(), slow.object());
    let late = ledger.commit_shard(&slow, &result(&slow.object())).await.unwrap();
    assert_eq!(late, CommitOutcome::Fenced);
    let outcome = ledger
        .commit_shard(&quick, &result(&quick.object()))
        .await
        .unwrap();
    assert_eq!(outcome, CommitOutcome::Committed);
    // Losing an attempt that is over changes nothing.
    assert!(
        !ledger
            .lose_shard(quick.shard.id, quick.shard.epoch, "late news")
            .await
            .unwrap()
    );
    assert_eq!(ledger.job(id).await.unwrap().unwrap().progress.runs_done, 4);
}

async fn a_repeated_commit_is_the_same_commit(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    let claim = ledger.begin_shard("a").await.unwrap().unwrap();
    for _ in 0..2 {
        let outcome = ledger
            .commit_shard(&claim, &result(&claim.object()))
            .await
            .unwrap();
        assert_eq!(outcome, CommitOutcome::Committed);
    }
    assert_eq!(ledger.job(id).await.unwrap().unwrap().progress.runs_done, 4);
}

async fn a_released_shard_loses_no_attempt(ledger: Ledger) {
    ledger.create_job(&new_job(&[4]), None).await.unwrap();
    for _ in 0..2 * ATTEMPT_LIMIT {
        let claim = ledger.begin_shard("a").await.unwrap().unwrap();
        assert_eq!(claim.shard.attempt, 1);
        assert!(ledger.release_shard(&claim).await.unwrap());
        assert!(!ledger.release_shard(&claim).await.unwrap());
    }
}

async fn a_bad_run_is_isolated(ledger: Ledger) {
    const BAD: u64 = 5;
    let id = ledger.create_job(&new_job(&[8, 8]), None).await.unwrap().id();
    while let Some(claim) = ledger.begin_shard("a").await.unwrap() {
        let runs = claim.shard.first_run..claim.shard.first_run + claim.shard.run_count;
        if runs.contains(&BAD) {
            ledger
                .lose_shard(claim.shard.id, claim.shard.epoch, "boom")
                .await
                .unwrap();
        } else {
            ledger
                .commit_shard(&claim, &result(&claim.object()))
                .await
                .unwrap();
        }
    }
    let job = ledger.job(id).await.unwrap().unwrap();
    assert!(job.is_complete());
    let settled = ledger.settled_shards(id, ShardKind::Runs, 0, 100).await.unwrap();
    let mut next = 0;
    for shard in &settled {
        assert_eq!(shard.first_run, next, "runs are covered once, without gaps");
        next += shard.run_count;
        let expected = if shard.first_run == BAD {
            ShardState::Dead
        } else {
            ShardState::Committed
        };
        assert_eq!(shard.state, expected);
    }
    assert_eq!(next, 16);
    let dead = settled
        .iter()
        .find(|shard| shard.state == ShardState::Dead)
        .unwrap();
    assert_eq!((dead.run_count, dead.reason.as_deref()), (1, Some("boom")));
}

async fn a_cancelled_job_takes_nothing_more(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4, 4]), None).await.unwrap().id();
    let claim = ledger.begin_shard("a").await.unwrap().unwrap();
    assert!(ledger.cancel_job(id).await.unwrap());
    assert!(!ledger.cancel_job(id).await.unwrap());
    assert!(!ledger.holds(&claim).await.unwrap());
    let late = ledger
        .commit_shard(&claim, &result(&claim.object()))
        .await
        .unwrap();
    assert_eq!(late, CommitOutcome::Fenced);
    assert!(ledger.begin_shard("a").await.unwrap().is_none());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!((job.state, job.progress.runs_done), (JobState::Cancelled, 0));
    assert!(ledger.unfinished_jobs().await.unwrap().is_empty());
    assert_eq!(ledger.uncollected_jobs(10).await.unwrap(), [id]);
    ledger.mark_collected(id).await.unwrap();
    assert!(ledger.uncollected_jobs(10).await.unwrap().is_empty());
    let missing = ledger.cancel_job(JobId::generate()).await;
    assert!(matches!(missing, Err(LedgerError::NoJob { .. })), "{missing:?}");
}

async fn a_worker_that_is_given_up_holds_nothing(ledger: Ledger) {
    ledger.create_job(&new_job(&[4, 4]), None).await.unwrap();
    let claim = ledger.begin_shard("a").await.unwrap().unwrap();
    assert!(ledger.beat("a").await.unwrap());
    let beats = ledger.beats().await.unwrap();
    assert_eq!(
        beats
            .iter()
            .map(|beat| (&*beat.worker, beat.beat))
            .collect::<Vec<_>>(),
        [("a", 1), ("b", 0)]
    );
    ledger.give_up_worker("a", "gone").await.unwrap();
    assert!(!ledger.beat("a").await.unwrap());
    assert!(ledger.begin_shard("a").await.unwrap().is_none());
    let again = ledger.begin_shard("b").await.unwrap().unwrap();
    assert_eq!((again.shard.id, again.shard.attempt), (claim.shard.id, 2));
    assert_eq!(again.shard.reason.as_deref(), Some("gone"));
    assert_eq!(ledger.recover_lost("gone").await.unwrap(), 0);
}

async fn of_two_planners_one_wins(ledger: Ledger) {
    let mut new = new_job(&[2]);
    new.spec.runs = 8;
    let id = ledger.create_job(&new, None).await.unwrap().id();
    assert!(ledger.plan_shards(id, ShardKind::Runs, 2, &[3, 3]).await.unwrap());
    assert!(!ledger.plan_shards(id, ShardKind::Runs, 2, &[6]).await.unwrap());
    assert_eq!(ledger.job(id).await.unwrap().unwrap().runs_planned, 8);
    assert_eq!(ledger.open_shard_count(id).await.unwrap(), 3);
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

async fn a_shard_whose_object_is_lost_is_done_again(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[2, 2]), None).await.unwrap().id();
    finish_runs(&ledger, id).await;
    let shard = ledger
        .settled_shards(id, ShardKind::Runs, 0, 10)
        .await
        .unwrap()
        .remove(0);
    assert!(ledger.redo_shard(shard.id, shard.epoch, "damaged").await.unwrap());
    assert!(!ledger.redo_shard(shard.id, shard.epoch, "damaged").await.unwrap());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(
        (job.state, job.progress.runs_done, job.is_complete()),
        (JobState::Publishing, 2, false)
    );
    let claim = ledger.begin_shard("a").await.unwrap().unwrap();
    assert_eq!((claim.shard.id, claim.shard.epoch), (shard.id, shard.epoch + 1));
    ledger
        .commit_shard(&claim, &result(&claim.object()))
        .await
        .unwrap();
    let job = ledger.job(id).await.unwrap().unwrap();
    assert!(job.is_complete());
    assert_eq!(job.progress.runs_failed, 2);
    assert!(ledger.publish_dataset(id, &new_dataset(), &[]).await.unwrap());
}

async fn a_data_set_appears_once_with_its_trainings(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[2, 2]), None).await.unwrap().id();
    assert!(!ledger.begin_publishing(id).await.unwrap(), "runs are missing");
    finish_runs(&ledger, id).await;
    let dataset = new_dataset();
    assert!(
        ledger
            .publish_dataset(id, &dataset, &[TrainingSpec::default()])
            .await
            .unwrap()
    );
    assert!(
        !ledger
            .publish_dataset(id, &dataset, &[TrainingSpec::default()])
            .await
            .unwrap()
    );
    assert_eq!(ledger.trainings_of(id).await.unwrap().len(), 1);
    assert_eq!(ledger.job(id).await.unwrap().unwrap().state, JobState::Training);

    let claim = ledger.begin_training("a").await.unwrap().unwrap();
    assert!(ledger.begin_training("b").await.unwrap().is_none());
    assert!(
        ledger
            .report_training(&claim, &TrainingProgress::default())
            .await
            .unwrap()
    );
    ledger.give_up_worker("a", "killed").await.unwrap();
    assert!(
        !ledger
            .report_training(&claim, &TrainingProgress::default())
            .await
            .unwrap()
    );
    let claim = ledger.begin_training("b").await.unwrap().unwrap();
    let model = NewModel {
        id: ModelId::of_sha256(HASH).unwrap(),
        sha256: HASH.to_owned(),
        metrics: serde_json::json!({ "mae": 1.0 }),
        files: Vec::new(),
    };
    assert!(ledger.commit_training(&claim, &model).await.unwrap());
    assert!(!ledger.commit_training(&claim, &model).await.unwrap());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(
        (job.state, job.dataset_id),
        (JobState::Succeeded, Some(dataset.id.clone()))
    );
    assert_eq!(
        ledger.model(&model.id).await.unwrap().unwrap().metrics,
        model.metrics
    );
    assert_eq!(ledger.models(None, 10).await.unwrap().len(), 1);

    // Another job that leads to the same content finds the data set there already.
    let twin = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    ledger.register_worker("c", Some("x86-64-v3")).await.unwrap();
    let claim = ledger.begin_shard("c").await.unwrap().unwrap();
    ledger
        .commit_shard(&claim, &result(&claim.object()))
        .await
        .unwrap();
    assert!(ledger.begin_publishing(twin).await.unwrap());
    assert!(ledger.publish_dataset(twin, &dataset, &[]).await.unwrap());
    assert_eq!(
        ledger.job(twin).await.unwrap().unwrap().state,
        JobState::Succeeded
    );
    let datasets = ledger.datasets(None, 10).await.unwrap();
    assert_eq!(datasets.len(), 1);
    assert_eq!(datasets[0].job_id, id);
    let after_it = ledger
        .datasets(Some((datasets[0].created_ms, dataset.id.as_str())), 10)
        .await
        .unwrap();
    assert!(after_it.is_empty());
    // Sequence numbers have no gaps.
    let sequences: Vec<u64> = ledger
        .events(id, 0, 100)
        .await
        .unwrap()
        .iter()
        .map(|event| event.sequence)
        .collect();
    assert_eq!(sequences, (1..=sequences.len() as u64).collect::<Vec<_>>());
}

async fn a_failed_training_fails_its_job_and_keeps_the_data_set(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    finish_runs(&ledger, id).await;
    let specs = [TrainingSpec::default(), TrainingSpec::default()];
    ledger.publish_dataset(id, &new_dataset(), &specs).await.unwrap();
    let bad = ledger.begin_training("a").await.unwrap().unwrap();
    assert!(
        ledger
            .fail_training(&bad, "the data set lacks target x")
            .await
            .unwrap()
    );
    assert_eq!(ledger.job(id).await.unwrap().unwrap().state, JobState::Training);
    for attempt in 1..=ATTEMPT_LIMIT {
        let claim = ledger.begin_training("a").await.unwrap().unwrap();
        assert_eq!(claim.training.attempt, attempt);
        ledger
            .lose_training(claim.training.id, claim.training.epoch, "killed")
            .await
            .unwrap();
    }
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(job.state, JobState::Failed);
    assert_eq!(
        job.reason.as_deref(),
        Some("2 of 2 trainings failed; the data set is published")
    );
    assert!(job.dataset_id.is_some());
    let first = ledger.training(bad.training.id).await.unwrap().unwrap();
    assert_eq!(
        (first.state, first.reason.as_deref()),
        (TrainingState::Failed, Some("the data set lacks target x"))
    );
    let key = IdempotencyKey::new("again", b"x");
    let direct = ledger
        .create_training(&new_dataset().id, &TrainingSpec::default(), Some(&key))
        .await
        .unwrap();
    let repeated = ledger
        .create_training(&new_dataset().id, &TrainingSpec::default(), Some(&key))
        .await
        .unwrap();
    assert_eq!(repeated, Created::Before(direct.id()));
}

async fn many_workers_share_without_overlap(ledger: Ledger) {
    const WORKERS: usize = 6;
    let id = ledger.create_job(&new_job(&[1; 60]), None).await.unwrap().id();
    let mut tasks = Vec::new();
    for number in 0..WORKERS {
        let ledger = ledger.clone();
        tasks.push(tokio::spawn(async move {
            let name = format!("worker-{number}");
            ledger.register_worker(&name, Some("x86-64-v3")).await.unwrap();
            let mut runs = Vec::new();
            while let Some(claim) = ledger.begin_shard(&name).await.unwrap() {
                runs.push(claim.shard.first_run);
                ledger
                    .commit_shard(&claim, &result(&claim.object()))
                    .await
                    .unwrap();
            }
            runs
        }));
    }
    let mut runs = Vec::new();
    for task in tasks {
        runs.extend(task.await.unwrap());
    }
    runs.sort_unstable();
    assert_eq!(runs, (0..60).collect::<Vec<u64>>());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert!(job.is_complete());
    // Queued, simulating, and one event per commit.
    assert_eq!(job.last_sequence, 62);
}

async fn pages_of_jobs_are_newest_first(ledger: Ledger) {
    let mut ids = Vec::new();
    for _ in 0..5 {
        ids.push(ledger.create_job(&new_job(&[1]), None).await.unwrap().id());
    }
    ids.reverse();
    let first: Vec<JobId> = ledger
        .jobs(None, 3)
        .await
        .unwrap()
        .iter()
        .map(|job| job.id)
        .collect();
    assert_eq!(first, ids[..3]);
    let rest: Vec<JobId> = ledger
        .jobs(Some(first[2]), 3)
        .await
        .unwrap()
        .iter()
        .map(|job| job.id)
        .collect();
    assert_eq!(rest, ids[3..]);
}

async fn urgent_jobs_go_first(ledger: Ledger) {
    let mut ids = Vec::new();
    for priority in [-1, 0, 5, 0] {
        let mut new = new_job(&[1]);
        new.spec.priority = priority;
        ids.push(ledger.create_job(&new, None).await.unwrap().id());
    }
    let mut begun = Vec::new();
    while let Some(claim) = ledger.begin_shard("a").await.unwrap() {
        begun.push(claim.job.id);
    }
    assert_eq!(begun, [ids[2], ids[1], ids[3], ids[0]]);
}

async fn a_job_is_computed_on_one_instruction_set(ledger: Ledger) {
    ledger.register_worker("c", Some("x86-64-v4")).await.unwrap();
    let first = ledger.create_job(&new_job(&[2, 2]), None).await.unwrap().id();
    let second = ledger.create_job(&new_job(&[2, 2]), None).await.unwrap().id();
    let job_of = async |worker: &str| {
        let claim = ledger.begin_shard(worker).await.unwrap()?;
        Some((claim.job.id, claim.job.instruction_set.unwrap()))
    };
    let (v3, v4) = ("x86-64-v3".to_owned(), "x86-64-v4".to_owned());
    assert_eq!(job_of("a").await, Some((first, v3.clone())));
    // The older job is begun on another level: the newer one is the first that this worker may take.
    assert_eq!(job_of("c").await, Some((second, v4.clone())));
    assert_eq!(job_of("c").await, Some((second, v4)));
    assert_eq!(job_of("c").await, None);
    assert_eq!(job_of("b").await, Some((first, v3)));
    assert_eq!(job_of("b").await, None);
}

async fn a_key_is_found_by_its_hash_until_it_is_revoked(ledger: Ledger) {
    let scopes = [Scope::Submit, Scope::Read];
    let (key, record) = ledger.create_key("night shift", &scopes, Some(5)).await.unwrap();
    let (other, _) = ledger.create_key("other", &[Scope::Admin], None).await.unwrap();
    // A prefix and 256 bits.
    assert_eq!(key.len(), 4 + 64);
    assert_ne!(key, other);
    let found = ledger.key(&keys::hash(&key)).await.unwrap().unwrap();
    assert_eq!(found, record);
    assert_eq!(
        (found.title.as_str(), found.scopes.as_slice()),
        ("night shift", scopes.as_slice())
    );
    assert!(ledger.key(&keys::hash("hfx_guess")).await.unwrap().is_none());
    assert!(ledger.revoke_key(record.id).await.unwrap());
    assert!(!ledger.revoke_key(record.id).await.unwrap());
    let listed = ledger.keys().await.unwrap();
    assert_eq!(listed.len(), 2);
    assert!(listed[0].revoked_ms.is_some() && listed[1].revoked_ms.is_none());
}

async fn given_up_runs_are_done_again_and_nothing_else(ledger: Ledger) {
    const BAD: u64 = 2;
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    while let Some(claim) = ledger.begin_shard("a").await.unwrap() {
        let runs = claim.shard.first_run..claim.shard.first_run + claim.shard.run_count;
        if runs.contains(&BAD) {
            ledger
                .lose_shard(claim.shard.id, claim.shard.epoch, "boom")
                .await
                .unwrap();
        } else {
            let result = ShardResult {
                failed_runs: 0,
                ..result(&claim.object())
            };
            ledger.commit_shard(&claim, &result).await.unwrap();
        }
    }
    assert!(!ledger.retry_job(id).await.unwrap(), "not over yet");
    assert!(ledger.begin_publishing(id).await.unwrap());
    ledger
        .publish_dataset(id, &new_dataset(), &[TrainingSpec::default()])
        .await
        .unwrap();
    let training = ledger.begin_training("a").await.unwrap().unwrap();
    ledger.fail_training(&training, "no").await.unwrap();
    assert_eq!(ledger.job(id).await.unwrap().unwrap().state, JobState::Failed);
    // What its other runs made is kept for this.
    assert!(ledger.uncollected_jobs(10).await.unwrap().is_empty());

    assert!(ledger.retry_job(id).await.unwrap());
    assert!(!ledger.retry_job(id).await.unwrap(), "in work already");
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(
        (
            job.state,
            job.progress.runs_done,
            job.progress.runs_failed,
            job.reason
        ),
        (JobState::Simulating, 3, 0, None)
    );
    let claim = ledger.begin_shard("b").await.unwrap().unwrap();
    assert_eq!((claim.shard.first_run, claim.shard.run_count), (BAD, 1));
    assert!(ledger.begin_shard("b").await.unwrap().is_none());
    let done = ShardResult {
        failed_runs: 0,
        ..result(&claim.object())
    };
    ledger.commit_shard(&claim, &done).await.unwrap();
    assert!(ledger.begin_publishing(id).await.unwrap());
    ledger
        .publish_dataset(id, &new_dataset(), &[TrainingSpec::default()])
        .await
        .unwrap();
    let trainings = ledger.trainings_of(id).await.unwrap();
    assert_eq!(trainings.len(), 1, "the one for the old data set is not counted");
    assert_eq!(trainings[0].state, TrainingState::Open);
    assert_eq!(ledger.uncollected_jobs(10).await.unwrap(), [id]);
    let missing = ledger.retry_job(JobId::generate()).await;
    assert!(matches!(missing, Err(LedgerError::NoJob { .. })), "{missing:?}");
}

async fn failed_trainings_are_done_again_and_nothing_else(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    finish_runs(&ledger, id).await;
    let specs = [TrainingSpec::default(), TrainingSpec::default()];
    ledger.publish_dataset(id, &new_dataset(), &specs).await.unwrap();
    let good = ledger.begin_training("a").await.unwrap().unwrap();
    let model = NewModel {
        id: ModelId::of_sha256(HASH).unwrap(),
        sha256: HASH.to_owned(),
        metrics: serde_json::json!({}),
        files: Vec::new(),
    };
    assert!(ledger.commit_training(&good, &model).await.unwrap());
    let bad = ledger.begin_training("a").await.unwrap().unwrap();
    ledger.fail_training(&bad, "no").await.unwrap();
    assert!(ledger.retry_job(id).await.unwrap());
    let again = ledger.begin_training("a").await.unwrap().unwrap();
    assert_eq!((again.training.id, again.training.attempt), (bad.training.id, 1));
    assert!(ledger.begin_training("a").await.unwrap().is_none());
    assert!(ledger.begin_shard("a").await.unwrap().is_none());
    assert!(ledger.commit_training(&again, &model).await.unwrap());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(job.state, JobState::Succeeded);
    assert!(!ledger.retry_job(id).await.unwrap());
}

async fn of_two_who_move_an_alias_one_wins(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    finish_runs(&ledger, id).await;
    let specs = vec![TrainingSpec::default(); 2];
    assert!(ledger.publish_dataset(id, &new_dataset(), &specs).await.unwrap());
    let mut models = Vec::new();
    for sha256 in [HASH.to_owned(), HASH.replace("9f", "8e")] {
        let claim = ledger.begin_training("a").await.unwrap().unwrap();
        let model = NewModel {
            id: ModelId::of_sha256(&sha256).unwrap(),
            sha256,
            metrics: serde_json::json!({}),
            files: Vec::new(),
        };
        assert!(ledger.commit_training(&claim, &model).await.unwrap());
        models.push(model.id);
    }
    let alias: AliasName = "boom@stable".parse().unwrap();
    let go = |model: usize, condition| {
        let (ledger, alias, model) = (ledger.clone(), alias.clone(), models[model].clone());
        async move { ledger.move_alias(&alias, &model, condition).await.unwrap() }
    };
    assert!(ledger.alias(&alias).await.unwrap().is_none());
    assert_eq!(go(0, AliasCondition::Present).await, AliasMove::Refused(None));
    assert!(
        matches!(go(0, AliasCondition::Absent).await, AliasMove::Moved(record) if record.generation == 1)
    );
    assert!(matches!(
        go(1, AliasCondition::Absent).await,
        AliasMove::Refused(Some(_))
    ));
    assert!(
        matches!(go(0, AliasCondition::None).await, AliasMove::Unchanged(record) if record.generation == 1)
    );
    // Both saw generation 1.
    let moves = futures::future::join_all((0..6).map(|_| go(1, AliasCondition::Generation(1)))).await;
    let moved = moves
        .iter()
        .filter(|outcome| matches!(outcome, AliasMove::Moved(_)))
        .count();
    assert_eq!(moved, 1, "{moves:?}");
    let history = ledger.alias_history(&alias).await.unwrap();
    let pointed: Vec<&ModelId> = history.iter().map(|record| &record.model_id).collect();
    assert_eq!(pointed, [&models[0], &models[1]]);
    let now = ledger.aliases().await.unwrap();
    assert_eq!((now.len(), now[0].generation), (1, 2));
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
