//! How a coordinator is set up.

use std::{net::SocketAddr, path::PathBuf, time::Duration};

use crate::remote_clip::StoreOptions;

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
    /// Failed attempts that a frame may have, at least 1.
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
        if self.lease_duration < 2 * self.heartbeat_interval {
            return Some(format!(
                "lease_duration {:?} is shorter than two heartbeats of {:?}; give a longer one",
                self.lease_duration, self.heartbeat_interval
            ));
        }
        None
    }
}
