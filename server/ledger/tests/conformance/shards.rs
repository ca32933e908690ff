//! Shards: handed out once, committed once, taken back from whoever is lost.

use crate::{finish_runs, new_dataset, new_job, result};
use hydroflex_ledger::transition::{ATTEMPT_LIMIT, ShardState};
use hydroflex_ledger::{CommitOutcome, Ledger, ShardKind};
use hydroflex_openapi::status::JobState;

on_every_engine![
    shards_are_handed_out_once_in_order,
    a_commit_of_an_old_epoch_is_fenced,
    a_repeated_commit_is_the_same_commit,
    a_released_shard_loses_no_attempt,
    a_bad_run_is_isolated,
    a_worker_that_is_given_up_holds_nothing,
    a_claim_whose_answer_was_lost_is_begun_again,
    of_two_planners_one_wins,
    a_shard_whose_object_is_lost_is_done_again,
    many_workers_share_without_overlap,
];

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

async fn a_claim_whose_answer_was_lost_is_begun_again(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    // The connection broke after the claim was committed: its worker knows only that it has nothing.
    drop(ledger.begin_shard("a").await.unwrap().unwrap());
    assert!(ledger.begin_shard("a").await.unwrap().is_none());
    ledger.give_up_worker("a", "its worker stopped").await.unwrap();
    ledger
        .register_worker("a-again", Some("x86-64-v3"))
        .await
        .unwrap();
    let claim = ledger.begin_shard("a-again").await.unwrap().unwrap();
    assert_eq!((claim.shard.epoch, claim.shard.attempt), (2, 2));
    let outcome = ledger
        .commit_shard(&claim, &result(&claim.object()))
        .await
        .unwrap();
    assert_eq!(outcome, CommitOutcome::Committed);
    assert!(ledger.job(id).await.unwrap().unwrap().is_complete());
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
