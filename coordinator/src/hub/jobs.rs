//! Jobs begin, change state, and end.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use splat::clip::Clip;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{CancelLease, Dismiss, Failure, FailureKind, coordinator_message::Message};

use super::{ActiveJob, Desk, FrameBase, Hub};
use crate::{
    driver,
    failure::{StageError, failure},
    queue::{
        JobId, OWN_NAME,
        job::{JobState, JobTrigger},
        retry::{Decision, decide},
        task::TaskState,
    },
    store::{AttemptOutcome, Change, NewJob, OrphanedLease, StoreError, TaskEvent},
};

impl Hub {
    /// After a start: leases of the coordinator before are void, and its jobs go on.
    pub(crate) async fn recover(self: &Arc<Self>) -> Result<(), StoreError> {
        let mut change = self.store.change().await?;
        change.all_workers_gone().await?;
        for lease in change.orphaned_leases().await? {
            if lease.worker == OWN_NAME {
                self.count_own_loss(&mut change, &lease).await?;
            } else {
                release(&mut change, &lease, "the coordinator was restarted").await?;
            }
        }
        change.commit().await?;
        for job in self.store.jobs().await? {
            if !job.state()?.has_ended() {
                tracing::info!(job_id = job.id, state = job.state()?.label(), "job goes on");
                self.activate(&job.id, None).await;
            }
        }
        Ok(())
    }

    /// Own leases of an orderly end are given back: nobody was lost with them.
    pub(crate) async fn release_own_leases(&self) -> Result<(), StoreError> {
        let mut change = self.store.change().await?;
        for lease in change.orphaned_leases().await?.iter().filter(|lease| lease.worker == OWN_NAME) {
            release(&mut change, lease, "the coordinator was stopped").await?;
        }
        change.commit().await
    }

    /// The coordinator died over its own work: that counts, so that a view that kills it is not begun for ever.
    async fn count_own_loss(&self, change: &mut Change, lease: &OrphanedLease) -> Result<(), StoreError> {
        let OrphanedLease { id, key, attempt, worker } = lease;
        let failures = self.store.task(key).await?.map_or(0, |task| task.failures) + 1;
        let reason = failure(FailureKind::LostWorker, "the coordinator died while it tracked the view");
        let next = match decide(reason.kind(), failures, self.options.max_attempts) {
            Decision::Retry(_) => TaskState::Ready,
            Decision::GiveUp => TaskState::Failed,
        };
        change.end_attempt(id, AttemptOutcome::Failed(reason.kind(), &reason.message)).await?;
        change.count_failure(&key.job, key.task, None).await?;
        change.set_task_state(&key.job, key.task, next).await?;
        let event =
            TaskEvent { attempt: *attempt, worker, failure: Some(&reason), ..TaskEvent::of(key.task) };
        change.append_task_event(&key.job, next, &event).await?;
        tracing::warn!(job_id = %key.job, number = key.task.number(), attempt, failures, "{}", reason.message);
        Ok(())
    }

    /// A new job begins.
    pub(crate) async fn create_job(
        self: &Arc<Self>,
        job: &NewJob,
        clip: Arc<Clip>,
    ) -> Result<(), StoreError> {
        let mut change = self.store.change().await?;
        change.insert_job(job).await?;
        change.append_job_event(&job.id, JobState::Ingesting, None).await?;
        change.commit().await?;
        tracing::info!(job_id = job.id, clip = job.clip, output = job.output, "job submitted");
        self.activate(&job.id, Some(clip)).await;
        Ok(())
    }

    /// An ended job begins again with what it has; failed and cancelled tasks get all their attempts again. Its files may
    /// have moved: they are where `clip_path` and `request` say now.
    pub(crate) async fn resubmit_job(
        self: &Arc<Self>,
        job: &str,
        clip_path: &str,
        request: &str,
        clip: Arc<Clip>,
    ) -> Result<(), StoreError> {
        let mut change = self.store.change().await?;
        let Ok(next) = change.job_state(job).await?.after(JobTrigger::Resubmit) else { return Ok(()) };
        change.set_job_inputs(job, clip_path, request).await?;
        change.set_job_state(job, next, None).await?;
        change.append_job_event(job, next, None).await?;
        change.reopen_tasks(job).await?;
        change.commit().await?;
        tracing::info!(job_id = job, "job submitted again");
        self.activate(job, Some(clip)).await;
        Ok(())
    }

    async fn activate(self: &Arc<Self>, id: &str, clip: Option<Arc<Clip>>) {
        let id: JobId = id.into();
        let active = ActiveJob {
            stop: self.shutdown.child_token(),
            changed: watch::Sender::new(()),
            clip,
            base: None,
            tracks: None,
            told: None,
        };
        let (stop, changed) = (active.stop.clone(), active.changed.subscribe());
        let clip = active.clip.clone();
        self.desk.lock().await.active.insert(id.clone(), active);
        self.tell_stored(&id);
        let hub = self.clone();
        let run = driver::run(hub, id.clone(), stop.clone(), changed, clip);
        self.spawn_driver(id, stop, run);
    }

    /// The job's stage `ended` well. `Stopped` if somebody ended the run meanwhile: the job may be another run's by now.
    pub(crate) async fn advance(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        ended: JobState,
    ) -> Result<JobState, StageError> {
        let mut desk = self.desk.lock().await;
        let mut change = self.store.change().await?;
        // Under the lock, under which runs are stopped.
        if stop.is_cancelled() || change.job_state(job).await? != ended {
            return Err(StageError::Stopped);
        }
        let Ok(next) = ended.after(JobTrigger::StageDone) else { return Err(StageError::Stopped) };
        change.set_job_state(job, next, None).await?;
        change.append_job_event(job, next, None).await?;
        change.commit().await?;
        tracing::info!(job_id = %job, state = next.label(), "job state");
        if next.has_ended() {
            self.retire(&mut desk, job);
        }
        self.tell_stored(job);
        Ok(next)
    }

    /// Ends a job for a client. Returns its state; an ended job stays as it is.
    pub(crate) async fn cancel_job(&self, job: &JobId) -> Result<JobState, StoreError> {
        let mut desk = self.desk.lock().await;
        self.end_job(&mut desk, job, JobTrigger::Cancel, None).await
    }

    /// One run of a job has failed. Nothing happens if it was stopped meanwhile: the job may be another run's by now.
    pub(crate) async fn fail_run(
        &self,
        job: &JobId,
        stop: &CancellationToken,
        failure: Failure,
    ) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        if !stop.is_cancelled() {
            self.end_job(&mut desk, job, JobTrigger::Fail, Some(failure)).await?;
        }
        Ok(())
    }

    /// The job's open tasks are cancelled, their workers told.
    async fn end_job(
        &self,
        desk: &mut Desk,
        job: &JobId,
        trigger: JobTrigger,
        failure: Option<Failure>,
    ) -> Result<JobState, StoreError> {
        let mut change = self.store.change().await?;
        let before = change.job_state(job).await?;
        let Ok(next) = before.after(trigger) else { return Ok(before) };
        let leases = desk.queue.cancel_job(job);
        for lease in &leases {
            change.end_attempt(&lease.id, AttemptOutcome::Cancelled).await?;
        }
        cancel_open_tasks(&mut change, job).await?;
        change.set_job_state(job, next, failure.as_ref()).await?;
        change.append_job_event(job, next, failure.as_ref()).await?;
        change.commit().await?;
        let reason = failure.as_ref().map_or("", |failure| failure.message.as_str());
        tracing::info!(job_id = %job, state = next.label(), reason, "job ended");
        for lease in leases {
            let reason = format!("the job is {}", next.label());
            desk.send(lease.session, Message::CancelLease(CancelLease { lease_id: lease.id, reason }));
        }
        self.retire(desk, job);
        self.tell_stored(job);
        Ok(next)
    }

    /// What the results of a job's frames are verified against from now on.
    pub(crate) async fn set_frame_base(&self, job: &JobId, base: Arc<FrameBase>) {
        if let Some(active) = self.desk.lock().await.active.get_mut(job) {
            active.base = Some(base);
        }
    }

    /// Output folders of jobs that have not ended, with their names.
    pub(crate) async fn active_outputs(&self) -> Result<Vec<(String, PathBuf)>, StoreError> {
        let mut outputs = Vec::new();
        for job in self.store.jobs().await? {
            if !job.state()?.has_ended() {
                outputs.push((job.id, PathBuf::from(job.output)));
            }
        }
        Ok(outputs)
    }

    /// A job that has not ended and reads the clip in this folder.
    pub(crate) async fn clip_user(&self, folder: &Path) -> Result<Option<String>, StoreError> {
        let opened = |job: &ActiveJob| job.clip.as_ref().is_some_and(|clip| clip.root() == folder);
        let user = {
            let desk = self.desk.lock().await;
            desk.active.iter().find(|(_, job)| opened(job)).map(|(id, _)| id.to_string())
        };
        if user.is_some() {
            return Ok(user);
        }
        // After a restart, a job opens the clip again by the path that it was submitted with.
        for job in self.store.jobs().await? {
            if !job.state()?.has_ended() && Path::new(&job.clip) == folder {
                return Ok(Some(job.id));
            }
        }
        Ok(None)
    }

    /// Whether a job lets another one have its output folder: it is one of this coordinator's, has no finished frame,
    /// and has ended. An embedded coordinator ends one that an earlier run has left behind.
    pub(crate) async fn gives_way(&self, job: &str) -> Result<bool, StoreError> {
        let Some(record) = self.store.job(job).await? else { return Ok(false) };
        if !record.state()?.has_ended() {
            if !self.options.replaces_abandoned_jobs || self.store.has_finished_frame(job).await? {
                return Ok(false);
            }
            tracing::warn!(
                job_id = job,
                "another submission takes the output folder of this job, which ends"
            );
            self.cancel_job(&job.into()).await?;
        }
        Ok(!self.store.has_finished_frame(job).await?)
    }

    fn retire(&self, desk: &mut Desk, job: &JobId) {
        if let Some(active) = desk.active.remove(job) {
            active.stop.cancel();
        }
        desk.has_worked = true;
        self.dismiss_if_idle(desk);
    }

    /// An embedded coordinator lets its workers go once there is nothing left for them.
    pub(super) fn dismiss_if_idle(&self, desk: &mut Desk) {
        if !self.options.dismiss_workers_when_idle || !desk.has_worked || !desk.active.is_empty() {
            return;
        }
        let sessions: Vec<_> = desk.sessions.keys().copied().collect();
        for session in sessions {
            desk.send(session, Message::Dismiss(Dismiss { reason: "no job is left".into() }));
        }
    }
}

async fn release(change: &mut Change, lease: &OrphanedLease, reason: &str) -> Result<(), StoreError> {
    let OrphanedLease { id, key, attempt, worker } = lease;
    change.end_attempt(id, AttemptOutcome::Released(reason)).await?;
    change.release_task(key, *attempt, worker).await?;
    let (kind, number) = (key.task.kind(), key.task.number());
    tracing::info!(job_id = %key.job, kind, number, attempt, reason, "the lease is void");
    Ok(())
}

async fn cancel_open_tasks(change: &mut Change, job: &JobId) -> Result<(), StoreError> {
    for (key, attempt) in change.open_tasks(job).await? {
        change.set_task_state(job, key.task, TaskState::Cancelled).await?;
        let event = TaskEvent { attempt, ..TaskEvent::of(key.task) };
        change.append_task_event(job, TaskState::Cancelled, &event).await?;
    }
    Ok(())
}
