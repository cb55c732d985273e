//! Why a stage or a verification failed, in the kinds of the wire.

use splat::{
    engine::EngineError,
    static_model::StaticModelError,
    tracking::{StateMisfit, learned::LearnedError},
};
use trackersplat_proto::v1::{Failure, FailureKind};

use crate::{blobs::BlobError, store::StoreError};

/// Why a job's stage did not end well.
#[derive(Debug)]
pub(crate) enum StageError {
    /// Somebody asked to stop: a cancelled job, or a coordinator that shuts down.
    Stopped,
    /// The job fails.
    Failed(Failure),
    /// The coordinator itself cannot go on; the job goes on after a restart.
    State(StoreError),
}

impl StageError {
    pub(crate) fn new(kind: FailureKind, message: impl Into<String>) -> Self {
        Self::Failed(failure(kind, message))
    }

    pub(crate) fn bad_input(message: impl Into<String>) -> Self {
        Self::new(FailureKind::BadInput, message)
    }
}

/// A failure of the wire.
pub(crate) fn failure(kind: FailureKind, message: impl Into<String>) -> Failure {
    Failure { kind: kind.into(), message: message.into() }
}

impl From<StoreError> for StageError {
    fn from(error: StoreError) -> Self {
        Self::State(error)
    }
}

impl From<BlobError> for StageError {
    fn from(error: BlobError) -> Self {
        Self::new(FailureKind::Transient, error.to_string())
    }
}

impl From<EngineError> for StageError {
    fn from(error: EngineError) -> Self {
        let kind = match &error {
            EngineError::InvalidInput(_) => FailureKind::BadInput,
            EngineError::OutOfResources { .. } => FailureKind::OutOfResources,
            EngineError::DeviceLost(_) => FailureKind::Transient,
            EngineError::Internal(_) => FailureKind::Bug,
        };
        Self::new(kind, error.to_string())
    }
}

impl From<LearnedError> for StageError {
    fn from(error: LearnedError) -> Self {
        Self::bad_input(error.to_string())
    }
}

impl From<StateMisfit> for StageError {
    fn from(misfit: StateMisfit) -> Self {
        Self::new(FailureKind::Bug, misfit.to_string())
    }
}

impl From<StaticModelError> for StageError {
    fn from(error: StaticModelError) -> Self {
        match error {
            StaticModelError::BadInput(message) => Self::bad_input(message),
            StaticModelError::Engine(error) => error.into(),
            StaticModelError::Cancelled => Self::Stopped,
        }
    }
}
