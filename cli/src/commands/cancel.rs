//! `cancel`: ends a job; its finished frames stay.

use clap::Args;
use trackersplat_proto::v1::CancelRequest;

use crate::{args::CoordinatorArgs, client, error::CliError, outcome::job_state_label, stdout};

/// Arguments of `cancel`.
#[derive(Args, Debug)]
pub(crate) struct CancelArgs {
    /// The job, as `submit` or `list` print it.
    job: String,

    #[command(flatten)]
    coordinator: CoordinatorArgs,
}

pub(super) async fn run(args: CancelArgs) -> Result<(), CliError> {
    let mut client = client::connect(&args.coordinator.coordinator).await?;
    let cancelled = client.cancel(CancelRequest { job_id: args.job }).await?.into_inner();
    stdout::line(job_state_label(cancelled.state()));
    Ok(())
}
