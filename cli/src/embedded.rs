//! A coordinator and its workers for one job, on this machine.

use std::{net::SocketAddr, path::Path, sync::Arc, time::Duration};

use splat::raster::CpuEngine;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use trackersplat_coordinator::{Running, ServeOptions, serve};
use trackersplat_proto::v1::SubmitRequest;

use crate::{
    client, display,
    error::CliError,
    follow::follow,
    logs::LogArgs,
    outcome::Outcome,
    worker_processes::{EndedWorker, WorkerProcesses},
};

/// Folder of the embedded coordinator's state inside the output folder.
const STATE_FOLDER: &str = ".trackersplat";
/// How long dismissed workers may take to end.
const FAREWELL: Duration = Duration::from_secs(3);

/// How an embedded run is set up.
pub(crate) struct EmbeddedRun<'a> {
    pub(crate) output: &'a Path,
    pub(crate) request: SubmitRequest,
    /// Worker processes to start; 0 waits for workers that are started by hand.
    pub(crate) workers: usize,
    pub(crate) listen: SocketAddr,
    pub(crate) logs: &'a LogArgs,
}

impl EmbeddedRun<'_> {
    /// Runs the job to its end. An interruption leaves a folder that the same run resumes.
    pub(crate) async fn run(self, interrupted: &CancellationToken) -> Result<Outcome, CliError> {
        let state = self.output.join(STATE_FOLDER);
        std::fs::create_dir_all(&state).map_err(|error| {
            CliError::bad_input(
                state.display(),
                format!("{error}; give an output folder that can be written"),
            )
        })?;
        let shutdown = CancellationToken::new();
        let coordinator = self.serve(&state, &shutdown).await?;
        let address = format!("http://{}", coordinator.address);
        let worked = self.work(&state, &address, interrupted).await;
        shutdown.cancel();
        // Only now: a worker that dies under a live coordinator would count as lost.
        let ended = coordinator.finished().await;
        let (outcome, workers) = worked?;
        if let Some(workers) = workers {
            workers.end(FAREWELL).await;
        }
        ended?;
        outcome.ok_or_else(|| CliError::Interrupted("interrupted; finished frames are kept".to_owned()))
    }

    async fn serve(&self, state: &Path, shutdown: &CancellationToken) -> Result<Running, CliError> {
        let options = ServeOptions {
            root: state.to_owned(),
            listen: self.listen,
            dismiss_workers_when_idle: self.workers > 0,
            ..ServeOptions::default()
        };
        Ok(serve(options, Arc::new(CpuEngine), shutdown.clone()).await?)
    }

    async fn work(
        &self,
        state: &Path,
        address: &str,
        interrupted: &CancellationToken,
    ) -> Result<(Option<Outcome>, Option<WorkerProcesses>), CliError> {
        let mut client = client::connect(address).await?;
        // Before any worker starts, so that bad input is refused at once.
        let submitting = client.submit(self.request.clone());
        let Some(submitted) = interrupted.run_until_cancelled(submitting).await else {
            return Ok((None, None));
        };
        let submitted = submitted?.into_inner();
        tracing::info!(address, job_id = submitted.job_id, resumed = submitted.resumed, "coordinator");
        eprintln!(
            "job {} {}; coordinator at {address}, output in {}",
            submitted.job_id,
            if submitted.resumed { "goes on" } else { "started" },
            self.output.display()
        );
        let mut workers = WorkerProcesses::start(self.workers, address, state)?;
        let mut display = display::choose(self.logs, address);
        let (notes, mut noted) = mpsc::unbounded_channel();
        let following = follow(&mut client, &submitted.job_id, 0, display.as_mut(), &mut noted, interrupted);
        let outcome = {
            tokio::pin!(following);
            loop {
                tokio::select! {
                    outcome = &mut following => break outcome,
                    ended = workers.next_ended() => {
                        // The receiver lives as long as this loop.
                        let _ = notes.send(obituary(&ended));
                    }
                }
            }
        };
        display.finish();
        Ok((outcome?, Some(workers)))
    }
}

/// What to say of a worker that ended while the job runs; the coordinator says how many frames wait.
fn obituary(ended: &EndedWorker) -> String {
    let status = match &ended.status {
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    };
    format!(
        "worker {} ended ({status}), {} left; its log is {}",
        ended.number,
        ended.left,
        ended.log.display()
    )
}
