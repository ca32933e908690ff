//! Sweeps: many trainings on one data set, asked for at once.
//!
//! A sweep has no state of its own to get out of step with: its cells are trainings like all others, and how
//! far it is follows from them.

use crate::artefacts::insert_training;
use crate::engine::{Row, values};
use crate::jobs::{IdempotencyKey, claim_key};
use crate::record::TrainingRecord;
use crate::{Created, Ledger, LedgerError, clock};
use hydroflex_openapi::id::{DatasetId, SweepId};
use hydroflex_openapi::job::TrainingSpec;
use hydroflex_openapi::status::TrainingState;
use hydroflex_openapi::sweep::{SweepProgress, SweepRequest, SweepStatus};

/// A sweep as it was asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepRecord {
    /// Identifier.
    pub id: SweepId,
    /// Data set that its networks learn from.
    pub dataset_id: DatasetId,
    /// The request, lists filled in.
    pub spec: SweepRequest,
    /// When it was accepted, ms since 1970.
    pub created_ms: i64,
}

/// A cell of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepCellRecord {
    /// Its training.
    pub training: TrainingRecord,
    /// What was measured of its model, once there is one.
    pub metrics: Option<serde_json::Value>,
}

impl SweepRecord {
    fn read(row: &Row) -> Result<Self, LedgerError> {
        Ok(Self {
            id: row.parse("id")?,
            dataset_id: row.parse("dataset_id")?,
            spec: row.json("spec")?,
            created_ms: row.int("created_ms")?,
        })
    }

    /// As the contract shows it.
    #[must_use]
    pub fn status(&self, progress: SweepProgress, finished_ms: Option<i64>) -> SweepStatus {
        let state = progress.state();
        SweepStatus {
            sweep_id: self.id,
            dataset_id: self.dataset_id.clone(),
            state,
            progress,
            spec: self.spec.clone(),
            created_at: clock::rfc3339(self.created_ms),
            finished_at: finished_ms.filter(|_| state.is_final()).map(clock::rfc3339),
        }
    }
}

impl Ledger {
    /// Accepts a sweep with all its trainings at once.
    ///
    /// # Errors
    /// [`LedgerError::KeyReused`]; what the database says.
    pub async fn create_sweep(
        &self,
        spec: &SweepRequest,
        cells: &[TrainingSpec],
        key: Option<&IdempotencyKey>,
    ) -> Result<Created<SweepId>, LedgerError> {
        let id = SweepId::generate();
        let mut tx = self.pool.begin().await?;
        if let Some(before) = claim_key(&mut tx, key, id).await? {
            return Ok(Created::Before(before));
        }
        tx.execute(
            "INSERT INTO sweeps (id, dataset_id, spec, created_ms) VALUES ($1, $2, $3, $4)",
            values![
                id.to_string(),
                spec.dataset_id.as_str(),
                serde_json::to_string(spec)?,
                clock::now_ms()
            ],
        )
        .await?;
        for cell in cells {
            insert_training(&mut tx, None, Some(id), &spec.dataset_id, cell).await?;
        }
        tx.commit().await?;
        Ok(Created::New(id))
    }

    /// One sweep.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn sweep(&self, id: SweepId) -> Result<Option<SweepRecord>, LedgerError> {
        self.pool
            .row("SELECT * FROM sweeps WHERE id = $1", values![id.to_string()])
            .await?
            .as_ref()
            .map(SweepRecord::read)
            .transpose()
    }

    /// Sweeps, newest first, after the one that `before` names.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn sweeps(&self, before: Option<SweepId>, limit: u64) -> Result<Vec<SweepRecord>, LedgerError> {
        // Identifiers are ordered by time; no hexadecimal digit sorts after `g`, in whatever order a database has for text.
        let before = before.map_or_else(|| "g".to_owned(), |id| id.to_string());
        self.pool
            .rows(
                "SELECT * FROM sweeps WHERE id < $1 ORDER BY id DESC LIMIT $2",
                values![before, limit],
            )
            .await?
            .iter()
            .map(SweepRecord::read)
            .collect()
    }

    /// How far a sweep is, and when its last training ended.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn sweep_progress(&self, id: SweepId) -> Result<(SweepProgress, Option<i64>), LedgerError> {
        let rows = self
            .pool
            .rows(
                "SELECT state, COUNT(*) AS n, MAX(finished_ms) AS finished_ms FROM trainings \
                 WHERE sweep_id = $1 GROUP BY state",
                values![id.to_string()],
            )
            .await?;
        let mut progress = SweepProgress::default();
        let mut finished = None;
        for row in &rows {
            let count = row.count("n")?;
            progress.total += count;
            match row.parse("state")? {
                TrainingState::Open => progress.open = count,
                TrainingState::Running => progress.running = count,
                TrainingState::Succeeded => progress.succeeded = count,
                TrainingState::Failed => progress.failed = count,
                TrainingState::Cancelled => progress.cancelled = count,
            }
            finished = finished.max(row.optional_int("finished_ms")?);
        }
        Ok((progress, finished))
    }

    /// Cells of a sweep in the order of the request, with what was measured so far.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn sweep_cells(&self, id: SweepId) -> Result<Vec<SweepCellRecord>, LedgerError> {
        self.pool
            .rows(
                "SELECT t.*, m.metrics AS metrics FROM trainings t LEFT JOIN models m ON m.id = t.model_id \
                 WHERE t.sweep_id = $1 ORDER BY t.id",
                values![id.to_string()],
            )
            .await?
            .iter()
            .map(|row| {
                let metrics = match row.optional_text("metrics")? {
                    Some(_) => Some(row.json("metrics")?),
                    None => None,
                };
                Ok(SweepCellRecord {
                    training: TrainingRecord::read(row)?,
                    metrics,
                })
            })
            .collect()
    }

    /// Sweeps of which a training is not over.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn unfinished_sweeps(&self) -> Result<u64, LedgerError> {
        let row = self
            .pool
            .row(
                "SELECT COUNT(DISTINCT sweep_id) AS n FROM trainings WHERE state IN ('open', 'running')",
                &[],
            )
            .await?;
        row.map_or(Ok(0), |row| row.count("n"))
    }

    /// Ends what a sweep has left; models that are there stay. Returns how many trainings that were.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn cancel_sweep(&self, id: SweepId) -> Result<u64, LedgerError> {
        self.pool
            .execute(
                "UPDATE trainings SET state = 'cancelled', reason = $2, finished_ms = $3 \
                 WHERE sweep_id = $1 AND state IN ('open', 'running')",
                values![id.to_string(), "cancelled on request", clock::now_ms()],
            )
            .await
    }

    /// Opens again what failed or was cancelled of a sweep. Returns how many trainings that were.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn retry_sweep(&self, id: SweepId) -> Result<u64, LedgerError> {
        self.pool
            .execute(
                "UPDATE trainings SET state = 'open', attempt = 0, worker = NULL, reason = NULL, \
                 finished_ms = NULL WHERE sweep_id = $1 AND state IN ('failed', 'cancelled')",
                values![id.to_string()],
            )
            .await
    }
}
