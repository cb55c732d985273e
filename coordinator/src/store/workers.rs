//! The workers that were ever seen, for operators.

use trackersplat_proto::v1::Register;

use super::{Change, Store, StoreError};

/// A worker as an operator sees it.
#[derive(Clone, Debug, PartialEq, Eq, sqlx::FromRow)]
pub struct WorkerRecord {
    /// Stable across restarts of the worker.
    pub id: String,
    /// Device name for people.
    pub device: String,
    /// Whether its stream is open.
    pub connected: bool,
}

impl Store {
    /// Every worker that was ever seen.
    pub async fn workers(&self) -> Result<Vec<WorkerRecord>, StoreError> {
        let sql = "SELECT id, device, connected FROM workers ORDER BY id";
        Ok(sqlx::query_as(sql).fetch_all(&self.pool).await?)
    }
}

impl Change {
    /// A worker registered.
    pub async fn worker_connected(&mut self, worker: &Register) -> Result<(), StoreError> {
        let sql = "INSERT INTO workers (id, incarnation, engine, device, threads, version, connected, first_seen, \
                   last_seen) VALUES (?, ?, ?, ?, ?, ?, 1, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'), \
                   strftime('%Y-%m-%dT%H:%M:%fZ', 'now')) \
                   ON CONFLICT (id) DO UPDATE SET incarnation = excluded.incarnation, engine = excluded.engine, \
                   device = excluded.device, threads = excluded.threads, version = excluded.version, \
                   connected = 1, last_seen = excluded.last_seen";
        let query = sqlx::query(sql).bind(&worker.worker_id).bind(&worker.incarnation).bind(&worker.engine);
        let query = query.bind(&worker.device).bind(worker.threads).bind(&worker.version);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A worker's stream is closed.
    pub async fn worker_gone(&mut self, worker_id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE workers SET connected = 0, last_seen = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE id = ?";
        sqlx::query(sql).bind(worker_id).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// No worker is connected: the coordinator has just started.
    pub async fn all_workers_gone(&mut self) -> Result<(), StoreError> {
        sqlx::query("UPDATE workers SET connected = 0").execute(&mut *self.transaction).await?;
        Ok(())
    }
}
