//! A job from submission to its end, one file per stage.
//!
//! Every stage asks the store first what is there already, so that going on after a restart, after a resubmission, and
//! starting afresh are the same code.

mod alone;
mod assemble;
mod frames;
mod imported;
mod ingest;
mod patience;
mod progress;
mod static_model;
mod tracks;

use std::{path::Path, sync::Arc, time::Instant};

use splat::{
    clip::{Clip, ClipOptions},
    settings::Settings,
};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::FailureKind;

use crate::{
    compute::go_on,
    failure::{StageError, failure},
    hub::Hub,
    queue::{JobId, job::JobState},
    request::{JobRequest, by_url},
    store::{JobRecord, StoreError, ViewRecord},
};

/// What every stage works with.
struct Job {
    hub: Arc<Hub>,
    id: JobId,
    stop: CancellationToken,
    /// Marked when something happens to the job's tasks or the workers.
    changed: watch::Receiver<()>,
    record: JobRecord,
    settings: Arc<Settings>,
    request: JobRequest,
    frames: Vec<u32>,
    /// How many of the frames were published in this run, in order.
    published: usize,
    clip: Option<Arc<Clip>>,
}

/// Runs a job until it ends or is stopped. A stopped job goes on after the next start.
pub(crate) async fn run(
    hub: Arc<Hub>,
    id: JobId,
    stop: CancellationToken,
    changed: watch::Receiver<()>,
    clip: Option<Arc<Clip>>,
) {
    if let Err(error) = run_stages(&hub, &id, stop, changed, clip).await {
        hub.fail(error);
    }
}

async fn run_stages(
    hub: &Arc<Hub>,
    id: &JobId,
    stop: CancellationToken,
    changed: watch::Receiver<()>,
    clip: Option<Arc<Clip>>,
) -> Result<(), StoreError> {
    let ended = match Job::load(hub.clone(), id.clone(), stop.clone(), changed, clip).await {
        Ok(mut job) => {
            let ended = job.run_to_end().await;
            ended.map_err(|error| job.named_by_url(error))
        }
        Err(error) => Err(error),
    };
    match ended {
        Ok(()) | Err(StageError::Stopped) => Ok(()),
        // One job's unreadable value is no reason to keep the others waiting.
        Err(StageError::State(error @ StoreError::Value { .. })) => {
            let message = format!("{error}; submit the job again with another output folder");
            hub.fail_run(id, &stop, failure(FailureKind::BadInput, message)).await
        }
        Err(StageError::State(error)) => Err(error),
        Err(StageError::Failed(failure)) => hub.fail_run(id, &stop, failure).await,
    }
}

impl Job {
    async fn load(
        hub: Arc<Hub>,
        id: JobId,
        stop: CancellationToken,
        changed: watch::Receiver<()>,
        clip: Option<Arc<Clip>>,
    ) -> Result<Self, StageError> {
        let record = hub.store.job(&id).await?.ok_or(StageError::Stopped)?;
        let wrong = |place, error: serde_json::Error| {
            StageError::State(StoreError::Value { place, value: error.to_string() })
        };
        let settings =
            serde_json::from_str(&record.settings).map_err(|error| wrong("jobs.settings", error))?;
        let request = serde_json::from_str(&record.request).map_err(|error| wrong("jobs.request", error))?;
        let frames = record.frame_numbers()?;
        Ok(Self {
            hub,
            id,
            stop,
            changed,
            record,
            settings: Arc::new(settings),
            request,
            frames,
            published: 0,
            clip,
        })
    }

    async fn run_to_end(&mut self) -> Result<(), StageError> {
        let mut state = self.record.state()?;
        while !state.has_ended() {
            go_on(&self.stop)?;
            let start = Instant::now();
            self.run_stage(state).await?;
            let mut change = self.hub.store.change().await?;
            change.add_stage_seconds(&self.id, state.label(), start.elapsed().as_secs_f64()).await?;
            change.commit().await?;
            state = self.hub.advance(&self.id, &self.stop, state).await?;
        }
        Ok(())
    }

    /// A failure names a copied clip by its URL.
    fn named_by_url(&self, error: StageError) -> StageError {
        match error {
            StageError::Failed(mut failure) => {
                failure.message =
                    by_url(&failure.message, &self.record.clip, self.request.clip_url.as_deref());
                StageError::Failed(failure)
            }
            error => error,
        }
    }

    async fn run_stage(&mut self, state: JobState) -> Result<(), StageError> {
        match state {
            JobState::Ingesting => self.ingest().await,
            JobState::StaticModel => self.make_static_model_beside_tracks().await,
            JobState::Tracking => self.track().await,
            JobState::Frames => self.compute_frames().await,
            JobState::Assembling => self.assemble().await,
            JobState::Done | JobState::Failed | JobState::Cancelled => Ok(()),
        }
    }

    /// Waits until no earlier job uses the compute pool.
    async fn turn(&self) -> Result<tokio::sync::SemaphorePermit<'_>, StageError> {
        let turn = self.stop.run_until_cancelled(self.hub.turn.acquire()).await;
        turn.and_then(Result::ok).ok_or(StageError::Stopped)
    }

    fn key_frame(&self) -> u32 {
        self.frames.first().copied().unwrap_or_default()
    }

    async fn views(&self) -> Result<Vec<ViewRecord>, StageError> {
        Ok(self.hub.store.views(&self.id).await?)
    }

    /// The clip; opened again after a restart, when it must still be what was submitted.
    async fn clip(&mut self) -> Result<Arc<Clip>, StageError> {
        if let Some(clip) = &self.clip {
            return Ok(clip.clone());
        }
        let (path, options) =
            (self.record.clip.clone(), self.request.clip_options(self.hub.scratch_folder()));
        let submitted = self.record.clip_digest.clone();
        let open = move || open_unchanged(Path::new(&path), &options, &submitted);
        let clip = Arc::new(self.hub.compute.run(open).await?);
        self.clip = Some(clip.clone());
        Ok(clip)
    }
}

fn open_unchanged(path: &Path, options: &ClipOptions, submitted: &str) -> Result<Clip, StageError> {
    let bad = |error: splat::clip::ClipError| StageError::bad_input(error.to_string());
    let clip = Clip::open(path, options).map_err(bad)?;
    let digest = clip.digest().map_err(bad)?;
    if digest != submitted {
        return Err(StageError::bad_input(format!(
            "the clip {} has changed since the job was submitted (digest {digest}, was {submitted}); submit it again, \
             with another output folder if frames of it are finished",
            path.display()
        )));
    }
    Ok(clip)
}
