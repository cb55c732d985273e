//! `worker`: computes frames for a coordinator.

use std::{path::PathBuf, time::Duration};

use clap::Args;
use trackersplat_worker::{Exit, WorkerError, WorkerOptions};

use super::{coordinator::seconds, cores};
use crate::{error::CliError, interrupt};

/// Arguments of `worker`.
#[derive(Args, Debug)]
pub(crate) struct WorkerArgs {
    #[command(flatten)]
    coordinator: crate::args::CoordinatorArgs,

    /// Threads for the frame [default: one per core].
    #[arg(long, value_name = "N")]
    threads: Option<usize>,

    /// Name of the worker; keep it across restarts [default: the one in --state-dir, else a new one].
    #[arg(long, value_name = "NAME")]
    id: Option<String>,

    /// Folder that remembers the worker's name.
    #[arg(long, value_name = "DIR")]
    state_dir: Option<PathBuf>,

    /// Seconds without a coordinator after which the worker gives up.
    #[arg(long, value_name = "SECONDS", default_value = "300", value_parser = seconds)]
    reconnect_for: Duration,

    /// Never open the store's directory, even if it is there: all bulk goes through the coordinator.
    #[arg(long)]
    remote_blobs: bool,

    #[command(flatten)]
    engine: crate::args::EngineArgs,
}

pub(super) async fn run(args: WorkerArgs) -> Result<(), CliError> {
    let options = WorkerOptions {
        coordinator: args.coordinator.coordinator,
        threads: args.threads.unwrap_or_else(cores),
        worker_id: args.id,
        state_dir: args.state_dir,
        reconnect_for: args.reconnect_for,
        remote_blobs: args.remote_blobs,
    };
    let engine = args.engine.engine()?;
    // A worker without its device is of no use, and the coordinator is told which one it is.
    engine.check().map_err(|error| CliError::failed("the worker's device", error))?;
    match trackersplat_worker::run(options, engine, interrupt::token()?).await {
        Ok(Exit::Dismissed | Exit::ShutDown) => Ok(()),
        Err(
            error @ (WorkerError::BadAddress(_)
            | WorkerError::BadName(_)
            | WorkerError::Threads { .. }
            | WorkerError::State { .. }),
        ) => Err(CliError::BadInput(error.to_string())),
        Err(error) => Err(CliError::Failed(error.to_string())),
    }
}
