//! What follows from a failure.

use crate::v1::FailureKind;

/// Who may try a failed frame again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RetryPolicy {
    /// Nobody: the same input fails again.
    Never,
    /// Any worker.
    AnyWorker,
    /// Another worker if one is connected, else the same.
    PreferAnotherWorker,
    /// A worker that has not failed it this way.
    OnlyAnotherWorker,
}

impl FailureKind {
    /// Who may try again after a failure of this kind. A kind that this version does not know is treated as a bug.
    pub fn retry_policy(self) -> RetryPolicy {
        match self {
            Self::BadInput => RetryPolicy::Never,
            Self::Transient | Self::Bug | Self::Unspecified => RetryPolicy::AnyWorker,
            Self::LostWorker => RetryPolicy::PreferAnotherWorker,
            Self::OutOfResources => RetryPolicy::OnlyAnotherWorker,
        }
    }

    /// The kind as people read it in tables and logs, such as `bad input`.
    pub fn label(self) -> &'static str {
        match self {
            Self::Unspecified => "unspecified",
            Self::BadInput => "bad input",
            Self::Transient => "transient",
            Self::LostWorker => "lost worker",
            Self::OutOfResources => "out of resources",
            Self::Bug => "bug",
        }
    }

    /// Inverse of [`FailureKind::label`]; `Unspecified` for any other text.
    pub fn from_label(label: &str) -> Self {
        let kinds = [Self::BadInput, Self::Transient, Self::LostWorker, Self::OutOfResources, Self::Bug];
        kinds.into_iter().find(|kind| kind.label() == label).unwrap_or(Self::Unspecified)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_input_is_never_retried_and_memory_only_elsewhere() {
        assert_eq!(FailureKind::BadInput.retry_policy(), RetryPolicy::Never);
        assert_eq!(FailureKind::OutOfResources.retry_policy(), RetryPolicy::OnlyAnotherWorker);
        assert_eq!(FailureKind::LostWorker.retry_policy(), RetryPolicy::PreferAnotherWorker);
        for kind in [FailureKind::Transient, FailureKind::Bug, FailureKind::Unspecified] {
            assert_eq!(kind.retry_policy(), RetryPolicy::AnyWorker);
        }
    }

    #[test]
    fn labels_name_their_kinds() {
        for number in 0..=5 {
            let kind = FailureKind::try_from(number).expect("0 to 5 are the kinds of the wire");
            assert_eq!(FailureKind::from_label(kind.label()), kind);
        }
        assert_eq!(FailureKind::from_label("no such kind"), FailureKind::Unspecified);
    }
}
