//! What is known of a job from its events.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use splat::frame::{FrameReport, ViewMetrics};
use trackersplat_proto::v1::{
    Failure, FailureKind, FrameStateChanged, JobEvent, JobState, TaskState, job_event::Event,
};

use crate::error::CliError;

/// A job as its stored events describe it; feeding them again from the start changes nothing.
#[derive(Clone, Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) state: JobState,
    pub(crate) failure: Option<Failure>,
    pub(crate) frames: BTreeMap<u32, FrameOutcome>,
    /// Sequence number of the last stored event.
    pub(crate) last_sequence: u64,
}

/// A frame as its events describe it.
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct FrameOutcome {
    pub(crate) state: &'static str,
    pub(crate) attempt: u32,
    pub(crate) worker: String,
    pub(crate) seconds: f64,
    /// Why the last attempt failed.
    pub(crate) failure: Option<String>,
    pub(crate) report: Option<FrameReport>,
}

impl FrameOutcome {
    /// Mean held-out metrics before and after refinement.
    pub(crate) fn means(&self) -> (Option<&ViewMetrics>, Option<&ViewMetrics>) {
        let report = self.report.as_ref();
        (report.and_then(|report| mean(&report.before)), report.and_then(|report| mean(&report.after)))
    }
}

/// The mean over views among a frame's metrics.
pub(crate) fn mean(metrics: &[ViewMetrics]) -> Option<&ViewMetrics> {
    metrics.iter().find(|metrics| metrics.view == "mean")
}

impl Outcome {
    /// Takes in an event.
    pub(crate) fn observe(&mut self, event: &JobEvent) {
        self.last_sequence = self.last_sequence.max(event.sequence);
        match &event.event {
            Some(Event::JobState(change)) => {
                self.state = change.state();
                self.failure = change.failure.clone();
            }
            Some(Event::FrameState(change)) => self.observe_frame(change),
            Some(Event::TracksState(_) | Event::Progress(_) | Event::Workers(_)) | None => {}
        }
    }

    fn observe_frame(&mut self, change: &FrameStateChanged) {
        let frame = self.frames.entry(change.frame).or_default();
        frame.state = task_state_label(change.state());
        frame.attempt = frame.attempt.max(change.attempt);
        frame.failure = change.failure.as_ref().map(|failure| failure.message.clone());
        if !change.worker_id.is_empty() {
            frame.worker.clone_from(&change.worker_id);
        }
        if change.state() == TaskState::Done {
            frame.seconds = change.seconds;
            // A report of a newer version may not be readable; the table then lacks its figures.
            frame.report = serde_json::from_str(&change.report_json).ok();
        }
    }

    /// Numbers of the frames in a state.
    pub(crate) fn frames_in(&self, state: TaskState) -> BTreeSet<u32> {
        let label = task_state_label(state);
        self.frames.iter().filter(|(_, frame)| frame.state == label).map(|(number, _)| *number).collect()
    }

    /// Success, or the error that says why the job did not succeed.
    pub(crate) fn result(&self) -> Result<(), CliError> {
        match self.state {
            JobState::Done => Ok(()),
            JobState::Cancelled => Err(CliError::Failed("the job was cancelled".into())),
            _ => Err(self.failed()),
        }
    }

    fn failed(&self) -> CliError {
        let Some(failure) = &self.failure else {
            return CliError::Failed(format!("the job ended in state {}", job_state_label(self.state)));
        };
        match failure.kind() {
            FailureKind::BadInput => CliError::BadInput(failure.message.clone()),
            kind => CliError::failed(kind.label(), &failure.message),
        }
    }
}

/// A job's state for people and scripts.
pub(crate) fn job_state_label(state: JobState) -> &'static str {
    match state {
        JobState::Unspecified => "unknown",
        JobState::Ingesting => "ingesting",
        JobState::StaticModel => "static-model",
        JobState::Tracking => "tracking",
        JobState::Frames => "frames",
        JobState::Assembling => "assembling",
        JobState::Done => "done",
        JobState::Failed => "failed",
        JobState::Cancelled => "cancelled",
    }
}

/// A frame's state for people and scripts.
pub(crate) fn task_state_label(state: TaskState) -> &'static str {
    match state {
        TaskState::Unspecified => "unknown",
        TaskState::Ready => "ready",
        TaskState::Leased => "leased",
        TaskState::Done => "done",
        TaskState::Failed => "failed",
        TaskState::Cancelled => "cancelled",
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use trackersplat_proto::v1::JobStateChanged;

    use super::*;

    pub(crate) fn job_event(sequence: u64, state: JobState, failure: Option<Failure>) -> JobEvent {
        let change = JobStateChanged { state: state.into(), failure };
        JobEvent { sequence, event: Some(Event::JobState(change)), ..JobEvent::default() }
    }

    pub(crate) fn frame_event(sequence: u64, frame: u32, state: TaskState) -> JobEvent {
        let report = FrameReport {
            after: vec![ViewMetrics { view: "mean".into(), psnr: 30.0, ssim: 0.9, moving_psnr: Some(28.0) }],
            ..FrameReport::default()
        };
        let change = FrameStateChanged {
            frame,
            state: state.into(),
            attempt: 1,
            report_json: serde_json::to_string(&report).expect("a report is JSON"),
            seconds: 2.5,
            ..FrameStateChanged::default()
        };
        JobEvent { sequence, event: Some(Event::FrameState(change)), ..JobEvent::default() }
    }

    #[test]
    fn events_add_up_to_the_job() {
        let mut outcome = Outcome::default();
        let events = [
            job_event(1, JobState::Frames, None),
            frame_event(2, 1, TaskState::Leased),
            frame_event(3, 2, TaskState::Ready),
            frame_event(4, 1, TaskState::Done),
        ];
        for _ in 0..2 {
            events.iter().for_each(|event| outcome.observe(event));
        }
        assert_eq!(outcome.last_sequence, 4);
        assert_eq!(outcome.frames_in(TaskState::Done), BTreeSet::from([1]));
        assert_eq!(outcome.frames[&1].seconds, 2.5);
        assert_eq!(outcome.frames[&1].means().1.map(|mean| mean.psnr), Some(30.0));
        assert_eq!(outcome.frames[&2].report, None);
    }

    #[test]
    fn how_a_job_ended_decides_the_exit_code() {
        let ended = |state, failure| {
            let mut outcome = Outcome::default();
            outcome.observe(&job_event(1, state, failure));
            outcome.result().map_err(|error| error.exit_code())
        };
        let failure = |kind: FailureKind| Some(Failure { kind: kind.into(), message: "why".into() });
        assert_eq!(ended(JobState::Done, None), Ok(()));
        assert_eq!(ended(JobState::Failed, failure(FailureKind::BadInput)), Err(3));
        assert_eq!(ended(JobState::Failed, failure(FailureKind::Bug)), Err(1));
        assert_eq!(ended(JobState::Failed, None), Err(1));
        assert_eq!(ended(JobState::Cancelled, None), Err(1));
    }

    #[test]
    fn a_job_that_was_submitted_again_forgets_its_old_failure() {
        let mut outcome = Outcome::default();
        let failure = Failure { kind: FailureKind::Bug.into(), message: "once".into() };
        outcome.observe(&job_event(1, JobState::Failed, Some(failure)));
        outcome.observe(&job_event(2, JobState::Frames, None));
        outcome.observe(&job_event(3, JobState::Done, None));
        assert!(outcome.result().is_ok());
    }
}
