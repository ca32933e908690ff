//! Whatever dies on the way: a job ends with the same data set as if nothing had happened.

use hydroflex_openapi::status::{JobState, JobStatus};
use hydroflex_tests::{ServiceUnderTest, Start, signal};
use nix::sys::signal::Signal;
use std::path::Path;
use std::sync::OnceLock;

/// A job whose runs take a few milliseconds each: the stories are about the service.
fn job(runs: u64) -> serde_json::Value {
    serde_json::json!({
        "runs": runs,
        "seed": 7,
        "duration_s": 0.5,
        "integrator": { "kind": "generalized-alpha" },
        "settling_runs": 3,
    })
}

const RUNS: u64 = 60;

fn workers(workers: usize) -> Start {
    Start {
        workers,
        ..Start::default()
    }
}

fn finished(status: &JobStatus) -> bool {
    status.state.is_final()
}

/// Hash of the data set as one undisturbed worker makes it.
fn undisturbed() -> &'static str {
    static HASH: OnceLock<String> = OnceLock::new();
    HASH.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
        let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
        let status = service.wait_for(&id, finished).unwrap();
        check_whole(&service, &status);
        service.terminate().unwrap();
        status.dataset_sha256.unwrap()
    })
}

/// Every run is accounted for once, and nothing lies about that nobody owns.
fn check_whole(service: &ServiceUnderTest, status: &JobStatus) {
    assert_eq!(status.state, JobState::Succeeded, "{status:?}\n{}", service.log());
    assert_eq!(status.progress.runs_done, status.progress.runs_total);
    assert_eq!(status.progress.settling_done, status.progress.settling_total);
    let id = status.dataset_id.as_ref().unwrap();
    let sums = service
        .get(&format!("/v1/datasets/{id}/files/SHA256SUMS"))
        .unwrap();
    for line in String::from_utf8(sums).unwrap().lines() {
        let (sha256, path) = line.split_once("  ").unwrap();
        let content = service.get(&format!("/v1/datasets/{id}/files/{path}")).unwrap();
        assert_eq!(hydroflex_tests::sha256(&content), sha256, "{path}");
    }
}

fn check_same(service: &ServiceUnderTest, status: &JobStatus) {
    check_whole(service, status);
    assert_eq!(status.progress.runs_failed, 0);
    assert_eq!(status.dataset_sha256.as_deref(), Some(undisturbed()));
}

fn shard_objects(data: &Path) -> usize {
    let Ok(jobs) = std::fs::read_dir(data.join("store/shards")) else {
        return 0;
    };
    jobs.flatten()
        .filter_map(|job| std::fs::read_dir(job.path()).ok())
        .map(Iterator::count)
        .sum()
}

#[test]
fn four_workers_publish_the_same_bytes_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(4)).unwrap();
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    check_same(&service, &status);
    service
        .wait_for(&id, |_| shard_objects(folder.path()) == 0)
        .unwrap();
    service.terminate().unwrap();
}

#[test]
fn a_killed_worker_loses_no_run() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(2)).unwrap();
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    for done in [1, 20, 40] {
        let status = service
            .wait_for(&id, |s| finished(s) || s.progress.runs_done >= done)
            .unwrap();
        if !finished(&status) {
            signal(
                service.wait_for_children("simulate", 1).unwrap()[0],
                Signal::SIGKILL,
            )
            .unwrap();
        }
    }
    let status = service.wait_for(&id, finished).unwrap();
    check_same(&service, &status);
}

#[test]
fn a_killed_coordinator_goes_on_after_its_restart() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(2)).unwrap();
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    service
        .wait_for(&id, |s| finished(s) || s.progress.runs_done >= 10)
        .unwrap();
    service.kill().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(2)).unwrap();
    let status = service.wait_for(&id, finished).unwrap();
    check_same(&service, &status);
    // The history has no gap either.
    let events = String::from_utf8(service.get(&format!("/v1/jobs/{id}/events")).unwrap()).unwrap();
    let ids: Vec<u64> = events
        .lines()
        .filter_map(|line| line.strip_prefix("id: "))
        .map(|id| id.parse().unwrap())
        .collect();
    assert_eq!(ids, (1..=ids.len() as u64).collect::<Vec<_>>());
}

#[test]
fn a_death_at_every_step_of_a_worker_changes_nothing() {
    for point in ["begin", "put", "commit"] {
        let folder = tempfile::tempdir().unwrap();
        let marker = folder.path().join("died");
        let start = Start {
            workers: 2,
            environment: vec![
                ("HYDROFLEX_CRASH_WORKER_AT", format!("{point}:2")),
                ("HYDROFLEX_CRASH_ONCE", marker.display().to_string()),
            ],
            ..Start::default()
        };
        let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
        let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
        let status = service.wait_for(&id, finished).unwrap();
        assert!(marker.exists(), "no worker died at {point}");
        check_same(&service, &status);
        service
            .wait_for(&id, |_| shard_objects(folder.path()) == 0)
            .unwrap();
    }
}

#[test]
fn a_death_at_every_step_of_publishing_changes_nothing() {
    for point in ["publish-written", "publish-upload", "publish-commit", "published"] {
        let folder = tempfile::tempdir().unwrap();
        let start = Start {
            workers: 2,
            environment: vec![("HYDROFLEX_CRASH_AT", point.to_owned())],
            ..Start::default()
        };
        let mut service = ServiceUnderTest::start(folder.path(), &start).unwrap();
        let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
        service.wait_for_end().unwrap();
        drop(service);
        let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
        if point != "published" {
            let seen = service.get("/v1/datasets").unwrap();
            let empty = br#"{"datasets":[]}"#;
            let now = service.job(&id).unwrap();
            assert!(
                seen == empty || now.dataset_id.is_some(),
                "a data set is visible before its time at {point}"
            );
        }
        let status = service.wait_for(&id, finished).unwrap();
        check_same(&service, &status);
        service
            .wait_for(&id, |_| shard_objects(folder.path()) == 0)
            .unwrap();
    }
}

#[test]
fn a_stopped_worker_is_given_up_and_fenced_off_when_it_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(2)).unwrap();
    let id = service.submit(&job(4 * RUNS)).unwrap().job_id.to_string();
    service
        .wait_for(&id, |s| finished(s) || s.progress.runs_done >= 8)
        .unwrap();
    let stopped = service.wait_for_children("simulate", 1).unwrap()[0];
    signal(stopped, Signal::SIGSTOP).unwrap();
    let status = service.wait_for(&id, finished).unwrap();
    // Stopped while it held the database's write lock, it has been killed meanwhile.
    let _ = signal(stopped, Signal::SIGCONT);
    check_whole(&service, &status);
    assert_eq!(status.progress.runs_failed, 0);
    // It goes on under a new name.
    let next = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let status = service.wait_for(&next, finished).unwrap();
    check_same(&service, &status);
}

#[test]
fn a_run_that_kills_its_worker_is_isolated_and_every_other_run_delivered() {
    const BAD: u64 = 17;
    let folder = tempfile::tempdir().unwrap();
    let start = Start {
        workers: 2,
        environment: vec![("HYDROFLEX_CRASH_WORKER_AT", format!("run-{BAD}"))],
        ..Start::default()
    };
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    let id = service.submit(&job(40)).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    check_whole(&service, &status);
    assert_eq!(status.progress.runs_failed, 1);
    let events = String::from_utf8(service.get(&format!("/v1/jobs/{id}/events")).unwrap()).unwrap();
    assert!(events.contains("\"outcome\":\"given_up\""), "{events}");
    assert!(events.contains("\"outcome\":\"halved\""), "{events}");
}

#[test]
fn a_cancelled_job_stops_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(2)).unwrap();
    let id = service.submit(&job(100_000)).unwrap().job_id.to_string();
    service
        .wait_for(&id, |status| status.progress.runs_done > 0)
        .unwrap();
    service.post(&format!("/v1/jobs/{id}/cancel")).unwrap();
    let status = service.job(&id).unwrap();
    assert_eq!(status.state, JobState::Cancelled);
    service
        .wait_for(&id, |_| shard_objects(folder.path()) == 0)
        .unwrap();
    // Workers are free for the next job at once.
    let next = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let status = service.wait_for(&next, finished).unwrap();
    check_same(&service, &status);
    assert!(service.job(&id).unwrap().progress.runs_done < 100_000);
}

#[test]
fn no_worker_outlives_the_service_however_it_ends() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(3)).unwrap();
    service.wait_for_children("simulate", 3).unwrap();
    service.kill().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(3)).unwrap();
    service.wait_for_children("simulate", 3).unwrap();
    service.terminate().unwrap();
}

#[test]
fn a_directory_in_use_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let first = ServiceUnderTest::start(folder.path(), &workers(0)).unwrap();
    let second = ServiceUnderTest::start(folder.path(), &workers(0))
        .err()
        .unwrap()
        .to_string();
    assert!(second.contains("in use by another hydroflex"), "{second}");
    first.terminate().unwrap();
}

/// The job with a network whose training takes a few seconds and is a function of its seed.
fn job_with_training() -> serde_json::Value {
    let mut job = job(RUNS);
    job["train"] = serde_json::json!([{
        "structure": "RLR",
        "window": { "rule": "given", "window_s": 0.1 },
        "targets": ["deflection_tip_y_m"],
        "epochs": 400,
        "windows": "overlapping",
    }]);
    job
}

#[test]
fn a_killed_trainer_goes_on_and_ends_with_the_same_model() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
    let id = service.submit(&job_with_training()).unwrap().job_id.to_string();
    let undisturbed = service.wait_for(&id, finished).unwrap();
    assert_eq!(
        undisturbed.state,
        JobState::Succeeded,
        "{undisturbed:?}\n{}",
        service.log()
    );
    let epoch = |status: &JobStatus| {
        status
            .trainings
            .first()
            .and_then(|t| t.progress.as_ref())
            .map_or(0, |progress| progress.epoch)
    };
    let id = service.submit(&job_with_training()).unwrap().job_id.to_string();
    let status = service.wait_for(&id, |s| finished(s) || epoch(s) > 100).unwrap();
    assert!(
        !finished(&status),
        "the training was over before it could be killed: {status:?}"
    );
    signal(service.wait_for_children("train", 1).unwrap()[0], Signal::SIGKILL).unwrap();
    // And once more, with everything else.
    let status = service.wait_for(&id, |s| finished(s) || epoch(s) > 250).unwrap();
    assert!(!finished(&status), "{status:?}");
    service.kill().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
    let status = service.wait_for(&id, finished).unwrap();
    assert_eq!(status.state, JobState::Succeeded, "{status:?}\n{}", service.log());
    assert_eq!(status.model_ids, undisturbed.model_ids);
    // The model answers, although this process has never loaded it.
    let model = &status.model_ids[0];
    let config = service
        .get(&format!("/v1/models/{model}/files/config.json"))
        .unwrap();
    let config: serde_json::Value = serde_json::from_slice(&config).unwrap();
    let inputs: serde_json::Map<String, serde_json::Value> = config["inputs"]
        .as_array()
        .unwrap()
        .iter()
        .map(|input| {
            (
                input["name"].as_str().unwrap().to_owned(),
                input["offset"].clone(),
            )
        })
        .collect();
    let answer = service
        .post_json(
            &format!("/v1/models/{model}/predict"),
            &serde_json::json!({ "inputs": inputs }),
        )
        .unwrap();
    assert_eq!(answer["count"], 1);
    assert!(
        answer["estimates"]["deflection_tip_y_m"][0]
            .as_f64()
            .unwrap()
            .is_finite()
    );
}
