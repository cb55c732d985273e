//! Workers come and go.

use std::{sync::Arc, time::Instant};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use trackersplat_proto::v1::{
    CancelLease, CoordinatorMessage, FailureKind, FrameJob, Heartbeat, Lease as LeaseMessage, Progress,
    Register, coordinator_message::Message, job_event::Event, lease,
};

use super::{Desk, Hub, Notice};
use crate::{
    failure::failure,
    queue::{Connected, FailedLease, JobId, Lease, SessionId, Task, task::TaskState},
    store::{AttemptOutcome, StoreError, TaskEvent},
};

/// Messages that may wait for one worker. A worker gets a few per frame; a full queue is a dead connection.
pub(crate) const OUTGOING_QUEUE: usize = 32;

/// One worker's stream, as the desk sees it.
pub(super) struct Session {
    worker_id: String,
    outgoing: mpsc::Sender<Result<CoordinatorMessage, Status>>,
    /// Cancelled when the stream is to be closed from this side.
    close: CancellationToken,
}

/// One worker's stream, as its service sees it.
pub(crate) struct Registered {
    pub(crate) session: SessionId,
    /// Cancelled when the stream is to be closed from this side.
    pub(crate) close: CancellationToken,
}

impl Desk {
    /// Sends to a worker without waiting; a stream that takes no more is closed.
    pub(super) fn send(&mut self, session: SessionId, message: Message) {
        let Some(session) = self.sessions.get(&session) else { return };
        if session.outgoing.try_send(Ok(CoordinatorMessage { message: Some(message) })).is_err() {
            tracing::warn!(worker_id = session.worker_id, "the worker reads nothing; closing its stream");
            session.close.cancel();
        }
    }
}

impl Hub {
    /// A worker's stream opens. Older streams of the same worker are closed; a lease that it still holds goes on.
    pub(crate) async fn register(
        &self,
        worker: &Register,
        outgoing: mpsc::Sender<Result<CoordinatorMessage, Status>>,
    ) -> Result<Registered, StoreError> {
        let mut desk = self.desk.lock().await;
        let session = SessionId(desk.next_session);
        desk.next_session += 1;
        let close = self.shutdown.child_token();
        let mut change = self.store.change().await?;
        change.worker_connected(worker).await?;
        change.commit().await?;
        let Connected { replaced, lost } = desk.queue.connect(session, worker, Instant::now());
        let entry = Session { worker_id: worker.worker_id.clone(), outgoing, close: close.clone() };
        desk.sessions.insert(session, entry);
        for older in replaced {
            self.forget(&mut desk, older).await?;
        }
        for failed in lost {
            let message = format!("worker {} came back without this lease", worker.worker_id);
            self.record_failed(&mut desk, &failed, &failure(FailureKind::LostWorker, message)).await?;
        }
        tracing::info!(worker_id = worker.worker_id, device = worker.device, "worker connected");
        self.dispatch(&mut desk).await?;
        Ok(Registered { session, close })
    }

    /// A worker's stream is gone: its lease waits for it to come back. At shutdown this is the coordinator's own doing:
    /// the lease is void after the restart and does not count as failed.
    pub(crate) async fn disconnected(&self, session: SessionId) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        if self.shutdown.is_cancelled() || !desk.sessions.contains_key(&session) {
            return Ok(());
        }
        desk.queue.disconnect(session, Instant::now());
        let worker_id = self.forget(&mut desk, session).await?;
        tracing::info!(worker_id, "the connection to the worker broke");
        self.dispatch(&mut desk).await
    }

    /// A worker drains: its lease goes back without counting as failed.
    pub(crate) async fn going_away(&self, session: SessionId, reason: &str) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        let given_back = desk.queue.drain(session, Instant::now());
        let worker_id = self.forget(&mut desk, session).await?;
        tracing::info!(worker_id, reason, "worker drains");
        if let Some(lease) = given_back {
            let mut change = self.store.change().await?;
            change.end_attempt(&lease.id, AttemptOutcome::Released(reason)).await?;
            change.release_task(&lease.key, lease.attempt, &worker_id).await?;
            change.commit().await?;
            self.tell_stored(&lease.key.job);
        }
        self.dispatch(&mut desk).await
    }

    async fn forget(&self, desk: &mut Desk, session: SessionId) -> Result<String, StoreError> {
        let Some(entry) = desk.sessions.remove(&session) else { return Ok(String::new()) };
        entry.close.cancel();
        let is_back = desk.sessions.values().any(|other| other.worker_id == entry.worker_id);
        if !is_back {
            let mut change = self.store.change().await?;
            change.worker_gone(&entry.worker_id).await?;
            change.commit().await?;
        }
        Ok(entry.worker_id)
    }

    /// A worker asks for a task.
    pub(crate) async fn lease_requested(&self, session: SessionId) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        desk.queue.park(session);
        self.dismiss_if_idle(&mut desk);
        self.dispatch(&mut desk).await
    }

    /// A sign of life. A worker that works on a lease it no longer holds is told to stop.
    pub(crate) async fn heartbeat(&self, session: SessionId, heartbeat: Heartbeat) {
        let Heartbeat { lease_id, attempt, stage, done, total } = heartbeat;
        if lease_id.is_empty() {
            return;
        }
        let mut desk = self.desk.lock().await;
        match desk.queue.heartbeat(session, &lease_id, attempt, Instant::now()) {
            Ok(lease) => {
                let lease = lease.clone();
                let (frame, view) = match lease.key.task {
                    Task::Frame(frame) => (frame, String::new()),
                    Task::Tracks(position) => (0, desk.view_name(&lease.key.job, position)),
                };
                let progress = Progress { stage, frame, done, total, worker_id: lease.worker_id, view };
                self.tell(Notice::Transient(lease.key.job, Event::Progress(progress)));
            }
            Err(stale) => {
                let reason = stale.to_string();
                desk.send(session, Message::CancelLease(CancelLease { lease_id, reason }));
            }
        }
    }

    /// Leases without a sign of life expire.
    pub(crate) async fn tick(&self, now: Instant) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        for failed in desk.queue.expire(now) {
            let FailedLease { lease, .. } = &failed;
            let worker = &lease.worker_id;
            let message = if desk.sessions.contains_key(&lease.session) {
                format!("no heartbeat of worker {worker} for {:?}", self.options.lease_duration)
            } else {
                format!("the connection to worker {worker} broke, and it did not come back")
            };
            let lost = failure(FailureKind::LostWorker, message);
            let reason = "the lease has expired".to_owned();
            desk.send(
                lease.session,
                Message::CancelLease(CancelLease { lease_id: lease.id.clone(), reason }),
            );
            self.record_failed(&mut desk, &failed, &lost).await?;
        }
        if self.options.dismiss_workers_when_idle {
            self.give_up_beyond_all_workers(&mut desk).await?;
        }
        self.dispatch(&mut desk).await?;
        // That no worker has come for long enough is no event of its own.
        for job in desk.active.keys().filter(|job| desk.queue.has_own_work(job, now)) {
            desk.changed(job);
        }
        Ok(())
    }

    /// Gives ready tasks to waiting workers: granted on disk before the worker hears of it.
    pub(super) async fn dispatch(&self, desk: &mut Desk) -> Result<(), StoreError> {
        let new_lease_id = || uuid::Uuid::now_v7().simple().to_string();
        for lease in desk.queue.assign(Instant::now(), new_lease_id) {
            self.grant(desk, lease).await?;
        }
        self.tell_workers(desk);
        Ok(())
    }

    async fn grant(&self, desk: &mut Desk, lease: Lease) -> Result<(), StoreError> {
        self.record_grant(&lease).await?;
        let job = &lease.key.job;
        let task = match lease.key.task {
            Task::Frame(frame) => Some(lease::Task::Frame(self.frame_job(job, frame).await?)),
            // Without tracks to be made there would be no lease of them.
            Task::Tracks(position) => self.track_job(desk, job, position).await?.map(lease::Task::Tracks),
        };
        let likely_next = match desk.queue.likely_next(&lease).map(|next| (next.job.clone(), next.task)) {
            Some((job, Task::Frame(frame))) => self
                .frame_job(&job, frame)
                .await
                .inspect_err(|error| tracing::warn!(%error, frame, "no hint at the next frame"))
                .ok(),
            Some((_, Task::Tracks(_))) | None => None,
        };
        let message = LeaseMessage { lease_id: lease.id.clone(), attempt: lease.attempt, task, likely_next };
        desk.send(lease.session, Message::Lease(message));
        Ok(())
    }

    /// A lease is on disk before anybody begins with it.
    pub(super) async fn record_grant(&self, lease: &Lease) -> Result<(), StoreError> {
        let Lease { id, attempt, key, worker_id, .. } = lease;
        let mut change = self.store.change().await?;
        change.grant(lease).await?;
        let event = TaskEvent { attempt: *attempt, worker: worker_id, ..TaskEvent::of(key.task) };
        change.append_task_event(&key.job, TaskState::Leased, &event).await?;
        change.commit().await?;
        self.tell_stored(&key.job);
        let (kind, number) = (key.task.kind(), key.task.number());
        tracing::info!(job_id = %key.job, kind, number, attempt, worker_id, lease_id = id, "leased");
        Ok(())
    }

    async fn frame_job(&self, job: &JobId, frame: u32) -> Result<FrameJob, StoreError> {
        let record = self.store.frame(job, frame).await?;
        let record = record.ok_or_else(|| StoreError::Value {
            place: "tasks",
            value: format!("no row for frame {frame} of job {job}"),
        })?;
        record.request()
    }
}

/// Shared by the services.
pub(crate) type SharedHub = Arc<Hub>;
