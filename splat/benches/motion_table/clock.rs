//! A clock that other programs do not turn.

use std::time::Duration;

/// What this thread has spent on a processor where the system tells, else the time since the first call.
#[cfg(unix)]
pub(crate) fn now() -> Duration {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(spent.tv_sec.unsigned_abs(), spent.tv_nsec.unsigned_abs() as u32)
}

/// What this thread has spent on a processor where the system tells, else the time since the first call.
#[cfg(not(unix))]
pub(crate) fn now() -> Duration {
    use std::{sync::LazyLock, time::Instant};
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    START.elapsed()
}
