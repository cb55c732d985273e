//! What the holders of leases say of them.

use std::time::Instant;

use trackersplat_proto::v1::FailureKind;

use super::{FailedLease, Lease, Queue, SessionId, Stale};

impl Queue {
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

    /// A track field has arrived, which is a sign of life as well: the lease does not expire until [`Self::end_field`].
    pub fn begin_field(
        &mut self,
        session: SessionId,
        lease_id: &str,
        attempt: u32,
        now: Instant,
    ) -> Result<&Lease, Stale> {
        self.heartbeat(session, lease_id, attempt, now)?;
        let lease = self.held(session, lease_id, attempt)?;
        lease.saying.insert(session);
        Ok(lease)
    }

    /// The field of a stream is verified, or is none. Heartbeats that came after it are still unread, so the lease lasts as
    /// long again.
    pub fn end_field(&mut self, session: SessionId, lease_id: &str, now: Instant) {
        let Some(lease) = self.leases.get_mut(lease_id) else { return };
        lease.saying.remove(&session);
        if lease.session == session {
            lease.deadline = now + self.policy.lease_duration;
        }
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

    /// Nobody verifies the report or field of this stream any more: the attempt has failed, whoever holds the lease by now.
    pub fn abandon_report(&mut self, session: SessionId) -> Option<FailedLease> {
        let abandoned = self.leases.values().find(|lease| lease.is_verified_for(session))?.id.clone();
        self.end_failed(&abandoned, FailureKind::Bug)
    }
}
