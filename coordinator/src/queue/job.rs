//! The states of a job as a table.

use trackersplat_proto::v1;

/// Where a job is. The table is in `proto/PROTOCOL.md`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobState {
    /// The clip is read, verified and copied into the store.
    Ingesting,
    /// The key frame is reconstructed or imported.
    StaticModel,
    /// The key frame is tracked to every frame.
    Tracking,
    /// Workers compute frames.
    Frames,
    /// The sequence is put together.
    Assembling,
    /// Every output is written.
    Done,
    /// It cannot go on.
    Failed,
    /// Somebody ended it.
    Cancelled,
}

/// What moves a job from one state to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobTrigger {
    /// The stage of the present state has ended well.
    StageDone,
    /// The stage of the present state cannot be completed.
    Fail,
    /// A client ends the job.
    Cancel,
    /// A client submits an ended job again.
    Resubmit,
}

/// A transition that the table does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a {state:?} job has no transition for {trigger:?}")]
pub struct IllegalJobTransition {
    /// Where the job is.
    pub state: JobState,
    /// What happened.
    pub trigger: JobTrigger,
}

impl JobState {
    /// Every state, in order.
    pub const ALL: [Self; 8] = [
        Self::Ingesting,
        Self::StaticModel,
        Self::Tracking,
        Self::Frames,
        Self::Assembling,
        Self::Done,
        Self::Failed,
        Self::Cancelled,
    ];

    /// The state after a trigger.
    pub fn after(self, trigger: JobTrigger) -> Result<Self, IllegalJobTransition> {
        use JobTrigger::{Cancel, Fail, Resubmit, StageDone};
        match (self, trigger) {
            (Self::Ingesting, StageDone) => Ok(Self::StaticModel),
            (Self::StaticModel, StageDone) => Ok(Self::Tracking),
            (Self::Tracking, StageDone) => Ok(Self::Frames),
            (Self::Frames, StageDone) => Ok(Self::Assembling),
            (Self::Assembling, StageDone) => Ok(Self::Done),
            (state, Fail) if !state.has_ended() => Ok(Self::Failed),
            (state, Cancel) if !state.has_ended() => Ok(Self::Cancelled),
            (state, Resubmit) if state.has_ended() => Ok(Self::Ingesting),
            (state, trigger) => Err(IllegalJobTransition { state, trigger }),
        }
    }

    /// Whether nothing more happens to the job unless it is submitted again.
    pub fn has_ended(self) -> bool {
        matches!(self, Self::Done | Self::Failed | Self::Cancelled)
    }

    /// The state as it stands in the database.
    pub fn label(self) -> &'static str {
        match self {
            Self::Ingesting => "ingesting",
            Self::StaticModel => "static-model",
            Self::Tracking => "tracking",
            Self::Frames => "frames",
            Self::Assembling => "assembling",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// Inverse of [`JobState::label`].
    pub fn from_label(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.label() == label)
    }

    /// The state on the wire.
    pub fn to_wire(self) -> v1::JobState {
        match self {
            Self::Ingesting => v1::JobState::Ingesting,
            Self::StaticModel => v1::JobState::StaticModel,
            Self::Tracking => v1::JobState::Tracking,
            Self::Frames => v1::JobState::Frames,
            Self::Assembling => v1::JobState::Assembling,
            Self::Done => v1::JobState::Done,
            Self::Failed => v1::JobState::Failed,
            Self::Cancelled => v1::JobState::Cancelled,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_transition_is_as_in_the_table_and_no_other_exists() {
        use JobState::*;
        use JobTrigger::*;
        let legal = [
            (Ingesting, StageDone, StaticModel),
            (StaticModel, StageDone, Tracking),
            (Tracking, StageDone, Frames),
            (Frames, StageDone, Assembling),
            (Assembling, StageDone, Done),
            (Ingesting, Fail, Failed),
            (StaticModel, Fail, Failed),
            (Tracking, Fail, Failed),
            (Frames, Fail, Failed),
            (Assembling, Fail, Failed),
            (Ingesting, Cancel, Cancelled),
            (StaticModel, Cancel, Cancelled),
            (Tracking, Cancel, Cancelled),
            (Frames, Cancel, Cancelled),
            (Assembling, Cancel, Cancelled),
            (Done, Resubmit, Ingesting),
            (Failed, Resubmit, Ingesting),
            (Cancelled, Resubmit, Ingesting),
        ];
        for state in JobState::ALL {
            for trigger in [StageDone, Fail, Cancel, Resubmit] {
                let listed = legal.iter().find(|row| row.0 == state && row.1 == trigger).map(|row| row.2);
                match state.after(trigger) {
                    Ok(next) => assert_eq!(Some(next), listed, "{state:?} {trigger:?}"),
                    Err(error) => {
                        assert_eq!(listed, None, "{state:?} {trigger:?}");
                        assert_eq!(error, IllegalJobTransition { state, trigger });
                    }
                }
            }
        }
    }

    #[test]
    fn labels_name_their_states() {
        for state in JobState::ALL {
            assert_eq!(JobState::from_label(state.label()), Some(state));
        }
        assert_eq!(JobState::from_label("paused"), None);
    }
}
