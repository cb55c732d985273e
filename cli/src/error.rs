//! Why a command failed, as its exit code says.

use std::fmt::Display;

use thiserror::Error;
use tonic::{Code, Status};
use trackersplat_coordinator::ServeError;

/// What `--help` says about exit codes.
pub(crate) const EXIT_CODES: &str = "Exit codes:
  0    success
  1    the job, the coordinator or a worker failed
  2    wrong usage of the command line
  3    bad input: a clip, file, setting or folder that cannot be used
  130  interrupted by Ctrl-C or SIGTERM; reconstruct goes on where it was when run again";

/// Why a command failed.
#[derive(Debug, Error)]
pub(crate) enum CliError {
    /// Something went wrong that is not the input's fault.
    #[error("{0}")]
    Failed(String),
    /// A clip, file, setting or folder cannot be used.
    #[error("{0}")]
    BadInput(String),
    /// Ctrl-C or SIGTERM.
    #[error("{0}")]
    Interrupted(String),
}

impl CliError {
    /// A failure with its context.
    pub(crate) fn failed(what: impl Display, why: impl Display) -> Self {
        Self::Failed(format!("{what}: {why}"))
    }

    /// Bad input with its context.
    pub(crate) fn bad_input(what: impl Display, why: impl Display) -> Self {
        Self::BadInput(format!("{what}: {why}"))
    }

    /// The process's exit code. 2 is clap's own, for wrong usage.
    pub(crate) fn exit_code(&self) -> u8 {
        match self {
            Self::Failed(_) => 1,
            Self::BadInput(_) => 3,
            Self::Interrupted(_) => 130,
        }
    }
}

impl From<Status> for CliError {
    fn from(status: Status) -> Self {
        let message = match status.message() {
            "" => status.code().to_string(),
            message => message.to_owned(),
        };
        match status.code() {
            Code::InvalidArgument | Code::FailedPrecondition | Code::NotFound => Self::BadInput(message),
            _ => Self::Failed(message),
        }
    }
}

impl From<ServeError> for CliError {
    fn from(error: ServeError) -> Self {
        match error {
            ServeError::Options(_)
            | ServeError::Root { .. }
            | ServeError::InUse { .. }
            | ServeError::Listen { .. } => Self::BadInput(error.to_string()),
            _ => Self::failed("coordinator", error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_codes_are_those_of_the_help() {
        assert_eq!(CliError::failed("job", "why").exit_code(), 1);
        assert_eq!(CliError::bad_input("clip", "why").exit_code(), 3);
        assert_eq!(CliError::Interrupted(String::new()).exit_code(), 130);
        for code in [1, 3, 130] {
            assert!(EXIT_CODES.contains(&format!("\n  {code} ")), "{code}");
        }
    }

    #[test]
    fn a_refused_submission_is_bad_input_and_a_lost_coordinator_is_not() {
        assert_eq!(CliError::from(Status::invalid_argument("clip x")).exit_code(), 3);
        assert_eq!(CliError::from(Status::failed_precondition("folder of another clip")).exit_code(), 3);
        assert_eq!(CliError::from(Status::not_found("job x")).exit_code(), 3);
        assert_eq!(CliError::from(Status::unavailable("gone")).exit_code(), 1);
        assert_eq!(CliError::from(Status::internal("")).to_string(), Code::Internal.to_string());
    }
}
