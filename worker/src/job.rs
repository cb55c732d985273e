//! A frame job from the wire to a report: fetch, run on the worker's own threads, store the delta.

use std::{
    any::Any,
    ops::ControlFlow,
    sync::Arc,
    time::{Duration, Instant},
};

use backon::Retryable;
use bytes::Bytes;
use splat::{
    engine::EngineError,
    frame::{FrameError, FrameInput, FrameProgress, FrameReport, FrameResult},
    gaussians::delta,
};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Blob, Failure, FailureKind, FrameJob, StageSeconds, Success, lease, report};

use crate::{
    ahead::Ahead,
    blobs::Blobs,
    connection::backoff,
    inputs::{self, InputCache},
    tracks::{LastTracker, Said},
};

/// What turns a frame's input into its result; `splat::frame::reconstruct_frame` on the worker's engine.
pub(crate) type Reconstruct = Arc<
    dyn Fn(&FrameInput, &mut dyn FnMut(FrameProgress) -> ControlFlow<()>) -> Result<FrameResult, FrameError>
        + Send
        + Sync,
>;

/// Why a frame job failed, as the coordinator decides by it.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub(crate) struct JobError {
    pub(crate) kind: FailureKind,
    pub(crate) message: String,
}

impl JobError {
    pub(crate) fn new(kind: FailureKind, message: String) -> Self {
        Self { kind, message }
    }

    pub(crate) fn bad_input(message: String) -> Self {
        Self::new(FailureKind::BadInput, message)
    }
}

/// Runs tasks on one device, one at a time.
pub(crate) struct JobRunner {
    pub(crate) reconstruct: Reconstruct,
    pub(crate) pool: Arc<rayon::ThreadPool>,
    pub(crate) cache: Arc<InputCache>,
    pub(crate) ahead: Ahead,
    pub(crate) last_tracker: Arc<LastTracker>,
    /// How long a transfer is tried again before the job fails as transient.
    pub(crate) patience: Duration,
    /// Seed of the jitter between those tries.
    pub(crate) jitter_seed: u64,
}

/// How a task ended, if it was not cancelled.
pub(crate) type Outcome = report::Outcome;

impl JobRunner {
    /// Does one task to its report; `None` if it was cancelled. The inputs of `likely_next` are loaded meanwhile.
    pub(crate) async fn run(
        &self,
        task: lease::Task,
        likely_next: Option<FrameJob>,
        blobs: &Blobs,
        said: Said,
        cancel: &CancellationToken,
    ) -> Option<Outcome> {
        let job = match task {
            lease::Task::Frame(job) => job,
            lease::Task::Tracks(job) => {
                if let Some(next) = likely_next {
                    self.ahead.begin(next, blobs.clone(), self.cache.clone());
                }
                return self.track(job, blobs.clone(), said, cancel.clone()).await;
            }
        };
        match self.attempt(&job, likely_next, blobs, said.progress, cancel).await {
            Ok(Some(success)) => Some(Outcome::Success(success)),
            Ok(None) => None,
            Err(error) => Some(Outcome::Failure(Failure { kind: error.kind.into(), message: error.message })),
        }
    }

    async fn attempt(
        &self,
        job: &FrameJob,
        likely_next: Option<FrameJob>,
        blobs: &Blobs,
        progress: watch::Sender<FrameProgress>,
        cancel: &CancellationToken,
    ) -> Result<Option<Success>, JobError> {
        let mut stages = StageClock::start("fetch");
        let fetch = self.load(job, blobs);
        let Some(input) = cancel.run_until_cancelled(fetch).await.transpose()? else { return Ok(None) };
        if let Some(next) = likely_next {
            self.ahead.begin(next, blobs.clone(), self.cache.clone());
        }
        let static_digest = static_digest(job)?;
        let Some((delta, report)) = self.compute(input, static_digest, progress, cancel, &mut stages).await?
        else {
            return Ok(None);
        };
        stages.enter("store");
        let store = retried(|| store(blobs, delta.clone()), self.patience, self.jitter_seed);
        let Some(delta) = cancel.run_until_cancelled(store).await.transpose()? else { return Ok(None) };
        let report_json = serde_json::to_string(&report)
            .map_err(|error| JobError::new(FailureKind::Bug, format!("the frame's report: {error}")))?;
        Ok(Some(Success { delta: Some(delta), report_json, seconds: stages.finish() }))
    }

    async fn load(&self, job: &FrameJob, blobs: &Blobs) -> Result<FrameInput, JobError> {
        if let Some(input) = self.ahead.take(job).await {
            return Ok(input);
        }
        retried(|| inputs::load(job, blobs, &self.cache), self.patience, self.jitter_seed).await
    }

    /// The CPU work, on a blocking thread inside the worker's pool, so that heartbeats go on. `None`: cancelled.
    async fn compute(
        &self,
        input: FrameInput,
        static_digest: blake3::Hash,
        progress: watch::Sender<FrameProgress>,
        cancel: &CancellationToken,
        stages: &mut StageClock,
    ) -> Result<Option<(Bytes, FrameReport)>, JobError> {
        let (reconstruct, pool, cancel) = (self.reconstruct.clone(), self.pool.clone(), cancel.clone());
        let mut clock = std::mem::take(stages);
        let work = tokio::task::spawn_blocking(move || {
            let mut on_progress = |now: FrameProgress| {
                clock.enter(now.stage);
                progress.send_replace(now);
                if cancel.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let result = pool.install(|| {
                let result = reconstruct(&input, &mut on_progress)?;
                let delta = delta::encode(&input.static_model, static_digest.as_bytes(), &result.gaussians);
                Ok((Bytes::from(delta), result.report))
            });
            (result, clock)
        });
        // A cancelled job is waited for: the next one must not share the device with its last step.
        let (result, clock) = work.await.map_err(|error| not_ended("the frame job", error))?;
        *stages = clock;
        match result {
            Ok(result) => Ok(Some(result)),
            Err(FrameError::Cancelled) => Ok(None),
            Err(error) => Err(failure_of(error)),
        }
    }
}

/// Tries a transfer again while it fails for reasons that may pass.
async fn retried<T, F: Future<Output = Result<T, JobError>>>(
    transfer: impl FnMut() -> F,
    patience: Duration,
    jitter_seed: u64,
) -> Result<T, JobError> {
    transfer
        .retry(backoff(patience, jitter_seed))
        .when(|error| error.kind == FailureKind::Transient)
        .notify(|error, delay| tracing::debug!(%error, ?delay, "a transfer failed and is tried again"))
        .await
}

async fn store(blobs: &Blobs, delta: Bytes) -> Result<Blob, JobError> {
    Ok(blobs.put(delta).await?)
}

fn static_digest(job: &FrameJob) -> Result<blake3::Hash, JobError> {
    let digest = job.static_model.as_ref().map_or("", |blob| blob.digest.as_str());
    blake3::Hash::from_hex(digest)
        .map_err(|error| JobError::bad_input(format!("the static model's digest '{digest}': {error}")))
}

/// The wire's kind of a frame's failure.
fn failure_of(error: FrameError) -> JobError {
    let kind = match &error {
        FrameError::BadInput(_) | FrameError::Engine(EngineError::InvalidInput(_)) => FailureKind::BadInput,
        FrameError::Engine(EngineError::OutOfResources { .. }) => FailureKind::OutOfResources,
        FrameError::Engine(EngineError::DeviceLost(_)) | FrameError::Cancelled => FailureKind::Transient,
        FrameError::Engine(EngineError::Internal(_)) => FailureKind::Bug,
    };
    JobError::new(kind, error.to_string())
}

/// Why blocking work has no result.
pub(crate) fn not_ended(what: &str, error: tokio::task::JoinError) -> JobError {
    let message = match error.try_into_panic() {
        Ok(panic) => format!("{what} panicked: {}", panic_text(&*panic)),
        Err(error) => format!("{what} did not end: {error}"),
    };
    JobError::new(FailureKind::Bug, message)
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}

/// Seconds per stage, in order of first entry.
#[derive(Debug, Default)]
struct StageClock {
    past: Vec<StageSeconds>,
    current: Option<(&'static str, Instant)>,
}

impl StageClock {
    fn start(stage: &'static str) -> Self {
        Self { past: Vec::new(), current: Some((stage, Instant::now())) }
    }

    fn enter(&mut self, stage: &'static str) {
        if self.current.is_some_and(|(current, _)| current == stage) {
            return;
        }
        self.leave();
        self.current = Some((stage, Instant::now()));
    }

    fn leave(&mut self) {
        let Some((stage, since)) = self.current.take() else { return };
        let seconds = since.elapsed().as_secs_f64();
        match self.past.iter_mut().find(|past| past.stage == stage) {
            Some(past) => past.seconds += seconds,
            None => self.past.push(StageSeconds { stage: stage.to_owned(), seconds }),
        }
    }

    fn finish(mut self) -> Vec<StageSeconds> {
        self.leave();
        self.past
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn every_failure_has_the_kind_that_decides_its_retry() {
        let kind = |error| failure_of(error).kind;
        assert_eq!(kind(FrameError::BadInput("x".into())), FailureKind::BadInput);
        assert_eq!(kind(EngineError::InvalidInput("x".into()).into()), FailureKind::BadInput);
        let memory = EngineError::OutOfResources { needed: 2, available: 1 };
        assert_eq!(kind(memory.into()), FailureKind::OutOfResources);
        assert_eq!(kind(EngineError::DeviceLost("x".into()).into()), FailureKind::Transient);
        assert_eq!(kind(EngineError::Internal("x".into()).into()), FailureKind::Bug);
    }

    #[test]
    fn a_stage_that_comes_again_is_one_entry() {
        let mut clock = StageClock::start("fetch");
        for stage in ["motion", "motion", "refine", "evaluate", "refine"] {
            clock.enter(stage);
        }
        let seconds = clock.finish();
        let stages: Vec<&str> = seconds.iter().map(|entry| entry.stage.as_str()).collect();
        assert_eq!(stages, ["fetch", "motion", "refine", "evaluate"]);
        assert!(seconds.iter().all(|entry| entry.seconds >= 0.0));
    }

    #[tokio::test]
    async fn only_transient_failures_are_tried_again_and_not_for_ever() {
        let patience = Duration::from_secs(60);
        let calls = std::cell::Cell::new(0);
        let refused = || async {
            calls.set(calls.get() + 1);
            Err::<(), _>(JobError::bad_input("no".into()))
        };
        assert_eq!(retried(refused, patience, 1).await.unwrap_err().kind, FailureKind::BadInput);
        assert_eq!(calls.get(), 1);

        let passing = || async {
            calls.set(calls.get() + 1);
            if calls.get() < 4 {
                return Err(JobError::new(FailureKind::Transient, "later".into()));
            }
            Ok(calls.get())
        };
        assert_eq!(retried(passing, patience, 1).await.unwrap(), 4);

        let gone = || async { Err::<(), _>(JobError::new(FailureKind::Transient, "gone".into())) };
        let lasting = retried(gone, Duration::from_millis(300), 1);
        assert_eq!(lasting.await.unwrap_err().message, "gone");
    }
}
