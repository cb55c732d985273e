//! Worker processes of an embedded coordinator.

use std::{
    fs::File,
    path::{Path, PathBuf},
    process::{ExitStatus, Stdio},
    time::Duration,
};

use futures::future::select_all;
use tokio::process::{Child, Command};

use crate::{args::WorkerSetup, error::CliError};

/// How long an embedded worker looks for its coordinator: it must not outlive a killed parent for long.
const RECONNECT_SECONDS: u32 = 10;

/// Children that are killed when this is dropped.
pub(crate) struct WorkerProcesses {
    running: Vec<Worker>,
}

struct Worker {
    number: usize,
    log: PathBuf,
    child: Child,
}

/// A worker that ended.
pub(crate) struct EndedWorker {
    pub(crate) number: usize,
    pub(crate) status: std::io::Result<ExitStatus>,
    pub(crate) log: PathBuf,
    /// Workers that still run.
    pub(crate) left: usize,
}

impl WorkerProcesses {
    /// Starts workers, numbered from 1, with logs in `folder`.
    pub(crate) fn start(setups: &[WorkerSetup], coordinator: &str, folder: &Path) -> Result<Self, CliError> {
        let program = std::env::current_exe()
            .map_err(|error| CliError::failed("cannot find this program's file", error))?;
        let running = (1..)
            .zip(setups)
            .map(|(number, setup)| start_one(&program, number, setup, coordinator, folder))
            .collect::<Result<_, _>>()?;
        Ok(Self { running })
    }

    /// Waits for any worker to end; for ever if there is none.
    pub(crate) async fn next_ended(&mut self) -> EndedWorker {
        if self.running.is_empty() {
            return std::future::pending().await;
        }
        let waits = self.running.iter_mut().map(|worker| Box::pin(worker.child.wait()));
        let (status, index, _) = select_all(waits).await;
        let Worker { number, log, .. } = self.running.remove(index);
        EndedWorker { number, status, log, left: self.running.len() }
    }

    /// Waits for dismissed workers to end by themselves, then kills the others.
    pub(crate) async fn end(mut self, patience: Duration) {
        let all_ended = async {
            while !self.running.is_empty() {
                self.next_ended().await;
            }
        };
        if tokio::time::timeout(patience, all_ended).await.is_ok() {
            return;
        }
        for worker in &mut self.running {
            // It may have ended by itself meanwhile.
            let _ = worker.child.kill().await;
        }
    }
}

fn start_one(
    program: &Path,
    number: usize,
    setup: &WorkerSetup,
    coordinator: &str,
    folder: &Path,
) -> Result<Worker, CliError> {
    let log = folder.join(format!("worker-{number}.log"));
    let file = File::create(&log).map_err(|error| CliError::bad_input(log.display(), error))?;
    let child = Command::new(program)
        .args(["worker", "--coordinator", coordinator, "--log-json"])
        .args(["--threads", &setup.threads.to_string()])
        .args(["--id", &format!("embedded-{number}")])
        .args(["--reconnect-for", &RECONNECT_SECONDS.to_string()])
        .args(&setup.arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(file)
        .kill_on_drop(true)
        .spawn()
        .map_err(|error| CliError::failed(format!("cannot start worker {number}"), error))?;
    Ok(Worker { number, log, child })
}
