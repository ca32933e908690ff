//! What must be true whenever one looks, and after every trial.

use crate::trial::Trial;
use crate::{RUNS, job};
use anyhow::{Context, ensure};
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::transition::ShardState;
use hydroflex_ledger::{Ledger, ShardKind};
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::status::{JobState, JobStatus};
use hydroflex_tests::{ServiceUnderTest, Start, sha256};
use std::path::Path;
use std::time::{Duration, Instant};

impl Trial {
    /// A data set that anybody can see is whole, whenever one looks.
    pub(super) fn look_as_a_reader(&mut self) -> anyhow::Result<()> {
        if !self.stopped.is_empty() || !self.cut.is_empty() {
            return Ok(());
        }
        let service = self.coordinator()?;
        let Ok(page) = service.get("/v1/datasets") else {
            return Ok(());
        };
        let page: serde_json::Value = serde_json::from_slice(&page)?;
        for dataset in page["datasets"].as_array().into_iter().flatten() {
            for file in dataset["files"].as_array().into_iter().flatten() {
                let path = format!(
                    "/v1/datasets/{}/files/{}",
                    dataset["dataset_id"].as_str().unwrap_or_default(),
                    file["path"].as_str().unwrap_or_default()
                );
                // The service or its store may be away; what it does send must be right.
                if let Ok(content) = service.get(&path) {
                    ensure!(
                        Some(sha256(&content).as_str()) == file["sha256"].as_str(),
                        "{path} is half-written"
                    );
                }
            }
        }
        Ok(())
    }

    /// What must be true after every trial.
    pub(super) fn judge(&mut self, id: &str) -> anyhow::Result<()> {
        let expected = undisturbed();
        let start = Instant::now();
        let status = loop {
            // One that was to die at its last step may do so just now.
            match self.coordinator()?.job(id) {
                Ok(status) => break status,
                Err(error) => ensure!(start.elapsed() < Duration::from_mins(1), "{error:#}"),
            }
        };
        ensure!(
            status.state == JobState::Succeeded && status.progress.runs_failed == 0,
            "{status:?}\n{}",
            self.logs()
        );
        ensure!(
            status.dataset_sha256.as_deref() == Some(expected),
            "the data set is another one: {status:?}"
        );
        self.look_as_a_reader()?;
        let runtime = tokio::runtime::Runtime::new()?;
        let job: JobId = id.parse()?;
        runtime.block_on(async {
            let ledger = Ledger::open(&self.database).await?;
            for (kind, runs) in [(ShardKind::Runs, RUNS), (ShardKind::Settling, 3)] {
                let mut next = 0;
                for shard in ledger.settled_shards(job, kind, 0, 10_000).await? {
                    ensure!(
                        shard.first_run == next && shard.state == ShardState::Committed,
                        "run {next} is not accounted for once: {shard:?}"
                    );
                    next += shard.run_count;
                }
                ensure!(next == runs, "{next} of {runs} {kind} are accounted for");
            }
            ledger.close().await;
            anyhow::Ok(())
        })?;
        self.check_orphans(&runtime, &status)
    }

    pub(super) fn check_orphans(
        &mut self,
        runtime: &tokio::runtime::Runtime,
        status: &JobStatus,
    ) -> anyhow::Result<()> {
        // A new coordinator sweeps when it starts: what late workers put goes then.
        for index in 0..self.coordinators.len() {
            self.coordinators[index] = None;
        }
        self.coordinator()?;
        let variables = self
            .environment
            .iter()
            .map(|(name, value)| ((*name).to_owned(), value.clone()));
        let blobs = Blobs::open_with(&self.store, variables)?;
        let start = Instant::now();
        loop {
            let shards = everything_below(runtime, &blobs, "shards")?;
            if shards.is_empty() {
                break;
            }
            ensure!(
                start.elapsed() < Duration::from_secs(30),
                "orphans stay: {shards:?}\n{}",
                self.logs()
            );
            std::thread::sleep(Duration::from_millis(200));
        }
        let id = status.dataset_id.as_ref().context("a published job has one")?;
        let listed = self.coordinator()?.get(&format!("/v1/datasets/{id}"))?;
        let listed: serde_json::Value = serde_json::from_slice(&listed)?;
        let mut listed: Vec<String> = listed["files"]
            .as_array()
            .into_iter()
            .flatten()
            .filter_map(|file| Some(format!("datasets/{id}/{}", file["path"].as_str()?)))
            .collect();
        listed.sort();
        let stored = everything_below(runtime, &blobs, "datasets")?;
        ensure!(stored == listed, "stored {stored:?}, listed {listed:?}");
        Ok(())
    }
}

/// Hash of the data set as one undisturbed worker makes it, on SQLite and a directory.
pub(super) fn undisturbed() -> &'static str {
    static HASH: std::sync::OnceLock<String> = std::sync::OnceLock::new();
    HASH.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let start = Start {
            workers: 1,
            ..Start::default()
        };
        let service = ServiceUnderTest::start(folder.path(), &start).unwrap();
        let id = service.submit(&job()).unwrap().job_id.to_string();
        let status = service.wait_for(&id, |status| status.state.is_final()).unwrap();
        service.terminate().unwrap();
        assert_eq!(status.state, JobState::Succeeded, "{status:?}");
        status.dataset_sha256.unwrap()
    })
}

/// What lies below a key, sorted: in a directory every file, also those that its store does not list.
pub(super) fn everything_below(
    runtime: &tokio::runtime::Runtime,
    blobs: &Blobs,
    key: &str,
) -> anyhow::Result<Vec<String>> {
    fn walk(folder: &Path, key: &str, found: &mut Vec<String>) -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let key = format!("{key}/{}", entry.file_name().to_string_lossy());
            if entry.file_type()?.is_dir() {
                walk(&entry.path(), &key, found)?;
            } else {
                found.push(key);
            }
        }
        Ok(())
    }
    let Some(folder) = blobs.local_path(key) else {
        return Ok(runtime.block_on(blobs.list(key))?);
    };
    loop {
        let mut found = Vec::new();
        match walk(&folder, key, &mut found) {
            // Something was deleted while it was looked at.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound && folder.exists() => {}
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error.into()),
            _ => {
                found.sort();
                return Ok(found);
            }
        }
    }
}
