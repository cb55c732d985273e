//! Frames become ready; tasks fail and end.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Failure, FailureKind, FrameJob};

use super::{Desk, FrameBase, Hub};
use crate::{
    failure::{StageError, failure},
    queue::{
        FailedLease, JobId, Lease, Task, TaskHistory, TaskKey,
        task::{TaskState, TaskTrigger},
    },
    store::{Artifact, AttemptOutcome, CommittedFrame, StoreError, TaskEvent},
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
            Some(record) if record.state()? != TaskState::Ready => return Ok(()),
            Some(record) => record.history()?,
            None => {
                change.append_ready_event(job, Task::Frame(frame)).await?;
                TaskHistory::default()
            }
        };
        change.commit().await?;
        self.tell_stored(job);
        desk.queue.add(TaskKey { job: job.clone(), task: Task::Frame(frame) }, history);
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
            Some(record) if record.state()?.after(TaskTrigger::Commit).is_err() => return Ok(()),
            Some(_) => {}
            None => change.append_ready_event(job, Task::Frame(frame)).await?,
        }
        change.commit_frame(job, frame, result).await?;
        let event =
            TaskEvent { worker: result.worker, report: result.report, ..TaskEvent::of(Task::Frame(frame)) };
        change.append_task_event(job, TaskState::Done, &event).await?;
        change.commit().await?;
        desk.queue.close_ready(&TaskKey { job: job.clone(), task: Task::Frame(frame) });
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
        if record.state()?.after(TaskTrigger::Lose).is_err() {
            return Ok(());
        }
        let mut change = self.store.change().await?;
        change.lose_result(job, frame).await?;
        change.commit().await?;
        tracing::warn!(job_id = %job, frame, "the frame's result is gone from the store; it is computed again");
        self.tell_stored(job);
        Ok(())
    }

    /// Number of tasks of a job that are ready or leased.
    pub(crate) async fn open_tasks(&self, job: &JobId) -> usize {
        self.desk.lock().await.queue.open_tasks(job)
    }

    /// Writes a failed attempt, and what follows from it, to the database.
    pub(super) async fn record_failed(
        &self,
        desk: &mut Desk,
        failed: &FailedLease,
        reason: &Failure,
    ) -> Result<(), StoreError> {
        let FailedLease { lease, retried } = failed;
        let (job, task, kind) = (&lease.key.job, lease.key.task, reason.kind());
        let next = if *retried { TaskState::Ready } else { TaskState::Failed };
        let excluded = (kind == FailureKind::OutOfResources).then_some(lease.worker_id.as_str());
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Failed(kind, &reason.message)).await?;
        change.count_failure(job, task, excluded).await?;
        change.set_task_state(job, task, next).await?;
        let event = TaskEvent {
            attempt: lease.attempt,
            worker: &lease.worker_id,
            failure: Some(reason),
            ..TaskEvent::of(task)
        };
        change.append_task_event(job, next, &event).await?;
        change.commit().await?;
        tracing::warn!(
            job_id = %job, task = task.kind(), number = task.number(), attempt = lease.attempt,
            worker_id = lease.worker_id, kind = kind.label(), reason = reason.message, retried, "attempt failed"
        );
        self.tell_stored(job);
        if let (Task::Tracks(position), false) = (task, retried) {
            desk.tracks_failed(job, position, reason);
        }
        desk.changed(job);
        Ok(())
    }

    /// Writes a verified result to the database; the artifact lets another job with the same input use it.
    pub(super) async fn record_done(
        &self,
        desk: &mut Desk,
        lease: &Lease,
        result: &CommittedFrame<'_>,
    ) -> Result<(), StoreError> {
        let (job, task, frame) = (&lease.key.job, lease.key.task, lease.key.task.number());
        let record = self.store.frame(job, frame).await?;
        let mut change = self.store.change().await?;
        change.end_attempt(&lease.id, AttemptOutcome::Done).await?;
        change.commit_frame(job, frame, result).await?;
        if let Some(record) = record {
            let artifact = Artifact { blob: result.delta.clone(), note: result.report.to_owned() };
            change.put_artifact(&record.result_key, "frame", &artifact).await?;
        }
        let event = TaskEvent {
            attempt: lease.attempt,
            worker: &lease.worker_id,
            report: result.report,
            seconds: result.seconds,
            ..TaskEvent::of(task)
        };
        change.append_task_event(job, TaskState::Done, &event).await?;
        change.commit().await?;
        tracing::info!(
            job_id = %job, frame, attempt = lease.attempt, worker_id = lease.worker_id,
            seconds = result.seconds, "frame done"
        );
        self.tell_stored(job);
        desk.changed(job);
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
            change.set_task_state(&key.job, key.task, TaskState::Failed).await?;
            let event = TaskEvent { failure: Some(&reason), ..TaskEvent::of(key.task) };
            change.append_task_event(&key.job, TaskState::Failed, &event).await?;
            change.commit().await?;
            self.tell_stored(&key.job);
            desk.changed(&key.job);
        }
        Ok(())
    }
}

impl Desk {
    /// Wakes the job's driver: something has ended, has come, or has failed.
    pub(super) fn changed(&self, job: &JobId) {
        if let Some(active) = self.active.get(job) {
            active.changed.send_replace(());
        }
    }

    /// What results of a job's present run are verified against, and its token.
    pub(super) fn base(&self, job: &JobId) -> Option<(Arc<FrameBase>, CancellationToken)> {
        let active = self.active.get(job)?;
        Some((active.base.clone()?, active.stop.clone()))
    }
}

#[cfg(test)]
impl Hub {
    /// As if something had happened to the tasks of a job.
    pub(crate) async fn stir(&self, job: &JobId) {
        self.desk.lock().await.changed(job);
    }
}
