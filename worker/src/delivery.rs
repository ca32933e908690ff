//! A shard on its way: its object into the store, then the commit that makes it count. It goes beside the
//! simulation of the next shard, one at a time.

use crate::shard::EncodedShard;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::{Claim, CommitOutcome, Ledger, LedgerError, ShardResult};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tracing::Instrument;

/// How long the database may be away before this worker's name is given up. The store may be away for longer: its
/// absence says nothing about the runs, so no attempt is charged for it.
const PATIENCE: Duration = Duration::from_mins(1);
/// Pause before a commit is tried again.
const PAUSE: Duration = Duration::from_millis(500);

/// Takes finished shards away.
pub(crate) struct Delivery {
    office: Office,
    under_way: Option<JoinHandle<Result<(), LedgerError>>>,
}

#[derive(Clone)]
struct Office {
    ledger: Ledger,
    blobs: Blobs,
    stop: watch::Receiver<bool>,
}

impl Delivery {
    /// With nothing under way. Once `stop` is true, what the store does not take is given back.
    pub(crate) fn new(ledger: Ledger, blobs: Blobs, stop: watch::Receiver<bool>) -> Self {
        Self {
            office: Office { ledger, blobs, stop },
            under_way: None,
        }
    }

    /// Sends a shard off. The one before must have arrived ([`Delivery::finish`]).
    pub(crate) fn begin(&mut self, claim: Claim, encoded: EncodedShard) {
        debug_assert!(self.under_way.is_none());
        let office = self.office.clone();
        let deliver = async move { office.deliver(&claim, encoded).await };
        self.under_way = Some(tokio::spawn(deliver.in_current_span()));
    }

    /// Whether a shard may still be on its way.
    pub(crate) fn is_under_way(&self) -> bool {
        self.under_way.as_ref().is_some_and(|task| !task.is_finished())
    }

    /// Waits for what is under way.
    ///
    /// # Errors
    /// What the ledger says.
    pub(crate) async fn finish(&mut self) -> Result<(), LedgerError> {
        let Some(under_way) = &mut self.under_way else {
            return Ok(());
        };
        let arrived = under_way.await;
        self.under_way = None;
        match arrived {
            Ok(outcome) => outcome,
            Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
            // Only a runtime that ends cancels it: nobody is left to be told.
            Err(_) => Ok(()),
        }
    }
}

impl Office {
    /// Puts the object, then commits: in this order, so that what is committed is there.
    async fn deliver(&self, claim: &Claim, encoded: EncodedShard) -> Result<(), LedgerError> {
        let object = claim.object();
        let start = Instant::now();
        if !self.put(claim, &object, &encoded).await? {
            return Ok(());
        }
        crash_point("put");
        let mut spent = encoded.spent;
        spent.put_s = start.elapsed().as_secs_f64();
        let result = ShardResult {
            size_bytes: encoded.content.len() as u64,
            sha256: encoded.sha256,
            failed_runs: encoded.failed_runs,
            object,
            spent,
        };
        let outcome = self.commit(claim, &result).await?;
        crash_point("commit");
        match outcome {
            CommitOutcome::Committed => tracing::debug!(simulate_s = spent.simulate_s, "committed"),
            CommitOutcome::Fenced => {
                tracing::info!(object = result.object, "fenced off; deleting the object");
                if let Err(error) = self.blobs.delete(&result.object).await {
                    tracing::warn!(%error, "an orphan stays until it is collected");
                }
            }
        }
        Ok(())
    }

    /// Puts the object, for as long as the shard is ours: to simulate it again would end here too. False if it was
    /// given back, or is somebody else's by now.
    async fn put(&self, claim: &Claim, object: &str, encoded: &EncodedShard) -> Result<bool, LedgerError> {
        let mut stop = self.stop.clone();
        let mut pause = Duration::from_millis(100);
        loop {
            match self.blobs.create(object, encoded.content.clone()).await {
                Ok(()) => return Ok(true),
                // Nobody else has this name: an earlier try of ours has worked without telling.
                Err(error) if error.is_already_there() => return Ok(true),
                Err(error) => tracing::warn!(%error, object, "put failed; trying again"),
            }
            if *stop.borrow() {
                tracing::warn!(
                    object,
                    "told to stop before the store took the object; the shard is given back"
                );
                self.ledger.release_shard(claim).await?;
                return Ok(false);
            }
            if let Ok(false) = self.ledger.holds(claim).await {
                tracing::debug!(object, "no longer wanted");
                return Ok(false);
            }
            tokio::select! {
                _ = stop.wait_for(|stop| *stop) => {}
                () = tokio::time::sleep(pause) => {}
            }
            pause = (pause * 2).min(Duration::from_secs(5));
        }
    }

    async fn commit(&self, claim: &Claim, result: &ShardResult) -> Result<CommitOutcome, LedgerError> {
        let start = Instant::now();
        loop {
            match self.ledger.commit_shard(claim, result).await {
                Err(error) if error.is_transient() && start.elapsed() < PATIENCE => {
                    tracing::warn!(%error, "commit failed; trying again");
                    tokio::time::sleep(PAUSE).await;
                }
                outcome => return outcome,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hydroflex_ledger::NewJob;
    use hydroflex_openapi::status::TimeSplit;
    use std::path::{Path, PathBuf};

    /// A claimed shard of two runs, in a new ledger below `folder`.
    async fn claimed(folder: &Path) -> (Ledger, Claim) {
        let url = format!("sqlite:{}", folder.join("ledger.sqlite").display());
        let ledger = Ledger::create(&url).await.unwrap();
        ledger.register_worker("a", None).await.unwrap();
        let job = NewJob {
            spec: serde_json::from_value(serde_json::json!({ "runs": 2, "settling_runs": 0 })).unwrap(),
            machine_sha256: "00".repeat(32),
            settling_shards: Vec::new(),
            run_shards: vec![2],
            notices: Vec::new(),
        };
        ledger.create_job(&job, None).await.unwrap();
        let claim = ledger.begin_shard("a").await.unwrap().unwrap();
        (ledger, claim)
    }

    fn encoded() -> EncodedShard {
        EncodedShard {
            content: "samples".into(),
            sha256: "00".repeat(32),
            failed_runs: 0,
            spent: TimeSplit::default(),
        }
    }

    /// A store that takes nothing of a claim: a file stands where a folder would be.
    fn away(folder: &Path, claim: &Claim) -> (Blobs, PathBuf) {
        let blobs = Blobs::open(&format!("file://{}", folder.join("store").display())).unwrap();
        let object = claim.object();
        let in_the_way = folder
            .join("store")
            .join(object.split('/').next().unwrap_or_default());
        std::fs::write(&in_the_way, "in the way").unwrap();
        (blobs, in_the_way)
    }

    #[tokio::test]
    async fn a_store_that_is_away_costs_no_attempt() {
        let folder = tempfile::tempdir().unwrap();
        let (ledger, claim) = claimed(folder.path()).await;
        let (blobs, in_the_way) = away(folder.path(), &claim);
        assert!(
            blobs.create(&claim.object(), "x".into()).await.is_err(),
            "it takes nothing"
        );
        let (_told, stop) = watch::channel(false);
        let mut delivery = Delivery::new(ledger.clone(), blobs, stop);
        delivery.begin(claim.clone(), encoded());
        tokio::time::sleep(Duration::from_secs(1)).await;
        assert!(ledger.holds(&claim).await.unwrap(), "still this worker's");
        std::fs::remove_file(in_the_way).unwrap();
        delivery.finish().await.unwrap();
        let progress = ledger.job(claim.job.id).await.unwrap().unwrap().progress;
        assert_eq!((progress.runs_done, progress.runs_failed), (2, 0));
    }

    #[tokio::test]
    async fn who_is_told_to_stop_gives_back_what_the_store_does_not_take() {
        let folder = tempfile::tempdir().unwrap();
        let (ledger, claim) = claimed(folder.path()).await;
        let (blobs, _in_the_way) = away(folder.path(), &claim);
        let (told, stop) = watch::channel(false);
        let mut delivery = Delivery::new(ledger.clone(), blobs, stop);
        delivery.begin(claim.clone(), encoded());
        told.send(true).unwrap();
        delivery.finish().await.unwrap();
        assert!(!ledger.holds(&claim).await.unwrap());
        let again = ledger.begin_shard("a").await.unwrap().unwrap();
        assert_eq!((again.shard.id, again.shard.attempt), (claim.shard.id, 1));
    }
}
