//! Which frame goes to which worker: pure and synchronous, time is a parameter.
//!
//! The queue knows the open frames only (ready or leased). Its caller writes every change to the database before any
//! worker or client hears of it, and rebuilds the queue from there after a restart.

pub mod frame;
pub mod job;
pub mod retry;
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

use self::retry::{Decision, decide};

/// A job's name. Names sort in the order of submission.
pub type JobId = Arc<str>;

/// One stream of one worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SessionId(pub u64);

/// One frame of one job; sorts by job, then by frame number.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct FrameKey {
    /// The job.
    pub job: JobId,
    /// Frame number in the clip.
    pub frame: u32,
}

/// A worker's right to one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Lease {
    /// Fencing token, with the attempt.
    pub id: String,
    /// Counts the leases of the frame from 1; never used twice.
    pub attempt: u32,
    /// What it is for.
    pub key: FrameKey,
    /// Who holds it.
    pub worker_id: String,
    /// The process that holds it: a worker that was started again does not.
    incarnation: String,
    /// The stream over which it is held.
    pub session: SessionId,
    /// When it was given.
    pub since: Instant,
    /// When it expires without a heartbeat.
    pub deadline: Instant,
    /// The stream whose report is being verified; it does not expire meanwhile.
    reporting: Option<SessionId>,
}

/// A lease that ended in failure, and what follows.
#[derive(Clone, Debug, PartialEq)]
pub struct FailedLease {
    /// The lease.
    pub lease: Lease,
    /// Whether the frame is ready again; else it has failed.
    pub retried: bool,
}

/// What a new stream of a worker ends.
#[derive(Debug, Default, PartialEq)]
pub struct Connected {
    /// Older streams of the same worker, which the caller must close.
    pub replaced: Vec<SessionId>,
    /// Leases of the worker that it does not hold any more.
    pub lost: Vec<FailedLease>,
}

/// Why a heartbeat or report has no effect.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stale {
    /// It has expired, was cancelled, or never existed.
    #[error("lease {0} is not held any more")]
    NotHeld(String),
    /// It is held with another attempt.
    #[error("lease {lease_id} is attempt {held}, the message says {given}")]
    OtherAttempt {
        /// The lease.
        lease_id: String,
        /// Its attempt.
        held: u32,
        /// The message's attempt.
        given: u32,
    },
    /// It was given to another stream.
    #[error("lease {0} belongs to another worker")]
    OtherWorker(String),
}

/// How many attempts and how much silence the queue admits.
#[derive(Clone, Copy, Debug)]
pub struct QueuePolicy {
    /// Attempts per frame that may fail.
    pub max_attempts: u32,
    /// A lease without a heartbeat for this long expires.
    pub lease_duration: Duration,
    /// A lease whose stream broke expires after this long, unless its holder comes back.
    pub reconnect_grace: Duration,
}

/// What the queue must know of a frame that becomes open.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FrameHistory {
    /// Leases so far.
    pub attempts: u32,
    /// Failed attempts so far, those through no fault of the frame left out.
    pub failures: u32,
    /// Workers that lack the resources for it.
    pub excluded: BTreeSet<String>,
}

#[derive(Debug, Default)]
struct OpenFrame {
    history: FrameHistory,
    /// Workers that were lost with it: others are preferred.
    avoided: BTreeSet<String>,
    lease: Option<String>,
}

#[derive(Debug)]
struct Session {
    worker_id: String,
    incarnation: String,
    /// Place in the line of workers that ask for a frame.
    ticket: Option<u64>,
    lease: Option<String>,
}

/// Open frames, leases, and workers that ask for one.
#[derive(Debug)]
pub struct Queue {
    policy: QueuePolicy,
    frames: BTreeMap<FrameKey, OpenFrame>,
    leases: BTreeMap<String, Lease>,
    sessions: BTreeMap<SessionId, Session>,
    next_ticket: u64,
}

impl Queue {
    /// An empty queue.
    pub fn new(policy: QueuePolicy) -> Self {
        Self {
            policy,
            frames: BTreeMap::new(),
            leases: BTreeMap::new(),
            sessions: BTreeMap::new(),
            next_ticket: 0,
        }
    }

    /// Makes a frame ready. A frame that is open already stays as it is.
    pub fn add(&mut self, key: FrameKey, history: FrameHistory) {
        self.frames.entry(key).or_insert_with(|| OpenFrame { history, ..OpenFrame::default() });
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
        let Some(lease_id) = self.sessions.remove(&session).and_then(|session| session.lease) else { return };
        if let Some(lease) = self.leases.get_mut(&lease_id) {
            lease.deadline = lease.deadline.min(now + self.policy.reconnect_grace);
        }
    }

    /// A worker drains: it gets nothing more, and its lease is void without counting as a failed attempt. A lease whose
    /// result is being verified goes on to its end.
    pub fn drain(&mut self, session: SessionId) -> Option<Lease> {
        let lease_id = self.sessions.remove(&session)?.lease?;
        if self.leases.get(&lease_id)?.reporting.is_some() {
            return None;
        }
        let lease = self.end(&lease_id)?;
        self.reopen(&lease.key);
        Some(lease)
    }

    /// A worker asks for one frame. It waits until one is there and it holds no lease.
    pub fn park(&mut self, session: SessionId) {
        let ticket = self.next_ticket;
        if let Some(session) = self.sessions.get_mut(&session)
            && session.ticket.is_none()
        {
            session.ticket = Some(ticket);
            self.next_ticket += 1;
        }
    }

    /// Gives ready frames to waiting workers, first come first served; frames in order of job and number.
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
        let (worker_id, incarnation) = (worker_id.clone(), incarnation.clone());
        let ready = self.frames.iter().filter(|(_, frame)| frame.lease.is_none());
        let key = ready.into_iter().find(|(_, frame)| self.may_take(frame, &worker_id))?.0.clone();
        let frame = self.frames.get_mut(&key)?;
        frame.history.attempts += 1;
        let id = new_lease_id();
        frame.lease = Some(id.clone());
        let lease = Lease {
            id: id.clone(),
            attempt: frame.history.attempts,
            key,
            worker_id,
            incarnation,
            session: session_id,
            since: now,
            deadline: now + self.policy.lease_duration,
            reporting: None,
        };
        let session = self.sessions.get_mut(&session_id)?;
        session.ticket = None;
        session.lease = Some(id.clone());
        self.leases.insert(id, lease.clone());
        Some(lease)
    }

    /// What the holder of a lease that was just given will likely be given next: those with older leases ask before it
    /// does. Of leases given at the same time those of earlier frames count as older.
    pub fn likely_next(&self, lease: &Lease) -> Option<&FrameKey> {
        let age = |lease: &Lease| (lease.since, lease.key.clone());
        let older = self.leases.values().filter(|other| age(other) < age(lease)).count();
        let ready = self.frames.iter().filter(|(_, frame)| frame.lease.is_none());
        ready.filter(|(_, frame)| self.may_take(frame, &lease.worker_id)).nth(older).map(|(key, _)| key)
    }

    /// Whether a worker may take a frame: never if it lacks the resources; if it was lost with the frame before, only
    /// while no other worker could take it.
    fn may_take(&self, frame: &OpenFrame, worker_id: &str) -> bool {
        if frame.history.excluded.contains(worker_id) {
            return false;
        }
        let is_unburdened = |id: &str| !frame.history.excluded.contains(id) && !frame.avoided.contains(id);
        is_unburdened(worker_id) || !self.sessions.values().any(|session| is_unburdened(&session.worker_id))
    }

    /// A sign of life for a lease.
    pub fn heartbeat(
        &mut self,
        session: SessionId,
        lease_id: &str,
        attempt: u32,
        now: Instant,
    ) -> Result<&Lease, Stale> {
        let deadline = now + self.policy.lease_duration;
        let lease = self.held(session, lease_id, attempt)?;
        lease.deadline = deadline;
        Ok(lease)
    }

    /// A report has arrived: the lease does not expire while it is verified, whatever becomes of the stream. `None` if
    /// an earlier report of it is being verified: this one is to be left alone.
    pub fn begin_report(
        &mut self,
        session: SessionId,
        lease_id: &str,
        attempt: u32,
    ) -> Result<Option<&Lease>, Stale> {
        let lease = self.held(session, lease_id, attempt)?;
        if lease.reporting.is_some() {
            return Ok(None);
        }
        lease.reporting = Some(session);
        Ok(Some(lease))
    }

    /// Nobody verifies the report of this stream any more: the attempt has failed, whoever holds the lease by now.
    pub fn abandon_report(&mut self, session: SessionId) -> Option<FailedLease> {
        let abandoned = self.leases.values().find(|lease| lease.reporting == Some(session))?.id.clone();
        self.end_failed(&abandoned, FailureKind::Bug)
    }

    /// The verified result counts: the frame is closed.
    pub fn commit(&mut self, lease_id: &str, attempt: u32) -> Result<Lease, Stale> {
        self.in_force(lease_id, attempt)?;
        let lease = self.end(lease_id).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))?;
        self.frames.remove(&lease.key);
        Ok(lease)
    }

    /// The attempt failed.
    pub fn fail(&mut self, lease_id: &str, attempt: u32, kind: FailureKind) -> Result<FailedLease, Stale> {
        self.in_force(lease_id, attempt)?;
        self.end_failed(lease_id, kind).ok_or_else(|| Stale::NotHeld(lease_id.to_owned()))
    }

    /// Leases without a sign of life have failed as lost.
    pub fn expire(&mut self, now: Instant) -> Vec<FailedLease> {
        let silent = self.leases.values().filter(|lease| lease.reporting.is_none() && lease.deadline <= now);
        let silent: Vec<String> = silent.map(|lease| lease.id.clone()).collect();
        silent.iter().filter_map(|id| self.end_failed(id, FailureKind::LostWorker)).collect()
    }

    /// Closes every open frame of a job. Returns its leases, whose holders must be told.
    pub fn cancel_job(&mut self, job: &str) -> Vec<Lease> {
        let held = self.leases.values().filter(|lease| &*lease.key.job == job);
        let held: Vec<String> = held.map(|lease| lease.id.clone()).collect();
        let ended = held.iter().filter_map(|id| self.end(id)).collect();
        self.frames.retain(|key, _| &*key.job != job);
        ended
    }

    /// Closes a ready frame that no worker is to compute. Whether it was there and not leased.
    pub fn close_ready(&mut self, key: &FrameKey) -> bool {
        let is_ready = self.frames.get(key).is_some_and(|frame| frame.lease.is_none());
        is_ready && self.frames.remove(key).is_some()
    }

    /// Ready frames of a job that no connected worker may take.
    pub fn waiting_frames(&self, job: &str) -> usize {
        let ready = self.frames.iter().filter(|(key, frame)| &*key.job == job && frame.lease.is_none());
        ready.filter(|(_, frame)| !self.is_servable(frame)).count()
    }

    /// Ready frames for which every connected worker, and there is at least one, lacks the resources. None while a
    /// worker may come back to its lease: it may be the one that has them.
    pub fn frames_beyond_all_workers(&self) -> Vec<FrameKey> {
        let is_held = |lease: &Lease| self.sessions.contains_key(&lease.session);
        if self.sessions.is_empty() || !self.leases.values().all(is_held) {
            return Vec::new();
        }
        let ready = self.frames.iter().filter(|(_, frame)| frame.lease.is_none());
        ready.filter(|(_, frame)| !self.is_servable(frame)).map(|(key, _)| key.clone()).collect()
    }

    fn is_servable(&self, frame: &OpenFrame) -> bool {
        self.sessions.values().any(|session| !frame.history.excluded.contains(&session.worker_id))
    }

    /// Open frames of a job.
    pub fn open_frames(&self, job: &str) -> usize {
        self.frames.keys().filter(|key| &*key.job == job).count()
    }

    /// Connected workers.
    pub fn connected(&self) -> usize {
        self.sessions.len()
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

    fn reopen(&mut self, key: &FrameKey) {
        if let Some(frame) = self.frames.get_mut(key) {
            frame.lease = None;
        }
    }

    fn end_failed(&mut self, lease_id: &str, kind: FailureKind) -> Option<FailedLease> {
        let lease = self.end(lease_id)?;
        let frame = self.frames.get_mut(&lease.key)?;
        frame.lease = None;
        frame.history.failures += 1;
        let decision = decide(kind, frame.history.failures, self.policy.max_attempts);
        match decision {
            Decision::Retry(RetryPolicy::OnlyAnotherWorker) => {
                frame.history.excluded.insert(lease.worker_id.clone());
            }
            Decision::Retry(RetryPolicy::PreferAnotherWorker) => {
                frame.avoided.insert(lease.worker_id.clone());
            }
            Decision::Retry(_) => {}
            Decision::GiveUp => {
                self.frames.remove(&lease.key);
            }
        }
        Some(FailedLease { lease, retried: decision != Decision::GiveUp })
    }
}
