//! Events of a job: numbered from 1 without gaps, inside the transaction of what they tell.

use crate::engine::{Transaction, values};
use crate::{Ledger, LedgerError, clock};
use hydroflex_openapi::event::{EventKind, JobEvent};
use hydroflex_openapi::id::JobId;

/// Appends an event. The row of the job is locked by the update until the transaction ends, so
/// sequence numbers appear in commit order.
pub(crate) async fn append(tx: &mut Transaction, job: JobId, event: &EventKind) -> Result<(), LedgerError> {
    let row = tx
        .row(
            "UPDATE jobs SET last_sequence = last_sequence + 1 WHERE id = $1 RETURNING last_sequence",
            values![job.to_string()],
        )
        .await?
        .ok_or_else(|| LedgerError::NoJob { id: job.to_string() })?;
    tx.execute(
        "INSERT INTO events (job_id, sequence, at_ms, body) VALUES ($1, $2, $3, $4)",
        values![
            job.to_string(),
            row.count("last_sequence")?,
            clock::now_ms(),
            serde_json::to_string(event)?
        ],
    )
    .await?;
    Ok(())
}

impl Ledger {
    /// Events of a job after a sequence number, oldest first.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn events(&self, job: JobId, after: u64, limit: u64) -> Result<Vec<JobEvent>, LedgerError> {
        self.pool
            .rows(
                "SELECT sequence, at_ms, body FROM events WHERE job_id = $1 AND sequence > $2 \
                 ORDER BY sequence LIMIT $3",
                values![job.to_string(), after, limit],
            )
            .await?
            .iter()
            .map(|row| {
                Ok(JobEvent {
                    sequence: row.count("sequence")?,
                    at: clock::rfc3339(row.int("at_ms")?),
                    what: row.json("body")?,
                })
            })
            .collect()
    }
}
