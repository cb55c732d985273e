//! How a coordinator is set up.

use std::{net::SocketAddr, path::PathBuf, time::Duration};

use crate::remote_clip::StoreOptions;

/// Longest lease: what comes later than this is no answer to a lost worker, and far from where clocks overflow.
const LONGEST_LEASE: Duration = Duration::from_secs(24 * 60 * 60);

/// How a coordinator is set up.
#[derive(Clone, Debug)]
pub struct ServeOptions {
    /// Folder of the coordinator's state: `state.sqlite`, `blobs/`, `clips/` for copies from object stores, and `jobs/` for jobs without an output folder.
    pub root: PathBuf,
    /// Where to listen; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// Threads for the static model and the tracks, at least 1.
    pub compute_threads: usize,
    /// Period at which workers must send heartbeats.
    pub heartbeat_interval: Duration,
    /// A lease without a heartbeat for this long expires; at least twice the heartbeat interval.
    pub lease_duration: Duration,
    /// A lease whose stream broke waits this long for its worker to come back, at most `lease_duration`.
    pub reconnect_grace: Duration,
    /// Failed attempts that a frame, or the tracks of a view, may have; at least 1.
    pub max_attempts: u32,
    /// Embedded mode: no other workers will ever join. They are dismissed when the last job has ended, and a frame
    /// that none of them has the resources for fails instead of waiting.
    pub dismiss_workers_when_idle: bool,
    /// Embedded mode: the run that embeds the coordinator is its only client. A job that an earlier run left behind
    /// without a finished frame is cancelled when another submission asks for its output folder.
    pub replaces_abandoned_jobs: bool,
    /// How object stores are reached that clips are submitted from.
    pub stores: StoreOptions,
}

impl Default for ServeOptions {
    fn default() -> Self {
        Self {
            root: PathBuf::from("trackersplat-coordinator"),
            listen: SocketAddr::from(([127, 0, 0, 1], 7700)),
            compute_threads: std::thread::available_parallelism().map_or(1, usize::from),
            heartbeat_interval: Duration::from_secs(1),
            lease_duration: Duration::from_secs(10),
            reconnect_grace: Duration::from_secs(3),
            max_attempts: 3,
            dismiss_workers_when_idle: false,
            replaces_abandoned_jobs: false,
            stores: StoreOptions::default(),
        }
    }
}

impl ServeOptions {
    /// What is wrong with the options, if anything.
    pub(crate) fn problem(&self) -> Option<String> {
        if self.compute_threads == 0 {
            return Some("compute_threads is 0; give at least 1".into());
        }
        if self.max_attempts == 0 {
            return Some("max_attempts is 0; give at least 1".into());
        }
        if self.heartbeat_interval.is_zero() {
            return Some("heartbeat_interval is 0; give at least a few milliseconds".into());
        }
        if self.lease_duration < self.heartbeat_interval.saturating_mul(2) {
            return Some(format!(
                "lease_duration {:?} is shorter than two heartbeats of {:?}; give a longer one",
                self.lease_duration, self.heartbeat_interval
            ));
        }
        if self.reconnect_grace > self.lease_duration {
            return Some(format!(
                "reconnect_grace {:?} is longer than lease_duration {:?}, after which the lease expires in any case; give a \
                 shorter one, or longer leases",
                self.reconnect_grace, self.lease_duration
            ));
        }
        if self.lease_duration > LONGEST_LEASE {
            return Some(format!(
                "lease_duration {:?} is longer than a day; give a shorter one, or a lost worker's frame is never given out \
                 again",
                self.lease_duration
            ));
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_that_contradict_each_other_are_refused_by_name() {
        let problem = |adjust: fn(&mut ServeOptions)| {
            let mut options = ServeOptions::default();
            adjust(&mut options);
            options.problem().unwrap_or_default()
        };
        assert_eq!(problem(|_| {}), "");
        assert_eq!(problem(|options| options.reconnect_grace = options.lease_duration), "");
        for (said, problem) in [
            ("heartbeat_interval", problem(|options| options.heartbeat_interval = Duration::ZERO)),
            ("two heartbeats", problem(|options| options.lease_duration = Duration::from_millis(1999))),
            ("reconnect_grace", problem(|options| options.reconnect_grace = Duration::from_secs(11))),
            ("reconnect_grace", problem(|options| options.reconnect_grace = Duration::MAX)),
            ("a day", problem(|options| options.lease_duration = Duration::MAX)),
            ("lease_duration", problem(|options| options.heartbeat_interval = Duration::MAX)),
        ] {
            assert!(problem.contains(said), "no {said:?} in {problem:?}");
        }
    }
}
