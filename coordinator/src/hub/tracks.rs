//! Tracks of views: given out window by window, reported, complete.

use std::time::Instant;

use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Blob, Failure, FailureKind, TrackJob, Tracked};

use super::{
    Desk, Hub,
    windows::{MAX_LOST_STATES, StateFault, keeps_no_state},
};
use crate::{
    failure::{StageError, failure},
    ledger::{State, TrackLedger},
    queue::{
        JobId, Lease, Task, TaskHistory, TaskKey,
        task::{TaskState, TaskTrigger},
    },
    store::{AttemptOutcome, StoreError, TaskEvent, TaskRecord},
};

impl Hub {
    /// What is known of a job's tracks from now on; views that lack fields become ready for workers.
    pub(crate) async fn begin_tracks(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        mut ledger: TrackLedger,
    ) -> Result<(), StageError> {
        let mut desk = self.desk.lock().await;
        if stop.is_cancelled() {
            return Err(StageError::Stopped);
        }
        let positions = ledger.positions();
        // A coordinator that was killed may have left them behind.
        let superseded: Vec<State> = positions.iter().flat_map(|&p| ledger.take_superseded(p)).collect();
        let is_missing = |&position: &u32| ledger.missing(position).is_some();
        let (missing, complete): (Vec<u32>, Vec<u32>) = positions.iter().partition(|p| is_missing(p));
        let (done, total) = ledger.counts();
        if let Some(active) = desk.active.get_mut(job) {
            active.tracks = Some(ledger);
        }
        for position in complete {
            self.settle_tracks(job, position).await?;
        }
        if missing.is_empty() {
            tracing::info!(job_id = %job, "tracks reused");
        } else {
            self.progress(job, "tracking", done, total);
        }
        for position in missing {
            self.publish_tracks(&mut desk, job, position).await?;
        }
        self.forget_states(&superseded).await?;
        Ok(self.dispatch(&mut desk).await?)
    }

    /// Whether views have become ready in this run of the job.
    pub(crate) async fn has_tracks(&self, job: &JobId) -> bool {
        self.desk.lock().await.ledger(job).is_some()
    }

    /// Fields that an earlier attempt or another job has made complete a view without a lease.
    async fn settle_tracks(&self, job: &JobId, position: u32) -> Result<(), StageError> {
        let key = TaskKey { job: job.clone(), task: Task::Tracks(position) };
        let Some(record) = self.store.task(&key).await? else { return Ok(()) };
        if record.state()?.after(TaskTrigger::Commit).is_err() {
            return Ok(());
        }
        let mut change = self.store.change().await?;
        change.commit_tracks(job, position, 0.0).await?;
        change.append_task_event(job, TaskState::Done, &TaskEvent::of(key.task)).await?;
        change.commit().await?;
        self.tell_stored(job);
        Ok(())
    }

    async fn publish_tracks(&self, desk: &mut Desk, job: &JobId, position: u32) -> Result<(), StageError> {
        let key = TaskKey { job: job.clone(), task: Task::Tracks(position) };
        let known = self.store.task(&key).await?;
        let state = known.as_ref().map(TaskRecord::state).transpose()?;
        let mut change = self.store.change().await?;
        match state {
            None => {
                change.publish_tracks(job, position).await?;
                change.append_ready_event(job, key.task).await?;
            }
            Some(TaskState::Failed) => {
                drop(change);
                let (kind, message) = self.store.last_failure(job, key.task).await?.unwrap_or_default();
                desk.tracks_failed(job, position, &failure(kind, message));
                return Ok(());
            }
            // Its fields were there, and are gone from the store.
            Some(state) if state.after(TaskTrigger::Lose).is_ok() => {
                change.reopen_task(job, key.task).await?;
            }
            Some(_) => {}
        }
        change.commit().await?;
        self.tell_stored(job);
        let Some(record) = self.store.task(&key).await? else { return Ok(()) };
        let before = desk.ledger(job).map_or(0, |ledger| ledger.before(position));
        desk.queue.add(key, TaskHistory { before, ..record.history()? });
        Ok(())
    }

    /// Reads what is known of a job's tracks; fails if a view cannot be tracked.
    pub(crate) async fn tracks<T>(
        &self,
        job: &JobId,
        read: impl FnOnce(&TrackLedger) -> T,
    ) -> Result<T, StageError> {
        let desk = self.desk.lock().await;
        let ledger = desk.ledger(job).ok_or(StageError::Stopped)?;
        match ledger.failed() {
            Some(reason) => Err(StageError::Failed(reason.clone())),
            None => Ok(read(ledger)),
        }
    }

    /// Number of views of a job that are ready to be tracked or leased; fails if one cannot be tracked.
    pub(crate) async fn open_tracks(&self, job: &JobId) -> Result<usize, StageError> {
        self.tracks(job, |_| ()).await?;
        Ok(self.desk.lock().await.queue.open_tracks(job))
    }

    /// Whether a view of the job is to be tracked by the coordinator itself: no connected worker may.
    pub(crate) async fn has_own_work(&self, job: &JobId) -> bool {
        self.desk.lock().await.queue.has_own_work(job, Instant::now())
    }

    /// The coordinator's own lease of such a view.
    pub(crate) async fn lease_own(
        &self,
        job: &JobId,
        stop: &CancellationToken,
    ) -> Result<Option<(Lease, TrackJob)>, StageError> {
        let mut desk = self.desk.lock().await;
        if stop.is_cancelled() {
            return Err(StageError::Stopped);
        }
        // Views are published with the ledger; without it there is none to lease.
        if desk.ledger(job).is_none() {
            return Ok(None);
        }
        let id = uuid::Uuid::now_v7().simple().to_string();
        let Some(lease) = desk.queue.lease_own(job, Instant::now(), id) else { return Ok(None) };
        self.record_grant(&lease).await?;
        let position = lease.key.task.number();
        let request = self.track_job(&mut desk, job, position).await?.ok_or_else(|| {
            let message = format!("the job has no view {position} to track: a defect of the coordinator");
            StageError::new(FailureKind::Bug, message)
        })?;
        Ok(Some((lease, request)))
    }

    /// What whoever leases a view gets.
    pub(super) async fn track_job(
        &self,
        desk: &mut Desk,
        job: &JobId,
        position: u32,
    ) -> Result<Option<TrackJob>, StoreError> {
        self.adopt_fields(desk, job, position).await?;
        let Some(ledger) = desk.ledger_mut(job) else { return Ok(None) };
        while let Some(State { key, blob: Some(blob) }) = ledger.next_state(position)
            && self.blobs.lacks(&blob).await
        {
            tracing::warn!(job_id = %job, position, "the tracker's state is gone from the store");
            ledger.lose_state(position, &key);
        }
        Ok(ledger.lease(position))
    }

    /// The coordinator's own lease has ended, well with the state after it if that is wanted.
    pub(crate) async fn own_ended(
        &self,
        lease: &Lease,
        ended: Result<Option<Blob>, Failure>,
    ) -> Result<(), StageError> {
        let stale = match ended {
            Ok(state) => self.tracked(lease, Tracked { fields: Vec::new(), state }).await?,
            Err(reason) => self.window_failed(lease, reason).await?,
        };
        if let Some(reason) = stale {
            tracing::info!(lease_id = lease.id, reason, "own tracks do not count");
        }
        let mut desk = self.desk.lock().await;
        Ok(self.dispatch(&mut desk).await?)
    }

    /// `None` if the window of the lease is complete, else why its tracks do not count.
    pub(super) async fn tracked(
        &self,
        lease: &Lease,
        tracked: Tracked,
    ) -> Result<Option<String>, StoreError> {
        for field in &tracked.fields {
            if let Err(reason) = self.keep_field(lease, field).await? {
                return self.refused(&lease.id, lease.attempt, reason).await;
            }
        }
        if let Some(state) = &tracked.state
            && let Err(fault) = self.keep_state(lease, state).await?
        {
            return match fault {
                StateFault::Gone => self.reported_state_gone(lease).await,
                StateFault::Refused(reason) => self.refused(&lease.id, lease.attempt, reason).await,
            };
        }
        let position = lease.key.task.number();
        let mut desk = self.desk.lock().await;
        let ledger = desk.ledger(&lease.key.job);
        if let Some(lack) = ledger.and_then(|ledger| ledger.lacks(position)) {
            drop(desk);
            let reason = failure(FailureKind::Bug, format!("the worker's report lacks {lack}"));
            return self.refused(&lease.id, lease.attempt, reason).await;
        }
        let next = ledger.and_then(|ledger| ledger.missing(position).map(|_| ledger.before(position)));
        if next.is_some() && ledger.is_some_and(|ledger| ledger.lost_states(position) >= MAX_LOST_STATES) {
            drop(desk);
            return self.refused(&lease.id, lease.attempt, keeps_no_state()).await;
        }
        let ended = match next {
            Some(before) => desk.queue.go_on(&lease.id, lease.attempt, before),
            None => desk.queue.commit(&lease.id, lease.attempt),
        };
        match ended {
            Ok(lease) if next.is_some() => self.record_window(&mut desk, &lease).await?,
            Ok(lease) => self.record_tracked(&mut desk, &lease).await?,
            Err(stale) => {
                drop(desk);
                return self.stale_success(&lease.id, lease.attempt, &stale).await;
            }
        }
        let ledger = desk.ledger_mut(&lease.key.job);
        let superseded = ledger.map(|ledger| ledger.take_superseded(position));
        self.forget_states(&superseded.unwrap_or_default()).await?;
        Ok(None)
    }

    async fn record_tracked(&self, desk: &mut Desk, lease: &Lease) -> Result<(), StoreError> {
        let (job, position) = (&lease.key.job, lease.key.task.number());
        let seconds = Instant::now().saturating_duration_since(lease.since).as_secs_f64();
        let before = self.store.task(&lease.key).await?.map_or(0.0, |record| record.seconds);
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Done).await?;
        change.commit_tracks(job, position, seconds).await?;
        let seconds = before + seconds;
        let event = TaskEvent {
            attempt: lease.attempt,
            worker: &lease.worker_id,
            seconds,
            ..TaskEvent::of(lease.key.task)
        };
        change.append_task_event(job, TaskState::Done, &event).await?;
        change.commit().await?;
        let view = desk.view_name(job, position);
        tracing::info!(
            job_id = %job, view, attempt = lease.attempt, worker_id = lease.worker_id, seconds, "view tracked"
        );
        self.tell_stored(job);
        desk.changed(job);
        Ok(())
    }
}

impl Desk {
    pub(super) fn ledger(&self, job: &JobId) -> Option<&TrackLedger> {
        self.active.get(job)?.tracks.as_ref()
    }

    pub(super) fn ledger_mut(&mut self, job: &JobId) -> Option<&mut TrackLedger> {
        self.active.get_mut(job)?.tracks.as_mut()
    }

    /// Name of a tracked view; empty if nothing is known of it.
    pub(super) fn view_name(&self, job: &JobId, position: u32) -> String {
        self.ledger(job).map_or("", |ledger| ledger.name(position)).to_owned()
    }

    /// A view cannot be tracked: the job's driver is to fail.
    pub(super) fn tracks_failed(&mut self, job: &JobId, position: u32, reason: &Failure) {
        if let Some(ledger) = self.ledger_mut(job) {
            ledger.fail(position, reason);
        }
        self.changed(job);
    }
}
