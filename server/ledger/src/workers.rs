//! Workers: one row per process start. A shard is lost when the worker that holds it is.

use crate::engine::values;
use crate::{Ledger, LedgerError, clock};

/// A worker as its watcher sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Beat {
    /// Worker.
    pub worker: String,
    /// How often it has reported; a number that stands still means a worker that does.
    pub beat: u64,
    /// Instruction-set level of its numbers; `None` if it takes no shards.
    pub instruction_set: Option<String>,
}

impl Ledger {
    /// Enters a worker under a name that has never been used, with the instruction-set level that its
    /// numbers depend on; `None` for one that takes no shards.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn register_worker(
        &self,
        name: &str,
        instruction_set: Option<&str>,
    ) -> Result<(), LedgerError> {
        self.pool
            .execute(
                "INSERT INTO workers (name, state, beat, started_ms, instruction_set) VALUES ($1, 'alive', 0, $2, $3)",
                values![name, clock::now_ms(), instruction_set.map(str::to_owned)],
            )
            .await
            .map(drop)
    }

    /// Reports that a worker lives. False if it has been given up: what it held is no longer its.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn beat(&self, name: &str) -> Result<bool, LedgerError> {
        let changed = self
            .pool
            .execute(
                "UPDATE workers SET beat = beat + 1 WHERE name = $1 AND state = 'alive'",
                values![name],
            )
            .await?;
        Ok(changed == 1)
    }

    /// Beats of the workers that count as alive.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn beats(&self) -> Result<Vec<Beat>, LedgerError> {
        self.pool
            .rows(
                "SELECT name, beat, instruction_set FROM workers WHERE state = 'alive' ORDER BY name",
                &[],
            )
            .await?
            .iter()
            .map(|row| {
                Ok(Beat {
                    worker: row.text("name")?,
                    beat: row.count("beat")?,
                    instruction_set: row.optional_text("instruction_set")?,
                })
            })
            .collect()
    }

    /// Gives a worker up: every shard and training in its hands is lost to it, and whatever it does
    /// later is fenced off. Doing so twice, or to a name never seen, changes nothing.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn give_up_worker(&self, name: &str, reason: &str) -> Result<(), LedgerError> {
        self.pool
            .execute("UPDATE workers SET state = 'gone' WHERE name = $1", values![name])
            .await?;
        self.recover_lost(reason).await.map(drop)
    }

    /// Takes back every shard and training whose worker is gone; returns how many. Safe to repeat:
    /// also the cure for a coordinator that died between the two steps of giving a worker up.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn recover_lost(&self, reason: &str) -> Result<u64, LedgerError> {
        let shards = self
            .pool
            .rows(
                "SELECT s.id, s.epoch FROM shards s JOIN workers w ON w.name = s.worker \
                 WHERE s.state = 'running' AND w.state = 'gone'",
                &[],
            )
            .await?;
        let mut recovered = 0;
        for row in &shards {
            recovered += u64::from(
                self.lose_shard(row.parse("id")?, row.count("epoch")?, reason)
                    .await?,
            );
        }
        let trainings = self
            .pool
            .rows(
                "SELECT t.id, t.epoch FROM trainings t JOIN workers w ON w.name = t.worker \
                 WHERE t.state = 'running' AND w.state = 'gone'",
                &[],
            )
            .await?;
        for row in &trainings {
            recovered += u64::from(
                self.lose_training(row.parse("id")?, row.count("epoch")?, reason)
                    .await?,
            );
        }
        Ok(recovered)
    }
}
