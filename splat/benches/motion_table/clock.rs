//! A clock that other programs do not turn.

use std::{fs, sync::LazyLock, time::Duration, time::Instant};

/// What this thread has spent on a processor where the system tells (Linux, to a few milliseconds), else the time since
/// the first call.
pub(crate) fn now() -> Duration {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    on_processor().unwrap_or_else(|| START.elapsed())
}

fn on_processor() -> Option<Duration> {
    let statistics = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    statistics.split_whitespace().next()?.parse().ok().map(Duration::from_nanos)
}
