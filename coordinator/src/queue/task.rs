//! What workers do, and its states as a table.

use trackersplat_proto::v1;

use super::JobId;

/// A unit of work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Task {
    /// The tracks of the view at this position in the clip.
    Tracks(u32),
    /// The frame of this number in the clip.
    Frame(u32),
}

impl Task {
    /// The kind as it stands in the database.
    pub fn kind(self) -> &'static str {
        match self {
            Self::Tracks(_) => "tracks",
            Self::Frame(_) => "frame",
        }
    }

    /// Position of the view, or frame number.
    pub fn number(self) -> u32 {
        let (Self::Tracks(number) | Self::Frame(number)) = self;
        number
    }

    /// Inverse of [`Task::kind`] and [`Task::number`].
    pub fn from_row(kind: &str, number: u32) -> Option<Self> {
        [Self::Tracks(number), Self::Frame(number)].into_iter().find(|task| task.kind() == kind)
    }
}

/// One task of one job; sorts by job, then by task.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TaskKey {
    /// The job.
    pub job: JobId,
    /// Which of its tasks.
    pub task: Task,
}

/// Where a task is. The table is in `proto/PROTOCOL.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskState {
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

/// What moves a task from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskTrigger {
    /// A worker gets the lease.
    Lease,
    /// A verified result is committed: the leaseholder's, or one that was computed before from the same input.
    Commit,
    /// The attempt failed and another one is due.
    Retry,
    /// A part of the task is committed, and another part is left.
    Continue,
    /// No other attempt is due.
    GiveUp,
    /// The lease is void through no fault of the task: the worker drains, or the coordinator was restarted.
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
#[error("a {state:?} task has no transition for {trigger:?}")]
pub struct IllegalTaskTransition {
    /// Where the task is.
    pub state: TaskState,
    /// What happened.
    pub trigger: TaskTrigger,
}

impl TaskState {
    /// Every state, in order.
    pub const ALL: [Self; 5] = [Self::Ready, Self::Leased, Self::Done, Self::Failed, Self::Cancelled];

    /// The state after a trigger.
    pub fn after(self, trigger: TaskTrigger) -> Result<Self, IllegalTaskTransition> {
        use TaskTrigger::{Cancel, Commit, Continue, GiveUp, Lease, Lose, Release, Resubmit, Retry};
        match (self, trigger) {
            (Self::Ready, Lease) => Ok(Self::Leased),
            (Self::Ready | Self::Leased, Commit) => Ok(Self::Done),
            (Self::Leased, Retry | Release | Continue) => Ok(Self::Ready),
            (Self::Ready | Self::Leased, GiveUp) => Ok(Self::Failed),
            (Self::Ready | Self::Leased, Cancel) => Ok(Self::Cancelled),
            (Self::Failed | Self::Cancelled, Resubmit) | (Self::Done, Lose) => Ok(Self::Ready),
            (state, trigger) => Err(IllegalTaskTransition { state, trigger }),
        }
    }

    /// Whether no worker is to work on the task any more.
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

    /// Inverse of [`TaskState::label`].
    pub fn from_label(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.label() == label)
    }

    /// The state on the wire.
    pub fn to_wire(self) -> v1::TaskState {
        match self {
            Self::Ready => v1::TaskState::Ready,
            Self::Leased => v1::TaskState::Leased,
            Self::Done => v1::TaskState::Done,
            Self::Failed => v1::TaskState::Failed,
            Self::Cancelled => v1::TaskState::Cancelled,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_transition_is_as_in_the_table_and_no_other_exists() {
        use TaskState::*;
        use TaskTrigger::*;
        let legal = [
            (Ready, Lease, Leased),
            (Ready, Commit, Done),
            (Ready, GiveUp, Failed),
            (Ready, Cancel, Cancelled),
            (Leased, Commit, Done),
            (Leased, Retry, Ready),
            (Leased, Release, Ready),
            (Leased, Continue, Ready),
            (Leased, GiveUp, Failed),
            (Leased, Cancel, Cancelled),
            (Failed, Resubmit, Ready),
            (Cancelled, Resubmit, Ready),
            (Done, Lose, Ready),
        ];
        for state in TaskState::ALL {
            for trigger in [Lease, Commit, Retry, Continue, GiveUp, Release, Cancel, Resubmit, Lose] {
                let listed = legal.iter().find(|row| row.0 == state && row.1 == trigger).map(|row| row.2);
                match state.after(trigger) {
                    Ok(next) => assert_eq!(Some(next), listed, "{state:?} {trigger:?}"),
                    Err(error) => {
                        assert_eq!(listed, None, "{state:?} {trigger:?}");
                        assert_eq!(error, IllegalTaskTransition { state, trigger });
                    }
                }
            }
        }
    }

    #[test]
    fn labels_name_their_states() {
        for state in TaskState::ALL {
            assert_eq!(TaskState::from_label(state.label()), Some(state));
        }
        assert_eq!(TaskState::from_label("lost"), None);
    }
}
