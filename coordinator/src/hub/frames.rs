//! Frames become ready, fail, and end.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Failure, FailureKind, FrameJob};

use super::{Desk, FrameBase, Hub};
use crate::{
    failure::{StageError, failure},
    queue::{
        FailedLease, FrameHistory, FrameKey, JobId,
        frame::{FrameState, FrameTrigger},
    },
    store::{Artifact, AttemptOutcome, CommittedFrame, FrameEvent, StoreError},
};

impl Hub {
    /// Makes a frame ready for workers. A frame that is done stays done.
    pub(crate) async fn publish(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        request: &FrameJob,
        result_key: &str,
    ) -> Result<(), StageError> {
        let frame = request.frame;
        let mut desk = self.desk.lock().await;
        let known = self.store.frame(job, frame).await?;
        let mut change = self.store.change().await?;
        if stop.is_cancelled() || change.job_state(job).await?.has_ended() {
            return Err(StageError::Stopped);
        }
        change.publish_frame(request, result_key).await?;
        let history = match &known {
            Some(record) if record.state()? != FrameState::Ready => return Ok(()),
            Some(record) => record.history()?,
            None => {
                change.append_ready_event(job, frame).await?;
                FrameHistory::default()
            }
        };
        change.commit().await?;
        self.tell_stored(job);
        desk.queue.add(FrameKey { job: job.clone(), frame }, history);
        Ok(self.dispatch(&mut desk).await?)
    }

    /// Commits a ready frame whose result was computed before from the same input.
    pub(crate) async fn reuse(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        request: &FrameJob,
        result_key: &str,
        result: &CommittedFrame<'_>,
    ) -> Result<(), StageError> {
        let frame = request.frame;
        let mut desk = self.desk.lock().await;
        let known = self.store.frame(job, frame).await?;
        let mut change = self.store.change().await?;
        if stop.is_cancelled() || change.job_state(job).await?.has_ended() {
            return Err(StageError::Stopped);
        }
        change.publish_frame(request, result_key).await?;
        match &known {
            Some(record) if record.state()?.after(FrameTrigger::Commit).is_err() => return Ok(()),
            Some(_) => {}
            None => change.append_ready_event(job, frame).await?,
        }
        change.commit_frame(job, frame, result).await?;
        let event =
            FrameEvent { frame, worker: result.worker, report: result.report, ..FrameEvent::default() };
        change.append_frame_event(job, FrameState::Done, &event).await?;
        change.commit().await?;
        desk.queue.close_ready(&FrameKey { job: job.clone(), frame });
        tracing::info!(job_id = %job, frame, "frame reused");
        self.tell_stored(job);
        Ok(())
    }

    /// Makes a done frame whose result is gone from the store ready again.
    pub(crate) async fn lose_result(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        frame: u32,
    ) -> Result<(), StageError> {
        let _desk = self.desk.lock().await;
        let Some(record) = self.store.frame(job, frame).await? else { return Ok(()) };
        if stop.is_cancelled() {
            return Err(StageError::Stopped);
        }
        if record.state()?.after(FrameTrigger::Lose).is_err() {
            return Ok(());
        }
        let mut change = self.store.change().await?;
        change.lose_result(job, frame).await?;
        change.commit().await?;
        tracing::warn!(job_id = %job, frame, "the frame's result is gone from the store; it is computed again");
        self.tell_stored(job);
        Ok(())
    }

    /// Number of frames of a job that are ready or leased.
    pub(crate) async fn open_frames(&self, job: &JobId) -> usize {
        self.desk.lock().await.queue.open_frames(job)
    }

    /// Writes a failed attempt, and what follows from it, to the database.
    pub(super) async fn record_failed(
        &self,
        desk: &mut Desk,
        failed: &FailedLease,
        reason: &Failure,
    ) -> Result<(), StoreError> {
        let FailedLease { lease, retried } = failed;
        let (job, frame, kind) = (&lease.key.job, lease.key.frame, reason.kind());
        let next = if *retried { FrameState::Ready } else { FrameState::Failed };
        let excluded = (kind == FailureKind::OutOfResources).then_some(lease.worker_id.as_str());
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Failed(kind, &reason.message)).await?;
        change.count_failure(job, frame, excluded).await?;
        change.set_frame_state(job, frame, next).await?;
        let event = FrameEvent {
            frame,
            attempt: lease.attempt,
            worker: &lease.worker_id,
            failure: Some(reason),
            ..FrameEvent::default()
        };
        change.append_frame_event(job, next, &event).await?;
        change.commit().await?;
        tracing::warn!(
            job_id = %job, frame, attempt = lease.attempt, worker_id = lease.worker_id,
            kind = kind.label(), reason = reason.message, retried, "attempt failed"
        );
        self.tell_stored(job);
        desk.frame_ended(job);
        Ok(())
    }

    /// Writes a verified result to the database; the artifact lets another job with the same input use it.
    pub(super) async fn record_done(
        &self,
        desk: &mut Desk,
        lease: &crate::queue::Lease,
        result: &CommittedFrame<'_>,
    ) -> Result<(), StoreError> {
        let (job, frame) = (&lease.key.job, lease.key.frame);
        let record = self.store.frame(job, frame).await?;
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Done).await?;
        change.commit_frame(job, frame, result).await?;
        if let Some(record) = record {
            let artifact = Artifact { blob: result.delta.clone(), note: result.report.to_owned() };
            change.put_artifact(&record.result_key, "frame", &artifact).await?;
        }
        let event = FrameEvent {
            frame,
            attempt: lease.attempt,
            worker: &lease.worker_id,
            report: result.report,
            seconds: result.seconds,
            ..FrameEvent::default()
        };
        change.append_frame_event(job, FrameState::Done, &event).await?;
        change.commit().await?;
        tracing::info!(
            job_id = %job, frame, attempt = lease.attempt, worker_id = lease.worker_id,
            seconds = result.seconds, "frame done"
        );
        self.tell_stored(job);
        desk.frame_ended(job);
        Ok(())
    }

    /// Fails ready frames that every worker of an embedded coordinator lacks the resources for: no other will come.
    pub(super) async fn give_up_beyond_all_workers(&self, desk: &mut Desk) -> Result<(), StoreError> {
        for key in desk.queue.frames_beyond_all_workers() {
            desk.queue.close_ready(&key);
            let reason = failure(
                FailureKind::OutOfResources,
                "every worker lacks the memory for this frame; use fewer Gaussians, smaller images or fewer workers",
            );
            let mut change = self.store.change().await?;
            change.set_frame_state(&key.job, key.frame, FrameState::Failed).await?;
            let event = FrameEvent { frame: key.frame, failure: Some(&reason), ..FrameEvent::default() };
            change.append_frame_event(&key.job, FrameState::Failed, &event).await?;
            change.commit().await?;
            self.tell_stored(&key.job);
            desk.frame_ended(&key.job);
        }
        Ok(())
    }
}

impl Desk {
    fn frame_ended(&self, job: &JobId) {
        if let Some(active) = self.active.get(job) {
            active.frame_ended.notify_one();
        }
    }

    /// What results of a job's present run are verified against, and its token.
    pub(super) fn base(&self, job: &JobId) -> Option<(Arc<FrameBase>, CancellationToken)> {
        let active = self.active.get(job)?;
        Some((active.base.clone()?, active.stop.clone()))
    }
}
