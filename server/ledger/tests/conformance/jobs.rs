//! Jobs: accepted once, in order of urgency, done again where they failed.

use crate::{new_dataset, new_job, result};
use hydroflex_ledger::{
    CommitOutcome, Created, IdempotencyKey, Ledger, LedgerError, NewDataset, NewJob, ShardResult,
};
use hydroflex_openapi::event::EventKind;
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::job::TrainingSpec;
use hydroflex_openapi::status::{JobNotice, JobState, TrainingState};

on_every_engine![
    a_job_its_shards_and_its_event_appear_together,
    the_same_key_makes_one_job,
    a_cancelled_job_takes_nothing_more,
    only_who_holds_a_shard_fails_its_job,
    pages_of_jobs_are_newest_first,
    urgent_jobs_go_first,
    a_job_is_computed_on_one_instruction_set,
    given_up_runs_are_done_again_and_nothing_else,
    remarks_are_kept_with_the_job_and_no_more_than_eight,
];

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

async fn only_who_holds_a_shard_fails_its_job(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4, 4]), None).await.unwrap().id();
    let slow = ledger.begin_shard("a").await.unwrap().unwrap();
    ledger
        .lose_shard(slow.shard.id, slow.shard.epoch, "stopped")
        .await
        .unwrap();
    assert!(!ledger.fail_job_of(&slow, "cannot be planned").await.unwrap());
    let quick = ledger.begin_shard("b").await.unwrap().unwrap();
    assert!(!ledger.fail_job_of(&slow, "cannot be planned").await.unwrap());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(job.state, JobState::Simulating);
    assert!(ledger.holds(&quick).await.unwrap());
    assert!(ledger.fail_job_of(&quick, "cannot be planned").await.unwrap());
    let job = ledger.job(id).await.unwrap().unwrap();
    assert_eq!(
        (job.state, job.reason.as_deref()),
        (JobState::Failed, Some("cannot be planned"))
    );
    assert!(!ledger.fail_job_of(&quick, "again").await.unwrap());
    assert!(ledger.begin_shard("a").await.unwrap().is_none());
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

async fn remarks_are_kept_with_the_job_and_no_more_than_eight(ledger: Ledger) {
    let notice = |number: u64| JobNotice {
        pointer: format!("/{number}"),
        detail: "short".to_owned(),
        proposed: Some(number.into()),
    };
    let new = NewJob {
        notices: (0..9).map(notice).collect(),
        ..new_job(&[4])
    };
    let id = ledger.create_job(&new, None).await.unwrap().id();
    let silent = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    let expected: Vec<JobNotice> = (0..8).map(notice).collect();
    assert_eq!(ledger.notices(id).await.unwrap(), expected);
    assert_eq!(ledger.notices(silent).await.unwrap(), []);
    // What happens later is no remark.
    assert!(ledger.cancel_job(silent).await.unwrap());
    assert_eq!(ledger.notices(silent).await.unwrap(), []);
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
    // A publisher that slept since the first round knows nothing of the run that was done again.
    let stale = new_dataset();
    assert!(!ledger.publish_dataset(id, &stale, &[]).await.unwrap());
    let round = ledger.job(id).await.unwrap().unwrap().round;
    let whole = NewDataset { round, ..stale };
    ledger
        .publish_dataset(id, &whole, &[TrainingSpec::default()])
        .await
        .unwrap();
    let trainings = ledger.trainings_of(id).await.unwrap();
    assert_eq!(trainings.len(), 1, "the one for the old data set is not counted");
    assert_eq!(trainings[0].state, TrainingState::Open);
    assert_eq!(ledger.uncollected_jobs(10).await.unwrap(), [id]);
    let missing = ledger.retry_job(JobId::generate()).await;
    assert!(matches!(missing, Err(LedgerError::NoJob { .. })), "{missing:?}");
}
