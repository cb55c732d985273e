//! The gRPC services: thin translations between the wire and the hub.

mod blobs;
mod fetch;
mod jobs;
mod locate;
mod submit;
mod watch;
mod work;

use tonic::Status;

pub(crate) use self::{blobs::BlobService, jobs::JobService, work::WorkService};
use crate::{hub::Hub, store::StoreError};

/// Chunks or events that may wait for one client.
const STREAM_QUEUE: usize = 16;

/// The state cannot be read or written: the coordinator ends, the client may try again after its restart.
fn state_failed(hub: &Hub, error: StoreError) -> Status {
    let status = Status::unavailable(error.to_string());
    hub.fail(error);
    status
}

fn unknown_job(job: &str) -> Status {
    let job: String = job.chars().take(80).collect();
    Status::not_found(format!("no job '{job}'; list the jobs to see their ids"))
}

/// Runs a change to its end even if the client hangs up, so that queue and database never differ.
async fn uninterrupted<T: Send + 'static>(
    change: impl Future<Output = Result<T, Status>> + Send + 'static,
) -> Result<T, Status> {
    let ended = tokio::spawn(change).await;
    ended.unwrap_or_else(|error| Err(Status::internal(format!("the request did not end: {error}"))))
}
