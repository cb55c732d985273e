//! Which task goes to which worker: pure and synchronous, time is a parameter.
//!
//! A task is a frame, or the tracks of one view. The queue knows the open ones only (ready or leased). Its caller
//! writes every change to the database before any worker or client hears of it, and rebuilds the queue from there after
//! a restart.

mod counts;
pub mod job;
mod lease;
mod reporting;
pub mod retry;
pub mod task;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, Instant},
};

use trackersplat_proto::{
    failure::RetryPolicy,
    v1::{FailureKind, Register},
};

use self::{
    lease::Holder,
    retry::{Decision, decide},
};
pub use self::{
    lease::{Connected, FailedLease, Lease, Stale},
    task::{Task, TaskKey},
};

/// A job's name. Names sort in the order of submission.
pub type JobId = Arc<str>;

/// One stream of one worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SessionId(pub u64);

impl SessionId {
    /// Not a stream: the coordinator itself, whose leases end with it and so need no heartbeat.
    pub const OWN: Self = Self(0);
}

/// How the coordinator is called where it does a task itself; no worker can be called that.
pub const OWN_NAME: &str = "(coordinator)";

/// How many attempts and how much silence the queue admits.
#[derive(Clone, Copy, Debug)]
pub struct QueuePolicy {
    /// Attempts per task that may fail.
    pub max_attempts: u32,
    /// A lease without a heartbeat for this long expires.
    pub lease_duration: Duration,
    /// A lease whose stream broke expires after this long, unless its holder comes back.
    pub reconnect_grace: Duration,
}

/// What the queue must know of a task that becomes open.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TaskHistory {
    /// Leases so far.
    pub attempts: u32,
    /// Failed attempts so far, those through no fault of the task left out.
    pub failures: u32,
    /// Workers that lack the resources for it.
    pub excluded: BTreeSet<String>,
    /// Of tracks: the frame before which their next window goes out. 0: before every frame.
    pub before: u32,
}

#[derive(Debug, Default)]
struct OpenTask {
    history: TaskHistory,
    /// Workers that were lost with it: others are preferred.
    avoided: BTreeSet<String>,
    lease: Option<String>,
}

impl OpenTask {
    /// Tasks go out by ascending rank: those of the oldest job first, by frames, and tracks before what waits for them.
    fn rank<'a>(&self, key: &'a TaskKey) -> (&'a JobId, u32, Task) {
        let before = match key.task {
            Task::Tracks(_) => self.history.before,
            Task::Frame(number) => number,
        };
        (&key.job, before, key.task)
    }
}

#[derive(Debug)]
struct Session {
    worker_id: String,
    incarnation: String,
    /// Place in the line of workers that ask for a task.
    ticket: Option<u64>,
    lease: Option<String>,
}

/// Open tasks, leases, and workers that ask for one.
#[derive(Debug)]
pub struct Queue {
    policy: QueuePolicy,
    tasks: BTreeMap<TaskKey, OpenTask>,
    leases: BTreeMap<String, Lease>,
    sessions: BTreeMap<SessionId, Session>,
    next_ticket: u64,
    /// Since when no worker is connected, if none is.
    alone_since: Instant,
}

impl Queue {
    /// An empty queue.
    pub fn new(policy: QueuePolicy, now: Instant) -> Self {
        Self {
            policy,
            tasks: BTreeMap::new(),
            leases: BTreeMap::new(),
            sessions: BTreeMap::new(),
            next_ticket: 0,
            alone_since: now,
        }
    }

    /// Makes a task ready. A task that is open already stays as it is.
    pub fn add(&mut self, key: TaskKey, history: TaskHistory) {
        self.tasks.entry(key).or_insert_with(|| OpenTask { history, ..OpenTask::default() });
    }

    /// A worker's stream opens, in place of older ones of the same worker. A lease that this very process still holds
    /// goes on over the new stream; others of this worker have failed as lost.
    pub fn connect(&mut self, session: SessionId, worker: &Register, now: Instant) -> Connected {
        let of_worker = |other: &Session| other.worker_id == worker.worker_id;
        let replaced =
            self.sessions.iter().filter(|(_, other)| of_worker(other)).map(|(&id, _)| id).collect();
        self.sessions.retain(|_, other| !of_worker(other));
        let mut entry = Session {
            worker_id: worker.worker_id.clone(),
            incarnation: worker.incarnation.clone(),
            ticket: None,
            lease: None,
        };
        let mut lost = Vec::new();
        for lease in self.leases.values_mut().filter(|lease| lease.worker_id == worker.worker_id) {
            if lease.incarnation == worker.incarnation && lease.id == worker.held_lease_id {
                lease.session = session;
                lease.deadline = now + self.policy.lease_duration;
                entry.lease = Some(lease.id.clone());
            } else if lease.reporting.is_none() {
                lost.push(lease.id.clone());
            }
        }
        self.sessions.insert(session, entry);
        let lost = lost.iter().filter_map(|id| self.end_failed(id, FailureKind::LostWorker)).collect();
        Connected { replaced, lost }
    }

    /// A worker's stream is gone: the lease waits a little for its holder to come back.
    pub fn disconnect(&mut self, session: SessionId, now: Instant) {
        let Some(lease_id) = self.leave(session, now).and_then(|session| session.lease) else { return };
        if let Some(lease) = self.leases.get_mut(&lease_id) {
            lease.deadline = lease.deadline.min(now + self.policy.reconnect_grace);
        }
    }

    /// A worker drains: it gets nothing more, and its lease is void without counting as a failed attempt. A lease whose
    /// result is being verified goes on to its end.
    pub fn drain(&mut self, session: SessionId, now: Instant) -> Option<Lease> {
        let lease_id = self.leave(session, now)?.lease?;
        if self.leases.get(&lease_id)?.reporting.is_some() {
            return None;
        }
        let lease = self.end(&lease_id)?;
        self.reopen(&lease.key);
        Some(lease)
    }

    fn leave(&mut self, session: SessionId, now: Instant) -> Option<Session> {
        let left = self.sessions.remove(&session)?;
        if self.sessions.is_empty() {
            self.alone_since = now;
        }
        Some(left)
    }

    /// A worker asks for one task. It waits until one is there and it holds no lease.
    pub fn park(&mut self, session: SessionId) {
        let ticket = self.next_ticket;
        if let Some(session) = self.sessions.get_mut(&session)
            && session.ticket.is_none()
        {
            session.ticket = Some(ticket);
            self.next_ticket += 1;
        }
    }

    /// Gives ready tasks to waiting workers, first come first served; tasks in the order of their ranks.
    pub fn assign(&mut self, now: Instant, mut new_lease_id: impl FnMut() -> String) -> Vec<Lease> {
        let mut waiting: Vec<(u64, SessionId)> = self
            .sessions
            .iter()
            .filter(|(_, session)| session.lease.is_none())
            .filter_map(|(&id, session)| Some((session.ticket?, id)))
            .collect();
        waiting.sort_unstable();
        waiting
            .into_iter()
            .filter_map(|(_, session)| self.lease_next(session, now, &mut new_lease_id))
            .collect()
    }

    fn lease_next(
        &mut self,
        session_id: SessionId,
        now: Instant,
        new_lease_id: &mut impl FnMut() -> String,
    ) -> Option<Lease> {
        let Session { worker_id, incarnation, .. } = self.sessions.get(&session_id)?;
        let holder =
            Holder { worker_id: worker_id.clone(), incarnation: incarnation.clone(), session: session_id };
        let key = self.first(|_, task| self.may_take(task, &holder.worker_id))?.clone();
        let lease = self.give(key, holder, now, new_lease_id())?;
        let session = self.sessions.get_mut(&session_id)?;
        session.ticket = None;
        session.lease = Some(lease.id.clone());
        Some(lease)
    }

    /// Whether the coordinator is to track a view of a job itself: no connected worker may, and where none is connected
    /// none has come for [`QueuePolicy::reconnect_grace`]. After a restart the views are thus left to the workers that
    /// come back.
    pub fn has_own_work(&self, job: &str, now: Instant) -> bool {
        self.own_work(job, now).is_some()
    }

    /// The coordinator's own lease of such a view.
    pub fn lease_own(&mut self, job: &str, now: Instant, lease_id: String) -> Option<Lease> {
        let key = self.own_work(job, now)?.clone();
        let holder =
            Holder { worker_id: OWN_NAME.to_owned(), incarnation: String::new(), session: SessionId::OWN };
        self.give(key, holder, now, lease_id)
    }

    fn own_work(&self, job: &str, now: Instant) -> Option<&TaskKey> {
        if self.sessions.is_empty() && now < self.alone_since + self.policy.reconnect_grace {
            return None;
        }
        self.first(|key, task| {
            let of_job = &*key.job == job && matches!(key.task, Task::Tracks(_));
            of_job && !self.is_servable(task) && !task.history.excluded.contains(OWN_NAME)
        })
    }

    /// The ready task that goes out before all others that may.
    fn first(&self, may: impl Fn(&TaskKey, &OpenTask) -> bool) -> Option<&TaskKey> {
        let ready = self.ready().filter(|(key, task)| may(key, task));
        ready.min_by_key(|&(key, task)| task.rank(key)).map(|(key, _)| key)
    }

    fn give(&mut self, key: TaskKey, holder: Holder, now: Instant, id: String) -> Option<Lease> {
        let task = self.tasks.get_mut(&key)?;
        task.history.attempts += 1;
        task.lease = Some(id.clone());
        let Holder { worker_id, incarnation, session } = holder;
        let lease = Lease {
            id: id.clone(),
            attempt: task.history.attempts,
            key,
            worker_id,
            incarnation,
            session,
            since: now,
            deadline: now + self.policy.lease_duration,
            reporting: None,
            saying: BTreeSet::new(),
        };
        self.leases.insert(id, lease.clone());
        Some(lease)
    }

    /// What the holder of a lease that was just given will likely be given next: those with older leases ask before it
    /// does. Of leases given at the same time those of earlier tasks count as older.
    pub fn likely_next(&self, lease: &Lease) -> Option<&TaskKey> {
        let age = |lease: &Lease| (lease.since, lease.key.clone());
        let of_workers = self.leases.values().filter(|other| other.session != SessionId::OWN);
        let older = of_workers.filter(|other| age(other) < age(lease)).count();
        let mut ready: Vec<_> =
            self.ready().filter(|(_, task)| self.may_take(task, &lease.worker_id)).collect();
        ready.sort_by_key(|&(key, task)| task.rank(key));
        ready.get(older).map(|(key, _)| *key)
    }

    fn ready(&self) -> impl Iterator<Item = (&TaskKey, &OpenTask)> {
        self.tasks.iter().filter(|(_, task)| task.lease.is_none())
    }

    /// Whether a worker may take a task: never if it lacks the resources; if it was lost with the task before, only
    /// while no other worker could take it.
    fn may_take(&self, task: &OpenTask, worker_id: &str) -> bool {
        if task.history.excluded.contains(worker_id) {
            return false;
        }
        let is_unburdened = |id: &str| !task.history.excluded.contains(id) && !task.avoided.contains(id);
        is_unburdened(worker_id) || !self.sessions.values().any(|session| is_unburdened(&session.worker_id))
    }

    /// The verified result counts: the task is closed.
    pub fn commit(&mut self, lease_id: &str, attempt: u32) -> Result<Lease, Stale> {
        self.in_force(lease_id, attempt)?;
        let lease = self.end(lease_id).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))?;
        self.tasks.remove(&lease.key);
        Ok(lease)
    }

    /// The lease has ended without an end of the task, and without a failure: the task is ready again. `before` as in
    /// [`TaskHistory`].
    pub fn go_on(&mut self, lease_id: &str, attempt: u32, before: u32) -> Result<Lease, Stale> {
        self.in_force(lease_id, attempt)?;
        let lease = self.end(lease_id).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))?;
        if let Some(task) = self.tasks.get_mut(&lease.key) {
            task.history.before = before;
            task.lease = None;
        }
        Ok(lease)
    }

    /// A ready task's place has changed; `before` as in [`TaskHistory`].
    pub fn reschedule(&mut self, key: &TaskKey, before: u32) {
        if let Some(task) = self.tasks.get_mut(key) {
            task.history.before = before;
        }
    }

    /// A part of the task's result is kept: whatever failed before, the task gets on, has all its attempts again, and
    /// those that were lost with it are as welcome as others.
    pub fn progressed(&mut self, key: &TaskKey) {
        if let Some(task) = self.tasks.get_mut(key) {
            task.history.failures = 0;
            task.avoided.clear();
        }
    }

    /// The attempt failed.
    pub fn fail(&mut self, lease_id: &str, attempt: u32, kind: FailureKind) -> Result<FailedLease, Stale> {
        self.in_force(lease_id, attempt)?;
        self.end_failed(lease_id, kind).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))
    }

    /// Leases without a sign of life have failed as lost.
    pub fn expire(&mut self, now: Instant) -> Vec<FailedLease> {
        let silent = self.leases.values().filter(|lease| lease.may_expire() && lease.deadline <= now);
        let silent: Vec<String> = silent.map(|lease| lease.id.clone()).collect();
        silent.iter().filter_map(|id| self.end_failed(id, FailureKind::LostWorker)).collect()
    }

    /// Closes every open task of a job. Returns its leases, whose holders must be told.
    pub fn cancel_job(&mut self, job: &str) -> Vec<Lease> {
        let held = self.leases.values().filter(|lease| &*lease.key.job == job);
        let held: Vec<String> = held.map(|lease| lease.id.clone()).collect();
        let ended = held.iter().filter_map(|id| self.end(id)).collect();
        self.tasks.retain(|key, _| &*key.job != job);
        ended
    }

    /// Closes a ready task that no worker is to do. Whether it was there and not leased.
    pub fn close_ready(&mut self, key: &TaskKey) -> bool {
        let is_ready = self.tasks.get(key).is_some_and(|task| task.lease.is_none());
        is_ready && self.tasks.remove(key).is_some()
    }

    fn is_servable(&self, task: &OpenTask) -> bool {
        self.sessions.values().any(|session| !task.history.excluded.contains(&session.worker_id))
    }

    /// Whether a lease is still held with this attempt, over whatever stream.
    pub fn check(&mut self, lease_id: &str, attempt: u32) -> Result<(), Stale> {
        self.in_force(lease_id, attempt).map(|_| ())
    }

    fn held(&mut self, session: SessionId, lease_id: &str, attempt: u32) -> Result<&mut Lease, Stale> {
        let lease = self.in_force(lease_id, attempt)?;
        if lease.session != session {
            return Err(Stale::OtherWorker(lease_id.to_owned()));
        }
        Ok(lease)
    }

    fn in_force(&mut self, lease_id: &str, attempt: u32) -> Result<&mut Lease, Stale> {
        let lease = self.leases.get_mut(lease_id).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))?;
        if lease.attempt != attempt {
            let lease_id = lease_id.to_owned();
            return Err(Stale::OtherAttempt { lease_id, held: lease.attempt, given: attempt });
        }
        Ok(lease)
    }

    /// Takes a lease back, whoever is to blame.
    fn end(&mut self, lease_id: &str) -> Option<Lease> {
        let lease = self.leases.remove(lease_id)?;
        if let Some(session) = self.sessions.get_mut(&lease.session) {
            session.lease.take_if(|held| held == lease_id);
        }
        Some(lease)
    }

    fn reopen(&mut self, key: &TaskKey) {
        if let Some(task) = self.tasks.get_mut(key) {
            task.lease = None;
        }
    }

    fn end_failed(&mut self, lease_id: &str, kind: FailureKind) -> Option<FailedLease> {
        let lease = self.end(lease_id)?;
        let task = self.tasks.get_mut(&lease.key)?;
        task.lease = None;
        task.history.failures += 1;
        let decision = decide(kind, task.history.failures, self.policy.max_attempts);
        match decision {
            Decision::Retry(RetryPolicy::OnlyAnotherWorker) => {
                task.history.excluded.insert(lease.worker_id.clone());
            }
            Decision::Retry(RetryPolicy::PreferAnotherWorker) => {
                task.avoided.insert(lease.worker_id.clone());
            }
            Decision::Retry(_) => {}
            Decision::GiveUp => {
                self.tasks.remove(&lease.key);
            }
        }
        Some(FailedLease { lease, retried: decision != Decision::GiveUp })
    }
}
