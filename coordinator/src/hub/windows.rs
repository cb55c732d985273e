//! Between two windows of a view: the tracker's states, kept, lost and discarded.

use std::{collections::BTreeSet, time::Instant};

use splat::{
    formats::{TrackError, track_state},
    tracking::TrackState,
};
use trackersplat_proto::v1::{Blob, Failure, FailureKind};

use super::{Desk, Hub, reports::unfetched};
use crate::{
    blobs::{BlobError, name},
    failure::failure,
    ledger::{State, StatePlace},
    queue::{Lease, Task},
    store::{Artifact, AttemptOutcome, StoreError},
};

/// States lost of a view without a new field from which on every window of it counts as failed: a store that keeps none
/// would have the view tracked again for ever.
pub(super) const MAX_LOST_STATES: u32 = 3;

/// Why a reported state is not kept.
pub(super) enum StateFault {
    /// It is gone from the store: another job may have discarded the same one. Nothing has failed.
    Gone,
    /// The attempt has failed.
    Refused(Failure),
}

/// Why a window counts as failed though it was tracked well.
pub(super) fn keeps_no_state() -> Failure {
    let message = format!(
        "the store has lost {MAX_LOST_STATES} of the tracker's states without a new field; check its disk"
    );
    failure(FailureKind::Transient, message)
}

impl Hub {
    /// A window is complete, and the view is ready for the next one.
    pub(super) async fn record_window(&self, desk: &mut Desk, lease: &Lease) -> Result<(), StoreError> {
        let seconds = Instant::now().saturating_duration_since(lease.since).as_secs_f64();
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Done).await?;
        change.continue_tracks(&lease.key, lease.attempt, &lease.worker_id, seconds).await?;
        change.commit().await?;
        let job = &lease.key.job;
        let view = desk.view_name(job, lease.key.task.number());
        let (attempt, worker_id) = (lease.attempt, &lease.worker_id);
        tracing::info!(job_id = %job, view, attempt, worker_id, seconds, "window tracked");
        self.tell_stored(job);
        desk.changed(job);
        Ok(())
    }

    /// Somebody gave a window up. Where the state is gone or damaged that it began from, that is nobody's failure: what
    /// comes before is tracked again. `None`, or why the lease ended meanwhile.
    pub(super) async fn window_failed(
        &self,
        lease: &Lease,
        reason: Failure,
    ) -> Result<Option<String>, StoreError> {
        let (job, position) = (&lease.key.job, lease.key.task.number());
        let begun_from = {
            let desk = self.desk.lock().await;
            desk.ledger(job).and_then(|ledger| ledger.leased_state(position))
        };
        let Some(State { key, blob: Some(blob) }) = begun_from else {
            return self.failed(&lease.id, lease.attempt, reason).await;
        };
        if !self.is_lost(&blob).await {
            return self.failed(&lease.id, lease.attempt, reason).await;
        }
        let mut desk = self.desk.lock().await;
        if let Err(stale) = desk.queue.check(&lease.id, lease.attempt) {
            return Ok(Some(stale.to_string()));
        }
        let Some(ledger) = desk.ledger_mut(job) else { return Ok(Some("the job has ended".into())) };
        ledger.lose_state(position, &key);
        let why = "the tracker's state is gone from the store, or damaged; tracks before it are made again";
        tracing::warn!(job_id = %job, position, attempt = lease.attempt, reason = reason.message, "{why}");
        // Whoever else names a damaged blob has no use for it. The file goes before its row: of a row without a file the
        // next lease takes notice.
        self.blobs.remove(&blob).await;
        let mut change = self.store.change().await?;
        change.remove_artifact(&key).await?;
        change.commit().await?;
        self.void_window(&mut desk, lease, why).await
    }

    /// Whether a state is gone from the store, or damaged.
    async fn is_lost(&self, blob: &Blob) -> bool {
        let _turn = self.reading_state.lock().await;
        matches!(self.blobs.get(blob).await, Err(BlobError::Missing(_) | BlobError::Corrupt { .. }))
    }

    /// The state that was reported after a window went before it was kept: the window is repeated, though not for ever.
    pub(super) async fn reported_state_gone(&self, lease: &Lease) -> Result<Option<String>, StoreError> {
        let position = lease.key.task.number();
        let mut desk = self.desk.lock().await;
        if let Err(stale) = desk.queue.check(&lease.id, lease.attempt) {
            return Ok(Some(stale.to_string()));
        }
        let Some(ledger) = desk.ledger_mut(&lease.key.job) else {
            return Ok(Some("the job has ended".into()));
        };
        ledger.count_lost(position);
        if ledger.lost_states(position) >= MAX_LOST_STATES {
            drop(desk);
            return self.refused(&lease.id, lease.attempt, keeps_no_state()).await;
        }
        let why = "the reported state of the tracker is gone from the store; the window is tracked again";
        let stale = self.void_window(&mut desk, lease, why).await?;
        Ok(Some(stale.unwrap_or_else(|| why.to_owned())))
    }

    /// Takes a window back that nobody has failed: the view is ready. `None`, or why the lease ended meanwhile.
    async fn void_window(
        &self,
        desk: &mut Desk,
        lease: &Lease,
        why: &str,
    ) -> Result<Option<String>, StoreError> {
        let job = &lease.key.job;
        let before = desk.ledger(job).map_or(0, |ledger| ledger.before(lease.key.task.number()));
        if let Err(stale) = desk.queue.go_on(&lease.id, lease.attempt, before) {
            return Ok(Some(stale.to_string()));
        }
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Released(why)).await?;
        change.release_task(&lease.key, lease.attempt, &lease.worker_id).await?;
        change.commit().await?;
        self.tell_stored(job);
        desk.changed(job);
        Ok(None)
    }

    /// Verifies the state after a window and keeps it, if it is wanted and the lease is held.
    pub(super) async fn keep_state(
        &self,
        lease: &Lease,
        blob: &Blob,
    ) -> Result<Result<(), StateFault>, StoreError> {
        let (job, position) = (&lease.key.job, lease.key.task.number());
        let place = {
            let desk = self.desk.lock().await;
            desk.ledger(job).and_then(|ledger| ledger.state_place(position))
        };
        let Some(place) = place else { return Ok(Ok(())) };
        let key = place.key.clone();
        if let Err(fault) = self.verify_state(blob, place).await {
            return Ok(Err(fault));
        }
        let mut desk = self.desk.lock().await;
        if desk.queue.check(&lease.id, lease.attempt).is_err() {
            return Ok(Ok(()));
        }
        // States are discarded at the desk: from here on this one stays.
        if self.blobs.lacks(blob).await {
            return Ok(Err(StateFault::Gone));
        }
        let artifact = Artifact { blob: blob.clone(), note: String::new() };
        let mut change = self.store.change().await?;
        // Only fields are progress: a state may be made for the second time.
        change.put_artifact(&key, "track-state", &artifact).await?;
        change.commit().await?;
        if let Some(ledger) = desk.ledger_mut(job) {
            ledger.keep_state(position, blob);
        }
        Ok(Ok(()))
    }

    /// The state is what its name says, readable, of the tracker's size, and of the frames that the next window needs.
    async fn verify_state(&self, blob: &Blob, place: StatePlace) -> Result<(), StateFault> {
        let bug = |message: String| StateFault::Refused(failure(FailureKind::Bug, message));
        // States may be large: one at a time is read, however many workers report.
        let _turn = self.reading_state.lock().await;
        let bytes = self.blobs.get(blob).await.map_err(|error| match error {
            BlobError::Missing(_) => StateFault::Gone,
            error => StateFault::Refused(unfetched(&error, "the tracker's state")),
        })?;
        let check = move || {
            let unreadable = |error: TrackError| format!("the tracker's state: {error}");
            // Before it is decompressed: a small blob may claim a large state.
            place.check_shape(track_state::shape(&bytes).map_err(unreadable)?)?;
            let state = track_state::decode(&bytes).map_err(unreadable)?;
            place.check_frames(&state.indices().collect::<Vec<_>>())
        };
        let checked = tokio::task::spawn_blocking(check).await;
        checked.unwrap_or_else(|error| Err(format!("reading the tracker's state: {error}"))).map_err(bug)
    }

    /// Forgets states that nobody goes on from any more, with the desk held: who keeps the same one meanwhile finds it gone.
    /// Files go before rows, so that a coordinator that is killed in between leaves no file that nothing names.
    pub(crate) async fn forget_states(&self, states: &[State]) -> Result<(), StoreError> {
        if states.is_empty() {
            return Ok(());
        }
        let keys: BTreeSet<&str> = states.iter().map(|state| state.key.as_str()).collect();
        // What remembers nothing is the same blob for every view, and one may be about to be reported.
        let nothing = name(&track_state::encode(&TrackState::default()));
        for blob in states.iter().filter_map(|state| state.blob.as_ref()).filter(|blob| **blob != nothing) {
            let named_by = self.store.artifact_keys(blob).await?;
            if named_by.iter().all(|key| keys.contains(key.as_str())) {
                self.blobs.remove(blob).await;
            }
        }
        let mut change = self.store.change().await?;
        for key in keys {
            change.remove_artifact(key).await?;
        }
        change.commit().await
    }
}

impl Desk {
    /// Takes away the state that a failed lease began from if the failure may be the state's own: the next attempt begins
    /// before it.
    pub(super) fn lose_unusable_state(&mut self, lease: &Lease, kind: FailureKind) -> Option<State> {
        let (Task::Tracks(position), FailureKind::Bug) = (lease.key.task, kind) else { return None };
        let ledger = self.ledger_mut(&lease.key.job)?;
        let state = ledger.leased_state(position).filter(|state| state.blob.is_some())?;
        // The store has kept it well.
        ledger.drop_state(position, &state.key);
        let before = ledger.before(position);
        self.queue.reschedule(&lease.key, before);
        Some(state)
    }
}

#[cfg(test)]
impl Hub {
    /// The turn of whoever reads a state.
    pub(crate) async fn turn_to_read_a_state(&self) -> tokio::sync::MutexGuard<'_, ()> {
        self.reading_state.lock().await
    }
}
