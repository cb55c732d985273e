//! `reconstruct`: the whole way on this machine.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
};

use clap::Args;
use trackersplat_coordinator::assembly::CONTACT_SHEET;
use trackersplat_proto::v1::SubmitRequest;

use super::{cores, print_json};
use crate::{
    args::{EngineArgs, JobArgs},
    embedded::EmbeddedRun,
    error::CliError,
    interrupt,
    logs::LogArgs,
    outcome::{Outcome, job_state_label},
    stdout, table,
};

/// Arguments of `reconstruct`.
#[derive(Args, Debug)]
pub(crate) struct ReconstructArgs {
    #[command(flatten)]
    job: JobArgs,

    /// Folder for the results; the same folder resumes.
    #[arg(short, long, value_name = "DIR", help_heading = "Output")]
    out: PathBuf,

    #[command(flatten)]
    run: RunArgs,
}

/// How a job is run on this machine.
#[derive(Args, Clone, Debug)]
pub(crate) struct RunArgs {
    /// Worker processes; 0 waits for workers that you start [default: one per GPU, else one of one thread per core].
    #[arg(long, value_name = "N", help_heading = "Execution")]
    pub(crate) workers: Option<usize>,

    /// Where the embedded coordinator listens; port 0 lets the system choose.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0", help_heading = "Execution")]
    pub(crate) listen: SocketAddr,

    #[command(flatten)]
    pub(crate) engine: EngineArgs,

    /// Print the result as JSON instead of a table.
    #[arg(long, help_heading = "Output")]
    pub(crate) json: bool,
}

pub(super) async fn run(args: ReconstructArgs, logs: &LogArgs) -> Result<(), CliError> {
    let request = args.job.request(Some(&args.out))?;
    reconstruct(request, &args.out, cores(), &args.run, logs).await
}

/// Runs a job and reports it; `on_cpu` is the number of workers on a machine without a GPU, unless one is given.
pub(super) async fn reconstruct(
    request: SubmitRequest,
    output: &Path,
    on_cpu: usize,
    run: &RunArgs,
    logs: &LogArgs,
) -> Result<(), CliError> {
    let interrupted = interrupt::token()?;
    let placement = run.engine.placement()?;
    let workers = run.engine.workers(&placement, run.workers, on_cpu, cores());
    let engine = run.engine.engine_on(&placement)?;
    let embedded = EmbeddedRun { output, request, workers, listen: run.listen, engine, logs };
    let outcome = embedded.run(&interrupted).await.map_err(|error| with_remedy(error, output))?;
    if run.json {
        print_json(&summary(&outcome, output))?;
    } else {
        print_summary(&outcome, output);
    }
    outcome.result()
}

fn with_remedy(error: CliError, output: &Path) -> CliError {
    let CliError::Interrupted(message) = error else { return error };
    CliError::Interrupted(format!(
        "{message}; the same command resumes, or remove {} to start over",
        output.display()
    ))
}

fn print_summary(outcome: &Outcome, output: &Path) {
    if !outcome.frames.is_empty() {
        stdout::line(table::frames(outcome));
        stdout::line("PSNR and SSIM: mean over held-out views, before → after refinement\n");
    }
    if outcome.result().is_err() {
        return;
    }
    let at = |name: &str| output.join(name).display().to_string();
    stdout::line(format_args!("frames         {}", at("frames")));
    stdout::line(format_args!("description    {}", at("sequence.json")));
    stdout::line(format_args!("metrics        {}", at("metrics.csv")));
    if output.join(CONTACT_SHEET).exists() {
        stdout::line(format_args!("contact sheet  {}", at(CONTACT_SHEET)));
    }
    let folder = output.display();
    stdout::line("\nnext:");
    stdout::line("  look at the contact sheet, or open the PLY files in a splat viewer such as SuperSplat");
    stdout::line(format_args!("  trackersplat render {folder} --view NAME --frame 1 --out view.png"));
    stdout::line(format_args!("  trackersplat eval {folder}"));
}

/// What `--json` prints.
pub(super) fn summary(outcome: &Outcome, output: &Path) -> serde_json::Value {
    serde_json::json!({
        "state": job_state_label(outcome.state),
        "failure": outcome.failure.as_ref().map(|failure| &failure.message),
        "output": output,
        "frames": outcome.frames,
    })
}
