//! Leases, how they end, and why a message about one has no effect.

use std::{collections::BTreeSet, time::Instant};

use super::{SessionId, TaskKey};

/// A worker's right to one task.
#[derive(Clone, Debug, PartialEq)]
pub struct Lease {
    /// Fencing token, with the attempt.
    pub id: String,
    /// Counts the leases of the task from 1; never used twice.
    pub attempt: u32,
    /// What it is for.
    pub key: TaskKey,
    /// Who holds it.
    pub worker_id: String,
    /// The process that holds it: a worker that was started again does not.
    pub(super) incarnation: String,
    /// The stream over which it is held.
    pub session: SessionId,
    /// When it was given.
    pub since: Instant,
    /// When it expires without a heartbeat.
    pub deadline: Instant,
    /// The stream whose report is being verified; it does not expire meanwhile.
    pub(super) reporting: Option<SessionId>,
    /// The streams whose fields are being verified; it does not expire meanwhile.
    pub(super) saying: BTreeSet<SessionId>,
}

impl Lease {
    pub(super) fn may_expire(&self) -> bool {
        self.session != SessionId::OWN && self.reporting.is_none() && self.saying.is_empty()
    }

    pub(super) fn is_verified_for(&self, session: SessionId) -> bool {
        self.reporting == Some(session) || self.saying.contains(&session)
    }
}

/// Who gets a lease.
pub(super) struct Holder {
    pub(super) worker_id: String,
    pub(super) incarnation: String,
    pub(super) session: SessionId,
}

/// A lease that ended in failure, and what follows.
#[derive(Clone, Debug, PartialEq)]
pub struct FailedLease {
    /// The lease.
    pub lease: Lease,
    /// Whether the task is ready again; else it has failed.
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
