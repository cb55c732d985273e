//! CPU work, away from the threads that serve the network.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::FailureKind;

use crate::failure::StageError;

/// The coordinator's own pool. Cheap to clone.
#[derive(Clone)]
pub(crate) struct Compute {
    pool: Arc<rayon::ThreadPool>,
}

impl Compute {
    pub(crate) fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        let name = |index| format!("coordinator-compute-{index}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build()?;
        Ok(Self { pool: Arc::new(pool) })
    }

    /// Runs work inside the pool and waits for it. A panic fails the work, not the coordinator.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, StageError> + Send + 'static,
    ) -> Result<T, StageError> {
        let pool = self.pool.clone();
        let ended = tokio::task::spawn_blocking(move || pool.install(work)).await;
        ended.unwrap_or_else(|error| Err(StageError::new(FailureKind::Bug, panic_message(error))))
    }
}

/// What a task that panicked said, as the message of a failure.
pub(crate) fn panic_message(error: tokio::task::JoinError) -> String {
    let Ok(panic) = error.try_into_panic() else { return "the computation was aborted".into() };
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
    format!("the computation panicked: {text}; this is a defect of trackersplat")
}

/// Fails with [`StageError::Stopped`] once somebody asked to stop.
pub(crate) fn go_on(stop: &CancellationToken) -> Result<(), StageError> {
    if stop.is_cancelled() { Err(StageError::Stopped) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_panic_is_a_failure_of_kind_bug_that_says_what_happened() {
        let compute = Compute::new(1).expect("one thread");
        let failed = compute.run::<()>(|| panic!("index 7")).await;
        let Err(StageError::Failed(failure)) = failed else { panic!("{failed:?}") };
        assert_eq!(failure.kind(), FailureKind::Bug);
        assert!(failure.message.contains("index 7"), "{}", failure.message);
        assert_eq!(compute.run(|| Ok(3)).await.ok(), Some(3), "the pool survives");
    }
}
