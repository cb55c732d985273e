//! The events of a job, numbered without gaps.

use sqlx::FromRow;
use trackersplat_proto::v1::{
    Failure, FailureKind, FrameStateChanged, JobEvent, JobStateChanged, TracksStateChanged, job_event::Event,
};

use super::{Change, Store, StoreError, signed, unsigned};
use crate::queue::{Task, job::JobState, task::TaskState};

#[derive(FromRow)]
struct EventRow {
    job_id: String,
    sequence: i64,
    kind: String,
    state: String,
    number: u32,
    view: String,
    attempt: u32,
    worker: String,
    failure_kind: String,
    message: String,
    report: String,
    seconds: f64,
}

impl EventRow {
    fn into_wire(self) -> Result<JobEvent, StoreError> {
        let failure = failure(&self.failure_kind, &self.message);
        let wrong_state = || StoreError::Value { place: "events.state", value: self.state.clone() };
        let task_state = || TaskState::from_label(&self.state).ok_or_else(wrong_state);
        let event = match self.kind.as_str() {
            "job" => {
                let state = JobState::from_label(&self.state).ok_or_else(wrong_state)?;
                Event::JobState(JobStateChanged { state: state.to_wire().into(), failure })
            }
            "frame" => Event::FrameState(FrameStateChanged {
                frame: self.number,
                state: task_state()?.to_wire().into(),
                attempt: self.attempt,
                worker_id: self.worker,
                failure,
                report_json: self.report,
                seconds: self.seconds,
            }),
            "tracks" => Event::TracksState(TracksStateChanged {
                state: task_state()?.to_wire().into(),
                view: self.view,
                attempt: self.attempt,
                worker_id: self.worker,
                failure,
                seconds: self.seconds,
            }),
            _ => return Err(StoreError::Value { place: "events.kind", value: self.kind }),
        };
        Ok(JobEvent { sequence: unsigned(self.sequence), job_id: self.job_id, event: Some(event) })
    }
}

/// What is stored of a task's change.
#[derive(Clone, Debug)]
pub(crate) struct TaskEvent<'a> {
    pub(crate) task: Task,
    pub(crate) attempt: u32,
    pub(crate) worker: &'a str,
    pub(crate) failure: Option<&'a Failure>,
    pub(crate) report: &'a str,
    pub(crate) seconds: f64,
}

impl TaskEvent<'_> {
    /// A change of which only the new state is to be said.
    pub(crate) fn of(task: Task) -> Self {
        Self { task, attempt: 0, worker: "", failure: None, report: "", seconds: 0.0 }
    }
}

impl Store {
    /// Up to `limit` events of a job after a sequence number, in order.
    pub async fn events_after(
        &self,
        job: &str,
        sequence: u64,
        limit: u32,
    ) -> Result<Vec<JobEvent>, StoreError> {
        let sql = "SELECT * FROM events WHERE job_id = ? AND sequence > ? ORDER BY sequence LIMIT ?";
        let query = sqlx::query_as::<_, EventRow>(sql).bind(job).bind(signed(sequence)).bind(limit);
        query.fetch_all(&self.pool).await?.into_iter().map(EventRow::into_wire).collect()
    }
}

impl Change {
    /// Appends the job's new state to its events.
    pub async fn append_job_event(
        &mut self,
        job: &str,
        state: JobState,
        failure: Option<&Failure>,
    ) -> Result<u64, StoreError> {
        let sequence = self.next_sequence(job).await?;
        let (failure_kind, message) = failure_columns(failure);
        let sql = "INSERT INTO events (job_id, sequence, at, kind, state, failure_kind, message) \
                   VALUES (?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'), 'job', ?, ?, ?)";
        let query = sqlx::query(sql).bind(job).bind(sequence).bind(state.label()).bind(failure_kind);
        query.bind(message).execute(&mut *self.transaction).await?;
        Ok(unsigned(sequence))
    }

    /// Appends a task's new state to the job's events.
    pub(crate) async fn append_task_event(
        &mut self,
        job: &str,
        state: TaskState,
        event: &TaskEvent<'_>,
    ) -> Result<u64, StoreError> {
        let sequence = self.next_sequence(job).await?;
        let (kind, number) = (event.task.kind(), event.task.number());
        let (failure_kind, message) = failure_columns(event.failure);
        let sql = "INSERT INTO events (job_id, sequence, at, kind, state, number, view, attempt, worker, \
                   failure_kind, message, report, seconds) \
                   VALUES (?1, ?2, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'), ?3, ?4, ?5, \
                   CASE WHEN ?3 = 'tracks' THEN (SELECT name FROM views WHERE job_id = ?1 AND position = ?5) \
                   ELSE '' END, ?6, ?7, ?8, ?9, ?10, ?11)";
        let query = sqlx::query(sql).bind(job).bind(sequence).bind(kind).bind(state.label()).bind(number);
        let query = query.bind(event.attempt).bind(event.worker).bind(failure_kind).bind(message);
        query.bind(event.report).bind(event.seconds).execute(&mut *self.transaction).await?;
        Ok(unsigned(sequence))
    }

    async fn next_sequence(&mut self, job: &str) -> Result<i64, StoreError> {
        let sql = "UPDATE jobs SET last_sequence = last_sequence + 1 WHERE id = ? RETURNING last_sequence";
        Ok(sqlx::query_scalar(sql).bind(job).fetch_one(&mut *self.transaction).await?)
    }
}

pub(super) fn failure(kind: &str, message: &str) -> Option<Failure> {
    let failed = !kind.is_empty();
    failed.then(|| Failure { kind: FailureKind::from_label(kind).into(), message: message.to_owned() })
}

pub(super) fn failure_columns(failure: Option<&Failure>) -> (&'static str, &str) {
    failure.map_or(("", ""), |failure| (failure.kind().label(), failure.message.as_str()))
}
