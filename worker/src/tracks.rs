//! A window of the tracks of a view from the wire to a report: every field is stored and said as soon as it is there.

use std::sync::{Arc, Mutex, PoisonError};

use backon::Retryable;
use bytes::Bytes;
use splat::{
    formats::{track_blob, track_state},
    frame::FrameProgress,
    image::Image,
    tracking::{
        StateMisfit, TrackField, TrackState, Tracker, TrackingSettings,
        learned::{LearnedError, MAX_MODEL_BYTES},
    },
};
use tokio::{
    runtime::Handle,
    sync::{mpsc::UnboundedSender, watch},
};
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{self, Failure, FailureKind, TrackFrame, TrackJob, Tracked, TrackedField};

use crate::{
    blobs::{BlobError, Blobs},
    connection::backoff,
    job::{JobError, JobRunner, Outcome, not_ended},
};

/// Where a task says how far it is.
#[derive(Clone, Debug)]
pub(crate) struct Said {
    pub(crate) progress: watch::Sender<FrameProgress>,
    /// Fields that are stored; at most one per frame of the job.
    pub(crate) fields: UnboundedSender<TrackedField>,
}

/// The tracker of the last view. The next view is mostly of the same job, and to load a network takes long.
#[derive(Default)]
pub(crate) struct LastTracker(Mutex<Option<(v1::Tracker, Arc<Tracker>)>>);

impl LastTracker {
    fn of(&self, wanted: &v1::Tracker) -> Option<Arc<Tracker>> {
        let last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        last.as_ref().filter(|(of, _)| of == wanted).map(|(_, tracker)| tracker.clone())
    }

    fn replace(&self, of: v1::Tracker, tracker: Arc<Tracker>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((of, tracker));
    }
}

/// Why tracking ended early.
enum Stop {
    Cancelled,
    Failed(JobError),
}

impl From<JobError> for Stop {
    fn from(error: JobError) -> Self {
        Self::Failed(error)
    }
}

impl From<LearnedError> for Stop {
    fn from(error: LearnedError) -> Self {
        JobError::bad_input(error.to_string()).into()
    }
}

impl From<StateMisfit> for Stop {
    fn from(misfit: StateMisfit) -> Self {
        JobError::new(FailureKind::Bug, misfit.to_string()).into()
    }
}

impl JobRunner {
    /// Tracks a window of one view to its report; `None` if it was cancelled.
    pub(crate) async fn track(
        &self,
        job: TrackJob,
        blobs: Blobs,
        said: Said,
        cancel: CancellationToken,
    ) -> Option<Outcome> {
        let settings_json = job.tracker.as_ref().map_or("", |tracker| tracker.settings_json.as_str());
        let settings: TrackingSettings = match serde_json::from_str(settings_json) {
            Ok(settings) => settings,
            Err(error) => {
                return failed(JobError::bad_input(format!("the tracker's settings: {error}")));
            }
        };
        let tracking = Tracking {
            settings,
            last: self.last_tracker.clone(),
            job,
            blobs,
            backoff: backoff(self.patience, self.jitter_seed),
            said,
            cancel,
            runtime: Handle::current(),
        };
        let pool = self.pool.clone();
        // On a blocking thread inside the worker's pool, so that heartbeats go on.
        let ended = tokio::task::spawn_blocking(move || pool.install(|| tracking.run())).await;
        match ended {
            Ok(Ok(tracked)) => Some(Outcome::Tracked(tracked)),
            Ok(Err(Stop::Cancelled)) => None,
            Ok(Err(Stop::Failed(error))) => failed(error),
            Err(error) => failed(not_ended("tracking", error)),
        }
    }
}

fn failed(error: JobError) -> Option<Outcome> {
    Some(Outcome::Failure(Failure { kind: error.kind.into(), message: error.message }))
}

/// A window of one view that is tracked. Runs on threads of the worker's pool, where waiting is allowed.
struct Tracking {
    settings: TrackingSettings,
    last: Arc<LastTracker>,
    job: TrackJob,
    blobs: Blobs,
    backoff: backon::ExponentialBuilder,
    said: Said,
    cancel: CancellationToken,
    runtime: Handle,
}

impl Tracking {
    fn run(&self) -> Result<Tracked, Stop> {
        let window = self.job.window();
        let mut tracked = Tracked::default();
        if window.is_empty() {
            return Ok(tracked);
        }
        let mut load = |place: usize| self.load(self.frame(place)?);
        let mut emit = |place: usize, field: TrackField| {
            let frame = self.frame(place)?;
            // What chains tracks makes fields that exist again; nobody needs them.
            if frame.tracks.is_none() {
                let encoded = Bytes::from(track_blob::encode(&field));
                let stored = TrackedField { frame: frame.frame, tracks: Some(self.store(encoded)?) };
                tracked.fields.push(stored.clone());
                // Nobody listens any more: the lease is gone, and the report with it.
                let _ = self.said.fields.send(stored);
            }
            self.advance(place + 1 - window.start)
        };
        self.advance(0)?;
        let is_missing = |place: usize| self.frame(place).is_ok_and(|frame| frame.tracks.is_none());
        let (tracker, from) = (self.tracker()?, self.state()?);
        let after =
            tracker.track_window(from, window.clone(), &is_missing, &mut load, &self.settings, &mut emit)?;
        if self.job.wants_state {
            tracked.state = Some(self.store(Bytes::from(track_state::encode(&after)))?);
        }
        Ok(tracked)
    }

    fn frame(&self, place: usize) -> Result<&TrackFrame, Stop> {
        let named = self.job.frame_at(place);
        let lacking = || {
            let view = &self.job.view;
            JobError::new(
                FailureKind::Bug,
                format!(
                    "view '{view}': the lease lacks the frame at place {place}: a defect of the coordinator"
                ),
            )
        };
        Ok(named.ok_or_else(lacking)?)
    }

    /// What tracking goes on from.
    fn state(&self) -> Result<TrackState, Stop> {
        let Some(blob) = &self.job.state else { return Ok(TrackState::default()) };
        // What is gone from the store does not come back: the coordinator leases the window before.
        let bytes = self.transfer_while(|error| !error.is_lost(), || self.blobs.get(blob))?;
        let view = &self.job.view;
        let decoded = track_state::decode(&bytes);
        Ok(decoded.map_err(|error| {
            JobError::new(FailureKind::Bug, format!("the tracker's state of view '{view}': {error}"))
        })?)
    }

    fn tracker(&self) -> Result<Arc<Tracker>, Stop> {
        let wanted = self.job.tracker.clone().unwrap_or_default();
        if let Some(tracker) = self.last.of(&wanted) {
            return Ok(tracker);
        }
        let bytes = match &wanted.model {
            Some(blob) if blob.size > MAX_MODEL_BYTES as u64 => {
                let (name, size) = (&wanted.model_name, blob.size);
                let reason = format!("tracker {name}: {size} bytes, at most {MAX_MODEL_BYTES} are taken");
                return Err(JobError::bad_input(reason).into());
            }
            Some(blob) => Some(self.transfer(|| self.blobs.get(blob))?.to_vec()),
            None => None,
        };
        let model = bytes.map(|bytes| (bytes, wanted.model_name.as_str()));
        let tracker = Arc::new(Tracker::new(model, &self.settings)?);
        self.last.replace(wanted.clone(), tracker.clone());
        Ok(tracker)
    }

    /// So many frames of the window are done.
    fn advance(&self, done: usize) -> Result<(), Stop> {
        let total = self.job.window().len() as u64;
        let progress = FrameProgress { stage: "tracks", done: done as u64, total };
        self.said.progress.send_replace(progress);
        if self.cancel.is_cancelled() { Err(Stop::Cancelled) } else { Ok(()) }
    }

    fn load(&self, frame: &TrackFrame) -> Result<Arc<Image>, Stop> {
        let (view, number) = (&self.job.view, frame.frame);
        let blob = frame.image.as_ref().ok_or_else(|| {
            JobError::bad_input(format!(
                "view '{view}' has no image at frame {number}: a defect of the coordinator"
            ))
        })?;
        let bytes = self.transfer(|| self.blobs.get(blob))?;
        let image = Image::decode(&bytes).map_err(|error| {
            JobError::bad_input(format!("image of view '{view}' at frame {number}: {error}"))
        })?;
        Ok(Arc::new(image))
    }

    fn store(&self, bytes: Bytes) -> Result<v1::Blob, Stop> {
        self.transfer(|| self.blobs.put(bytes.clone()))
    }

    /// Waits for a transfer, which is tried again while it fails for reasons that may pass.
    fn transfer<T, F: Future<Output = Result<T, BlobError>>>(
        &self,
        transfer: impl FnMut() -> F,
    ) -> Result<T, Stop> {
        self.transfer_while(|_| true, transfer)
    }

    /// [`Self::transfer`] that gives up at once where `may_pass` says so.
    fn transfer_while<T, F: Future<Output = Result<T, BlobError>>>(
        &self,
        may_pass: impl Fn(&BlobError) -> bool,
        transfer: impl FnMut() -> F,
    ) -> Result<T, Stop> {
        let retried = transfer
            .retry(self.backoff)
            .when(|error| error.kind() == FailureKind::Transient && may_pass(error))
            .notify(|error, delay| tracing::debug!(%error, ?delay, "a transfer failed and is tried again"));
        let retried = self.cancel.run_until_cancelled(retried);
        let ended = self.runtime.block_on(retried).ok_or(Stop::Cancelled)?;
        ended.map_err(|error| JobError::from(error).into())
    }
}

#[cfg(test)]
#[path = "track_tests.rs"]
mod tests;
