//! Bulk that the coordinator's own work reads and writes: a store that fails for a moment fails no attempt.

use std::time::Duration;

use backon::{ExponentialBuilder, Retryable};
use tokio_util::sync::CancellationToken;

use crate::{blobs::BlobError, failure::StageError};

/// How long a transfer is tried again.
const PATIENCE: Duration = Duration::from_secs(10);
/// Pause before the second attempt; later ones are longer.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// A transfer that is tried again, with growing delays, while it fails for reasons of which `may_pass` says that they may.
pub(super) async fn patiently<T, F: Future<Output = Result<T, BlobError>>>(
    stop: &CancellationToken,
    may_pass: impl Fn(&BlobError) -> bool,
    transfer: impl FnMut() -> F,
) -> Result<T, StageError> {
    let pauses = ExponentialBuilder::new()
        .with_min_delay(FIRST_PAUSE)
        .with_max_delay(LONGEST_PAUSE)
        .without_max_times()
        .with_total_delay(Some(PATIENCE));
    let tried = transfer
        .retry(pauses)
        .when(|error| !matches!(error, BlobError::Name(_) | BlobError::TooLarge { .. }) && may_pass(error))
        .notify(|error, pause| tracing::warn!(%error, ?pause, "a transfer failed and is tried again"));
    let ended = stop.run_until_cancelled(tried).await.ok_or(StageError::Stopped)?;
    Ok(ended?)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    use trackersplat_proto::v1::FailureKind;

    use super::*;

    fn hiccup() -> BlobError {
        object_store::Error::NotImplemented { operation: "anything".into(), implementer: "a test".into() }
            .into()
    }

    /// A transfer that fails until it has failed so often; how it ends, and how often it was tried.
    async fn tried(
        failures: usize,
        fails: impl Fn() -> BlobError,
        may_pass: bool,
    ) -> (Result<(), StageError>, usize) {
        let times = AtomicUsize::new(0);
        let stop = CancellationToken::new();
        let transfer = async || if times.fetch_add(1, Relaxed) < failures { Err(fails()) } else { Ok(()) };
        let ended = patiently(&stop, |_| may_pass, transfer).await;
        (ended, times.into_inner())
    }

    #[tokio::test]
    async fn what_may_pass_is_tried_again_and_nothing_else() {
        assert!(matches!(tried(2, hiccup, true).await, (Ok(()), 3)));
        let (failed, times) = tried(2, || BlobError::Missing("a state".into()), false).await;
        let Err(StageError::Failed(failure)) = failed else { panic!("{failed:?}") };
        assert_eq!((failure.kind(), times), (FailureKind::Transient, 1));
        let too_large = || BlobError::TooLarge { digest: String::new(), size: 2, limit: 1 };
        assert!(matches!(tried(2, too_large, true).await, (Err(StageError::Failed(_)), 1)));
    }

    #[tokio::test]
    async fn who_stops_waits_for_no_store() {
        let stop = CancellationToken::new();
        let transfer = async || {
            stop.cancel();
            Err::<(), _>(hiccup())
        };
        assert!(matches!(patiently(&stop, |_| true, transfer).await, Err(StageError::Stopped)));
    }
}
