//! A shard on its way: its object into the store, then the commit that makes it count. It goes beside the
//! simulation of the next shard, one at a time.

use crate::outage::Outage;
use crate::shard::EncodedShard;
use hydroflex_ledger::blobs::{BlobError, Blobs};
use hydroflex_ledger::crash::crash_point;
use hydroflex_ledger::{Claim, CommitOutcome, Ledger, LedgerError, ShardResult};
use std::time::{Duration, Instant};
use tokio::task::JoinHandle;
use tracing::Instrument;

/// Pause before a commit is tried again.
const PAUSE: Duration = Duration::from_millis(500);

/// Takes finished shards away.
pub(crate) struct Delivery {
    office: Office,
    under_way: Option<JoinHandle<Result<Put, LedgerError>>>,
    outage: Outage,
}

/// What became of a shard's object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Put {
    Taken,
    /// The store did not take it for so long that the shard was given back.
    Refused,
}

#[derive(Clone)]
struct Office {
    ledger: Ledger,
    blobs: Blobs,
    patience: Duration,
}

impl Delivery {
    /// With nothing under way. The database or the store may be away for `patience` before a shard is given
    /// back.
    pub(crate) fn new(ledger: Ledger, blobs: Blobs, patience: Duration) -> Self {
        Self {
            office: Office {
                ledger,
                blobs,
                patience,
            },
            under_way: None,
            outage: Outage::new(patience),
        }
    }

    /// True while the object of a shard is on its way.
    pub(crate) fn is_under_way(&self) -> bool {
        self.under_way.is_some()
    }

    /// What the store has refused lately.
    pub(crate) fn outage(&mut self) -> &mut Outage {
        &mut self.outage
    }

    /// Sends a shard off. The one before must have arrived ([`Delivery::finish`]).
    pub(crate) fn begin(&mut self, claim: Claim, encoded: EncodedShard) {
        debug_assert!(self.under_way.is_none());
        let office = self.office.clone();
        let deliver = async move { office.deliver(&claim, encoded).await };
        self.under_way = Some(tokio::spawn(deliver.in_current_span()));
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
            Ok(put) => {
                match put? {
                    Put::Taken => self.outage.over(),
                    Put::Refused => self.outage.refused(),
                }
                Ok(())
            }
            Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
            // Only a runtime that ends cancels it: nobody is left to be told.
            Err(_) => Ok(()),
        }
    }
}

impl Office {
    /// Puts the object, then commits: in this order, so that what is committed is there.
    async fn deliver(&self, claim: &Claim, encoded: EncodedShard) -> Result<Put, LedgerError> {
        let object = claim.object();
        let start = Instant::now();
        if let Err(error) = self.put(&object, &encoded).await {
            // The runs have no part in it, so it is no attempt of theirs.
            tracing::warn!(%error, object, "the object could not be put; giving the shard back");
            self.ledger.release_shard(claim).await?;
            return Ok(Put::Refused);
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
        Ok(Put::Taken)
    }

    async fn put(&self, object: &str, encoded: &EncodedShard) -> Result<(), BlobError> {
        let start = Instant::now();
        let mut pause = Duration::from_millis(100);
        loop {
            match self.blobs.create(object, encoded.content.clone()).await {
                Ok(()) => return Ok(()),
                // Nobody else has this name: an earlier try of ours has worked without telling.
                Err(error) if error.is_already_there() => return Ok(()),
                Err(error) if start.elapsed() > self.patience => return Err(error),
                Err(error) => tracing::warn!(%error, object, "put failed; trying again"),
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(Duration::from_secs(5));
        }
    }

    async fn commit(&self, claim: &Claim, result: &ShardResult) -> Result<CommitOutcome, LedgerError> {
        let start = Instant::now();
        loop {
            match self.ledger.commit_shard(claim, result).await {
                Err(error) if error.is_transient() && start.elapsed() < self.patience => {
                    tracing::warn!(%error, "commit failed; trying again");
                    tokio::time::sleep(PAUSE).await;
                }
                outcome => return outcome,
            }
        }
    }
}
