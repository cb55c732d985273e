//! What frames and the tracks of views have in common: states, leases and attempts.

use std::collections::BTreeSet;

use sqlx::FromRow;
use trackersplat_proto::v1::FailureKind;

use super::{Change, Store, StoreError, TaskEvent};
use crate::queue::{JobId, Lease, Task, TaskHistory, TaskKey, task::TaskState};

/// A task as it is.
#[derive(Clone, Debug, FromRow)]
pub struct TaskRecord {
    state: String,
    /// Leases given.
    pub attempts: u32,
    /// Attempts that failed.
    pub failures: u32,
    excluded: String,
    /// Worker of the last attempt.
    pub worker: String,
    /// From lease to result.
    pub seconds: f64,
}

/// A lease of a coordinator that is gone.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OrphanedLease {
    /// The lease.
    pub id: String,
    /// What it was for.
    pub key: TaskKey,
    /// Its attempt.
    pub attempt: u32,
    /// Who held it.
    pub worker: String,
}

/// How an attempt ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttemptOutcome<'a> {
    /// Its result is committed.
    Done,
    /// Given back through no fault of the task.
    Released(&'a str),
    /// The job was cancelled.
    Cancelled,
    /// It failed.
    Failed(FailureKind, &'a str),
}

impl TaskRecord {
    /// Where the task is.
    pub fn state(&self) -> Result<TaskState, StoreError> {
        TaskState::from_label(&self.state)
            .ok_or_else(|| StoreError::Value { place: "tasks.state", value: self.state.clone() })
    }

    /// What the queue must know.
    pub fn history(&self) -> Result<TaskHistory, StoreError> {
        let excluded: BTreeSet<String> = serde_json::from_str(&self.excluded)
            .map_err(|_| StoreError::Value { place: "tasks.excluded", value: self.excluded.clone() })?;
        Ok(TaskHistory { attempts: self.attempts, failures: self.failures, excluded, before: 0 })
    }
}

fn key_of_row(job: &str, kind: &str, number: u32) -> Result<TaskKey, StoreError> {
    let task = Task::from_row(kind, number)
        .ok_or_else(|| StoreError::Value { place: "tasks.kind", value: kind.to_owned() })?;
    Ok(TaskKey { job: JobId::from(job), task })
}

impl Store {
    /// One task.
    pub async fn task(&self, key: &TaskKey) -> Result<Option<TaskRecord>, StoreError> {
        let sql = "SELECT * FROM tasks WHERE job_id = ? AND kind = ? AND number = ?";
        let query = sqlx::query_as(sql).bind(&*key.job).bind(key.task.kind()).bind(key.task.number());
        Ok(query.fetch_optional(&self.pool).await?)
    }

    /// Whether a lease's result was committed, for a report that comes again.
    pub async fn was_committed(&self, lease_id: &str, attempt: u32) -> Result<bool, StoreError> {
        let sql = "SELECT COUNT(*) FROM attempts WHERE lease_id = ? AND attempt = ? AND outcome = 'done'";
        let query = sqlx::query_scalar(sql).bind(lease_id).bind(attempt);
        let count: i64 = query.fetch_one(&self.pool).await?;
        Ok(count > 0)
    }

    /// Kind and message of a task's last failed attempt.
    pub async fn last_failure(
        &self,
        job: &str,
        task: Task,
    ) -> Result<Option<(FailureKind, String)>, StoreError> {
        let sql = "SELECT outcome, message FROM attempts WHERE job_id = ? AND kind = ? AND number = ? \
                   AND outcome NOT IN ('running', 'done', 'released', 'cancelled') ORDER BY attempt DESC LIMIT 1";
        let query = sqlx::query_as(sql).bind(job).bind(task.kind()).bind(task.number());
        let row: Option<(String, String)> = query.fetch_optional(&self.pool).await?;
        Ok(row.map(|(kind, message)| (FailureKind::from_label(&kind), message)))
    }
}

impl Change {
    /// Tasks of a job that are ready or leased, inside this change, with their attempts.
    pub async fn open_tasks(&mut self, job: &str) -> Result<Vec<(TaskKey, u32)>, StoreError> {
        let sql = "SELECT kind, number, attempts FROM tasks WHERE job_id = ? AND state IN ('ready', 'leased') \
                   ORDER BY kind, number";
        let query = sqlx::query_as(sql).bind(job);
        let rows: Vec<(String, u32, u32)> = query.fetch_all(&mut *self.transaction).await?;
        let open =
            |(kind, number, attempts): (String, u32, u32)| Ok((key_of_row(job, &kind, number)?, attempts));
        rows.into_iter().map(open).collect()
    }

    /// The tracks of a view become ready for the first time. Tracks that are there already keep their state.
    pub async fn publish_tracks(&mut self, job: &str, position: u32) -> Result<(), StoreError> {
        let sql = "INSERT INTO tasks (job_id, kind, number, state, changed_at) \
                   VALUES (?, 'tracks', ?, 'ready', strftime('%Y-%m-%dT%H:%M:%fZ', 'now')) \
                   ON CONFLICT (job_id, kind, number) DO NOTHING";
        sqlx::query(sql).bind(job).bind(position).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A task's new state.
    pub async fn set_task_state(
        &mut self,
        job: &str,
        task: Task,
        state: TaskState,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE tasks SET state = ?, changed_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') \
                   WHERE job_id = ? AND kind = ? AND number = ?";
        let query = sqlx::query(sql).bind(state.label()).bind(job).bind(task.kind()).bind(task.number());
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// The tracks of a view are complete, after so many seconds of the last lease.
    pub async fn commit_tracks(&mut self, job: &str, position: u32, seconds: f64) -> Result<(), StoreError> {
        let task = Task::Tracks(position);
        self.set_task_state(job, task, TaskState::Done).await?;
        self.add_seconds(job, task, seconds).await
    }

    /// A window of the tracks of a view is complete, and another one is left: the view is ready again.
    pub async fn continue_tracks(
        &mut self,
        key: &TaskKey,
        attempt: u32,
        worker: &str,
        seconds: f64,
    ) -> Result<(), StoreError> {
        self.add_seconds(&key.job, key.task, seconds).await?;
        self.release_task(key, attempt, worker).await
    }

    async fn add_seconds(&mut self, job: &str, task: Task, seconds: f64) -> Result<(), StoreError> {
        let sql = "UPDATE tasks SET seconds = seconds + ? WHERE job_id = ? AND kind = ? AND number = ?";
        let query = sqlx::query(sql).bind(seconds).bind(job).bind(task.kind()).bind(task.number());
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A worker got the lease of a task.
    pub async fn grant(&mut self, lease: &Lease) -> Result<(), StoreError> {
        let (job, task) = (&*lease.key.job, lease.key.task);
        self.set_task_state(job, task, TaskState::Leased).await?;
        let sql = "UPDATE tasks SET attempts = ?, worker = ? WHERE job_id = ? AND kind = ? AND number = ?";
        let query = sqlx::query(sql).bind(lease.attempt).bind(&lease.worker_id).bind(job);
        query.bind(task.kind()).bind(task.number()).execute(&mut *self.transaction).await?;
        let sql = "INSERT INTO attempts (job_id, kind, number, attempt, lease_id, worker, granted_at) \
                   VALUES (?, ?, ?, ?, ?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))";
        let query = sqlx::query(sql).bind(job).bind(task.kind()).bind(task.number()).bind(lease.attempt);
        query.bind(&lease.id).bind(&lease.worker_id).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// An attempt ended.
    pub async fn end_attempt(
        &mut self,
        lease_id: &str,
        outcome: AttemptOutcome<'_>,
    ) -> Result<(), StoreError> {
        let (label, message) = match outcome {
            AttemptOutcome::Done => ("done", ""),
            AttemptOutcome::Released(reason) => ("released", reason),
            AttemptOutcome::Cancelled => ("cancelled", ""),
            AttemptOutcome::Failed(kind, message) => (kind.label(), message),
        };
        let sql = "UPDATE attempts SET outcome = ?, message = ?, \
                   ended_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE lease_id = ?";
        let query = sqlx::query(sql).bind(label).bind(message).bind(lease_id);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Counts a failed attempt of a task; `excluded` names the worker that must not get it again.
    pub async fn count_failure(
        &mut self,
        job: &str,
        task: Task,
        excluded: Option<&str>,
    ) -> Result<(), StoreError> {
        // The worker is appended to the JSON list.
        let sql = "UPDATE tasks SET failures = failures + 1, \
                   excluded = CASE WHEN ?1 = '' THEN excluded ELSE json_insert(excluded, '$[#]', ?1) END \
                   WHERE job_id = ?2 AND kind = ?3 AND number = ?4";
        let query = sqlx::query(sql).bind(excluded.unwrap_or_default()).bind(job);
        query.bind(task.kind()).bind(task.number()).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A task gets on: it has all its attempts again.
    pub async fn forget_failures(&mut self, key: &TaskKey) -> Result<(), StoreError> {
        let sql = "UPDATE tasks SET failures = 0 \
                   WHERE job_id = ? AND kind = ? AND number = ? AND failures > 0";
        let query = sqlx::query(sql).bind(&*key.job).bind(key.task.kind()).bind(key.task.number());
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Gives the failed and cancelled tasks of a job all their attempts again, and says so.
    pub async fn reopen_tasks(&mut self, job: &str) -> Result<(), StoreError> {
        let sql = "SELECT kind, number FROM tasks WHERE job_id = ? AND state IN ('failed', 'cancelled') \
                   ORDER BY kind, number";
        let query = sqlx::query_as(sql).bind(job);
        let rows: Vec<(String, u32)> = query.fetch_all(&mut *self.transaction).await?;
        for (kind, number) in rows {
            self.reopen_task(job, key_of_row(job, &kind, number)?.task).await?;
        }
        Ok(())
    }

    /// An ended task is ready again, with all its attempts.
    pub async fn reopen_task(&mut self, job: &str, task: Task) -> Result<(), StoreError> {
        self.set_task_state(job, task, TaskState::Ready).await?;
        let sql =
            "UPDATE tasks SET failures = 0, excluded = '[]' WHERE job_id = ? AND kind = ? AND number = ?";
        let query = sqlx::query(sql).bind(job).bind(task.kind()).bind(task.number());
        query.execute(&mut *self.transaction).await?;
        self.append_ready_event(job, task).await
    }

    /// Leases of a coordinator that is gone.
    pub async fn orphaned_leases(&mut self) -> Result<Vec<OrphanedLease>, StoreError> {
        let sql = "SELECT lease_id, job_id, kind, number, attempt, worker FROM attempts WHERE outcome = 'running' \
                   ORDER BY job_id, kind, number";
        let query = sqlx::query_as(sql);
        let rows: Vec<(String, String, String, u32, u32, String)> =
            query.fetch_all(&mut *self.transaction).await?;
        let orphan =
            |(id, job, kind, number, attempt, worker): (String, String, String, u32, u32, String)| {
                Ok(OrphanedLease { id, key: key_of_row(&job, &kind, number)?, attempt, worker })
            };
        rows.into_iter().map(orphan).collect()
    }

    /// A lease has ended through no fault of the task, which is not done: it is ready again.
    pub async fn release_task(
        &mut self,
        key: &TaskKey,
        attempt: u32,
        worker: &str,
    ) -> Result<(), StoreError> {
        self.set_task_state(&key.job, key.task, TaskState::Ready).await?;
        let event = TaskEvent { attempt, worker, ..TaskEvent::of(key.task) };
        self.append_task_event(&key.job, TaskState::Ready, &event).await?;
        Ok(())
    }

    /// Appends that a task waits for a worker.
    pub async fn append_ready_event(&mut self, job: &str, task: Task) -> Result<(), StoreError> {
        self.append_task_event(job, TaskState::Ready, &TaskEvent::of(task)).await?;
        Ok(())
    }
}
