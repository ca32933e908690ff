//! Data sets, trainings and models; names for models, and keys for people.

use crate::{HASH, finish_runs, new_dataset, new_job, result};
use hydroflex_ledger::keys::{self, Scope};
use hydroflex_ledger::transition::ATTEMPT_LIMIT;
use hydroflex_ledger::{AliasCondition, AliasMove, Created, IdempotencyKey, Ledger, NewModel};
use hydroflex_openapi::id::{AliasName, ModelId};
use hydroflex_openapi::job::TrainingSpec;
use hydroflex_openapi::status::{JobState, TrainingProgress, TrainingState};
use hydroflex_openapi::sweep::{SweepRequest, SweepState};

on_every_engine![
    a_data_set_appears_once_with_its_trainings,
    a_failed_training_fails_its_job_and_keeps_the_data_set,
    failed_trainings_are_done_again_and_nothing_else,
    a_sweep_is_what_its_trainings_are,
    of_two_who_move_an_alias_one_wins,
    a_key_is_found_by_its_hash_until_it_is_revoked,
];

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

async fn a_sweep_is_what_its_trainings_are(ledger: Ledger) {
    let id = ledger.create_job(&new_job(&[4]), None).await.unwrap().id();
    finish_runs(&ledger, id).await;
    assert!(ledger.publish_dataset(id, &new_dataset(), &[]).await.unwrap());
    let request: SweepRequest =
        serde_json::from_value(serde_json::json!({ "dataset_id": new_dataset().id })).unwrap();
    let cells: Vec<TrainingSpec> = (0..3)
        .map(|seed| TrainingSpec {
            seed,
            ..TrainingSpec::default()
        })
        .collect();
    let key = IdempotencyKey::new("sweep", b"x");
    let sweep = ledger.create_sweep(&request, &cells, Some(&key)).await.unwrap();
    assert_eq!(
        ledger.create_sweep(&request, &cells, Some(&key)).await.unwrap(),
        Created::Before(sweep.id())
    );
    let id = sweep.id();
    let single = ledger
        .create_training(&request.dataset_id, &TrainingSpec::default(), None)
        .await
        .unwrap();
    // What was asked for by itself does not wait for a sweep, although it came later.
    let claim = ledger.begin_training("a").await.unwrap().unwrap();
    assert_eq!(claim.training.id, single.id());
    let first = ledger.begin_training("a").await.unwrap().unwrap();
    let model = NewModel {
        id: ModelId::of_sha256(HASH).unwrap(),
        sha256: HASH.to_owned(),
        metrics: serde_json::json!({ "judged": 1 }),
        files: Vec::new(),
    };
    assert!(ledger.commit_training(&first, &model).await.unwrap());
    let second = ledger.begin_training("a").await.unwrap().unwrap();
    ledger.fail_training(&second, "no").await.unwrap();
    let (progress, _) = ledger.sweep_progress(id).await.unwrap();
    assert_eq!(
        (progress.total, progress.open, progress.succeeded, progress.failed),
        (3, 1, 1, 1)
    );
    assert_eq!(progress.state(), SweepState::Running);
    let third = ledger.begin_training("a").await.unwrap().unwrap();
    assert_eq!(ledger.cancel_sweep(id).await.unwrap(), 1);
    assert!(!ledger.holds_training(&third).await.unwrap());
    assert!(!ledger.commit_training(&third, &model).await.unwrap());
    let (progress, finished_ms) = ledger.sweep_progress(id).await.unwrap();
    assert_eq!(progress.state(), SweepState::Cancelled);
    assert!(finished_ms.is_some());
    // What is there is not trained again.
    assert_eq!(ledger.retry_sweep(id).await.unwrap(), 2);
    for expected in [&second, &third] {
        let again = ledger.begin_training("a").await.unwrap().unwrap();
        assert_eq!(
            (again.training.id, again.training.attempt),
            (expected.training.id, 1)
        );
        assert!(ledger.commit_training(&again, &model).await.unwrap());
    }
    assert_eq!(
        ledger.sweep_progress(id).await.unwrap().0.state(),
        SweepState::Succeeded
    );
    let seeds: Vec<(u64, bool)> = ledger
        .sweep_cells(id)
        .await
        .unwrap()
        .iter()
        .map(|cell| (cell.training.spec.seed, cell.metrics.is_some()))
        .collect();
    assert_eq!(seeds, [(0, true), (1, true), (2, true)]);
    assert_eq!(ledger.sweeps(None, 10).await.unwrap().len(), 1);
    assert!(ledger.sweeps(Some(id), 10).await.unwrap().is_empty());
    assert_eq!(ledger.unfinished_sweeps().await.unwrap(), 0);
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
