//! Progress of a stage, not more often than people look.

use std::{
    ops::ControlFlow,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use tokio_util::sync::CancellationToken;

use crate::{hub::Hub, queue::JobId};

const PERIOD: Duration = Duration::from_millis(100);

/// Counts what is done of a stage and tells watching clients. Shared by the threads of the stage.
pub(super) struct StageProgress {
    hub: Arc<Hub>,
    job: JobId,
    stop: CancellationToken,
    stage: &'static str,
    done: AtomicU64,
    told: Mutex<Option<Instant>>,
}

impl StageProgress {
    pub(super) fn new(job: &super::Job, stage: &'static str) -> Self {
        Self {
            hub: job.hub.clone(),
            job: job.id.clone(),
            stop: job.stop.clone(),
            stage,
            done: AtomicU64::new(0),
            told: Mutex::new(None),
        }
    }

    /// One more unit of `total` is done.
    pub(super) fn advance(&self, total: u64) -> ControlFlow<()> {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.set(done, total)
    }

    /// `done` of `total` units are done. Breaks once somebody asked to stop.
    pub(super) fn set(&self, done: u64, total: u64) -> ControlFlow<()> {
        if done >= total || self.is_due() {
            self.hub.progress(&self.job, self.stage, done, total);
        }
        if self.stop.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    fn is_due(&self) -> bool {
        let now = Instant::now();
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        let is_due = told.is_none_or(|last| now.duration_since(last) >= PERIOD);
        if is_due {
            *told = Some(now);
        }
        is_due
    }
}
