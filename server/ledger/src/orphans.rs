//! Objects that nothing names: found, and deleted when nobody can be putting them.
//!
//! ```text
//! shards/JOB/…     of jobs that are over and cleaned up: a late worker put them
//! datasets/ID/…    of no data set: an attempt to publish was cancelled, or died
//! ```
//!
//! A data set's objects have the same names in every attempt, so age alone does not make them orphans:
//! an attempt announces itself in the ledger before it puts the first one ([`Ledger::announce_upload`]),
//! and each object is deleted in a transaction in which nobody can ([`Ledger::abandoned`]).

use crate::blobs::{BlobError, Blobs};
use crate::engine::{Transaction, values};
use crate::{Ledger, LedgerError};
use hydroflex_openapi::id::{DatasetId, JobId};
use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

/// Why orphans could not be looked for.
#[derive(Debug, thiserror::Error)]
pub enum OrphanError {
    /// The ledger did not answer.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The store did not answer.
    #[error(transparent)]
    Blob(#[from] BlobError),
}

/// What a collector has seen, by its own monotonic clock.
#[derive(Debug)]
pub struct Orphans {
    grace: Duration,
    /// Data sets that exist, which is for ever.
    named: HashSet<DatasetId>,
    /// Folders that belonged to no data set when they were first seen.
    unnamed: HashMap<DatasetId, Instant>,
}

impl Orphans {
    /// A collector that leaves objects of no data set alone for `grace`.
    #[must_use]
    pub fn new(grace: Duration) -> Self {
        Self {
            grace,
            named: HashSet::new(),
            unnamed: HashMap::new(),
        }
    }

    /// Deletes what nothing names; returns how many objects that were. What is not ours is not touched.
    ///
    /// # Errors
    /// Passes on what ledger and store say; what is left is found again.
    pub async fn sweep(&mut self, ledger: &Ledger, blobs: &Blobs) -> Result<u64, OrphanError> {
        let mut deleted = 0;
        for name in blobs.folders("shards").await? {
            let Ok(job) = name.parse::<JobId>() else { continue };
            if ledger.is_collected(job).await? {
                deleted += blobs.delete_below(&format!("shards/{job}")).await?;
            }
        }
        let mut unnamed = HashMap::new();
        for name in blobs.folders("datasets").await? {
            let Ok(id) = name.parse::<DatasetId>() else {
                continue;
            };
            if self.named.contains(&id) {
                continue;
            }
            if ledger.dataset(&id).await?.is_some() {
                // Every object of it is there; what is not whole is of an attempt that died.
                blobs.remove_interrupted_puts(&format!("datasets/{id}"));
                self.named.insert(id);
                continue;
            }
            let since = self.unnamed.get(&id).copied().unwrap_or_else(Instant::now);
            if since.elapsed() >= self.grace {
                deleted += delete_abandoned(ledger, blobs, &id).await?;
            }
            unnamed.insert(id, since);
        }
        self.unnamed = unnamed;
        Ok(deleted)
    }
}

/// One object in each transaction: whoever is stopped in the middle has one deletion under way, not hundreds.
async fn delete_abandoned(ledger: &Ledger, blobs: &Blobs, id: &DatasetId) -> Result<u64, OrphanError> {
    let folder = format!("datasets/{id}");
    let mut deleted = 0;
    for key in blobs.list(&folder).await? {
        let Some(abandoned) = ledger.abandoned(id).await? else {
            return Ok(deleted);
        };
        blobs.delete(&key).await?;
        abandoned.release().await?;
        deleted += 1;
    }
    // With nothing listed nobody was asked yet whether somebody puts there.
    if let Some(abandoned) = ledger.abandoned(id).await? {
        blobs.remove_interrupted_puts(&folder);
        abandoned.release().await?;
        blobs.remove_empty_folders(&folder);
    }
    Ok(deleted)
}

/// A data set's name while nobody can begin to put its objects.
pub struct Abandoned {
    transaction: Transaction,
    dataset: DatasetId,
}

impl Abandoned {
    /// Lets others begin.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn release(mut self) -> Result<(), LedgerError> {
        forget(&mut self.transaction, &self.dataset).await?;
        self.transaction.commit().await
    }
}

/// Whoever holds this row's lock is alone with the data set's name.
async fn lock(tx: &mut Transaction, dataset: &DatasetId) -> Result<(), LedgerError> {
    tx.execute(
        "INSERT INTO uploads (dataset_id, job_id) VALUES ($1, '') \
         ON CONFLICT (dataset_id, job_id) DO UPDATE SET job_id = excluded.job_id",
        values![dataset.as_str()],
    )
    .await
    .map(drop)
}

/// Forgets who announced a data set that is published, or that nobody is putting.
pub(crate) async fn forget(tx: &mut Transaction, dataset: &DatasetId) -> Result<(), LedgerError> {
    tx.execute(
        "DELETE FROM uploads WHERE dataset_id = $1",
        values![dataset.as_str()],
    )
    .await
    .map(drop)
}

impl Ledger {
    /// Says that a job's data set is about to be put: its objects stay until the job is over.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn announce_upload(&self, job: JobId, dataset: &DatasetId) -> Result<(), LedgerError> {
        let mut tx = self.pool.begin().await?;
        lock(&mut tx, dataset).await?;
        tx.execute(
            "INSERT INTO uploads (dataset_id, job_id) VALUES ($1, $2) ON CONFLICT (dataset_id, job_id) DO NOTHING",
            values![dataset.as_str(), job.to_string()],
        )
        .await?;
        tx.commit().await
    }

    /// Holds the name of a data set that does not exist and that no unfinished job is putting, until it is
    /// released or dropped. `None` if it exists, or somebody is.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn abandoned(&self, dataset: &DatasetId) -> Result<Option<Abandoned>, LedgerError> {
        let mut tx = self.pool.begin().await?;
        lock(&mut tx, dataset).await?;
        let wanted = tx
            .row(
                "SELECT id FROM datasets WHERE id = $1 UNION ALL SELECT j.id FROM uploads u \
                 JOIN jobs j ON j.id = u.job_id WHERE u.dataset_id = $1 \
                 AND j.state IN ('queued', 'simulating', 'publishing')",
                values![dataset.as_str()],
            )
            .await?;
        Ok(wanted.is_none().then(|| Abandoned {
            transaction: tx,
            dataset: dataset.clone(),
        }))
    }
}
