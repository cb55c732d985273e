//! A client of a coordinator.

use std::time::Duration;

use tonic::transport::{Channel, Endpoint};
use trackersplat_proto::v1::jobs_client::JobsClient;

use crate::error::CliError;

const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Connects to the coordinator at `http://host:port`.
pub(crate) async fn connect(coordinator: &str) -> Result<JobsClient<Channel>, CliError> {
    let endpoint = Endpoint::from_shared(coordinator.to_owned())
        .ok()
        .filter(|endpoint| endpoint.uri().scheme_str() == Some("http"))
        .ok_or_else(|| CliError::bad_input(format!("address '{coordinator}'"), "write http://host:port"))?;
    let channel = endpoint.connect_timeout(CONNECT_TIMEOUT).connect().await.map_err(|error| {
        CliError::failed(
            format!("no coordinator at {coordinator}"),
            format!("{error}; start one with `trackersplat coordinator --root DIR`"),
        )
    })?;
    Ok(JobsClient::new(channel))
}
