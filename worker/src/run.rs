//! What a worker does with each message, from registration to dismissal.

use std::{
    future::pending,
    hash::{Hash, Hasher},
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use splat::{engine::Engine, frame::FrameProgress};
use thiserror::Error;
use tokio::{
    sync::watch,
    task::JoinHandle,
    time::{Instant, MissedTickBehavior, interval, interval_at},
};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use trackersplat_proto::{
    ids::{InvalidId, check_worker_id},
    v1::{
        Failure, FailureKind, GoingAway, Heartbeat, Lease, LeaseRequest, Register, Report,
        coordinator_message, worker_message,
    },
};

use crate::{
    ahead::Ahead,
    blobs::Blobs,
    connection::{self, Connection, ConnectionError},
    job::{JobRunner, Outcome, Reconstruct},
};

/// Longest wait for the last words to reach the coordinator, and for the running step to end, at shutdown.
const FAREWELL: Duration = Duration::from_secs(3);
/// Heartbeats before an unacknowledged report is sent again.
const HEARTBEATS_PER_RESEND: u32 = 3;
/// Heartbeat period for a coordinator that states none.
const DEFAULT_HEARTBEAT: Duration = Duration::from_secs(1);
/// Pause before a stream that broke is opened again, so that a coordinator that drops everybody is not flooded.
const RECONNECT_PAUSE: Duration = Duration::from_millis(100);

/// How a worker is set up.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// The coordinator's address, `http://host:port`.
    pub coordinator: String,
    /// Threads of the worker's pool, at least 1.
    pub threads: usize,
    /// Name of the worker, stable across restarts; `None`: the one in `state_dir`, else a new one.
    pub worker_id: Option<String>,
    /// Folder that remembers the worker's name.
    pub state_dir: Option<PathBuf>,
    /// How long the coordinator may be away before the worker gives up.
    pub reconnect_for: Duration,
    /// Whether bulk always goes through the coordinator, even where its store's directory is visible.
    pub remote_blobs: bool,
}

/// Why a worker ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// The coordinator needs no more workers.
    Dismissed,
    /// The caller asked for it.
    ShutDown,
}

/// Why a worker ended badly.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The address is no `http://host:port`.
    #[error("coordinator address '{0}' is not of the form http://host:port")]
    BadAddress(String),
    /// The name cannot be sent.
    #[error(transparent)]
    BadName(#[from] InvalidId),
    /// No thread pool of that size.
    #[error("cannot start {threads} worker threads: {reason}; give a smaller number, at least 1")]
    Threads {
        /// Threads that were asked for.
        threads: usize,
        /// What the system says.
        reason: String,
    },
    /// The worker's name cannot be read or remembered.
    #[error("worker state in {path}: {reason}; give a folder that can be written")]
    State {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: String,
    },
    /// The coordinator does not want this worker.
    #[error("the coordinator at {coordinator} refuses this worker: {reason}")]
    Refused {
        /// Its address.
        coordinator: String,
        /// What it says.
        reason: String,
    },
    /// The coordinator stayed away for longer than `reconnect_for`.
    #[error(
        "no coordinator at {coordinator} for {seconds} s: {reason}; check the address and that it runs, then start the worker again"
    )]
    Unreachable {
        /// Its address.
        coordinator: String,
        /// How long it was tried.
        seconds: u64,
        /// The last failure.
        reason: String,
    },
}

/// Works for a coordinator until it is dismissed, shut down, or given up on.
///
/// A broken stream is opened again for up to [`WorkerOptions::reconnect_for`]; the running frame goes on meanwhile.
/// The new stream names the lease that the worker still works on, or whose report has no receipt yet, and the lease goes
/// on over it if the worker is back in time. Whether its result counts is the coordinator's to say: a lease that has
/// expired, or of before the coordinator was restarted, is cancelled at the next heartbeat, or its report is answered
/// with a receipt that is not accepted. A report that was accepted before, and comes again because its receipt was lost,
/// is accepted again; one that is being verified gets no receipt yet, so it is sent until it gets one. Then the worker
/// asks for the next frame. Needs a tokio runtime with timers and I/O.
pub async fn run(
    options: WorkerOptions,
    engine: Arc<dyn Engine>,
    shutdown: CancellationToken,
) -> Result<Exit, WorkerError> {
    let engine_name = engine.name().to_owned();
    let reconstruct: Reconstruct =
        Arc::new(move |input, progress| splat::frame::reconstruct_frame(engine.as_ref(), input, progress));
    run_with(options, &engine_name, reconstruct, shutdown).await
}

/// [`run`] with any way to reconstruct a frame.
pub(crate) async fn run_with(
    options: WorkerOptions,
    engine: &str,
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
            coordinator = worker.options.coordinator,
            "registered"
        );
        match worker.serve(connected).await {
            Ok(exit) => return Ok(exit),
            Err(ConnectionError::Refused(reason)) => return Err(worker.refused(reason)),
            Err(ConnectionError::Lost(reason)) => {
                tracing::warn!(reason, "lost the coordinator, connecting again")
            }
        }
        tokio::time::sleep(RECONNECT_PAUSE).await;
    }
}

/// A lease whose frame is being computed.
struct RunningLease {
    lease_id: String,
    attempt: u32,
    progress: watch::Receiver<FrameProgress>,
    cancel: CancellationToken,
    task: JoinHandle<Option<Outcome>>,
}

struct Worker {
    options: WorkerOptions,
    register: Register,
    jitter_seed: u64,
    channel: Channel,
    runner: Arc<JobRunner>,
    shutdown: CancellationToken,
    running: Option<RunningLease>,
    /// The last result, until the coordinator says it has it.
    unacknowledged: Option<Report>,
}

impl Worker {
    fn new(
        options: WorkerOptions,
        engine: &str,
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
            engine: engine.to_owned(),
            device: format!("{} threads, {}", options.threads, std::env::consts::ARCH),
            threads: u32::try_from(options.threads).unwrap_or(u32::MAX),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            held_lease_id: String::new(),
        };
        let runner = Arc::new(JobRunner {
            reconstruct,
            pool: Arc::new(pool),
            cache: Arc::default(),
            ahead: Ahead::default(),
            patience: options.reconnect_for,
            jitter_seed,
        });
        Ok(Self {
            options,
            register,
            jitter_seed,
            channel,
            runner,
            shutdown,
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
    async fn serve(&mut self, mut connection: Connection) -> Result<Exit, ConnectionError> {
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
                outcome = finished(&mut self.running) => {
                    self.unacknowledged = self.report_of(outcome);
                    match self.unacknowledged {
                        Some(_) => self.send_report(&connection)?,
                        None => connection.send(worker_message::Message::LeaseRequest(LeaseRequest {}))?,
                    }
                    resend.reset();
                }
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

    /// Begins a lease. One at a time: a lease that comes while a frame runs is left to expire.
    fn start(&mut self, lease: Lease, blobs: &Blobs) {
        let Lease { lease_id, attempt, job, likely_next } = lease;
        if let Some(running) = &self.running {
            tracing::warn!(
                lease_id,
                running = running.lease_id,
                "leased while busy; the new lease is left to expire"
            );
            return;
        }
        let job = job.unwrap_or_default();
        tracing::info!(lease_id, attempt, job_id = job.job_id, frame = job.frame, "frame started");
        let cancel = CancellationToken::new();
        let (sender, progress) = watch::channel(FrameProgress { stage: "fetch", done: 0, total: 0 });
        let (runner, blobs, job_cancel) = (self.runner.clone(), blobs.clone(), cancel.clone());
        let task =
            tokio::spawn(async move { runner.run(&job, likely_next, &blobs, sender, &job_cancel).await });
        self.running = Some(RunningLease { lease_id, attempt, progress, cancel, task });
    }

    fn cancel(&self, lease_id: &str, reason: &str) {
        let Some(running) = self.running.as_ref().filter(|running| running.lease_id == lease_id) else {
            return;
        };
        tracing::info!(lease_id, reason, "lease cancelled");
        running.cancel.cancel();
    }

    /// Takes the finished lease out and makes its report; `None` if it was cancelled.
    fn report_of(&mut self, outcome: Option<Outcome>) -> Option<Report> {
        let running = self.running.take()?;
        let outcome = outcome?;
        match &outcome {
            Outcome::Success(_) => tracing::info!(lease_id = running.lease_id, "frame done"),
            Outcome::Failure(failure) => {
                tracing::warn!(
                    lease_id = running.lease_id,
                    kind = failure.kind().as_str_name(),
                    failure.message,
                    "frame failed"
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

    /// Says goodbye and stops the running frame.
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

/// The outcome of the running lease; never ready without one.
async fn finished(running: &mut Option<RunningLease>) -> Option<Outcome> {
    let Some(running) = running else { return pending().await };
    match (&mut running.task).await {
        Ok(outcome) => outcome,
        Err(error) => Some(Outcome::Failure(Failure {
            kind: FailureKind::Bug.into(),
            message: format!("the frame job's task: {error}"),
        })),
    }
}

fn heartbeat_period(milliseconds: u32) -> Duration {
    match milliseconds {
        0 => DEFAULT_HEARTBEAT,
        milliseconds => Duration::from_millis(milliseconds.into()),
    }
}

fn thread_pool(threads: usize) -> Result<rayon::ThreadPool, WorkerError> {
    let failed = |reason: String| WorkerError::Threads { threads, reason };
    if threads == 0 {
        return Err(failed("a worker needs a thread".into()));
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|index| format!("frame-{index}"))
        .build()
        .map_err(|error| failed(error.to_string()))
}

/// The given name, else the remembered one, else a new one that is remembered if there is a folder for it.
fn worker_id(options: &WorkerOptions, incarnation: uuid::Uuid) -> Result<String, WorkerError> {
    if let Some(id) = &options.worker_id {
        return Ok(id.clone());
    }
    let fresh = format!("worker-{}", incarnation.simple());
    let Some(directory) = &options.state_dir else { return Ok(fresh) };
    let path = directory.join("worker-id");
    let failed = |error: std::io::Error| WorkerError::State { path: path.clone(), reason: error.to_string() };
    match std::fs::read_to_string(&path) {
        Ok(known) if !known.trim().is_empty() => return Ok(known.trim().to_owned()),
        Ok(_) => {}
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => return Err(failed(error)),
    }
    remember(directory, &path, &fresh).map_err(failed)?;
    Ok(fresh)
}

fn remember(directory: &Path, path: &Path, id: &str) -> std::io::Result<()> {
    std::fs::create_dir_all(directory)?;
    let temporary = path.with_extension("partial");
    std::fs::write(&temporary, id)?;
    std::fs::rename(temporary, path)
}

#[cfg(test)]
#[path = "run_tests.rs"]
mod tests;
