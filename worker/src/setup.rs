//! How a worker is set up, and why it ends.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use thiserror::Error;
use trackersplat_proto::ids::InvalidId;

/// How a worker is set up.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// The coordinator's address, `http://host:port`.
    pub coordinator: String,
    /// Threads of the worker's pool, at least 1.
    pub threads: usize,
    /// Name of the worker, stable across restarts; `None`: the one in `state_dir`, else a new one.
    pub worker_id: Option<String>,
    /// Folder that remembers the worker's name.
    pub state_dir: Option<PathBuf>,
    /// How long the coordinator may be away before the worker gives up.
    pub reconnect_for: Duration,
    /// Whether bulk always goes through the coordinator, even where its store's directory is visible.
    pub remote_blobs: bool,
}

/// Why a worker ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// The coordinator needs no more workers.
    Dismissed,
    /// The caller asked for it.
    ShutDown,
}

/// Why a worker ended badly.
#[derive(Debug, Error)]
pub enum WorkerError {
    /// The address is no `http://host:port`.
    #[error("coordinator address '{0}' is not of the form http://host:port")]
    BadAddress(String),
    /// The name cannot be sent.
    #[error(transparent)]
    BadName(#[from] InvalidId),
    /// No thread pool of that size.
    #[error("cannot start {threads} worker threads: {reason}; give a smaller number, at least 1")]
    Threads {
        /// Threads that were asked for.
        threads: usize,
        /// What the system says.
        reason: String,
    },
    /// The worker's name cannot be read or remembered.
    #[error("worker state in {path}: {reason}; give a folder that can be written")]
    State {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: String,
    },
    /// The coordinator does not want this worker.
    #[error("the coordinator at {coordinator} refuses this worker: {reason}")]
    Refused {
        /// Its address.
        coordinator: String,
        /// What it says.
        reason: String,
    },
    /// The coordinator stayed away for longer than `reconnect_for`.
    #[error(
        "no coordinator at {coordinator} for {seconds} s: {reason}; check the address and that it runs, then start the worker again"
    )]
    Unreachable {
        /// Its address.
        coordinator: String,
        /// How long it was tried.
        seconds: u64,
        /// The last failure.
        reason: String,
    },
    /// The device is lost for good.
    #[error(
        "the worker's device does not work any more: {reason}; see to its driver, then start the worker again"
    )]
    Device {
        /// What the engine says.
        reason: String,
    },
}

pub(crate) fn thread_pool(threads: usize) -> Result<rayon::ThreadPool, WorkerError> {
    let failed = |reason: String| WorkerError::Threads { threads, reason };
    if threads == 0 {
        return Err(failed("a worker needs a thread".into()));
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|index| format!("frame-{index}"))
        .build()
        .map_err(|error| failed(error.to_string()))
}

/// The given name, else the remembered one, else a new one that is remembered if there is a folder for it.
pub(crate) fn worker_id(options: &WorkerOptions, incarnation: uuid::Uuid) -> Result<String, WorkerError> {
    if let Some(id) = &options.worker_id {
        return Ok(id.clone());
    }
    let fresh = format!("worker-{}", incarnation.simple());
    let Some(directory) = &options.state_dir else { return Ok(fresh) };
    let path = directory.join("worker-id");
    let failed = |error: std::io::Error| WorkerError::State { path: path.clone(), reason: error.to_string() };
    match std::fs::read_to_string(&path) {
        Ok(known) if !known.trim().is_empty() => return Ok(known.trim().to_owned()),
        Ok(_) => {}
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => return Err(failed(error)),
    }
    remember(directory, &path, &fresh).map_err(failed)?;
    Ok(fresh)
}

fn remember(directory: &Path, path: &Path, id: &str) -> std::io::Result<()> {
    std::fs::create_dir_all(directory)?;
    let temporary = path.with_extension("partial");
    std::fs::write(&temporary, id)?;
    std::fs::rename(temporary, path)
}
