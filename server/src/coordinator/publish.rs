//! From committed shards to a visible data set.
//!
//! ```text
//! shards in run order ──► scratch directory ──► datasets/ID/… in the store ──► one transaction
//! ```
//!
//! The scratch directory fills while later runs are still simulated. A death anywhere before the
//! transaction leaves nothing that a reader could see; the next attempt writes the same bytes under the
//! same names.

use super::Coordinator;
use super::machines::CheckedMachine;
use hydroflex_dataset::{
    DirectorySink, PublishError, Published, Publisher, RunKind, RunRecord, ShardError, ShardReader,
};
use hydroflex_ledger::blobs::BlobError;
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::transition::ShardState;
use hydroflex_ledger::{JobRecord, LedgerError, NewDataset, ShardKind, ShardRecord};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::id::{DatasetId, IdError};
use hydroflex_openapi::problem::FieldError;
use hydroflex_sim::scenario::ScenarioError;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;

/// Reason in the data set of a run that killed every worker that tried it. The real reasons name
/// processes and times; they are in the job's events, because a data set holds neither.
const GIVEN_UP: &str = "given up: every attempt ended with the worker's failure";

/// Shards that wait for the writer, beside the one that is read: they may have 64 MiB each.
const READ_AHEAD: usize = 1;

/// How often the ledger is asked for the next shard while it is still simulated.
const POLL: Duration = Duration::from_millis(20);

/// Why a data set was not published.
#[derive(Debug, thiserror::Error)]
pub enum PublishFailure {
    /// The ledger did not answer.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The store did not answer, or an object is damaged.
    #[error(transparent)]
    Blob(#[from] BlobError),
    /// The machine of the job is refused by this build.
    #[error("the machine is refused by this build: {}", .0.detail)]
    Machine(FieldError),
    /// The machine of the job is not what it was when the job was accepted.
    #[error("this build's machine has SHA-256 {found}, the job was accepted with {expected}")]
    OtherMachine {
        /// As found.
        found: String,
        /// As accepted.
        expected: String,
    },
    /// The data set cannot be written.
    #[error("the data set cannot be written: {0}")]
    Write(#[from] PublishError),
    /// A shard cannot be read.
    #[error("shard {object} cannot be read: {source}")]
    Shard {
        /// Object.
        object: String,
        /// Cause.
        source: ShardError,
    },
    /// The shards do not cover the runs.
    #[error("the {kind} shards cover {found} runs, not {expected}")]
    Uncovered {
        /// Kind of runs.
        kind: ShardKind,
        /// Runs covered.
        found: u64,
        /// Runs of the job.
        expected: u64,
    },
    /// The job was ended by somebody else.
    #[error("the job is over")]
    Over,
    /// A run that was given up cannot be planned.
    #[error(transparent)]
    Plan(#[from] ScenarioError),
    /// The scratch directory fails.
    #[error("{}: {source}", path.display())]
    Scratch {
        /// File or directory.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A hash that is none.
    #[error(transparent)]
    Id(#[from] IdError),
    /// The writer ended without a word.
    #[error("the writer of the data set panicked: {0}")]
    Panicked(String),
}

impl PublishFailure {
    /// True if another try would fail in the same way.
    #[must_use]
    pub fn is_permanent(&self) -> bool {
        match self {
            Self::Ledger(error) => !error.is_transient(),
            // A full disk is a reason to wait, wherever it shows.
            Self::Blob(_)
            | Self::Scratch { .. }
            | Self::Write(PublishError::Sink { .. } | PublishError::Parquet { .. }) => false,
            _ => true,
        }
    }
}

/// What the writer is fed.
enum Feed {
    Object { name: String, content: bytes::Bytes },
    GivenUp { kind: RunKind, run_id: u64 },
}

/// Publishes the data set of a job that has been begun: writes what is simulated, waits for the rest.
///
/// # Errors
/// See [`PublishFailure`].
pub async fn publish(coordinator: &Coordinator, job: &JobRecord) -> Result<(), PublishFailure> {
    match publish_if_wanted(coordinator, job).await {
        Ok(()) | Err(PublishFailure::Over) => Ok(()),
        // The shards of a job that is over are deleted.
        Err(error) => match coordinator.ledger().job(job.id).await {
            Ok(Some(now)) if now.state.is_final() => Ok(()),
            _ => Err(error),
        },
    }
}

async fn publish_if_wanted(coordinator: &Coordinator, job: &JobRecord) -> Result<(), PublishFailure> {
    let machine = coordinator
        .machine(&job.spec)
        .await
        .map_err(PublishFailure::Machine)?;
    if machine.sha256() != job.machine_sha256 {
        return Err(PublishFailure::OtherMachine {
            found: machine.sha256().to_owned(),
            expected: job.machine_sha256.clone(),
        });
    }
    let scratch = Scratch::new(&coordinator.config().scratch, job)?;
    let published = write(coordinator, job, machine, &scratch.target()).await?;
    coordinator.ledger().begin_publishing(job.id).await?;
    crash_point("publish-written");
    let id = DatasetId::of_sha256(&published.dataset_sha256)?;
    let files: Vec<FileEntry> = published
        .files
        .iter()
        .map(|file| FileEntry {
            path: file.path.clone(),
            size_bytes: file.bytes,
            sha256: file.sha256.clone(),
        })
        .collect();
    // From here on until the job is over, what lies under the data set's name is no orphan.
    coordinator.ledger().announce_upload(job.id, &id).await?;
    for (number, file) in files.iter().enumerate() {
        let key = format!("datasets/{id}/{}", file.path);
        coordinator
            .blobs()
            .adopt(&scratch.target().join(&file.path), &key)
            .await?;
        if number == 0 {
            crash_point("publish-upload");
        }
    }
    crash_point("publish-commit");
    let dataset = NewDataset {
        id,
        sha256: published.dataset_sha256,
        spec: job.spec.clone(),
        runs: job.spec.runs,
        files,
        round: job.round,
    };
    let visible = coordinator
        .ledger()
        .publish_dataset(job.id, &dataset, &job.spec.train)
        .await?;
    crash_point("published");
    if visible {
        tracing::info!(job = %job.id, dataset = %dataset.id, "data set published");
    }
    Ok(())
}

/// Reads shards on async threads, writes the data set on a blocking one; a few shards of memory.
async fn write(
    coordinator: &Coordinator,
    job: &JobRecord,
    machine: Arc<CheckedMachine>,
    target: &Path,
) -> Result<Published, PublishFailure> {
    let (sender, receiver) = mpsc::channel(READ_AHEAD);
    let (spec, target) = (job.spec.clone(), target.to_owned());
    // Jobs that were begun before levels were recorded ran where we run.
    let level = job
        .instruction_set
        .clone()
        .unwrap_or_else(|| hydroflex_sim::instruction_set::level().to_owned());
    let writer = tokio::task::spawn_blocking(move || {
        let sink = DirectorySink::create(&target).map_err(|source| PublishFailure::Scratch {
            path: target.clone(),
            source,
        })?;
        let publisher = Publisher::with_encoders(
            machine.publish_spec(spec.clone(), &level),
            sink,
            crate::service::cores(),
        )?;
        let (published, sink) = consume(receiver, publisher, &spec, &machine)?;
        sink.commit()
            .map_err(|source| PublishFailure::Scratch { path: target, source })?;
        Ok(published)
    });
    let fed = async {
        feed(
            coordinator,
            job,
            ShardKind::Settling,
            job.spec.settling_runs,
            &sender,
        )
        .await?;
        feed(coordinator, job, ShardKind::Runs, job.spec.runs, &sender).await
    }
    .await;
    let failed_to_feed = match fed {
        Ok(true) | Err(_) => fed.err(),
        // The writer hung up: it knows why.
        Ok(false) => None,
    };
    if failed_to_feed.is_none() {
        drop(sender);
        return writer
            .await
            .map_err(|error| PublishFailure::Panicked(error.to_string()))?;
    }
    drop(sender);
    let _ = writer.await;
    match failed_to_feed {
        Some(error) => Err(error),
        None => Err(PublishFailure::Panicked(
            "feeding ended without a reason".to_owned(),
        )),
    }
}

/// Sends the shards of one kind in run order, as they are settled. False if the writer hung up.
async fn feed(
    coordinator: &Coordinator,
    job: &JobRecord,
    kind: ShardKind,
    expected: u64,
    sender: &mpsc::Sender<Feed>,
) -> Result<bool, PublishFailure> {
    let mut next = 0;
    while next < expected {
        // Asked before the shards are: a job that was complete then has them all.
        let Some(now) = coordinator.ledger().job(job.id).await? else {
            return Err(PublishFailure::Over);
        };
        if now.state.is_final() || now.round != job.round {
            return Err(PublishFailure::Over);
        }
        let before = next;
        let shards = coordinator
            .ledger()
            .settled_shards(job.id, kind, next, 64)
            .await?;
        for shard in &shards {
            if shard.first_run != next {
                break;
            }
            let item = fetch(coordinator, shard).await?;
            if sender.send(item).await.is_err() {
                return Ok(false);
            }
            next += shard.run_count;
        }
        if next == before {
            // Another coordinator may have had a shard done again since the job was asked.
            if now.is_complete()
                && let Some(job) = coordinator.ledger().job(job.id).await?
                && job.is_complete()
            {
                return Err(PublishFailure::Uncovered {
                    kind,
                    found: next,
                    expected,
                });
            }
            if sender.is_closed() {
                return Ok(false);
            }
            tokio::time::sleep(POLL).await;
        }
    }
    Ok(true)
}

async fn fetch(coordinator: &Coordinator, shard: &ShardRecord) -> Result<Feed, PublishFailure> {
    match (&shard.object, &shard.sha256) {
        (Some(object), Some(sha256)) if shard.state == ShardState::Committed => {
            let content = match coordinator.blobs().read(object, sha256).await {
                Ok(content) => content,
                Err(error) => {
                    if error.is_loss() {
                        let reason = error.to_string();
                        coordinator
                            .ledger()
                            .redo_shard(shard.id, shard.epoch, &reason)
                            .await?;
                    }
                    return Err(error.into());
                }
            };
            Ok(Feed::Object {
                name: object.clone(),
                content,
            })
        }
        _ => {
            let kind = match shard.kind {
                ShardKind::Runs => RunKind::Job,
                ShardKind::Settling => RunKind::Settling,
            };
            Ok(Feed::GivenUp {
                kind,
                run_id: shard.first_run,
            })
        }
    }
}

fn consume(
    mut receiver: mpsc::Receiver<Feed>,
    mut publisher: Publisher<DirectorySink>,
    spec: &hydroflex_openapi::job::JobSpec,
    machine: &CheckedMachine,
) -> Result<(Published, DirectorySink), PublishFailure> {
    while let Some(item) = receiver.blocking_recv() {
        match item {
            Feed::Object { name, content } => {
                let unreadable = |source| PublishFailure::Shard {
                    object: name.clone(),
                    source,
                };
                for record in ShardReader::open(Cursor::new(content)).map_err(unreadable)? {
                    let record: RunRecord = record.map_err(unreadable)?;
                    publisher.push(&record)?;
                }
            }
            Feed::GivenUp { kind, run_id } => {
                let planned = hydroflex_worker::run::plan(spec, machine.ready(), kind, run_id)?;
                publisher.push(&planned.failed(GIVEN_UP.to_owned()))?;
            }
        }
    }
    Ok(publisher.finish()?)
}

/// A directory of its own for one attempt; gone when the attempt is.
struct Scratch(PathBuf);

impl Scratch {
    fn new(root: &Path, job: &JobRecord) -> Result<Self, PublishFailure> {
        let path = root.join(format!("{}-{}", job.id, uuid::Uuid::now_v7()));
        std::fs::create_dir_all(&path).map_err(|source| PublishFailure::Scratch {
            path: path.clone(),
            source,
        })?;
        Ok(Self(path))
    }

    fn target(&self) -> PathBuf {
        self.0.join("dataset")
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
