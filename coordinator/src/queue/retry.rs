//! Whether a failed attempt is followed by another one.

use trackersplat_proto::{failure::RetryPolicy, v1::FailureKind};

/// What follows from a failed attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Another attempt is due, by whom the policy allows.
    Retry(RetryPolicy),
    /// The frame fails.
    GiveUp,
}

/// Decides after the `failures`-th failed attempt, counted from 1.
pub fn decide(kind: FailureKind, failures: u32, max_attempts: u32) -> Decision {
    match kind.retry_policy() {
        RetryPolicy::Never => Decision::GiveUp,
        _ if failures >= max_attempts => Decision::GiveUp,
        policy => Decision::Retry(policy),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_attempts_then_no_more() {
        for kind in [
            FailureKind::Transient,
            FailureKind::LostWorker,
            FailureKind::OutOfResources,
            FailureKind::Bug,
            FailureKind::Unspecified,
        ] {
            assert_eq!(decide(kind, 1, 3), Decision::Retry(kind.retry_policy()));
            assert_eq!(decide(kind, 2, 3), Decision::Retry(kind.retry_policy()));
            assert_eq!(decide(kind, 3, 3), Decision::GiveUp);
        }
    }

    #[test]
    fn bad_input_has_one_attempt() {
        assert_eq!(decide(FailureKind::BadInput, 1, 3), Decision::GiveUp);
    }
}
