//! Between two windows of a view: the tracker's states, kept, lost and discarded.

use std::{ops::Range, time::Instant};

use splat::{formats::track_state, tracking::TrackState};
use trackersplat_proto::v1::{Blob, Failure, FailureKind};

use super::{Desk, Hub};
use crate::{
    blobs::{BlobError, name},
    failure::failure,
    ledger::{State, StatePlace},
    queue::{Lease, Task},
    store::{Artifact, AttemptOutcome, StoreError},
};

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
        let is_lost =
            matches!(self.blobs.get(&blob).await, Err(BlobError::Missing(_) | BlobError::Corrupt { .. }));
        if !is_lost {
            return self.failed(&lease.id, lease.attempt, reason).await;
        }
        let mut desk = self.desk.lock().await;
        let Some(ledger) = desk.ledger_mut(job) else { return Ok(Some("the job has ended".into())) };
        ledger.lose_state(position, &key);
        let before = ledger.before(position);
        if let Err(stale) = desk.queue.go_on(&lease.id, lease.attempt, before) {
            return Ok(Some(stale.to_string()));
        }
        let why = "the tracker's state is gone from the store, or damaged; tracks before it are made again";
        tracing::warn!(job_id = %job, position, attempt = lease.attempt, reason = reason.message, "{why}");
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Released(why)).await?;
        change.release_task(&lease.key, lease.attempt, &lease.worker_id).await?;
        change.remove_artifact(&key).await?;
        change.commit().await?;
        self.tell_stored(job);
        desk.changed(job);
        drop(desk);
        // Whoever else names a damaged blob has no use for it, and it would be taken for one that is there already.
        self.blobs.remove(&blob).await;
        Ok(None)
    }

    /// Verifies the state after a window and keeps it, if it is wanted and the lease is held. `Err`: the attempt has failed,
    /// and why.
    pub(super) async fn keep_state(
        &self,
        lease: &Lease,
        blob: &Blob,
    ) -> Result<Result<(), Failure>, StoreError> {
        let (job, position) = (&lease.key.job, lease.key.task.number());
        let place = {
            let desk = self.desk.lock().await;
            desk.ledger(job).and_then(|ledger| ledger.state_place(position))
        };
        let Some(StatePlace { key, past }) = place else { return Ok(Ok(())) };
        if let Err(reason) = self.verify_state(blob, past).await {
            return Ok(Err(reason));
        }
        let mut desk = self.desk.lock().await;
        if desk.queue.check(&lease.id, lease.attempt).is_err() {
            return Ok(Ok(()));
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

    /// The state is what its name says, readable, and of frames that the next window is given.
    async fn verify_state(&self, blob: &Blob, past: Range<usize>) -> Result<(), Failure> {
        let bug = |message: String| failure(FailureKind::Bug, message);
        // States may be large: one at a time is read, however many workers report.
        let _turn = self.reading_state.lock().await;
        let bytes = self.fetched(blob, "the tracker's state").await?;
        let decoded = tokio::task::spawn_blocking(move || track_state::decode(&bytes)).await;
        let state = decoded
            .map_err(|error| bug(format!("reading the tracker's state: {error}")))?
            .map_err(|error| bug(format!("the tracker's state: {error}")))?;
        match state.indices().find(|index| !past.contains(index)) {
            Some(index) => Err(bug(format!(
                "the tracker's state remembers the view's frame {index}, frames {} to {} are possible",
                past.start,
                past.end - 1
            ))),
            None => Ok(()),
        }
    }

    /// Forgets states that nobody goes on from any more. Their blobs that nothing names now are to be removed, once the desk
    /// is free: if a job of the same clip makes one again meanwhile, its window before is repeated.
    pub(super) async fn forget_states(&self, states: &[State]) -> Result<Vec<Blob>, StoreError> {
        if states.is_empty() {
            return Ok(Vec::new());
        }
        let mut change = self.store.change().await?;
        for state in states {
            change.remove_artifact(&state.key).await?;
        }
        change.commit().await?;
        // What remembers nothing is the same blob for every view, and one may be about to be reported.
        let nothing = name(&track_state::encode(&TrackState::default()));
        let mut nameless = Vec::new();
        for blob in states.iter().filter_map(|state| state.blob.as_ref()).filter(|blob| **blob != nothing) {
            if !self.store.is_artifact(blob).await? {
                nameless.push(blob.clone());
            }
        }
        Ok(nameless)
    }

    pub(super) async fn remove_blobs(&self, blobs: &[Blob]) {
        for blob in blobs {
            self.blobs.remove(blob).await;
        }
    }
}

impl Desk {
    /// Takes away the state that a failed lease began from if the failure may be the state's own: the next attempt begins
    /// before it.
    pub(super) fn lose_unusable_state(&mut self, lease: &Lease, kind: FailureKind) -> Option<State> {
        let (Task::Tracks(position), FailureKind::Bug) = (lease.key.task, kind) else { return None };
        let ledger = self.ledger_mut(&lease.key.job)?;
        let state = ledger.leased_state(position).filter(|state| state.blob.is_some())?;
        ledger.lose_state(position, &state.key);
        let before = ledger.before(position);
        self.queue.reschedule(&lease.key, before);
        Some(state)
    }
}
