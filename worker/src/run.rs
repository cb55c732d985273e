//! What a worker does with each message, from registration to dismissal.

use std::{
    future::pending,
    hash::{Hash, Hasher},
    sync::Arc,
    time::Duration,
};

use splat::{engine::Engine, frame::FrameProgress};
use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch},
    task::JoinHandle,
    time::{Instant, MissedTickBehavior, interval, interval_at},
};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use trackersplat_proto::{
    ids::check_worker_id,
    v1::{
        Failure, FailureKind, FieldReport, FrameJob, GoingAway, Heartbeat, Lease, LeaseRequest, Register,
        Report, TrackedField, coordinator_message, lease, worker_message,
    },
};

use crate::{
    ahead::Ahead,
    blobs::Blobs,
    connection::{self, Connection, ConnectionError},
    job::{JobRunner, Outcome, Reconstruct},
    setup::{Exit, WorkerError, WorkerOptions, thread_pool, worker_id},
    tracks::Said,
};

/// Longest wait for the last words to reach the coordinator, and for the running step to end, at shutdown.
const FAREWELL: Duration = Duration::from_secs(3);
/// Heartbeats before an unacknowledged report is sent again.
const HEARTBEATS_PER_RESEND: u32 = 3;
/// Heartbeat period for a coordinator that states none.
const DEFAULT_HEARTBEAT: Duration = Duration::from_secs(1);
/// Pause before a stream that broke is opened again, so that a coordinator that drops everybody is not flooded.
const RECONNECT_PAUSE: Duration = Duration::from_millis(100);

/// Why a stream is not served any longer, if the worker's work is not over.
enum StreamEnd {
    Connection(ConnectionError),
    /// The device is lost for good; the coordinator has the task back.
    Device(String),
}

impl From<ConnectionError> for StreamEnd {
    fn from(error: ConnectionError) -> Self {
        Self::Connection(error)
    }
}

/// Works for a coordinator until it is dismissed, shut down, or given up on.
///
/// A broken stream is opened again for up to [`WorkerOptions::reconnect_for`]; the running task goes on meanwhile.
/// The new stream names the lease that the worker still works on, or whose report has no receipt yet, and the lease goes
/// on over it if the worker is back in time. Whether its result counts is the coordinator's to say: a lease that has
/// expired, or of before the coordinator was restarted, is cancelled at the next heartbeat, or its report is answered
/// with a receipt that is not accepted. A report that was accepted before, and comes again because its receipt was lost,
/// is accepted again; one that is being verified gets no receipt yet, so it is sent until it gets one. Then the worker
/// asks for the next task. Needs a tokio runtime with timers and I/O.
///
/// After a failed task the worker asks for the next one only if the engine's device is there, or came back
/// ([`Engine::check`]); else it ends with [`WorkerError::Device`], so that it does not fail one task after the other.
pub async fn run(
    options: WorkerOptions,
    engine: Arc<dyn Engine>,
    shutdown: CancellationToken,
) -> Result<Exit, WorkerError> {
    let computing = engine.clone();
    let reconstruct: Reconstruct =
        Arc::new(move |input, progress| splat::frame::reconstruct_frame(computing.as_ref(), input, progress));
    run_with(options, engine, reconstruct, shutdown).await
}

/// [`run`] with any way to reconstruct a frame.
pub(crate) async fn run_with(
    options: WorkerOptions,
    engine: Arc<dyn Engine>,
    reconstruct: Reconstruct,
    shutdown: CancellationToken,
) -> Result<Exit, WorkerError> {
    let mut worker = Worker::new(options, engine, reconstruct, shutdown)?;
    loop {
        let connected = tokio::select! {
            biased;
            () = worker.shutdown.cancelled() => return Ok(worker.stop(None).await),
            connected = worker.connect() => connected?,
        };
        tracing::info!(
            worker_id = worker.register.worker_id,
            device = worker.register.device,
            coordinator = worker.options.coordinator,
            "registered"
        );
        match worker.serve(connected).await {
            Ok(exit) => return Ok(exit),
            Err(StreamEnd::Device(reason)) => return Err(WorkerError::Device { reason }),
            Err(StreamEnd::Connection(ConnectionError::Refused(reason))) => {
                return Err(worker.refused(reason));
            }
            Err(StreamEnd::Connection(ConnectionError::Lost(reason))) => {
                tracing::warn!(reason, "lost the coordinator, connecting again")
            }
        }
        tokio::time::sleep(RECONNECT_PAUSE).await;
    }
}

/// A lease whose task is being done.
struct RunningLease {
    lease_id: String,
    attempt: u32,
    progress: watch::Receiver<FrameProgress>,
    /// Track fields that are stored and not yet said.
    fields: mpsc::UnboundedReceiver<TrackedField>,
    cancel: CancellationToken,
    task: JoinHandle<Option<Outcome>>,
}

struct Worker {
    options: WorkerOptions,
    register: Register,
    jitter_seed: u64,
    channel: Channel,
    engine: Arc<dyn Engine>,
    runner: Arc<JobRunner>,
    shutdown: CancellationToken,
    /// Whether a task failed since the device was last looked at.
    is_device_in_doubt: bool,
    running: Option<RunningLease>,
    /// The last result, until the coordinator says it has it.
    unacknowledged: Option<Report>,
}

impl Worker {
    fn new(
        options: WorkerOptions,
        engine: Arc<dyn Engine>,
        reconstruct: Reconstruct,
        shutdown: CancellationToken,
    ) -> Result<Self, WorkerError> {
        let channel = connection::channel(&options.coordinator)?;
        let incarnation = uuid::Uuid::now_v7();
        let worker_id = worker_id(&options, incarnation)?;
        check_worker_id(&worker_id)?;
        let pool = thread_pool(options.threads)?;
        let mut hasher = std::hash::DefaultHasher::new();
        incarnation.hash(&mut hasher);
        let jitter_seed = hasher.finish();
        let register = Register {
            worker_id,
            incarnation: incarnation.to_string(),
            engine: engine.name().to_owned(),
            device: engine.device_name().map_or_else(
                || format!("{} threads, {}", options.threads, std::env::consts::ARCH),
                str::to_owned,
            ),
            threads: u32::try_from(options.threads).unwrap_or(u32::MAX),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            held_lease_id: String::new(),
        };
        let runner = Arc::new(JobRunner {
            reconstruct,
            pool: Arc::new(pool),
            cache: Arc::default(),
            ahead: Ahead::default(),
            last_tracker: Arc::default(),
            patience: options.reconnect_for,
            jitter_seed,
        });
        Ok(Self {
            options,
            register,
            jitter_seed,
            channel,
            engine,
            runner,
            shutdown,
            is_device_in_doubt: false,
            running: None,
            unacknowledged: None,
        })
    }

    async fn connect(&self) -> Result<Connection, WorkerError> {
        let patience = self.options.reconnect_for;
        let register = Register { held_lease_id: self.held_lease_id(), ..self.register.clone() };
        connection::connect(&self.channel, &register, patience, self.jitter_seed).await.map_err(|error| {
            match error {
                ConnectionError::Refused(reason) => self.refused(reason),
                ConnectionError::Lost(reason) => WorkerError::Unreachable {
                    coordinator: self.options.coordinator.clone(),
                    seconds: patience.as_secs(),
                    reason,
                },
            }
        })
    }

    fn held_lease_id(&self) -> String {
        let running = self.running.as_ref().map(|running| running.lease_id.clone());
        let unacknowledged = || self.unacknowledged.as_ref().map(|report| report.lease_id.clone());
        running.or_else(unacknowledged).unwrap_or_default()
    }

    fn refused(&self, reason: String) -> WorkerError {
        WorkerError::Refused { coordinator: self.options.coordinator.clone(), reason }
    }

    /// Works over one stream until it breaks or the worker's work is over.
    async fn serve(&mut self, mut connection: Connection) -> Result<Exit, StreamEnd> {
        let blobs = if self.options.remote_blobs {
            Blobs::through_coordinator(self.channel.clone())
        } else {
            Blobs::open(&connection.welcome, self.channel.clone()).await
        };
        let period = heartbeat_period(connection.welcome.heartbeat_interval_ms);
        let mut heartbeat = interval(period);
        heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let resend_period = period * HEARTBEATS_PER_RESEND;
        let mut resend = interval_at(Instant::now() + resend_period, resend_period);
        let shutdown = self.shutdown.clone();
        let field_room = connection.field_room.clone();

        if self.unacknowledged.is_some() {
            self.send_report(&connection)?;
        } else if self.running.is_none() {
            connection.send(worker_message::Message::LeaseRequest(LeaseRequest {}))?;
        }
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return Ok(self.stop(Some(connection)).await),
                message = connection.receive() => match message? {
                    coordinator_message::Message::Lease(lease) => self.start(lease, &blobs),
                    coordinator_message::Message::CancelLease(cancel) => self.cancel(&cancel.lease_id, &cancel.reason),
                    coordinator_message::Message::Receipt(receipt) => {
                        if self.acknowledge(&receipt.lease_id, receipt.accepted, &receipt.reason) {
                            let looked = tokio::select! {
                                biased;
                                // To open a device may take long, and nobody needs it any more.
                                () = shutdown.cancelled() => return Ok(self.stop(Some(connection)).await),
                                looked = self.look_at_device() => looked,
                            };
                            if let Err(reason) = looked {
                                let goodbye = GoingAway { reason: reason.clone() };
                                // A stream that breaks right now brings no device back.
                                let _ = connection.send(worker_message::Message::GoingAway(goodbye));
                                connection.close(FAREWELL).await;
                                return Err(StreamEnd::Device(reason));
                            }
                            connection.send(worker_message::Message::LeaseRequest(LeaseRequest {}))?;
                        }
                    }
                    coordinator_message::Message::Dismiss(dismiss) => {
                        tracing::info!(reason = dismiss.reason, "dismissed");
                        self.end_running().await;
                        return Ok(Exit::Dismissed);
                    }
                    coordinator_message::Message::Welcome(_) => tracing::warn!("a second welcome, ignored"),
                },
                step = next_step(&mut self.running, &field_room) => match step {
                    Step::Field(field, room) => connection.send_field(field, room)?,
                    Step::Ended(outcome) => {
                        self.unacknowledged = self.report_of(outcome);
                        match self.unacknowledged {
                            Some(_) => self.send_report(&connection)?,
                            None => connection.send(worker_message::Message::LeaseRequest(LeaseRequest {}))?,
                        }
                        resend.reset();
                    }
                },
                _ = heartbeat.tick() => {
                    if self.running.is_none() && self.unacknowledged.is_none() {
                        self.runner.ahead.forget();
                    }
                    connection.send(self.heartbeat())?;
                }
                _ = resend.tick(), if self.unacknowledged.is_some() => self.send_report(&connection)?,
            }
        }
    }

    /// Begins a lease. One at a time: a lease that comes while a task runs is left to expire.
    fn start(&mut self, lease: Lease, blobs: &Blobs) {
        let Lease { lease_id, attempt, task, likely_next } = lease;
        if let Some(running) = &self.running {
            tracing::warn!(
                lease_id,
                running = running.lease_id,
                "leased while busy; the new lease is left to expire"
            );
            return;
        }
        // A lease of nothing fails as a frame that names nothing.
        let task = task.unwrap_or_else(|| lease::Task::Frame(FrameJob::default()));
        match &task {
            lease::Task::Frame(job) => {
                tracing::info!(lease_id, attempt, job_id = job.job_id, frame = job.frame, "frame started");
            }
            lease::Task::Tracks(job) => {
                tracing::info!(lease_id, attempt, job_id = job.job_id, view = job.view, "tracks started");
            }
        }
        let cancel = CancellationToken::new();
        let (sender, progress) = watch::channel(FrameProgress { stage: "fetch", done: 0, total: 0 });
        let (said, fields) = mpsc::unbounded_channel();
        let said = Said { progress: sender, fields: said };
        let (runner, blobs, task_cancel) = (self.runner.clone(), blobs.clone(), cancel.clone());
        let task =
            tokio::spawn(async move { runner.run(task, likely_next, &blobs, said, &task_cancel).await });
        self.running = Some(RunningLease { lease_id, attempt, progress, fields, cancel, task });
    }

    fn cancel(&self, lease_id: &str, reason: &str) {
        let Some(running) = self.running.as_ref().filter(|running| running.lease_id == lease_id) else {
            return;
        };
        tracing::info!(lease_id, reason, "lease cancelled");
        running.cancel.cancel();
    }

    /// Whether the device is there for another task; it may be opened again for that, which takes a while.
    async fn look_at_device(&mut self) -> Result<(), String> {
        if !self.is_device_in_doubt {
            return Ok(());
        }
        let engine = self.engine.clone();
        let looked = tokio::task::spawn_blocking(move || engine.check()).await;
        match looked {
            Ok(Ok(())) => {
                self.is_device_in_doubt = false;
                Ok(())
            }
            Ok(Err(error)) => Err(error.to_string()),
            Err(error) => Err(format!("looking at it: {error}")),
        }
    }

    /// Takes the finished lease out and makes its report; `None` if it was cancelled.
    fn report_of(&mut self, outcome: Option<Outcome>) -> Option<Report> {
        let running = self.running.take()?;
        let outcome = outcome?;
        match &outcome {
            Outcome::Success(_) | Outcome::Tracked(_) => tracing::info!(lease_id = running.lease_id, "done"),
            Outcome::Failure(failure) => {
                self.is_device_in_doubt = true;
                tracing::warn!(
                    lease_id = running.lease_id,
                    kind = failure.kind().as_str_name(),
                    failure.message,
                    "failed"
                );
            }
        }
        Some(Report { lease_id: running.lease_id, attempt: running.attempt, outcome: Some(outcome) })
    }

    fn send_report(&self, connection: &Connection) -> Result<(), ConnectionError> {
        match &self.unacknowledged {
            Some(report) => connection.send(worker_message::Message::Report(report.clone())),
            None => Ok(()),
        }
    }

    /// Whether the receipt was for the report that waits; a repeated receipt is not.
    fn acknowledge(&mut self, lease_id: &str, accepted: bool, reason: &str) -> bool {
        if self.unacknowledged.as_ref().is_none_or(|report| report.lease_id != lease_id) {
            return false;
        }
        if !accepted {
            tracing::warn!(lease_id, reason, "the coordinator dropped the report");
        }
        self.unacknowledged = None;
        true
    }

    fn heartbeat(&self) -> worker_message::Message {
        let Some(running) = &self.running else {
            return worker_message::Message::Heartbeat(Heartbeat::default());
        };
        let FrameProgress { stage, done, total } = *running.progress.borrow();
        worker_message::Message::Heartbeat(Heartbeat {
            lease_id: running.lease_id.clone(),
            attempt: running.attempt,
            stage: stage.to_owned(),
            done,
            total,
        })
    }

    /// Says goodbye and stops the running task.
    async fn stop(&mut self, connection: Option<Connection>) -> Exit {
        if let Some(connection) = connection {
            let reason = "the worker was asked to stop".to_owned();
            // A stream that takes no message any more is as good as closed.
            let _ = connection.send(worker_message::Message::GoingAway(GoingAway { reason }));
            tokio::join!(connection.close(FAREWELL), self.end_running());
        } else {
            self.end_running().await;
        }
        Exit::ShutDown
    }

    async fn end_running(&mut self) {
        let Some(running) = self.running.take() else { return };
        running.cancel.cancel();
        if tokio::time::timeout(FAREWELL, running.task).await.is_err() {
            tracing::warn!(lease_id = running.lease_id, "the running step did not end in time");
        }
    }
}

/// What becomes of the running lease.
enum Step {
    /// A track field is stored, and there is room for it in the queue to the coordinator.
    Field(FieldReport, OwnedSemaphorePermit),
    /// The task has ended; without an outcome it was cancelled.
    Ended(Option<Outcome>),
}

/// The next step of the running lease; never ready without one. Fields that are not yet said when the task ends well are in
/// its outcome; those of one that failed are made again.
async fn next_step(running: &mut Option<RunningLease>, field_room: &Arc<Semaphore>) -> Step {
    let Some(running) = running else { return pending().await };
    let ended = tokio::select! {
        biased;
        ended = &mut running.task => ended,
        Some((field, room)) = next_field(&mut running.fields, field_room) => {
            let (lease_id, attempt) = (running.lease_id.clone(), running.attempt);
            return Step::Field(FieldReport { lease_id, attempt, field: Some(field) }, room);
        }
    };
    Step::Ended(ended.unwrap_or_else(|error| {
        let message = format!("the worker's task: {error}");
        Some(Outcome::Failure(Failure { kind: FailureKind::Bug.into(), message }))
    }))
}

/// The next field once there is room for it; until then it waits where it is, also for another stream.
async fn next_field(
    fields: &mut mpsc::UnboundedReceiver<TrackedField>,
    room: &Arc<Semaphore>,
) -> Option<(TrackedField, OwnedSemaphorePermit)> {
    let room = room.clone().acquire_owned().await.ok()?;
    Some((fields.recv().await?, room))
}

fn heartbeat_period(milliseconds: u32) -> Duration {
    match milliseconds {
        0 => DEFAULT_HEARTBEAT,
        milliseconds => Duration::from_millis(milliseconds.into()),
    }
}

#[cfg(test)]
#[path = "run_tests.rs"]
mod tests;
