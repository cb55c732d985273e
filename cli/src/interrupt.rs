//! Ctrl-C and SIGTERM as a cancellation token.

use std::time::{Duration, Instant};

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::error::CliError;

/// Signals within this time are one wish: supervisors signal a process and its group.
const ONE_WISH: Duration = Duration::from_secs(1);

/// A token that the first SIGINT or SIGTERM cancels; a second one ends the process at once.
pub(crate) fn token() -> Result<CancellationToken, CliError> {
    let failed = |error| CliError::failed("cannot listen for signals", error);
    let mut interrupts = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminations = signal(SignalKind::terminate()).map_err(failed)?;
    let token = CancellationToken::new();
    let cancelled = token.clone();
    tokio::spawn(async move {
        let mut first: Option<Instant> = None;
        loop {
            tokio::select! {
                _ = interrupts.recv() => {}
                _ = terminations.recv() => {}
            }
            match first {
                None => first = Some(Instant::now()),
                Some(first) if first.elapsed() > ONE_WISH => std::process::exit(130),
                Some(_) => {}
            }
            cancelled.cancel();
        }
    });
    Ok(token)
}
