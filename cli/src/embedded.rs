//! A coordinator and its workers for one job, on this machine.

use std::{net::SocketAddr, path::Path, sync::Arc, time::Duration};

use splat::engine::Engine;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use trackersplat_coordinator::{Running, ServeOptions, serve};
use trackersplat_proto::v1::{JobState, ListRequest, SubmitRequest, jobs_client::JobsClient};

use crate::{
    args::WorkerSetup,
    client, display, environment,
    error::CliError,
    follow::follow,
    logs::LogArgs,
    outcome::Outcome,
    output_owner,
    worker_processes::{EndedWorker, WorkerProcesses},
};

/// Folder of the embedded coordinator's state inside the output folder.
pub(crate) const STATE_FOLDER: &str = ".trackersplat";
/// How long dismissed workers may take to end.
const FAREWELL: Duration = Duration::from_secs(3);

/// How an embedded run is set up.
pub(crate) struct EmbeddedRun<'a> {
    pub(crate) output: &'a Path,
    pub(crate) request: SubmitRequest,
    /// Worker processes to start; none waits for workers that are started by hand.
    pub(crate) workers: Vec<WorkerSetup>,
    pub(crate) listen: SocketAddr,
    /// The coordinator's own.
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) logs: &'a LogArgs,
}

impl EmbeddedRun<'_> {
    /// Runs the job to its end. An interruption leaves a folder that the same run resumes.
    pub(crate) async fn run(self, interrupted: &CancellationToken) -> Result<Outcome, CliError> {
        output_owner::check(self.output, &self.request)?;
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
        let stop = interrupted.child_token();
        let working = async {
            let worked = self.work(&state, &address, &stop).await;
            shutdown.cancel();
            worked
        };
        // A coordinator that fails ends before the work, which would look for it in vain.
        let serving = async {
            let ended = coordinator.finished().await;
            stop.cancel();
            ended
        };
        let (worked, ended) = tokio::join!(working, serving);
        // Its error is the cause of whatever the work met.
        ended?;
        let (outcome, workers) = worked?;
        // Only now: a worker that dies under a live coordinator would count as lost.
        if let Some(workers) = workers {
            workers.end(FAREWELL).await;
        }
        outcome.ok_or_else(|| CliError::Interrupted("interrupted; finished frames are kept".to_owned()))
    }

    async fn serve(&self, state: &Path, shutdown: &CancellationToken) -> Result<Running, CliError> {
        let options = ServeOptions {
            root: state.to_owned(),
            listen: self.listen,
            dismiss_workers_when_idle: !self.workers.is_empty(),
            replaces_abandoned_jobs: true,
            stores: environment::stores(),
            ..ServeOptions::default()
        };
        Ok(serve(options, self.engine.clone(), shutdown.clone()).await?)
    }

    async fn work(
        &self,
        state: &Path,
        address: &str,
        stop: &CancellationToken,
    ) -> Result<(Option<Outcome>, Option<WorkerProcesses>), CliError> {
        let mut client = client::connect(address).await?;
        // Before any worker starts, so that bad input is refused at once.
        let submitting = client.submit(self.request.clone());
        let Some(submitted) = stop.run_until_cancelled(submitting).await else {
            return Ok((None, None));
        };
        let submitted = submitted?.into_inner();
        // Not its device, which may not be open yet: results name theirs.
        tracing::info!(
            address,
            engine = self.engine.name(),
            job_id = submitted.job_id,
            resumed = submitted.resumed,
            "coordinator"
        );
        eprintln!(
            "job {} {}; coordinator at {address}, output in {}",
            submitted.job_id,
            if submitted.resumed { "goes on" } else { "started" },
            self.output.display()
        );
        let is_done = is_done(&mut client, &submitted.job_id).await?;
        let needed: &[WorkerSetup] = if is_done { &[] } else { &self.workers };
        let mut workers = WorkerProcesses::start(needed, address, state)?;
        let mut display = display::choose(self.logs, address);
        let (notes, mut noted) = mpsc::unbounded_channel();
        let following = follow(&mut client, &submitted.job_id, 0, display.as_mut(), &mut noted, stop);
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

/// Whether a job has nothing left to compute.
async fn is_done(client: &mut JobsClient<Channel>, job_id: &str) -> Result<bool, CliError> {
    let jobs = client.list(ListRequest {}).await?.into_inner().jobs;
    Ok(jobs.iter().any(|job| job.job_id == job_id && job.state() == JobState::Done))
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
