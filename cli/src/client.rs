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
            format!("{}; start one with `trackersplat coordinator --root DIR`", root_cause(&error)),
        )
    })?;
    Ok(JobsClient::new(channel))
}

/// The innermost reason; the layers around it only say that something failed.
fn root_cause(error: &dyn std::error::Error) -> String {
    error.source().map_or_else(|| error.to_string(), root_cause)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_absent_coordinator_is_a_failure_and_a_wrong_address_bad_input() {
        let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
        let absent =
            connect(&format!("http://{}", free.expect("a free port"))).await.expect_err("nobody listens");
        assert_eq!(absent.exit_code(), 1);
        assert!(absent.to_string().to_lowercase().contains("refused"), "{absent}");
        let wrong = connect("127.0.0.1:7700").await.expect_err("no URL");
        assert_eq!(wrong.exit_code(), 3);
    }
}
