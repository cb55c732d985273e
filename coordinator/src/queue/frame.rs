//! The states of a frame as a table.

use trackersplat_proto::v1;

/// Where a frame is. The table is in `proto/PROTOCOL.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameState {
    /// Waits for a worker.
    Ready,
    /// A worker holds the lease.
    Leased,
    /// Its result is committed.
    Done,
    /// Out of attempts, or its input is bad.
    Failed,
    /// Its job was cancelled.
    Cancelled,
}

/// What moves a frame from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameTrigger {
    /// A worker gets the lease.
    Lease,
    /// A verified result is committed: the leaseholder's, or one that was computed before from the same input.
    Commit,
    /// The attempt failed and another one is due.
    Retry,
    /// No other attempt is due.
    GiveUp,
    /// The lease is void through no fault of the frame: the worker drains, or the coordinator was restarted.
    Release,
    /// The job was cancelled.
    Cancel,
    /// The ended job was submitted again.
    Resubmit,
    /// The bytes of its result are gone from the store.
    Lose,
}

/// A transition that the table does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a {state:?} frame has no transition for {trigger:?}")]
pub struct IllegalFrameTransition {
    /// Where the frame is.
    pub state: FrameState,
    /// What happened.
    pub trigger: FrameTrigger,
}

impl FrameState {
    /// Every state, in order.
    pub const ALL: [Self; 5] = [Self::Ready, Self::Leased, Self::Done, Self::Failed, Self::Cancelled];

    /// The state after a trigger.
    pub fn after(self, trigger: FrameTrigger) -> Result<Self, IllegalFrameTransition> {
        use FrameTrigger::{Cancel, Commit, GiveUp, Lease, Lose, Release, Resubmit, Retry};
        match (self, trigger) {
            (Self::Ready, Lease) => Ok(Self::Leased),
            (Self::Ready | Self::Leased, Commit) => Ok(Self::Done),
            (Self::Leased, Retry | Release) => Ok(Self::Ready),
            (Self::Ready | Self::Leased, GiveUp) => Ok(Self::Failed),
            (Self::Ready | Self::Leased, Cancel) => Ok(Self::Cancelled),
            (Self::Failed | Self::Cancelled, Resubmit) | (Self::Done, Lose) => Ok(Self::Ready),
            (state, trigger) => Err(IllegalFrameTransition { state, trigger }),
        }
    }

    /// Whether no worker is to work on the frame any more.
    pub fn has_ended(self) -> bool {
        matches!(self, Self::Done | Self::Failed | Self::Cancelled)
    }

    /// The state as it stands in the database.
    pub fn label(self) -> &'static str {
        match self {
            Self::Ready => "ready",
            Self::Leased => "leased",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Inverse of [`FrameState::label`].
    pub fn from_label(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.label() == label)
    }

    /// The state on the wire.
    pub fn to_wire(self) -> v1::FrameState {
        match self {
            Self::Ready => v1::FrameState::Ready,
            Self::Leased => v1::FrameState::Leased,
            Self::Done => v1::FrameState::Done,
            Self::Failed => v1::FrameState::Failed,
            Self::Cancelled => v1::FrameState::Cancelled,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_transition_is_as_in_the_table_and_no_other_exists() {
        use FrameState::*;
        use FrameTrigger::*;
        let legal = [
            (Ready, Lease, Leased),
            (Ready, Commit, Done),
            (Ready, GiveUp, Failed),
            (Ready, Cancel, Cancelled),
            (Leased, Commit, Done),
            (Leased, Retry, Ready),
            (Leased, Release, Ready),
            (Leased, GiveUp, Failed),
            (Leased, Cancel, Cancelled),
            (Failed, Resubmit, Ready),
            (Cancelled, Resubmit, Ready),
            (Done, Lose, Ready),
        ];
        for state in FrameState::ALL {
            for trigger in [Lease, Commit, Retry, GiveUp, Release, Cancel, Resubmit, Lose] {
                let listed = legal.iter().find(|row| row.0 == state && row.1 == trigger).map(|row| row.2);
                match state.after(trigger) {
                    Ok(next) => assert_eq!(Some(next), listed, "{state:?} {trigger:?}"),
                    Err(error) => {
                        assert_eq!(listed, None, "{state:?} {trigger:?}");
                        assert_eq!(error, IllegalFrameTransition { state, trigger });
                    }
                }
            }
        }
    }

    #[test]
    fn labels_name_their_states() {
        for state in FrameState::ALL {
            assert_eq!(FrameState::from_label(state.label()), Some(state));
        }
        assert_eq!(FrameState::from_label("lost"), None);
    }
}
