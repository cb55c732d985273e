//! The coordinator's state on disk: one SQLite file that an operator can read; `migrations/` is its reference.

mod artifacts;
mod events;
mod frames;
mod jobs;
mod tasks;
#[cfg(test)]
mod tests;
mod workers;

use std::{path::Path, time::Duration};

use sqlx::{
    Sqlite, SqlitePool, Transaction,
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous},
};
use thiserror::Error;

pub(crate) use self::events::TaskEvent;
pub use self::{
    artifacts::Artifact,
    frames::{CommittedFrame, FrameRecord, ImageRecord, ViewRecord},
    jobs::{JobRecord, NewJob, Summary},
    tasks::{AttemptOutcome, OrphanedLease, TaskRecord},
    workers::WorkerRecord,
};

/// Connections to the file; SQLite admits one writer at a time.
const CONNECTIONS: u32 = 4;
/// Longest wait for another writer.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);

/// Why the state could not be read or written.
#[derive(Debug, Error)]
pub enum StoreError {
    /// SQLite refuses.
    #[error("coordinator state: {0}; check that the disk is not full and the file is not damaged")]
    Database(#[from] sqlx::Error),
    /// The file is of another version.
    #[error("coordinator state: {0}; use the version of trackersplat that wrote it, or another root folder")]
    Migration(#[from] sqlx::migrate::MigrateError),
    /// A value in the file is none that this version writes.
    #[error("coordinator state: {place} is '{value}'; the file was changed by hand or by another version")]
    Value {
        /// Table and column.
        place: &'static str,
        /// What stands there.
        value: String,
    },
}

impl StoreError {
    /// Whether the state was closed before the request came.
    pub fn is_closed(&self) -> bool {
        matches!(self, Self::Database(sqlx::Error::PoolClosed))
    }
}

/// The state on disk. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Store {
    pool: SqlitePool,
}

/// One atomic change; dropped without [`Change::commit`] it never happened.
pub struct Change {
    transaction: Transaction<'static, Sqlite>,
}

impl Store {
    /// Opens the file, creating it if there is none, and brings its schema up to date.
    pub async fn open(file: &Path) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new()
            .filename(file)
            .create_if_missing(true)
            .foreign_keys(true)
            .journal_mode(SqliteJournalMode::Wal)
            // With WAL, FULL makes a commit survive power loss: a worker's receipt must not outlive the result.
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(BUSY_TIMEOUT);
        let pool = SqlitePoolOptions::new().max_connections(CONNECTIONS).connect_with(options).await?;
        sqlx::migrate!().run(&pool).await?;
        Ok(Self { pool })
    }

    /// Begins a change. It holds SQLite's write lock from the start, so that it never fails half-way for being late.
    pub async fn change(&self) -> Result<Change, StoreError> {
        Ok(Change { transaction: self.pool.begin_with("BEGIN IMMEDIATE").await? })
    }

    /// Writes everything to the file and closes it.
    pub async fn close(&self) {
        self.pool.close().await;
    }
}

impl Change {
    /// Makes the change durable.
    pub async fn commit(self) -> Result<(), StoreError> {
        Ok(self.transaction.commit().await?)
    }
}

/// SQLite's integers are signed; sizes and sequence numbers stay far below the limit.
fn signed(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn unsigned(value: i64) -> u64 {
    u64::try_from(value).unwrap_or(0)
}
