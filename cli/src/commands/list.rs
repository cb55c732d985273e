//! `list`: a coordinator's jobs.

use clap::Args;
use trackersplat_proto::v1::{JobSummary, ListRequest};

use super::print_json;
use crate::{args::CoordinatorArgs, client, error::CliError, outcome::job_state_label, stdout, table};

/// Arguments of `list`.
#[derive(Args, Debug)]
pub(crate) struct ListArgs {
    #[command(flatten)]
    coordinator: CoordinatorArgs,

    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) async fn run(args: ListArgs) -> Result<(), CliError> {
    let mut client = client::connect(&args.coordinator.coordinator).await?;
    let jobs = client.list(ListRequest {}).await?.into_inner().jobs;
    if args.json {
        return print_json(&jobs.iter().map(to_json).collect::<Vec<_>>());
    }
    let mut table = table::empty(&["job", "state", "done", "failed", "frames", "submitted", "clip"]);
    for job in &jobs {
        table.add_row([
            job.job_id.clone(),
            job_state_label(job.state()).to_owned(),
            job.frames_done.to_string(),
            job.frames_failed.to_string(),
            job.frames.to_string(),
            job.submitted_at.clone(),
            job.clip.clone(),
        ]);
    }
    stdout::line(&table);
    Ok(())
}

fn to_json(job: &JobSummary) -> serde_json::Value {
    serde_json::json!({
        "job_id": job.job_id,
        "state": job_state_label(job.state()),
        "clip": job.clip,
        "output": job.output,
        "frames": job.frames,
        "frames_done": job.frames_done,
        "frames_failed": job.frames_failed,
        "submitted_at": job.submitted_at,
    })
}
