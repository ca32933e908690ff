//! The REST interface, asked right and asked wrong.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use axum::body::Body;
use common::Desk;
use hydroflex_ledger::{NewDataset, NewJob, ShardResult};
use hydroflex_openapi::catalogue::{DatasetInfo, DatasetPage, FileEntry, MachineList, MeshInfo};
use hydroflex_openapi::id::DatasetId;
use hydroflex_openapi::status::{JobPage, JobState, JobStatus, TimeSplit};
use sha2::{Digest, Sha256};

#[tokio::test(flavor = "multi_thread")]
async fn a_job_is_accepted_shown_listed_and_cancelled() {
    let desk = Desk::new().await;
    let accepted = desk.post("/v1/jobs", r#"{"runs": 80}"#).await;
    assert_eq!(
        accepted.status,
        202,
        "{}",
        String::from_utf8_lossy(&accepted.body)
    );
    let job: JobStatus = accepted.json();
    assert_eq!(accepted.header("location"), format!("/v1/jobs/{}", job.job_id));
    assert!(!accepted.header("retry-after").is_empty());
    assert_eq!((job.state, job.progress.runs_total), (JobState::Queued, 80));
    let shown: JobStatus = desk.get(accepted.header("location")).await.json();
    assert_eq!(shown, job);
    let listed: JobPage = desk.get("/v1/jobs").await.json();
    assert_eq!(listed.jobs, std::slice::from_ref(&job));
    let cancelled: JobStatus = desk
        .post(&format!("/v1/jobs/{}/cancel", job.job_id), "")
        .await
        .json();
    assert_eq!(cancelled.state, JobState::Cancelled);
    let again = desk.post(&format!("/v1/jobs/{}/cancel", job.job_id), "").await;
    assert_eq!(again.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_of_runs_too_short_for_its_windows_says_so() {
    let desk = Desk::new().await;
    let accepted = desk
        .post("/v1/jobs", r#"{"runs": 8, "payload_kg": 200, "duration_s": 0.5}"#)
        .await;
    assert_eq!(accepted.status, 202);
    let job: JobStatus = accepted.json();
    assert_eq!(job.notices.len(), 1, "{:?}", job.notices);
    assert_eq!(job.notices[0].pointer, "/duration_s");
    let proposed_s = job.notices[0].proposed.as_ref().unwrap().as_f64().unwrap();
    assert!(proposed_s > 0.9, "{:?}", job.notices);
    let shown: JobStatus = desk.get(accepted.header("location")).await.json();
    assert_eq!(shown.notices, job.notices);
    let events = desk.ledger.events(job.job_id, 0, 10).await.unwrap();
    assert!(events.iter().any(|event| event.what.name() == "notice"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_varies_materials_and_is_refused_what_is_none() {
    let desk = Desk::new().await;
    let accepted = desk
        .post("/v1/jobs", r#"{"runs": 8, "materials": ["steel", "aluminium"]}"#)
        .await;
    assert_eq!(
        accepted.status,
        202,
        "{}",
        String::from_utf8_lossy(&accepted.body)
    );
    let problem = desk
        .post("/v1/jobs", r#"{"runs": 8, "materials": ["steel", "wood"]}"#)
        .await
        .problem(422);
    let error = &problem.errors[0];
    assert_eq!(
        (error.pointer.as_str(), error.value.clone()),
        ("/materials/1", Some("wood".into()))
    );
    assert!(error.allowed.as_ref().unwrap().contains("titanium"), "{error:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mesh_is_uploaded_once_checked_and_named_by_a_job() {
    let desk = Desk::new().await;
    // The built-in mesh under a machine file that wants one given.
    let mesh = include_str!("../../sim/machines/lift-boom/lift-boom.inp");
    let toml = include_str!("../../sim/machines/lift-boom.toml");
    let built_in = "mesh = { built_in = \"lift-boom\" }";
    assert!(toml.contains(built_in));
    let toml = toml.replace(built_in, "mesh = { given = \"any boom\" }");
    let job = |meshes: serde_json::Value| {
        serde_json::json!({"runs": 8, "machine": {"toml": toml}, "meshes": meshes}).to_string()
    };
    let missing = desk
        .post("/v1/jobs", &job(serde_json::json!({})))
        .await
        .problem(422);
    assert!(missing.detail.contains("POST /v1/meshes"), "{}", missing.detail);

    let plain = [("content-type", "text/plain")];
    let first = desk.send("POST", "/v1/meshes", &plain, mesh).await;
    assert_eq!(first.status, 201);
    let info: MeshInfo = first.json();
    assert_eq!(info.mesh_sha256, hex::encode(Sha256::digest(mesh)));
    assert_eq!((info.nodes, info.element_kind.as_str()), (14301, "C3D10"));
    let again = desk.send("POST", "/v1/meshes", &plain, mesh).await;
    assert_eq!(again.json::<MeshInfo>(), info);

    let accepted = desk
        .post("/v1/jobs", &job(serde_json::json!({"boom": info.mesh_sha256})))
        .await;
    assert_eq!(
        accepted.status,
        202,
        "{}",
        String::from_utf8_lossy(&accepted.body)
    );
    for (body, sha256, pointer) in [
        ("boom", "0".repeat(64), "/meshes/boom"),
        ("boom", "../../ledger.sqlite".to_owned(), "/meshes/boom"),
        ("mast", info.mesh_sha256.clone(), "/machine/toml"),
    ] {
        let problem = desk
            .post("/v1/jobs", &job(serde_json::json!({body: sha256})))
            .await
            .problem(422);
        assert_eq!(problem.errors[0].pointer, pointer);
    }
    let broken = desk
        .send("POST", "/v1/meshes", &plain, mesh.replacen("C3D10", "C3D8", 1))
        .await;
    let broken = broken.problem(422);
    assert!(broken.detail.contains("line"), "{}", broken.detail);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_repeated_request_with_a_key_makes_one_job() {
    let desk = Desk::new().await;
    let key = [
        ("content-type", "application/json"),
        ("idempotency-key", "friday-17"),
    ];
    let first = desk.send("POST", "/v1/jobs", &key, r#"{"runs": 80}"#).await;
    let second = desk.send("POST", "/v1/jobs", &key, r#"{"runs": 80}"#).await;
    assert_eq!(first.header("location"), second.header("location"));
    let other = desk.send("POST", "/v1/jobs", &key, r#"{"runs": 81}"#).await;
    assert_eq!(other.problem(422).kind, "/problems/idempotency-key-reused");
    let listed: JobPage = desk.get("/v1/jobs").await.json();
    assert_eq!(listed.jobs.len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_refusal_names_field_value_and_what_is_allowed() {
    let desk = Desk::new().await;
    for (body, pointer) in [
        (r#"{"runs": 0}"#, "/runs"),
        (r#"{"runs": 80, "duration_s": -1.0}"#, "/duration_s"),
        (r#"{"runs": 80, "machine": "forklift"}"#, "/machine"),
        (r#"{"runs": 80, "machine": "/etc/passwd"}"#, "/machine"),
        (r#"{"runs": 80, "machine": "lift-boom-published"}"#, "/machine"),
        (
            r#"{"runs": 80, "machine": {"toml": "format = 1"}}"#,
            "/machine/toml",
        ),
        (r#"{"runs": 80, "wheels": 4}"#, "/wheels"),
        (r#"{"runs": "many"}"#, "/runs"),
        (r#"{"runs": 80, "payload_kg": -5.0}"#, "/payload_kg"),
        (
            r#"{"runs": 80, "train": [{"structure": "QQQ"}]}"#,
            "/train/0/structure",
        ),
        (
            r#"{"runs": 80, "train": [{"targets": ["wind_m_per_s"]}]}"#,
            "/train/0/targets/0",
        ),
        // What would fail only after every run is there.
        (
            r#"{"runs": 80, "train": [{"structure": "RDTL"}]}"#,
            "/train/0/structure",
        ),
        (
            r#"{"runs": 80, "train": [{"structure": "RLR", "output_steps": 150, "window": {"rule": "given", "window_s": 0.5}}]}"#,
            "/train/0/output_steps",
        ),
        (
            r#"{"runs": 80, "duration_s": 10, "train": [{"structure": "RLR", "width_windows": 16, "window": {"rule": "given", "window_s": 5}}]}"#,
            "/train/0/width_windows",
        ),
    ] {
        let problem = desk.post("/v1/jobs", body).await.problem(422);
        let pointers: Vec<&str> = problem
            .errors
            .iter()
            .map(|error| error.pointer.as_str())
            .collect();
        assert!(pointers.contains(&pointer), "{body}: {problem:?}");
    }
    let listed: JobPage = desk.get("/v1/jobs").await.json();
    assert!(listed.jobs.is_empty(), "a refused job leaves nothing");
}

#[tokio::test(flavor = "multi_thread")]
async fn whatever_goes_wrong_is_a_problem() {
    let desk = Desk::new().await;
    desk.get("/nothing/here").await.problem(404);
    desk.get("/v1/jobs/17").await.problem(404);
    desk.get("/v1/jobs/01a20431-1cf0-7719-af78-6b255de1ee1f")
        .await
        .problem(404);
    desk.get("/v1/jobs/01a20431-1cf0-7719-af78-6b255de1ee1f/events")
        .await
        .problem(404);
    desk.get("/v1/datasets/9f86d081884c7d659a2feaa0c55ad015")
        .await
        .problem(404);
    desk.get("/v1/models/%2e%2e%2f%2e%2e").await.problem(404);
    desk.get("/v1/jobs/%ff").await.problem(404);
    desk.get("/v1/machines/forklift").await.problem(404);
    desk.get("/v1/jobs?limit=0").await.problem(422);
    desk.get("/v1/jobs?limit=x").await.problem(422);
    desk.get("/v1/jobs?cursor=x").await.problem(422);
    desk.get("/v1/datasets?cursor=x").await.problem(422);
    desk.send("DELETE", "/v1/jobs", &[], Body::empty())
        .await
        .problem(405);
    desk.send("PUT", "/v1/datasets/x/files/y", &[], Body::empty())
        .await
        .problem(405);
    desk.post("/v1/jobs", "{").await.problem(400);
    desk.post("/v1/jobs", &"[".repeat(10_000)).await.problem(400);
    desk.send("POST", "/v1/jobs", &[], "{}").await.problem(415);
    let key = [("content-type", "application/json"), ("idempotency-key", "")];
    desk.send("POST", "/v1/jobs", &key, r#"{"runs": 80}"#)
        .await
        .problem(422);
    let large = format!("{{\"title\": \"{}\"}}", "x".repeat(33 << 20));
    desk.post("/v1/jobs", &large).await.problem(413);
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_follow_each_other_to_the_end() {
    let desk = Desk::new().await;
    let mut made = Vec::new();
    for seed in 0..5 {
        let job: JobStatus = desk
            .post("/v1/jobs", &format!("{{\"runs\": 1, \"seed\": {seed}}}"))
            .await
            .json();
        made.push(job.job_id);
    }
    made.reverse();
    let (mut seen, mut path) = (Vec::new(), "/v1/jobs?limit=2".to_owned());
    loop {
        let page: JobPage = desk.get(&path).await.json();
        seen.extend(page.jobs.iter().map(|job| job.job_id));
        match page.next_cursor {
            Some(cursor) => path = format!("/v1/jobs?limit=2&cursor={cursor}"),
            None => break,
        }
    }
    assert_eq!(seen, made);
}

#[tokio::test(flavor = "multi_thread")]
async fn events_are_replayed_from_anywhere_and_end_with_the_job() {
    let desk = Desk::new().await;
    let job: JobStatus = desk.post("/v1/jobs", r#"{"runs": 1}"#).await.json();
    desk.ledger.cancel_job(job.job_id).await.unwrap();
    let path = format!("/v1/jobs/{}/events", job.job_id);
    let all = desk.get(&path).await;
    assert!(all.header("content-type").starts_with("text/event-stream"));
    let text = String::from_utf8(all.body).unwrap();
    assert!(text.contains("id: 1\n") && text.contains("id: 2\n"), "{text}");
    assert!(text.contains("\"state\":\"cancelled\""), "{text}");
    let rest = desk
        .send("GET", &path, &[("last-event-id", "1")], Body::empty())
        .await;
    let text = String::from_utf8(rest.body).unwrap();
    assert!(!text.contains("id: 1\n") && text.contains("id: 2\n"), "{text}");
    let nothing = desk
        .send("GET", &path, &[("last-event-id", "2")], Body::empty())
        .await;
    assert_eq!(nothing.status, 204);
    desk.send("GET", &path, &[("last-event-id", "yesterday")], Body::empty())
        .await
        .problem(422);
}

/// A published data set of two files, without simulating it.
async fn publish(desk: &Desk) -> (DatasetInfo, Vec<Vec<u8>>) {
    let contents = vec![
        (0..10_000_u32).flat_map(u32::to_le_bytes).collect(),
        b"two\n".to_vec(),
    ];
    let hash = |content: &[u8]| hex::encode(Sha256::digest(content));
    let files: Vec<FileEntry> = ["data/train-00000-of-00001.parquet", "README.md"]
        .iter()
        .zip(&contents)
        .map(|(path, content): (_, &Vec<u8>)| FileEntry {
            path: (*path).to_owned(),
            size_bytes: content.len() as u64,
            sha256: hash(content),
        })
        .collect();
    let sha256 = hash(b"sums");
    let id = DatasetId::of_sha256(&sha256).unwrap();
    for (file, content) in files.iter().zip(&contents) {
        desk.blobs
            .create(&format!("datasets/{id}/{}", file.path), content.clone().into())
            .await
            .unwrap();
    }
    let spec: hydroflex_openapi::job::JobSpec =
        serde_json::from_value(serde_json::json!({"runs": 1, "settling_runs": 0})).unwrap();
    let new = NewJob {
        spec: spec.clone(),
        machine_sha256: hash(b""),
        settling_shards: Vec::new(),
        run_shards: vec![1],
        notices: Vec::new(),
    };
    let job = desk.ledger.create_job(&new, None).await.unwrap().id();
    desk.ledger
        .register_worker("worker.test", Some("x86-64-v3"))
        .await
        .unwrap();
    let claim = desk.ledger.begin_shard("worker.test").await.unwrap().unwrap();
    let result = ShardResult {
        object: claim.object(),
        sha256: hash(b""),
        size_bytes: 0,
        failed_runs: 0,
        spent: TimeSplit::default(),
    };
    desk.ledger.commit_shard(&claim, &result).await.unwrap();
    assert!(desk.ledger.begin_publishing(job).await.unwrap());
    let dataset = NewDataset {
        round: 0,
        id: id.clone(),
        sha256,
        spec,
        runs: 1,
        files,
    };
    assert!(desk.ledger.publish_dataset(job, &dataset, &[]).await.unwrap());
    (desk.get(&format!("/v1/datasets/{id}")).await.json(), contents)
}

#[tokio::test(flavor = "multi_thread")]
async fn files_come_whole_in_ranges_or_not_again() {
    let desk = Desk::new().await;
    let (dataset, contents) = publish(&desk).await;
    let listed: DatasetPage = desk.get("/v1/datasets").await.json();
    assert_eq!(listed.datasets, std::slice::from_ref(&dataset));
    let file = &dataset.files[0];
    let path = format!("/v1/datasets/{}/files/{}", dataset.dataset_id, file.path);
    let etag = format!("\"{}\"", file.sha256);

    let whole = desk.get(&path).await;
    assert_eq!((whole.status.as_u16(), &whole.body), (200, &contents[0]));
    assert_eq!(whole.header("etag"), etag);
    assert_eq!(whole.header("accept-ranges"), "bytes");

    let head = desk.send("HEAD", &path, &[], Body::empty()).await;
    assert_eq!((head.status.as_u16(), head.body.len()), (200, 0));
    assert_eq!(head.header("content-length"), "40000");

    let part = desk
        .send("GET", &path, &[("range", "bytes=100-199")], Body::empty())
        .await;
    assert_eq!(
        (part.status.as_u16(), part.body.as_slice()),
        (206, &contents[0][100..200])
    );
    assert_eq!(part.header("content-range"), "bytes 100-199/40000");
    let tail = desk
        .send("GET", &path, &[("range", "bytes=-8")], Body::empty())
        .await;
    assert_eq!(tail.body, contents[0][39_992..]);
    let fresh = [("range", "bytes=0-0"), ("if-range", etag.as_str())];
    assert_eq!(desk.send("GET", &path, &fresh, Body::empty()).await.status, 206);
    let stale = [("range", "bytes=0-0"), ("if-range", "\"other\"")];
    assert_eq!(desk.send("GET", &path, &stale, Body::empty()).await.status, 200);
    let outside = desk
        .send("GET", &path, &[("range", "bytes=40000-")], Body::empty())
        .await;
    outside.problem(416);
    assert_eq!(outside.header("content-range"), "bytes */40000");
    let known = desk
        .send("GET", &path, &[("if-none-match", etag.as_str())], Body::empty())
        .await;
    assert_eq!((known.status.as_u16(), known.body.len()), (304, 0));
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_beside_the_listed_files_can_be_reached() {
    let desk = Desk::new().await;
    let (dataset, _) = publish(&desk).await;
    let base = format!("/v1/datasets/{}/files", dataset.dataset_id);
    for path in [
        "../../../ledger.sqlite",
        "%2e%2e/%2e%2e/ledger.sqlite",
        "/etc/passwd",
        "data",
        "data/",
        "",
        "x",
    ] {
        let answer = desk.get(&format!("{base}/{path}")).await;
        answer.problem(404);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_archive_is_a_tar_of_every_file() {
    let desk = Desk::new().await;
    let (dataset, contents) = publish(&desk).await;
    let answer = desk
        .get(&format!("/v1/datasets/{}/archive.tar", dataset.dataset_id))
        .await;
    assert_eq!(answer.header("content-length"), answer.body.len().to_string());
    let mut archive = tar::Archive::new(answer.body.as_slice());
    let mut found = Vec::new();
    for entry in archive.entries().unwrap() {
        let mut entry = entry.unwrap();
        let path = entry.path().unwrap().display().to_string();
        let mut content = Vec::new();
        std::io::Read::read_to_end(&mut entry, &mut content).unwrap();
        found.push((path, content));
    }
    let folder = format!("hydroflex-{}", dataset.dataset_id);
    let expected: Vec<(String, Vec<u8>)> = dataset
        .files
        .iter()
        .map(|file| format!("{folder}/{}", file.path))
        .zip(contents)
        .collect();
    assert_eq!(found, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn trainings_are_checked_against_their_data_set() {
    let desk = Desk::new().await;
    let unknown = r#"{"dataset_id": "9f86d081884c7d659a2feaa0c55ad015"}"#;
    assert_eq!(
        desk.post("/v1/trainings", unknown).await.problem(422).errors[0].pointer,
        "/dataset_id"
    );
    let (dataset, _) = publish(&desk).await;
    let id = &dataset.dataset_id;
    let bad = format!(r#"{{"dataset_id": "{id}", "spec": {{"targets": ["wind"]}}}}"#);
    let pointer = desk.post("/v1/trainings", &bad).await.problem(422).errors[0]
        .pointer
        .clone();
    assert_eq!(pointer, "/spec/targets/0");
    // Without settling runs the window has to be given.
    let spec = r#"{"window": {"rule": "given", "window_s": 0.1}}"#;
    let good = desk
        .post(
            "/v1/trainings",
            &format!(r#"{{"dataset_id": "{id}", "spec": {spec}}}"#),
        )
        .await;
    assert_eq!(good.status, 202);
    assert_eq!(desk.get(good.header("location")).await.status, 200);
    let nobody = desk
        .post(
            "/v1/models/9f86d081884c7d659a2feaa0c55ad015/predict",
            r#"{"inputs": {}}"#,
        )
        .await;
    nobody.problem(404);
}

#[tokio::test(flavor = "multi_thread")]
async fn machines_health_metrics_and_the_browsable_page_answer() {
    let desk = Desk::new().await;
    let machines: MachineList = desk.get("/v1/machines").await.json();
    assert!(
        machines
            .machines
            .iter()
            .any(|machine| machine.name == "lift-boom" && machine.available)
    );
    assert_eq!(desk.get("/v1/machines/lift-boom").await.status, 200);
    assert_eq!(desk.get("/health/live").await.body, b"live\n");
    assert_eq!(desk.get("/health/ready").await.body, b"ready\n");
    let metrics = String::from_utf8(desk.get("/metrics").await.body).unwrap();
    assert!(metrics.contains("hydroflex_http_requests_total"), "{metrics}");
    let page = String::from_utf8(desk.get("/docs/").await.body).unwrap();
    assert!(page.contains("swagger"), "{page}");
    assert!(
        !page.contains("//unpkg") && !page.contains("//cdn"),
        "the page works without the internet"
    );
    let document: serde_json::Value = desk.get("/openapi.json").await.json();
    assert!(document["paths"]["/v1/jobs"].is_object());
}

/// What is refused about a sweep on this data set, with the pointers that must be named.
async fn refused(desk: &Desk, dataset: &str, body: serde_json::Value, pointers: &[&str]) {
    let mut body = body;
    body["dataset_id"] = dataset.into();
    let problem = desk.post("/v1/sweeps", &body.to_string()).await.problem(422);
    let found: Vec<&str> = problem.errors.iter().map(|e| e.pointer.as_str()).collect();
    assert_eq!(found, pointers, "{body}");
    for error in &problem.errors {
        assert!(error.allowed.is_some() && error.value.is_some(), "{error:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sweep_is_accepted_shown_and_cancelled_and_a_bad_one_refused_by_name() {
    use hydroflex_openapi::sweep::{SweepPage, SweepState, SweepStatus, SweepTable};
    let desk = Desk::new().await;
    let (dataset, _) = publish(&desk).await;
    let id = dataset.dataset_id.as_str();
    let window = serde_json::json!({ "rule": "given", "window_s": 0.1 });
    let body = serde_json::json!({ "dataset_id": id, "grid": "published", "spec": { "window": window } });
    let accepted = desk.post("/v1/sweeps", &body.to_string()).await;
    assert_eq!(
        accepted.status,
        202,
        "{}",
        String::from_utf8_lossy(&accepted.body)
    );
    let status: SweepStatus = accepted.json();
    assert_eq!((status.progress.total, status.progress.open), (125, 125));
    assert_eq!(status.state, SweepState::Running);
    let place = accepted.header("location").to_owned();
    let table: SweepTable = desk.get(&format!("{place}/table")).await.json();
    assert_eq!(table.rows.len(), 125);
    let cell = |index: usize| {
        let row = &table.rows[index];
        (row.structure.as_str(), row.sensors.as_str(), row.seed)
    };
    assert_eq!(cell(0), ("L", "U s ds p1 p2", 0));
    assert_eq!(cell(6), ("L", "U s p1 p2", 1));
    assert_eq!(cell(124), ("RLR", "U s", 4));
    let csv = desk.get(&format!("{place}/table.csv")).await;
    assert!(csv.header("content-type").starts_with("text/csv"));
    let text = String::from_utf8(csv.body).unwrap();
    let columns: Vec<usize> = text.lines().map(|line| line.split(',').count()).collect();
    assert_eq!((columns.len(), columns.iter().max()), (126, columns.iter().min()));
    assert_eq!(desk.get(&format!("{place}/table.md")).await.status, 200);
    let svg = desk.get(&format!("{place}/plot.svg")).await;
    assert_eq!(svg.header("content-type"), "image/svg+xml");
    let cancelled: SweepStatus = desk.post(&format!("{place}/cancel"), "").await.json();
    assert_eq!(cancelled.state, SweepState::Cancelled);
    let listed: SweepPage = desk.get("/v1/sweeps").await.json();
    assert_eq!(listed.sweeps, [cancelled]);
    assert_eq!(desk.post(&format!("{place}/retry"), "").await.status, 200);

    let json = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
    let spec = r#""spec": { "window": { "rule": "given", "window_s": 0.1 } }"#;
    for (body, pointers) in [
        (format!(r#"{{ "structures": [], {spec} }}"#), &["/structures"][..]),
        (
            format!(r#"{{ "structures": ["RLR", "RQR"], {spec} }}"#),
            &["/structures/1"],
        ),
        (
            format!(r#"{{ "structures": ["L", "L"], {spec} }}"#),
            &["/structures/1"],
        ),
        (
            format!(r#"{{ "sensors": ["us", ["length_lift_m", "nothing"]], {spec} }}"#),
            &["/sensors/1/1"],
        ),
        (format!(r#"{{ "sensors": [[]], {spec} }}"#), &["/sensors/0"]),
        (
            r#"{ "windows": [{ "rule": "given", "window_s": 99.0 }] }"#.to_owned(),
            &["/windows/0/window_s"],
        ),
        (
            r#"{ "spec": { "structure": "RQR", "window": { "rule": "given", "window_s": 0.1 } } }"#
                .to_owned(),
            &["/spec/structure"],
        ),
    ] {
        refused(&desk, id, json(&body), pointers).await;
    }
    // More windows than a job may have trainings.
    let windows = |count: i32| -> Vec<serde_json::Value> {
        let one = |k: i32| serde_json::json!({ "rule": "given", "window_s": 0.1 + 0.001 * f64::from(k) });
        (0..count).map(one).collect()
    };
    let wide = serde_json::json!({ "dataset_id": id, "windows": windows(300), "structures": ["L"] });
    let accepted = desk.post("/v1/sweeps", &wide.to_string()).await;
    assert_eq!(accepted.status, 202);
    let mut late = windows(300);
    late[280]["window_s"] = serde_json::json!(99.0);
    let wrong = serde_json::json!({ "windows": late, "structures": ["L"] });
    refused(&desk, id, wrong, &["/windows/280/window_s"]).await;
    let seeds: Vec<u64> = (0..1025).collect();
    let many = serde_json::json!({ "seeds": seeds, "spec": { "window": window } });
    refused(&desk, id, many, &[""]).await;
    refused(&desk, &"0".repeat(32), serde_json::json!({}), &["/dataset_id"]).await;
}
