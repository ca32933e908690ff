//! The two database engines behind one small surface: values in, rows out, transactions.
//!
//! Statements are written once, in the SQL that SQLite and PostgreSQL share (`$1` parameters,
//! `RETURNING`, `ON CONFLICT`); [`Engine`] tells the few places where they differ.

use crate::LedgerError;
use sqlx::postgres::{PgConnectOptions, PgConnection, PgPool, PgPoolOptions, PgRow};
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteRow, SqliteSynchronous,
};
use sqlx::{Connection as _, Executor as _, Postgres, Row as _, Sqlite};
use std::str::FromStr;
use std::time::Duration;

/// Which database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    /// Embedded: one file, one machine.
    Sqlite,
    /// The engine that several machines share.
    Postgres,
}

/// A parameter. NULL is typed, because PostgreSQL wants to know.
#[derive(Debug, Clone)]
pub(crate) enum Value {
    Int(Option<i64>),
    Real(f64),
    Text(Option<String>),
}

impl From<i64> for Value {
    fn from(value: i64) -> Self {
        Self::Int(Some(value))
    }
}
impl From<u64> for Value {
    /// Counts of runs, epochs and bytes: the contract keeps them far below 2^63.
    fn from(value: u64) -> Self {
        Self::Int(Some(i64::try_from(value).unwrap_or(i64::MAX)))
    }
}
impl From<f64> for Value {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}
impl From<&str> for Value {
    fn from(value: &str) -> Self {
        Self::Text(Some(value.to_owned()))
    }
}
impl From<String> for Value {
    fn from(value: String) -> Self {
        Self::Text(Some(value))
    }
}
impl From<Option<i64>> for Value {
    fn from(value: Option<i64>) -> Self {
        Self::Int(value)
    }
}
impl From<Option<String>> for Value {
    fn from(value: Option<String>) -> Self {
        Self::Text(value)
    }
}

/// Parameters of one statement.
macro_rules! values {
    ($($value:expr),* $(,)?) => { &[$($crate::engine::Value::from($value)),*] };
}
pub(crate) use values;

/// A row of either engine, read by column name.
pub(crate) enum Row {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

impl Row {
    pub(crate) fn int(&self, column: &str) -> Result<i64, LedgerError> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(column)?,
            Self::Postgres(row) => row.try_get(column)?,
        })
    }

    pub(crate) fn count(&self, column: &str) -> Result<u64, LedgerError> {
        let value = self.int(column)?;
        u64::try_from(value).map_err(|_| LedgerError::corrupt(column, &value.to_string()))
    }

    pub(crate) fn real(&self, column: &str) -> Result<f64, LedgerError> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(column)?,
            Self::Postgres(row) => row.try_get(column)?,
        })
    }

    pub(crate) fn optional_int(&self, column: &str) -> Result<Option<i64>, LedgerError> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(column)?,
            Self::Postgres(row) => row.try_get(column)?,
        })
    }

    pub(crate) fn optional_text(&self, column: &str) -> Result<Option<String>, LedgerError> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(column)?,
            Self::Postgres(row) => row.try_get(column)?,
        })
    }

    pub(crate) fn text(&self, column: &str) -> Result<String, LedgerError> {
        self.optional_text(column)?
            .ok_or_else(|| LedgerError::corrupt(column, "NULL"))
    }

    /// A text column in its own type.
    pub(crate) fn parse<T: FromStr>(&self, column: &str) -> Result<T, LedgerError> {
        let text = self.text(column)?;
        text.parse().map_err(|_| LedgerError::corrupt(column, &text))
    }

    /// A nullable text column in its own type.
    pub(crate) fn parse_optional<T: FromStr>(&self, column: &str) -> Result<Option<T>, LedgerError> {
        self.optional_text(column)?
            .map(|text| text.parse().map_err(|_| LedgerError::corrupt(column, &text)))
            .transpose()
    }

    /// A JSON column in its own type.
    pub(crate) fn json<T: serde::de::DeserializeOwned>(&self, column: &str) -> Result<T, LedgerError> {
        let text = self.text(column)?;
        serde_json::from_str(&text).map_err(|_| LedgerError::corrupt(column, &text))
    }
}

/// Connections to one database.
#[derive(Clone)]
pub(crate) enum Pool {
    Sqlite(SqlitePool),
    Postgres(PgPool),
}

/// A transaction; rolled back when dropped.
pub(crate) enum Transaction {
    Sqlite(sqlx::Transaction<'static, Sqlite>),
    Postgres(sqlx::Transaction<'static, Postgres>),
}

/// How long a writer waits for another one before it gives up. Transactions here take milliseconds,
/// but a full disk queue or a stopped process can hold one much longer.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
/// What PostgreSQL is told by every session: nobody sleeps in a transaction for longer, and a peer that
/// does not answer for half a minute is gone.
const GIVE_UP_THE_SILENT: &str = "SET idle_in_transaction_session_timeout = '15s'; \
    SET tcp_keepalives_idle = 10; SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 4; \
    SET tcp_user_timeout = '30s'";

macro_rules! bind_all {
    ($statement:expr, $parameters:expr) => {{
        let mut statement = sqlx::query($statement);
        for parameter in $parameters {
            statement = match parameter.clone() {
                Value::Int(value) => statement.bind(value),
                Value::Real(value) => statement.bind(value),
                Value::Text(value) => statement.bind(value),
            };
        }
        statement
    }};
}

/// A single attempt to reach PostgreSQL.
async fn once(options: &PgConnectOptions) -> Result<(), sqlx::Error> {
    let attempt = async { PgConnection::connect_with(options).await?.close().await };
    tokio::time::timeout(Duration::from_secs(5), attempt)
        .await
        .unwrap_or(Err(sqlx::Error::PoolTimedOut))
}

impl Pool {
    /// Connects; `sqlite:PATH` and `sqlite://PATH` make the file if it is absent.
    pub(crate) async fn connect(url: &str, connections: u32) -> Result<Self, LedgerError> {
        if let Some(path) = url.strip_prefix("sqlite:") {
            refuse_network_file_system(path)?;
            let options = SqliteConnectOptions::from_str(url)?
                .create_if_missing(true)
                .journal_mode(SqliteJournalMode::Wal)
                .synchronous(SqliteSynchronous::Full)
                .busy_timeout(BUSY_TIMEOUT)
                .foreign_keys(true);
            // On a full disk SQLite may end a transaction by itself, which sqlx does not notice: such a
            // connection refuses every further transaction, so it is closed instead of handed out again.
            let pool = SqlitePoolOptions::new()
                .max_connections(connections)
                .acquire_timeout(BUSY_TIMEOUT)
                .before_acquire(|connection, _| Box::pin(async move { Ok(!connection.is_in_transaction()) }))
                .connect_with(options)
                .await?;
            Ok(Self::Sqlite(pool))
        } else if url.starts_with("postgres:") || url.starts_with("postgresql:") {
            // Once by itself: the pool would try for long without a word.
            let options = PgConnectOptions::from_str(url)?;
            if let Err(error) = once(&options).await {
                tracing::warn!(
                    host = options.get_host(),
                    port = options.get_port(),
                    %error,
                    "the database does not answer; trying for {} s",
                    BUSY_TIMEOUT.as_secs()
                );
            }
            let pool = PgPoolOptions::new()
                .max_connections(connections)
                .acquire_timeout(BUSY_TIMEOUT)
                // A machine that is cut off in the middle of a transaction holds its locks until the server
                // gives it up, by default after two hours: every other worker would wait for it.
                .after_connect(|connection, _| {
                    Box::pin(async move { connection.execute(GIVE_UP_THE_SILENT).await.map(drop) })
                })
                .connect_with(options.clone())
                .await;
            match pool {
                Ok(pool) => Ok(Self::Postgres(pool)),
                // The pool has tried again and again, and does not say what stood in the way.
                Err(sqlx::Error::PoolTimedOut) => {
                    once(&options).await?;
                    Err(sqlx::Error::PoolTimedOut.into())
                }
                Err(error) => Err(error.into()),
            }
        } else {
            // The URL may hold a password: only its scheme is repeated.
            let scheme = url.split(':').next().unwrap_or_default().to_owned();
            Err(LedgerError::UnknownEngine { scheme })
        }
    }

    pub(crate) fn engine(&self) -> Engine {
        match self {
            Self::Sqlite(_) => Engine::Sqlite,
            Self::Postgres(_) => Engine::Postgres,
        }
    }

    pub(crate) async fn rows(&self, sql: &'static str, with: &[Value]) -> Result<Vec<Row>, LedgerError> {
        Ok(match self {
            Self::Sqlite(pool) => bind_all!(sql, with)
                .fetch_all(pool)
                .await?
                .into_iter()
                .map(Row::Sqlite)
                .collect(),
            Self::Postgres(pool) => bind_all!(sql, with)
                .fetch_all(pool)
                .await?
                .into_iter()
                .map(Row::Postgres)
                .collect(),
        })
    }

    pub(crate) async fn row(&self, sql: &'static str, with: &[Value]) -> Result<Option<Row>, LedgerError> {
        Ok(self.rows(sql, with).await?.into_iter().next())
    }

    pub(crate) async fn execute(&self, sql: &'static str, with: &[Value]) -> Result<u64, LedgerError> {
        Ok(match self {
            Self::Sqlite(pool) => bind_all!(sql, with).execute(pool).await?.rows_affected(),
            Self::Postgres(pool) => bind_all!(sql, with).execute(pool).await?.rows_affected(),
        })
    }

    /// Begins a transaction that will write. SQLite takes its write lock at once, so that a
    /// transaction never has to be repeated because another one wrote after it had read.
    pub(crate) async fn begin(&self) -> Result<Transaction, LedgerError> {
        Ok(match self {
            Self::Sqlite(pool) => Transaction::Sqlite(pool.begin_with("BEGIN IMMEDIATE").await?),
            Self::Postgres(pool) => Transaction::Postgres(pool.begin().await?),
        })
    }

    /// Runs a script of several statements.
    pub(crate) async fn script(transaction: &mut Transaction, sql: &'static str) -> Result<(), LedgerError> {
        match transaction {
            Transaction::Sqlite(tx) => sqlx::raw_sql(sql).execute(&mut **tx).await.map(drop)?,
            Transaction::Postgres(tx) => sqlx::raw_sql(sql).execute(&mut **tx).await.map(drop)?,
        }
        Ok(())
    }

    pub(crate) async fn close(&self) {
        match self {
            Self::Sqlite(pool) => pool.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
    }
}

impl Transaction {
    pub(crate) async fn rows(&mut self, sql: &'static str, with: &[Value]) -> Result<Vec<Row>, LedgerError> {
        Ok(match self {
            Self::Sqlite(tx) => bind_all!(sql, with)
                .fetch_all(&mut **tx)
                .await?
                .into_iter()
                .map(Row::Sqlite)
                .collect(),
            Self::Postgres(tx) => bind_all!(sql, with)
                .fetch_all(&mut **tx)
                .await?
                .into_iter()
                .map(Row::Postgres)
                .collect(),
        })
    }

    pub(crate) async fn row(
        &mut self,
        sql: &'static str,
        with: &[Value],
    ) -> Result<Option<Row>, LedgerError> {
        Ok(self.rows(sql, with).await?.into_iter().next())
    }

    pub(crate) async fn execute(&mut self, sql: &'static str, with: &[Value]) -> Result<u64, LedgerError> {
        Ok(match self {
            Self::Sqlite(tx) => bind_all!(sql, with).execute(&mut **tx).await?.rows_affected(),
            Self::Postgres(tx) => bind_all!(sql, with).execute(&mut **tx).await?.rows_affected(),
        })
    }

    pub(crate) async fn commit(self) -> Result<(), LedgerError> {
        match self {
            Self::Sqlite(tx) => tx.commit().await?,
            Self::Postgres(tx) => tx.commit().await?,
        }
        Ok(())
    }
}

/// SQLite's locks and its write-ahead log need a file system of this machine: over a network two
/// writers can both believe that they hold the lock.
fn refuse_network_file_system(path: &str) -> Result<(), LedgerError> {
    let path = path
        .trim_start_matches("//")
        .split('?')
        .next()
        .unwrap_or_default();
    let folder = match std::path::Path::new(path).parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => std::path::Path::new("."),
    };
    match nix::sys::statfs::statfs(folder) {
        Ok(facts) => match network_name(facts.filesystem_type().0.cast_unsigned()) {
            Some(name) => Err(LedgerError::NetworkFileSystem {
                folder: folder.to_owned(),
                name,
            }),
            None => Ok(()),
        },
        // A folder that is not there is told by whoever opens the file.
        Err(_) => Ok(()),
    }
}

/// Network file systems by the magic number of `statfs`, as in Linux' `magic.h`.
fn network_name(magic: u64) -> Option<&'static str> {
    match magic & 0xffff_ffff {
        0x6969 => Some("NFS"),
        0x517b | 0xff53_4d42 | 0xfe53_4d42 => Some("SMB"),
        0x0102_1997 => Some("9p"),
        0x00c3_6400 => Some("Ceph"),
        0x0bd0_0bd0 => Some("Lustre"),
        0x4750_4653 => Some("GPFS"),
        0x1983_0326 => Some("BeeGFS"),
        0x5346_414f => Some("AFS"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_local_folder_is_accepted_and_a_network_file_system_named() {
        assert!(refuse_network_file_system("/proc/../tmp/ledger.sqlite").is_ok());
        assert!(refuse_network_file_system("//ledger.sqlite?mode=rwc").is_ok());
        assert_eq!(network_name(0x6969), Some("NFS"));
        assert_eq!(network_name(0xff53_4d42), Some("SMB"));
        // ext, XFS, btrfs, tmpfs, overlay
        for local in [0xef53, 0x5846_5342, 0x9123_683e, 0x0102_1994, 0x794c_7630] {
            assert_eq!(network_name(local), None);
        }
    }
}
