//! How many tasks are open, and which of them nobody may do.

use super::{Lease, OWN_NAME, OpenTask, Queue, SessionId, Task, TaskKey};

impl Queue {
    /// Ready tasks of a job that nobody may do now: frames that no connected worker may take, and views for which the
    /// coordinator lacks the resources as well.
    pub fn waiting_tasks(&self, job: &str) -> usize {
        let waits = |(key, task): &(&TaskKey, &OpenTask)| {
            let is_own = matches!(key.task, Task::Tracks(_)) && !task.history.excluded.contains(OWN_NAME);
            &*key.job == job && !is_own && !self.is_servable(task)
        };
        self.ready().filter(waits).count()
    }

    /// Ready frames for which every connected worker, and there is at least one, lacks the resources. None while a
    /// worker may come back to its lease: it may be the one that has them.
    pub fn frames_beyond_all_workers(&self) -> Vec<TaskKey> {
        let is_held =
            |lease: &Lease| lease.session == SessionId::OWN || self.sessions.contains_key(&lease.session);
        if self.sessions.is_empty() || !self.leases.values().all(is_held) {
            return Vec::new();
        }
        self.unservable_frames().cloned().collect()
    }

    fn unservable_frames(&self) -> impl Iterator<Item = &TaskKey> {
        let is_frame = |key: &TaskKey| matches!(key.task, Task::Frame(_));
        let beyond = self.ready().filter(move |(key, task)| is_frame(key) && !self.is_servable(task));
        beyond.map(|(key, _)| key)
    }

    /// Open tasks of a job.
    pub fn open_tasks(&self, job: &str) -> usize {
        self.tasks.keys().filter(|key| &*key.job == job).count()
    }

    /// Open tracks of a job.
    pub fn open_tracks(&self, job: &str) -> usize {
        let is_open = |key: &&TaskKey| &*key.job == job && matches!(key.task, Task::Tracks(_));
        self.tasks.keys().filter(is_open).count()
    }

    /// Connected workers.
    pub fn connected(&self) -> usize {
        self.sessions.len()
    }
}
