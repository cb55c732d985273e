//! Where jobs, workers and clients meet.
//!
//! One lock, [`Desk`], orders everything that happens: a change is made in the queue, written to the database, and
//! only then told to workers and clients. If the database fails, the coordinator ends: after a restart it goes on from
//! what is written.

mod fields;
mod frames;
mod jobs;
mod reports;
mod sessions;
mod tracks;
mod windows;

use std::{
    collections::{BTreeMap, HashMap},
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::Instant,
};

use splat::{clip::Clip, engine::Engine, gaussians::Gaussians};
use tokio::{
    sync::{Semaphore, broadcast, watch},
    task::JoinSet,
};
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Blob, FailureKind, JobEvent, Progress, WorkersChanged, job_event::Event};

use self::sessions::Session;
pub(crate) use self::sessions::{OUTGOING_QUEUE, Registered, SharedHub};
use crate::{
    blobs::BlobStore,
    compute::{Compute, panic_message},
    failure::failure,
    ledger::TrackLedger,
    options::ServeOptions,
    queue::{JobId, Queue, QueuePolicy, SessionId},
    store::{Store, StoreError},
};

/// Notices that a slow client may lag behind before transient ones are dropped; stored ones are read again.
const NOTICES: usize = 1024;

/// What clients that watch are told.
#[derive(Clone, Debug)]
pub(crate) enum Notice {
    /// The job has new stored events.
    Stored(JobId),
    /// How things are now; the sequence number is the watcher's.
    Transient(JobId, Event),
}

/// What results of a job's frames are verified against.
pub(crate) struct FrameBase {
    pub(crate) model: Gaussians,
    pub(crate) blob: Blob,
    /// The blob's digest as bytes.
    pub(crate) digest: [u8; 32],
    pub(crate) output: PathBuf,
}

/// A job that has not ended.
pub(crate) struct ActiveJob {
    /// Cancelled when the job is to stop, or the coordinator.
    pub(crate) stop: CancellationToken,
    /// Marked when something happens that the driver may wait for.
    pub(crate) changed: watch::Sender<()>,
    /// The clip as the submission opened and digested it.
    pub(crate) clip: Option<Arc<Clip>>,
    base: Option<Arc<FrameBase>>,
    tracks: Option<TrackLedger>,
    /// Connected workers and waiting tasks as clients were last told.
    told: Option<(usize, usize)>,
}

/// What the lock protects.
pub(crate) struct Desk {
    queue: Queue,
    sessions: BTreeMap<SessionId, Session>,
    active: HashMap<JobId, ActiveJob>,
    next_session: u64,
    /// Whether a job has ended since the start, so that idle workers of an embedded coordinator may go.
    has_worked: bool,
}

/// The coordinator's shared state.
pub(crate) struct Hub {
    pub(crate) options: ServeOptions,
    pub(crate) store: Store,
    pub(crate) blobs: BlobStore,
    pub(crate) compute: Compute,
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) shutdown: CancellationToken,
    /// One job at a time uses the compute pool, so that an earlier job is not slowed down by later ones.
    pub(crate) turn: Semaphore,
    /// One state of the tracker at a time is read for verification.
    reading_state: tokio::sync::Mutex<()>,
    /// One submission at a time, so that the same one twice is one job.
    pub(crate) submitting: tokio::sync::Mutex<()>,
    /// One submission of a URL at a time, by the URL's digest, so that no copy changes while another reads it.
    copying: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
    pub(crate) probe: Blob,
    desk: tokio::sync::Mutex<Desk>,
    notices: broadcast::Sender<Notice>,
    drivers: Mutex<JoinSet<()>>,
    fatal: Mutex<Option<StoreError>>,
}

impl Hub {
    pub(crate) fn new(
        options: ServeOptions,
        store: Store,
        blobs: BlobStore,
        probe: Blob,
        compute: Compute,
        engine: Arc<dyn Engine>,
        shutdown: CancellationToken,
    ) -> Self {
        let policy = QueuePolicy {
            max_attempts: options.max_attempts,
            lease_duration: options.lease_duration,
            reconnect_grace: options.reconnect_grace,
        };
        let desk = Desk {
            queue: Queue::new(policy, Instant::now()),
            sessions: BTreeMap::new(),
            active: HashMap::new(),
            next_session: 1,
            has_worked: false,
        };
        Self {
            options,
            store,
            blobs,
            compute,
            engine,
            shutdown,
            turn: Semaphore::new(1),
            reading_state: tokio::sync::Mutex::new(()),
            submitting: tokio::sync::Mutex::new(()),
            copying: Mutex::default(),
            probe,
            desk: tokio::sync::Mutex::new(desk),
            notices: broadcast::Sender::new(NOTICES),
            drivers: Mutex::new(JoinSet::new()),
            fatal: Mutex::new(None),
        }
    }

    /// What happens from now on.
    pub(crate) fn subscribe(&self) -> broadcast::Receiver<Notice> {
        self.notices.subscribe()
    }

    /// Folder of the blobs.
    pub(crate) fn blob_folder(&self) -> PathBuf {
        self.options.root.join("blobs")
    }

    /// Folder of frames that were decoded from videos.
    pub(crate) fn scratch_folder(&self) -> PathBuf {
        self.options.root.join("decoded")
    }

    /// Folder of clips that were copied from object stores.
    pub(crate) fn clip_folder(&self) -> PathBuf {
        self.options.root.join("clips")
    }

    /// Who holds this lock may change the copy of the clip whose URL has this digest.
    pub(crate) fn copying(&self, url_digest: &str) -> Arc<tokio::sync::Mutex<()>> {
        let mut copying = self.copying.lock().unwrap_or_else(PoisonError::into_inner);
        copying.retain(|_, lock| Arc::strong_count(lock) > 1);
        copying.entry(url_digest.to_owned()).or_default().clone()
    }

    /// Paths under the root that are no job's output.
    pub(crate) fn private_paths(&self) -> Vec<PathBuf> {
        let root = &self.options.root;
        ["state.sqlite", "state.sqlite-wal", "state.sqlite-shm", "lock", "blobs", "clips", "decoded", "jobs"]
            .map(|name| root.join(name))
            .into()
    }

    /// The coordinator cannot go on: it ends, and a restart goes on from what is written.
    pub(crate) fn fail(&self, error: StoreError) {
        if error.is_closed() {
            // Only this coordinator closes its state, after it was asked to end: a request that came too late.
            return;
        }
        tracing::error!(%error, "the coordinator's state cannot be read or written; shutting down");
        let mut fatal = self.fatal.lock().unwrap_or_else(PoisonError::into_inner);
        fatal.get_or_insert(error);
        self.shutdown.cancel();
    }

    /// Why the coordinator ended, if it was not asked to.
    pub(crate) fn take_fatal(&self) -> Option<StoreError> {
        self.fatal.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Runs a job's driver beside everything else. If it panics, its run fails.
    pub(crate) fn spawn_driver(
        self: &Arc<Self>,
        job: JobId,
        stop: CancellationToken,
        driver: impl Future<Output = ()> + Send + 'static,
    ) {
        let hub = self.clone();
        let driver = async move {
            // A task of its own, so that a panic ends that task only.
            let Err(error) = tokio::spawn(driver).await else { return };
            let defect = failure(FailureKind::Bug, panic_message(error));
            if let Err(error) = hub.fail_run(&job, &stop, defect).await {
                hub.fail(error);
            }
        };
        let mut drivers = self.drivers.lock().unwrap_or_else(PoisonError::into_inner);
        while drivers.try_join_next().is_some() {}
        drivers.spawn(driver);
    }

    /// Waits until every driver has ended; they do once shutdown is requested.
    pub(crate) async fn drivers_ended(&self) {
        let drivers = std::mem::take(&mut *self.drivers.lock().unwrap_or_else(PoisonError::into_inner));
        drivers.join_all().await;
    }

    /// Tells watching clients how far a job's stage is.
    pub(crate) fn progress(&self, job: &JobId, stage: &str, done: u64, total: u64) {
        let progress = Progress { stage: stage.to_owned(), done, total, ..Progress::default() };
        self.tell(Notice::Transient(job.clone(), Event::Progress(progress)));
    }

    fn tell(&self, notice: Notice) {
        // Without a watching client there is nobody to tell.
        let _ = self.notices.send(notice);
    }

    fn tell_stored(&self, job: &JobId) {
        self.tell(Notice::Stored(job.clone()));
    }

    /// How many workers there are and how many of the job's tasks wait for one; `None` unless the job is active.
    pub(crate) async fn workers_now(&self, job: &str, sequence: u64) -> Option<JobEvent> {
        let desk = self.desk.lock().await;
        desk.active.contains_key(job).then(|| JobEvent {
            sequence,
            job_id: job.to_owned(),
            event: Some(workers_event(desk.queue.connected(), desk.queue.waiting_tasks(job))),
        })
    }

    /// Tells watching clients of every active job if workers or waiting tasks have changed.
    fn tell_workers(&self, desk: &mut Desk) {
        let connected = desk.queue.connected();
        for (id, job) in &mut desk.active {
            let now = (connected, desk.queue.waiting_tasks(id));
            if job.told.replace(now) != Some(now) {
                if now.1 > 0 {
                    tracing::info!(job_id = %id, connected, waiting = now.1, "tasks wait for a worker");
                }
                self.tell(Notice::Transient(id.clone(), workers_event(now.0, now.1)));
                job.changed.send_replace(());
            }
        }
    }
}

fn workers_event(connected: usize, waiting: usize) -> Event {
    let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    Event::Workers(WorkersChanged { connected: count(connected), waiting_frames: count(waiting) })
}
