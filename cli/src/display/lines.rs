//! Structured lines, for logs and pipes.

use trackersplat_proto::v1::{JobEvent, job_event::Event};

use super::{Display, no_worker_text};
use crate::outcome::{Outcome, job_state_label, task_state_label};

/// A line per change; progress in between at debug level.
pub(super) struct Lines {
    coordinator: String,
}

impl Lines {
    pub(super) fn new(coordinator: &str) -> Self {
        Self { coordinator: coordinator.to_owned() }
    }
}

impl Display for Lines {
    fn event(&mut self, event: &JobEvent, _outcome: &Outcome) {
        match &event.event {
            Some(Event::JobState(change)) => match &change.failure {
                Some(failure) => {
                    tracing::error!(state = job_state_label(change.state()), reason = failure.message, "job");
                }
                None => tracing::info!(state = job_state_label(change.state()), "job"),
            },
            Some(Event::FrameState(change)) => {
                let state = task_state_label(change.state());
                let (frame, attempt, worker) = (change.frame, change.attempt, change.worker_id.as_str());
                match &change.failure {
                    Some(failure) => {
                        tracing::warn!(frame, state, attempt, worker, reason = failure.message, "frame");
                    }
                    None => tracing::info!(frame, state, attempt, worker, "frame"),
                }
            }
            Some(Event::TracksState(change)) => {
                let state = task_state_label(change.state());
                let (view, attempt, worker) = (&change.view, change.attempt, change.worker_id.as_str());
                match &change.failure {
                    Some(failure) => {
                        tracing::warn!(view, state, attempt, worker, reason = failure.message, "tracks");
                    }
                    None => tracing::info!(view, state, attempt, worker, "tracks"),
                }
            }
            Some(Event::Progress(progress)) => {
                let (stage, done, total) = (progress.stage.as_str(), progress.done, progress.total);
                if progress.view.is_empty() {
                    tracing::debug!(stage, frame = progress.frame, done, total, "progress");
                } else {
                    tracing::debug!(stage, view = progress.view, done, total, "progress");
                }
            }
            Some(Event::Workers(workers)) => {
                tracing::info!(
                    connected = workers.connected,
                    waiting_frames = workers.waiting_frames,
                    "workers"
                );
            }
            None => {}
        }
    }

    fn no_worker(&mut self, waiting_frames: u32) {
        tracing::warn!("{}", no_worker_text(waiting_frames, &self.coordinator));
    }

    fn note(&mut self, text: &str) {
        tracing::warn!("{text}");
    }

    fn finish(&mut self) {}
}
