//! The events of a job, numbered without gaps.

use sqlx::FromRow;
use trackersplat_proto::v1::{
    Failure, FailureKind, FrameStateChanged, JobEvent, JobStateChanged, job_event::Event,
};

use super::{Change, Store, StoreError, signed, unsigned};
use crate::queue::{frame::FrameState, job::JobState};

#[derive(FromRow)]
struct EventRow {
    job_id: String,
    sequence: i64,
    kind: String,
    state: String,
    frame: u32,
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
        let event = match self.kind.as_str() {
            "job" => {
                let state = JobState::from_label(&self.state).ok_or_else(wrong_state)?;
                Event::JobState(JobStateChanged { state: state.to_wire().into(), failure })
            }
            "frame" => Event::FrameState(FrameStateChanged {
                frame: self.frame,
                state: FrameState::from_label(&self.state).ok_or_else(wrong_state)?.to_wire().into(),
                attempt: self.attempt,
                worker_id: self.worker,
                failure,
                report_json: self.report,
                seconds: self.seconds,
            }),
            _ => return Err(StoreError::Value { place: "events.kind", value: self.kind }),
        };
        Ok(JobEvent { sequence: unsigned(self.sequence), job_id: self.job_id, event: Some(event) })
    }
}

/// What is stored of a frame's change.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameEvent<'a> {
    pub(crate) frame: u32,
    pub(crate) attempt: u32,
    pub(crate) worker: &'a str,
    pub(crate) failure: Option<&'a Failure>,
    pub(crate) report: &'a str,
    pub(crate) seconds: f64,
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
        self.append(job, "job", state.label(), &FrameEvent { failure, ..FrameEvent::default() }).await
    }

    /// Appends a frame's new state to the job's events.
    pub(crate) async fn append_frame_event(
        &mut self,
        job: &str,
        state: FrameState,
        event: &FrameEvent<'_>,
    ) -> Result<u64, StoreError> {
        self.append(job, "frame", state.label(), event).await
    }

    async fn append(
        &mut self,
        job: &str,
        kind: &str,
        state: &str,
        event: &FrameEvent<'_>,
    ) -> Result<u64, StoreError> {
        let sql = "UPDATE jobs SET last_sequence = last_sequence + 1 WHERE id = ? RETURNING last_sequence";
        let sequence: i64 = sqlx::query_scalar(sql).bind(job).fetch_one(&mut *self.transaction).await?;
        let (failure_kind, message) = failure_columns(event.failure);
        let sql = "INSERT INTO events (job_id, sequence, at, kind, state, frame, attempt, worker, failure_kind, \
                   message, report, seconds) \
                   VALUES (?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'), ?, ?, ?, ?, ?, ?, ?, ?, ?)";
        let query = sqlx::query(sql).bind(job).bind(sequence).bind(kind).bind(state).bind(event.frame);
        let query = query.bind(event.attempt).bind(event.worker).bind(failure_kind).bind(message);
        query.bind(event.report).bind(event.seconds).execute(&mut *self.transaction).await?;
        Ok(unsigned(sequence))
    }
}

pub(super) fn failure(kind: &str, message: &str) -> Option<Failure> {
    let failed = !kind.is_empty();
    failed.then(|| Failure { kind: FailureKind::from_label(kind).into(), message: message.to_owned() })
}

pub(super) fn failure_columns(failure: Option<&Failure>) -> (&'static str, &str) {
    failure.map_or(("", ""), |failure| (failure.kind().label(), failure.message.as_str()))
}
