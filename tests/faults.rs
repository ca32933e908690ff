//! Whatever dies on the way: a job ends with the same data set as if nothing had happened.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use hydroflex_ledger::blobs::Blobs;
use hydroflex_openapi::status::{JobState, JobStatus};
use hydroflex_openapi::sweep::{SweepState, SweepStatus};
use hydroflex_tests::{Pilot, ServiceUnderTest, Start, servers, signal};
use nix::sys::signal::Signal;
use std::path::Path;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

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
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    check_whole(&service, &status);
    assert_eq!(status.progress.runs_failed, 1);
    let events = String::from_utf8(service.get(&format!("/v1/jobs/{id}/events")).unwrap()).unwrap();
    assert!(events.contains("\"outcome\":\"given_up\""), "{events}");
    assert!(events.contains("\"outcome\":\"halved\""), "{events}");
    // With the cause gone, that run alone is done again; the data set is then the undisturbed one.
    service.terminate().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
    service.post(&format!("/v1/jobs/{id}/retry")).unwrap();
    let status = service.wait_for(&id, finished).unwrap();
    check_same(&service, &status);
    service
        .wait_for(&id, |_| shard_objects(folder.path()) == 0)
        .unwrap();
}

/// A run that hangs, or eats memory, without end: others are delivered, and the reason is recorded.
fn a_run_that_never_ends_is_isolated(how: &str, limits: &[(&'static str, &str)], reason: &str) {
    const BAD: u64 = 5;
    let folder = tempfile::tempdir().unwrap();
    let mut start = Start {
        workers: 2,
        environment: vec![
            ("HYDROFLEX_CRASH_WORKER_AT", format!("run-{BAD}")),
            ("HYDROFLEX_CRASH_HOW", how.to_owned()),
        ],
        ..Start::default()
    };
    for (name, value) in limits {
        start.environment.push((*name, (*value).to_owned()));
    }
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    let id = service.submit(&job(8)).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    check_whole(&service, &status);
    assert_eq!(status.progress.runs_failed, 1);
    let events = String::from_utf8(service.get(&format!("/v1/jobs/{id}/events")).unwrap()).unwrap();
    let given_up = events
        .lines()
        .find(|line| line.contains("\"outcome\":\"given_up\""))
        .unwrap_or_else(|| panic!("{events}"));
    assert!(given_up.contains(&format!("\"first_run\":{BAD}")), "{given_up}");
    assert!(given_up.contains(reason), "{given_up}");
}

#[test]
fn a_run_that_hangs_is_isolated_and_every_other_run_delivered() {
    a_run_that_never_ends_is_isolated(
        "hang",
        &[("HYDROFLEX_RUN_LIMIT", "1")],
        "a run took longer than 1 s",
    );
}

#[test]
fn a_run_that_eats_memory_is_isolated_and_every_other_run_delivered() {
    a_run_that_never_ends_is_isolated(
        "eat",
        &[("HYDROFLEX_MEMORY_LIMIT", "512")],
        "a run took more than 512 MiB of memory",
    );
}

#[test]
fn a_run_is_shown_again_and_a_data_set_made_again_from_its_manifest() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(1)).unwrap();
    let mut urgent = job(RUNS);
    urgent["priority"] = 7.into();
    let id = service.submit(&urgent).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    // When its turn came is no part of it.
    check_same(&service, &status);
    let cache = folder.path().join("cache").display().to_string();
    let dataset = folder.path().join("set").display().to_string();
    let fetched = status.dataset_id.as_ref().unwrap().to_string();
    hydroflex_tests::command(&[
        "dataset",
        "fetch",
        &fetched,
        "--out",
        &dataset,
        "--url",
        service.url(),
    ])
    .unwrap();

    let by_job = [
        "rerun",
        &id,
        "--run",
        "17",
        "--json",
        "--cache",
        &cache,
        "--url",
        service.url(),
    ];
    let by_job: serde_json::Value =
        serde_json::from_str(&hydroflex_tests::command(&by_job).unwrap()).unwrap();
    let csv = folder.path().join("run.csv").display().to_string();
    let by_manifest = [
        "rerun", &dataset, "--run", "17", "--json", "--cache", &cache, "--out", &csv,
    ];
    let by_manifest: serde_json::Value =
        serde_json::from_str(&hydroflex_tests::command(&by_manifest).unwrap()).unwrap();
    assert_eq!(by_job["channels"], by_manifest["channels"]);
    assert_eq!(by_job["status"], "ok");
    // The run as it is in the data set.
    let published = hydroflex_dataset::Dataset::open(&dataset).unwrap();
    let row = published.runs().iter().find(|row| row.run_id == 17).unwrap();
    assert_eq!(by_job["seed"].as_u64(), row.seed);
    assert_eq!(by_job["payload_kg"].as_f64(), Some(row.payload_kg));
    let lines = std::fs::read_to_string(&csv).unwrap().lines().count();
    assert_eq!(lines, 1 + 101);
    let refused = hydroflex_tests::command(&["rerun", &dataset, "--run", "60", "--cache", &cache]);
    let refused = refused.unwrap_err().to_string();
    assert!(refused.contains("allowed is 0 to 59"), "{refused}");

    let again = ["reproduce", &dataset, "--json", "--cache", &cache];
    let again: serde_json::Value = serde_json::from_str(&hydroflex_tests::command(&again).unwrap()).unwrap();
    assert_eq!(again["same"], true);
    assert_eq!(again["dataset_sha256"].as_str(), status.dataset_sha256.as_deref());
    // A manifest that promises other bytes is found out.
    let path = Path::new(&dataset).join("manifest.json");
    let mut manifest: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    manifest["source"]["spec"]["seed"] = 8.into();
    std::fs::write(&path, manifest.to_string()).unwrap();
    let other = hydroflex_tests::command(&["reproduce", &dataset, "--cache", &cache]);
    let other = other.unwrap_err().to_string();
    assert!(other.contains("data/train-00000-of-00001.parquet"), "{other}");
    service.terminate().unwrap();
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
        // Seconds of work also on a fast machine: progress is told a few times a second.
        "epochs": 2500,
        "windows": "overlapping",
    }]);
    job
}

/// A sweep as it is.
fn sweep(service: &ServiceUnderTest, path: &str) -> SweepStatus {
    serde_json::from_slice(&service.get(path).unwrap()).unwrap()
}

/// Waits until a sweep is as wanted.
fn wait_for_sweep(
    service: &ServiceUnderTest,
    path: &str,
    wanted: impl Fn(&SweepStatus) -> bool,
) -> SweepStatus {
    let start = Instant::now();
    loop {
        let status = sweep(service, path);
        if wanted(&status) {
            return status;
        }
        assert!(
            start.elapsed() < Duration::from_mins(4),
            "{status:?}\n{}",
            service.log()
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_sweep_killed_in_the_middle_ends_with_the_table_of_an_undisturbed_one() {
    let folder = tempfile::tempdir().unwrap();
    let mut start = workers(1);
    start.environment.push(("HYDROFLEX_TRAINERS", "2".to_owned()));
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let dataset = service.wait_for(&id, finished).unwrap().dataset_id.unwrap();
    let request = serde_json::json!({
        "dataset_id": dataset,
        "structures": ["L", "RLR"],
        "sensors": ["all", "us"],
        "seeds": [0, 1],
        "spec": {
            "window": { "rule": "given", "window_s": 0.1 },
            "targets": ["deflection_tip_y_m"],
            "epochs": 60,
        },
    });
    let submit = |service: &ServiceUnderTest| {
        let status = service.post_json("/v1/sweeps", &request).unwrap();
        format!("/v1/sweeps/{}", status["sweep_id"].as_str().unwrap())
    };
    let table = |service: &ServiceUnderTest, path: &str| {
        String::from_utf8(service.get(&format!("{path}/table.csv")).unwrap()).unwrap()
    };
    let path = submit(&service);
    let status = wait_for_sweep(&service, &path, |s| s.state.is_final());
    assert_eq!(
        status.state,
        SweepState::Succeeded,
        "{status:?}\n{}",
        service.log()
    );
    assert_eq!((status.progress.total, status.progress.succeeded), (8, 8));
    let undisturbed = table(&service, &path);
    assert_eq!(undisturbed.lines().count(), 9, "{undisturbed}");
    assert!(undisturbed.contains("least_squares_mae"), "{undisturbed}");

    let path = submit(&service);
    let begun = |s: &SweepStatus| s.progress.succeeded >= 2 && s.progress.running > 0;
    let status = wait_for_sweep(&service, &path, |s| begun(s) || s.state.is_final());
    assert!(!status.state.is_final(), "{status:?}");
    // A trainer dies, and then everything.
    signal(service.wait_for_children("train", 2).unwrap()[0], Signal::SIGKILL).unwrap();
    let status = wait_for_sweep(&service, &path, |s| s.progress.succeeded >= 4);
    assert!(!status.state.is_final(), "{status:?}");
    service.kill().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
    let status = wait_for_sweep(&service, &path, |s| s.state.is_final());
    assert_eq!(
        status.state,
        SweepState::Succeeded,
        "{status:?}\n{}",
        service.log()
    );
    assert_eq!(table(&service, &path), undisturbed);
    let svg = service.get(&format!("{path}/plot.svg")).unwrap();
    assert!(String::from_utf8(svg).unwrap().matches("<circle").count() >= 8);
    service.terminate().unwrap();
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
    let status = service.wait_for(&id, |s| finished(s) || epoch(s) > 600).unwrap();
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

/// Chosen parts of the environment's database and store; `None` where one of them is not installed.
struct Shared {
    database: String,
    store: String,
}

fn postgres_and_s3(name: &str) -> Option<Shared> {
    let store = servers::moto::shared()?;
    let database = servers::postgres::fresh_database(name)?;
    let bucket = name.replace('_', "-");
    store.bucket(&bucket);
    Some(Shared {
        database,
        store: format!("s3://{bucket}/runs"),
    })
}

impl Shared {
    fn start(&self, workers: usize) -> Start {
        Start {
            workers,
            environment: Self::environment(),
            database: Some(self.database.clone()),
            store: Some(self.store.clone()),
            ..Start::default()
        }
    }

    fn environment() -> Vec<(&'static str, String)> {
        let server = servers::moto::shared().unwrap();
        servers::moto::environment(server.port())
    }

    fn objects(&self, below: &str) -> Vec<String> {
        let variables = Self::environment()
            .into_iter()
            .map(|(name, value)| (name.to_owned(), value));
        let blobs = Blobs::open_with(&self.store, variables).unwrap();
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(blobs.list(below)).unwrap()
    }

    fn pilot(&self, cache: &Path, arguments: &[&str]) -> Pilot {
        Pilot::start(
            &self.database,
            &self.store,
            cache,
            &Self::environment(),
            arguments,
        )
        .unwrap()
    }
}

#[test]
fn postgres_and_s3_with_four_workers_give_the_bytes_of_sqlite_and_a_directory_with_one() {
    let Some(shared) = postgres_and_s3("four_workers") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &shared.start(2)).unwrap();
    let cache = folder.path().join("pilots");
    let pilots = [shared.pilot(&cache, &[]), shared.pilot(&cache, &[])];
    let id = service.submit(&job(RUNS)).unwrap().job_id.to_string();
    let status = service.wait_for(&id, finished).unwrap();
    check_same(&service, &status);
    // A reader takes a part of a file, and knows when it has it already.
    let dataset = status.dataset_id.unwrap();
    let path = format!("/v1/datasets/{dataset}/files/data/train-00000-of-00001.parquet");
    let whole = service.get(&path).unwrap();
    let part = service.get_range(&path, whole.len() as u64 - 8, None).unwrap();
    assert_eq!(part.status, 206);
    assert_eq!(part.body, whole[whole.len() - 8..]);
    assert_eq!(part.etag, format!("\"{}\"", hydroflex_tests::sha256(&whole)));
    let known = service.get_range(&path, 0, Some(&part.etag)).unwrap();
    assert_eq!((known.status, known.body.len()), (304, 0));
    service
        .wait_for(&id, |_| shared.objects("shards").is_empty())
        .unwrap();
    for pilot in pilots {
        pilot.terminate().unwrap();
    }
    service.terminate().unwrap();
}

#[test]
fn of_two_coordinators_on_one_database_one_may_die() {
    let Some(shared) = postgres_and_s3("two_coordinators") else {
        return;
    };
    let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let doomed = ServiceUnderTest::start(first.path(), &shared.start(1)).unwrap();
    let other = ServiceUnderTest::start(second.path(), &shared.start(1)).unwrap();
    let pilot = shared.pilot(&second.path().join("pilot"), &[]);
    let id = doomed.submit(&job(RUNS)).unwrap().job_id.to_string();
    other
        .wait_for(&id, |s| finished(s) || s.progress.runs_done >= 10)
        .unwrap();
    doomed.kill().unwrap();
    let status = other.wait_for(&id, finished).unwrap();
    check_same(&other, &status);
    other
        .wait_for(&id, |_| shared.objects("shards").is_empty())
        .unwrap();
    pilot.terminate().unwrap();
    other.terminate().unwrap();
}

#[test]
fn a_pilot_drains_before_its_time_is_up_and_gives_its_shard_back_when_told_to() {
    let folder = tempfile::tempdir().unwrap();
    let service = ServiceUnderTest::start(folder.path(), &workers(0)).unwrap();
    let database = format!("sqlite:{}", folder.path().join("ledger.sqlite").display());
    let store = format!("file://{}", folder.path().join("store").display());
    let pilot = |arguments: &[&str]| {
        Pilot::start(&database, &store, &folder.path().join("cache"), &[], arguments).unwrap()
    };
    let id = service.submit(&job(100_000)).unwrap().job_id.to_string();
    // One whose time is up ends by itself, without an error, and whatever it began is handed in.
    pilot(&["--drain-after", "2"]).wait().unwrap();
    let status = service.job(&id).unwrap();
    assert!(status.progress.runs_done > 0, "{status:?}");
    let told = pilot(&[]);
    let before = status.progress.runs_done;
    service
        .wait_for(&id, |status| status.progress.runs_done > before)
        .unwrap();
    told.terminate().unwrap();
    // Nothing was lost on the way: no attempt counts as failed.
    let events = |id: &str| {
        service.post(&format!("/v1/jobs/{id}/cancel")).unwrap();
        String::from_utf8(service.get(&format!("/v1/jobs/{id}/events")).unwrap()).unwrap()
    };
    let events = events(&id);
    assert!(!events.contains("\"outcome\":\"retried\""), "{events}");
}
