//! What can go wrong in the ledger.

/// Why the ledger did not answer.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// The URL names no database that we know.
    #[error("a database URL begins with sqlite: or postgres:, not {scheme:?}")]
    UnknownEngine {
        /// Text before the first colon.
        scheme: String,
    },
    /// SQLite on a network file system.
    #[error(
        "{} is on {name}, a network file system, where SQLite is not safe; use a local directory, or PostgreSQL \
         (--database postgres://…) for several machines",
        folder.display()
    )]
    NetworkFileSystem {
        /// Folder of the database.
        folder: std::path::PathBuf,
        /// Its file system.
        name: &'static str,
    },
    /// The database refused, or could not be reached.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// The database holds no ledger yet: the coordinator makes it.
    #[error("the database holds no hydroflex ledger yet; start the coordinator first")]
    NoSchema,
    /// The database was written by a newer hydroflex.
    #[error("the ledger has schema version {found}, this build knows up to {known}")]
    NewerSchema {
        /// Version in the database.
        found: u64,
        /// Newest version of this build.
        known: u64,
    },
    /// A column holds what no hydroflex wrote.
    #[error("column {column} holds {value:?}")]
    Corrupt {
        /// Column.
        column: String,
        /// Value, shortened.
        value: String,
    },
    /// An idempotency key was used before with another body.
    #[error("the idempotency key {key:?} was used before with another body")]
    KeyReused {
        /// Key.
        key: String,
    },
    /// No such job.
    #[error("no job {id}")]
    NoJob {
        /// Job.
        id: String,
    },
    /// The operating system has no random numbers.
    #[error("no random numbers: {0}")]
    Random(String),
    /// A contract type that JSON cannot hold.
    #[error("cannot write as JSON: {0}")]
    Json(#[from] serde_json::Error),
}

impl LedgerError {
    pub(crate) fn corrupt(column: &str, value: &str) -> Self {
        Self::Corrupt {
            column: column.to_owned(),
            value: value.chars().take(80).collect(),
        }
    }

    /// True if the same call may succeed later without anybody doing anything: the engine was busy,
    /// restarting or unreachable.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Database(error) => match error {
                sqlx::Error::Io(_)
                | sqlx::Error::PoolTimedOut
                | sqlx::Error::PoolClosed
                | sqlx::Error::WorkerCrashed
                | sqlx::Error::Protocol(_) => true,
                sqlx::Error::Database(database) => database.code().is_some_and(|code| {
                    // SQLite: BUSY 5, LOCKED 6, IOERR 10, FULL 13 (extended codes share the low byte).
                    // PostgreSQL: connection (08), resources (53), shutdown (57), serialisation (40).
                    match code.parse::<u32>() {
                        Ok(number) if number < 100_000 && code.len() < 5 => {
                            matches!(number & 0xff, 5 | 6 | 10 | 13)
                        }
                        _ => ["08", "53", "57", "40", "58"]
                            .iter()
                            .any(|class| code.starts_with(class)),
                    }
                }),
                _ => false,
            },
            _ => false,
        }
    }
}
