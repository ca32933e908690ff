//! The trainer: a process of its own that takes trainings from the ledger, one after the other.
//!
//! A checkpoint directory per training, named after it, below the cache: a trainer that was killed goes
//! on where the last one stopped.

use super::machines::CheckedMachine;
use crate::calibration;
use anyhow::Context;
use hydroflex_dataset::Dataset;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::{Ledger, LedgerError, NewModel, TrainingClaim, identity};
use hydroflex_ml::evaluate::{evaluate, with_noise_of_training};
use hydroflex_ml::model::Model;
use hydroflex_ml::runs::Runs;
use hydroflex_ml::train::{self, TrainError};
use hydroflex_openapi::catalogue::FileEntry;
use hydroflex_openapi::dataset::{DatasetSource, SplitName};
use hydroflex_openapi::id::ModelId;
use hydroflex_openapi::model::ModelSummary;
use hydroflex_openapi::status::TrainingProgress;
use hydroflex_openapi::sweep::CellResult;
use hydroflex_worker::machines::Machines;
use sha2::{Digest, Sha256};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::sync::watch;

/// How often an idle trainer looks for work, and a busy one reports.
const LOOK: Duration = Duration::from_millis(300);
/// How often a trainer reports that it lives.
const BEAT: Duration = Duration::from_secs(1);

/// How a trainer works.
#[derive(Debug, Clone)]
pub struct TrainerConfig {
    /// Database URL.
    pub database: String,
    /// Store URL.
    pub store: String,
    /// Directory for checkpoints.
    pub cache: PathBuf,
}

/// Trains until told to stop.
///
/// # Errors
/// If the database or store cannot be used.
pub async fn work(config: TrainerConfig, mut stop: watch::Receiver<bool>) -> anyhow::Result<()> {
    let ledger = loop {
        match Ledger::open(&config.database).await {
            Ok(ledger) => break ledger,
            Err(error) if error.is_transient() => tracing::debug!(%error, "waiting for the database"),
            Err(error) => return Err(error).context("cannot open the database"),
        }
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(()),
            () = tokio::time::sleep(LOOK) => {}
        }
    };
    let blobs = Blobs::open(&config.store)?;
    let machines = Arc::new(Machines::new(config.cache.clone()));
    for life in 1.. {
        let name = identity::worker_name("trainer", life);
        let ended = live(&ledger, &blobs, &machines, &config.cache, &name, stop.clone()).await;
        // A claim whose answer was lost is in nobody's hands as long as this name counts as alive.
        let _ = ledger.give_up_worker(&name, "its trainer stopped").await;
        match ended {
            Err(error) if error.is_transient() => {
                tracing::warn!(trainer = name, %error, "the database is away; trying again");
            }
            ended => return ended.context("the database refuses the trainer"),
        }
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(()),
            () = tokio::time::sleep(BEAT) => {}
        }
    }
    Ok(())
}

/// Trains under one name, until told to stop or given up.
async fn live(
    ledger: &Ledger,
    blobs: &Blobs,
    machines: &Arc<Machines>,
    cache: &Path,
    name: &str,
    stop: watch::Receiver<bool>,
) -> Result<(), LedgerError> {
    ledger.register_worker(name, None).await?;
    let mut heart = tokio::spawn(beat(ledger.clone(), name.to_owned()));
    let ended = tokio::select! {
        ended = serve(ledger, blobs, machines, cache, name, stop) => ended,
        // Given up: somebody else may have the training. The supervisor starts us anew.
        _ = &mut heart => Ok(()),
    };
    heart.abort();
    ended
}

async fn serve(
    ledger: &Ledger,
    blobs: &Blobs,
    machines: &Arc<Machines>,
    cache: &Path,
    name: &str,
    mut stop: watch::Receiver<bool>,
) -> Result<(), LedgerError> {
    loop {
        // After an error nobody knows whether a training was begun: it ends this life.
        if let Some(claim) = ledger.begin_training(name).await? {
            crash_point("train-begin");
            let training = claim.training.id;
            tracing::info!(%training, attempt = claim.training.attempt, "training begun");
            if let Err(error) = attempt(ledger, blobs, machines, cache, &claim, &stop).await {
                let reason = format!("{error:#}");
                tracing::warn!(%training, reason, "training attempt lost");
                ledger
                    .lose_training(training, claim.training.epoch, &reason)
                    .await?;
            }
        }
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(()),
            () = tokio::time::sleep(LOOK) => {}
        }
    }
}

/// One attempt. `Ok` if the training is over or was given back; an error is worth another attempt.
async fn attempt(
    ledger: &Ledger,
    blobs: &Blobs,
    machines: &Arc<Machines>,
    cache: &Path,
    claim: &TrainingClaim,
    stop: &watch::Receiver<bool>,
) -> anyhow::Result<()> {
    let folder = cache.join("trainings").join(claim.training.id.to_string());
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let (dataset, temporary) = blobs.folder(&claim.dataset.key(""), &claim.dataset.files).await?;
    let latest = Arc::new(std::sync::Mutex::new(None));
    let cancel = Arc::new(AtomicBool::new(false));
    let mut work = tokio::task::spawn_blocking({
        let (spec, folder) = (claim.training.spec.clone(), folder.clone());
        let (latest, cancel) = (latest.clone(), cancel.clone());
        let (machines, blobs) = (machines.clone(), blobs.clone());
        move || {
            let _temporary = temporary;
            learn(&dataset, &spec, &machines, &blobs, &folder, &latest, &cancel)
        }
    });
    let mut reported = None;
    let learned = loop {
        tokio::select! {
            done = &mut work => break done,
            () = tokio::time::sleep(LOOK) => {
                let progress: Option<TrainingProgress> = latest.lock().ok().and_then(|latest| latest.clone());
                let wanted = match &progress {
                    Some(progress) if reported != Some(progress.epoch) => {
                        reported = Some(progress.epoch);
                        ledger.report_training(claim, progress).await
                    }
                    _ => ledger.holds_training(claim).await,
                };
                if matches!(wanted, Ok(false)) || *stop.borrow() {
                    cancel.store(true, Ordering::Relaxed);
                }
            }
        }
    };
    let judged = match learned.context("the training panicked")? {
        Ok(judged) => judged,
        Err(TrainError::Cancelled { .. }) => {
            // Told to stop: the checkpoint is kept and the attempt given back. If the training was
            // cancelled, it is no longer ours and this changes nothing.
            ledger.release_training(claim).await?;
            return Ok(());
        }
        Err(TrainError::Checkpoint(error)) => {
            return Err(error).context("cannot write the checkpoint");
        }
        Err(error) => {
            ledger.fail_training(claim, &error.to_string()).await?;
            return Ok(());
        }
    };
    register(ledger, blobs, claim, &folder.join("model"), judged).await?;
    let _ = std::fs::remove_dir_all(&folder);
    Ok(())
}

fn learn(
    dataset: &Path,
    spec: &hydroflex_openapi::job::TrainingSpec,
    machines: &Machines,
    blobs: &Blobs,
    folder: &Path,
    latest: &std::sync::Mutex<Option<TrainingProgress>>,
    cancel: &AtomicBool,
) -> Result<Option<CellResult>, TrainError> {
    let dataset = Dataset::open(dataset)?;
    let long = calibration_runs(&dataset, machines, blobs);
    let mut report = |progress: train::Progress| {
        if let Ok(mut latest) = latest.lock() {
            *latest = Some(TrainingProgress {
                epoch: progress.epoch as u64,
                epochs: progress.epochs.unwrap_or(0) as u64,
                fraction: progress.fraction,
                loss: Some(progress.train_loss),
                validation_loss: progress.validation_loss,
            });
        }
        if cancel.load(Ordering::Relaxed) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let summary = train::train_dataset(
        &dataset,
        spec,
        long.as_ref(),
        &mut report,
        &folder.join("checkpoint"),
        &folder.join("model"),
    )?;
    match judge(&dataset, &folder.join("model"), &summary) {
        Ok(judged) => Ok(Some(judged)),
        Err(error) => {
            let reason = format!("{error:#}");
            tracing::warn!(reason, "the model cannot be judged on its data set");
            Ok(None)
        }
    }
}

/// The model and simple estimators on the data set's test runs, or its validation runs where there are none.
fn judge(dataset: &Dataset, folder: &Path, summary: &ModelSummary) -> anyhow::Result<CellResult> {
    let model = Model::load(folder).context("the model that was just written cannot be read")?;
    let runs = hydroflex_ml::dataset::evaluation_runs(dataset, &model)?;
    let runs = with_noise_of_training(&model, &runs, model.config().provenance.spec.seed)?;
    let report = evaluate(&model, &runs, dataset.dataset_sha256())?.report;
    let has_tests = dataset.runs().iter().any(|run| run.split == SplitName::Test);
    Ok(CellResult {
        window_steps: summary.window_steps as u64,
        window_s: summary.window_s,
        parameters: summary.parameters as u64,
        epochs: summary.epochs as u64,
        judged_on: if has_tests { "test" } else { "validation" }.to_owned(),
        runs: report.runs as u64,
        targets: report.targets,
        baselines: report.baselines,
    })
}

/// Long runs of the data set's job; none if they cannot be made, which the model's provenance shows.
fn calibration_runs(dataset: &Dataset, machines: &Machines, blobs: &Blobs) -> Option<Runs> {
    let DatasetSource::Job { spec } = &dataset.manifest().source else {
        return None;
    };
    let made = machines
        .ready(spec, blobs)
        .map_err(anyhow::Error::from)
        .and_then(|ready| calibration::simulate(spec, &CheckedMachine::new(ready)));
    match made {
        Ok(runs) => Some(runs),
        Err(error) => {
            let reason = format!("{error:#}");
            tracing::warn!(
                reason,
                "no long calibration runs; the validation runs calibrate alone"
            );
            None
        }
    }
}

/// Puts the model folder into the store under its content's name, then registers it.
async fn register(
    ledger: &Ledger,
    blobs: &Blobs,
    claim: &TrainingClaim,
    folder: &Path,
    judged: Option<CellResult>,
) -> anyhow::Result<()> {
    let model = Model::load(folder).context("the model that was just written cannot be read")?;
    let id = ModelId::of_sha256(model.sha256())?;
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let content = std::fs::read(entry.path())?;
        files.push(FileEntry {
            path: entry.file_name().to_string_lossy().into_owned(),
            size_bytes: content.len() as u64,
            sha256: hex::encode(Sha256::digest(&content)),
        });
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    for file in &files {
        blobs
            .upload(&folder.join(&file.path), &format!("models/{id}/{}", file.path))
            .await?;
    }
    crash_point("train-commit");
    let metrics = serde_json::json!({
        "validation": model.config().validation,
        "validation_least_squares": model.config().validation_least_squares,
        "judged": judged,
    });
    let new = NewModel {
        id,
        sha256: model.sha256().to_owned(),
        metrics,
        files,
    };
    if ledger.commit_training(claim, &new).await? {
        tracing::info!(training = %claim.training.id, model = %new.id, "model registered");
    }
    Ok(())
}

/// Ends when the trainer has been given up.
async fn beat(ledger: Ledger, name: String) {
    while !matches!(ledger.beat(&name).await, Ok(false)) {
        tokio::time::sleep(BEAT).await;
    }
}
