//! Track fields: reported one by one, verified, kept, and taken over from other jobs.

use std::time::Instant;

use splat::formats::{TrackError, track_blob};
use trackersplat_proto::v1::{
    Blob, CancelLease, Failure, FailureKind, FieldReport, TrackedField, coordinator_message::Message,
};

use super::{Desk, Hub};
use crate::{
    failure::{StageError, failure},
    ledger::Place,
    queue::{JobId, Lease, SessionId, Task},
    store::{Artifact, StoreError},
};

impl Hub {
    /// The coordinator has made a field under its own lease.
    pub(crate) async fn own_field(&self, lease: &Lease, field: TrackedField) -> Result<(), StageError> {
        self.keep_field(lease, &field).await?.map_err(StageError::Failed)
    }

    /// A worker has stored a field. It is a sign of life as well; a worker that works on a lease it no longer holds, or
    /// whose field does not verify, is told to stop.
    pub(crate) async fn field_reported(
        &self,
        session: SessionId,
        report: FieldReport,
    ) -> Result<(), StoreError> {
        let FieldReport { lease_id, attempt, field } = report;
        let held = {
            let mut desk = self.desk.lock().await;
            desk.queue.begin_field(session, &lease_id, attempt, Instant::now()).cloned()
        };
        let reason = match held {
            Err(stale) => stale.to_string(),
            Ok(lease) => {
                let kept = self.keep_reported_field(&lease, &field.unwrap_or_default()).await;
                self.desk.lock().await.queue.end_field(session, &lease_id, Instant::now());
                match kept? {
                    Ok(()) => return Ok(()),
                    Err(reason) => {
                        let message = reason.message.clone();
                        self.failed(&lease_id, attempt, reason).await?.unwrap_or(message)
                    }
                }
            }
        };
        let mut desk = self.desk.lock().await;
        desk.send(session, Message::CancelLease(CancelLease { lease_id, reason }));
        self.dispatch(&mut desk).await
    }

    async fn keep_reported_field(
        &self,
        lease: &Lease,
        field: &TrackedField,
    ) -> Result<Result<(), Failure>, StoreError> {
        match lease.key.task {
            Task::Tracks(_) => self.keep_field(lease, field).await,
            Task::Frame(_) => {
                let message = "the worker reports tracks under the lease of a frame";
                Ok(Err(failure(FailureKind::Bug, message)))
            }
        }
    }

    /// Verifies a field and keeps it, unless it is there already or its lease has ended meanwhile. `Err`: the attempt has
    /// failed, and why.
    pub(super) async fn keep_field(
        &self,
        lease: &Lease,
        field: &TrackedField,
    ) -> Result<Result<(), Failure>, StoreError> {
        let (job, position) = (&lease.key.job, lease.key.task.number());
        let placed = {
            let desk = self.desk.lock().await;
            desk.placed(job, position, field)
        };
        let (place, blob) = match placed {
            Ok(Some(place)) => (place, field.tracks.clone().unwrap_or_default()),
            Ok(None) => return Ok(Ok(())),
            Err(reason) => return Ok(Err(reason)),
        };
        if let Err(reason) = self.verify_field(&blob, place.size).await {
            return Ok(Err(reason));
        }
        let mut desk = self.desk.lock().await;
        // What has changed while the field was verified counts: the lease may be another worker's by now.
        match (desk.queue.check(&lease.id, lease.attempt), desk.placed(job, position, field)) {
            (Ok(()), Ok(Some(_))) => {}
            (Ok(()), Err(reason)) => return Ok(Err(reason)),
            (Ok(()), Ok(None)) | (Err(_), _) => return Ok(Ok(())),
        }
        let known = self.held_field(&place.key).await?;
        let mut change = self.store.change().await?;
        if known.is_none() {
            let artifact = Artifact { blob: blob.clone(), note: String::new() };
            change.put_artifact(&place.key, "tracks", &artifact).await?;
        }
        change.forget_failures(&lease.key).await?;
        change.commit().await?;
        desk.queue.progressed(&lease.key);
        if let Some(ledger) = desk.ledger_mut(job) {
            match known.filter(|known| *known != blob) {
                Some(known) => ledger.adopt(position, field.frame, known),
                None => ledger.keep(position, field),
            }
            let (done, total) = ledger.counts();
            self.progress(job, "tracking", done, total);
        }
        desk.changed(job);
        Ok(Ok(()))
    }

    /// Takes over the fields that other jobs of the same clip have made, from the first that a view lacks up to the first
    /// that nobody has made.
    pub(super) async fn adopt_fields(
        &self,
        desk: &mut Desk,
        job: &JobId,
        position: u32,
    ) -> Result<(), StoreError> {
        let Some(ledger) = desk.ledger_mut(job) else { return Ok(()) };
        let before = ledger.counts();
        for (frame, key) in ledger.missing_fields(position) {
            let Some(tracks) = self.held_field(&key).await? else { break };
            ledger.adopt(position, frame, tracks);
        }
        let (done, total) = ledger.counts();
        if (done, total) != before {
            self.progress(job, "tracking", done, total);
            desk.changed(job);
        }
        Ok(())
    }

    /// The field of this key that another job of the same clip has made meanwhile.
    async fn held_field(&self, key: &str) -> Result<Option<Blob>, StoreError> {
        let Some(Artifact { blob, .. }) = self.store.artifact(key).await? else { return Ok(None) };
        Ok(self.blobs.holds(&blob).await.then_some(blob))
    }

    /// The field is what its name says, readable, and of the size of the view.
    async fn verify_field(&self, blob: &Blob, (width, height): (u32, u32)) -> Result<(), Failure> {
        let bug = |message: String| failure(FailureKind::Bug, message);
        let bytes = self.fetched(blob, "the worker's tracks").await?;
        let unreadable = move |error: TrackError| bug(format!("the worker's tracks: {error}"));
        let check = move || {
            // Before they are decompressed: a small blob may claim a large field.
            let found = track_blob::size(&bytes).map_err(unreadable)?;
            if found != (width, height) {
                return Err(bug(format!(
                    "the worker's tracks are of {} x {} pixels, the view of {width} x {height}",
                    found.0, found.1
                )));
            }
            track_blob::decode(&bytes).map_err(unreadable).map(|_| ())
        };
        let checked = tokio::task::spawn_blocking(check).await;
        checked.unwrap_or_else(|error| Err(bug(format!("reading the worker's tracks: {error}"))))
    }
}

impl Desk {
    fn placed(&self, job: &JobId, position: u32, field: &TrackedField) -> Result<Option<Place>, Failure> {
        let ledger = self.ledger(job);
        let ledger =
            ledger.ok_or_else(|| failure(FailureKind::Transient, "the job is not ready for results"))?;
        ledger.place(position, field).map_err(|message| failure(FailureKind::Bug, message))
    }
}
