//! `submit`: hands a clip to a coordinator and returns.

use std::path::PathBuf;

use clap::Args;

use super::print_json;
use crate::{
    args::{CoordinatorArgs, JobArgs},
    client,
    error::CliError,
    stdout,
};

/// Arguments of `submit`.
#[derive(Args, Debug)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    job: JobArgs,

    /// Folder for the results, as the coordinator sees it [default: below its --root].
    #[arg(short, long, value_name = "DIR", help_heading = "Output")]
    out: Option<PathBuf>,

    #[command(flatten)]
    coordinator: CoordinatorArgs,

    /// Print JSON.
    #[arg(long, help_heading = "Output")]
    json: bool,
}

pub(super) async fn run(args: SubmitArgs) -> Result<(), CliError> {
    let request = args.job.request(args.out.as_deref())?;
    let mut client = client::connect(&args.coordinator.coordinator).await?;
    let submitted = client.submit(request).await?.into_inner();
    if args.json {
        return print_json(&serde_json::json!({ "job_id": submitted.job_id, "resumed": submitted.resumed }));
    }
    stdout::line(submitted.job_id);
    Ok(())
}
