//! What coordinator and workers share: jobs, shards with fencing epochs, events, artefacts, and blobs.
//!
//! The ledger decides what is true. A worker may be slow, stopped, killed or cut off at any moment and
//! come back later: its commit counts only if it still holds the epoch under which it began.
//!
//! - `transition`: the life of a shard as a pure function
//! - `engine`: SQLite and PostgreSQL behind one small surface
//! - `jobs`, `shards`, `workers`, `artefacts`, `sweeps`, `aliases`, `events`: what can be done, one transaction each
//! - `keys`: who may use the REST interface
//! - `blobs`: objects in a directory, or in S3 (`s3`) over TLS (`tls`)
//! - `crash`: places where tests let a process die
//!
//! Deliberately absent: a queue. Workers claim straight from the table of shards. Also absent: any
//! comparison of clocks. Whether a worker lives is judged by whoever watches its beat count up.

pub mod transition;
mod engine;
mod error;
mod record;
mod jobs;
mod shards;
mod workers;
mod artefacts;
mod sweeps;
pub mod orphans;
mod aliases;
mod events;
pub mod keys;
pub mod blobs;
mod s3;
pub mod tls;
pub mod crash;
pub mod identity;
pub mod clock;

pub use aliases::{AliasCondition, AliasMove, AliasRecord};
pub use artefacts::{NewDataset, NewModel, TrainingClaim};
pub use engine::Engine;
pub use error::LedgerError;
pub use jobs::{Created, IdempotencyKey, NewJob};
pub use record::{DatasetRecord, JobRecord, ModelRecord, ShardRecord, TrainingRecord};
pub use shards::{Claim, CommitOutcome, ShardKind, ShardResult};
pub use sweeps::{SweepCellRecord, SweepRecord};
pub use workers::Beat;

use engine::{Pool, values};
use std::time::Duration;

/// One script per schema version, in order; a released one never changes.
const SCHEMA: [&str; 7] = [
    include_str!("../migrations/0001_ledger.sql"),
    include_str!("../migrations/0002_aliases.sql"),
    include_str!("../migrations/0003_keys.sql"),
    include_str!("../migrations/0004_instruction_sets.sql"),
    include_str!("../migrations/0005_uploads.sql"),
    include_str!("../migrations/0006_sweeps.sql"),
    include_str!("../migrations/0007_rounds.sql"),
];

/// The shared record of what is to be done and what is done.
#[derive(Clone)]
pub struct Ledger {
    pool: Pool,
}

impl Ledger {
    /// Opens the database and makes or upgrades its schema: for coordinators.
    ///
    /// # Errors
    /// Refuses unknown engines and schemas of newer builds; passes on what the database says.
    pub async fn create(url: &str) -> Result<Self, LedgerError> {
        let ledger = Self {
            pool: Pool::connect(url, 8).await?,
        };
        ledger.migrate().await?;
        Ok(ledger)
    }

    /// Opens a database that a coordinator has set up: for workers.
    ///
    /// # Errors
    /// [`LedgerError::NoSchema`] if no coordinator has.
    pub async fn open(url: &str) -> Result<Self, LedgerError> {
        let ledger = Self {
            pool: Pool::connect(url, 3).await?,
        };
        match ledger.schema_version().await? {
            0 => Err(LedgerError::NoSchema),
            version => Self::refuse_newer(version).map(|()| ledger),
        }
    }

    /// Which database this is.
    #[must_use]
    pub fn engine(&self) -> Engine {
        self.pool.engine()
    }

    /// Longest pause of a worker between two looks for work: a file of this machine is asked by a few, a server
    /// by hundreds.
    #[must_use]
    pub fn longest_idle(&self) -> Duration {
        match self.engine() {
            Engine::Sqlite => Duration::from_millis(20),
            Engine::Postgres => Duration::from_millis(100),
        }
    }

    /// Answers if the database does.
    ///
    /// # Errors
    /// Passes on what the database says.
    pub async fn ping(&self) -> Result<(), LedgerError> {
        self.pool.rows("SELECT 1 AS one", &[]).await.map(drop)
    }

    /// Waits for running statements and closes every connection.
    pub async fn close(&self) {
        self.pool.close().await;
    }

    fn refuse_newer(found: u64) -> Result<(), LedgerError> {
        let known = SCHEMA.len() as u64;
        if found > known {
            Err(LedgerError::NewerSchema { found, known })
        } else {
            Ok(())
        }
    }

    async fn schema_version(&self) -> Result<u64, LedgerError> {
        let table = match self.engine() {
            Engine::Sqlite => "SELECT COUNT(*) AS n FROM sqlite_master WHERE name = 'hydroflex_schema'",
            Engine::Postgres => {
                "SELECT COUNT(*) AS n FROM pg_tables \
                 WHERE tablename = 'hydroflex_schema' AND schemaname = current_schema()"
            }
        };
        match self.pool.row(table, &[]).await? {
            Some(row) if row.int("n")? > 0 => {}
            _ => return Ok(0),
        }
        match self.pool.row("SELECT version FROM hydroflex_schema", &[]).await? {
            Some(row) => row.count("version"),
            None => Ok(0),
        }
    }

    async fn migrate(&self) -> Result<(), LedgerError> {
        Self::refuse_newer(self.schema_version().await?)?;
        let mut tx = self.pool.begin().await?;
        if self.engine() == Engine::Postgres {
            // Two coordinators may start at once; SQLite's write lock orders them by itself.
            tx.execute("SELECT pg_advisory_xact_lock(4879128)", &[]).await?;
        }
        tx.execute(
            "CREATE TABLE IF NOT EXISTS hydroflex_schema (version BIGINT NOT NULL)",
            &[],
        )
        .await?;
        let done = if let Some(row) = tx.row("SELECT version FROM hydroflex_schema", &[]).await? {
            row.count("version")?
        } else {
            tx.execute("INSERT INTO hydroflex_schema (version) VALUES (0)", &[])
                .await?;
            0
        };
        for (index, script) in SCHEMA.into_iter().enumerate() {
            if index as u64 >= done {
                Pool::script(&mut tx, script).await?;
            }
        }
        tx.execute(
            "UPDATE hydroflex_schema SET version = $1",
            values![SCHEMA.len() as u64],
        )
        .await?;
        tx.commit().await
    }
}
