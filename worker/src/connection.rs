//! One bidirectional stream to the coordinator, and getting it back after it breaks.

use std::{sync::Arc, time::Duration};

use backon::{ExponentialBuilder, Retryable};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::{StreamExt, wrappers::ReceiverStream};
use tonic::{
    Code, Status, Streaming,
    transport::{Channel, Endpoint},
};
use trackersplat_proto::{
    MAX_WORKER_MESSAGE,
    v1::{
        CoordinatorMessage, FieldReport, Register, Welcome, WorkerMessage, coordinator_message,
        worker_message, workers_client::WorkersClient,
    },
};

use crate::setup::WorkerError;

/// Longest wait for the connection and for the answer to `Register`.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);
/// A silent peer is noticed within about twice this.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Messages that may wait for the network. A worker sends a few per second, fields aside; a full queue is a dead
/// connection.
const OUTGOING_QUEUE: usize = 64;
/// Track fields among them: more wait until there is room, so that they never fill the queue.
const OUTGOING_FIELDS: usize = 32;

/// A message that waits for the network, and a field's room, which is free once the network has taken it.
struct Outgoing {
    message: WorkerMessage,
    _room: Option<OwnedSemaphorePermit>,
}

/// An open stream after a successful registration.
pub(crate) struct Connection {
    outgoing: mpsc::Sender<Outgoing>,
    /// Fields that may be queued now.
    pub(crate) field_room: Arc<Semaphore>,
    incoming: Streaming<CoordinatorMessage>,
    /// The coordinator's terms.
    pub(crate) welcome: Welcome,
}

/// Why a stream ended or did not open.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ConnectionError {
    /// The coordinator does not want this worker: trying again changes nothing.
    #[error("{0}")]
    Refused(String),
    /// The network or the coordinator went away: it may come back.
    #[error("{0}")]
    Lost(String),
}

impl From<Status> for ConnectionError {
    fn from(status: Status) -> Self {
        let message = match status.message() {
            "" => status.code().to_string(),
            message => message.to_owned(),
        };
        match status.code() {
            Code::InvalidArgument
            | Code::FailedPrecondition
            | Code::PermissionDenied
            | Code::Unauthenticated
            | Code::Unimplemented => Self::Refused(message),
            _ => Self::Lost(message),
        }
    }
}

impl Connection {
    /// The next message of the coordinator.
    pub(crate) async fn receive(&mut self) -> Result<coordinator_message::Message, ConnectionError> {
        next_message(&mut self.incoming).await
    }

    /// Queues a message; never waits.
    pub(crate) fn send(&self, message: worker_message::Message) -> Result<(), ConnectionError> {
        self.queue(message, None)
    }

    /// Queues a field, with its permit of [`Connection::field_room`].
    pub(crate) fn send_field(
        &self,
        field: FieldReport,
        room: OwnedSemaphorePermit,
    ) -> Result<(), ConnectionError> {
        self.queue(worker_message::Message::Field(field), Some(room))
    }

    fn queue(
        &self,
        message: worker_message::Message,
        room: Option<OwnedSemaphorePermit>,
    ) -> Result<(), ConnectionError> {
        let message = WorkerMessage { message: Some(message) };
        self.outgoing
            .try_send(Outgoing { message, _room: room })
            .map_err(|_| ConnectionError::Lost("the coordinator takes no more messages".into()))
    }

    /// Ends the worker's side and waits until the coordinator has read all of it, or `patience` is over.
    pub(crate) async fn close(self, patience: Duration) {
        let Self { outgoing, mut incoming, .. } = self;
        drop(outgoing);
        let drained = async { while let Ok(Some(_)) = incoming.message().await {} };
        // Best effort: a coordinator that does not answer notices the missing heartbeats instead.
        let _ = tokio::time::timeout(patience, drained).await;
    }
}

/// A channel that connects on first use and again after every failure.
pub(crate) fn channel(coordinator: &str) -> Result<Channel, WorkerError> {
    let endpoint = Endpoint::from_shared(coordinator.to_owned())
        .ok()
        .filter(|endpoint| endpoint.uri().scheme_str() == Some("http") && endpoint.uri().host().is_some())
        .ok_or_else(|| WorkerError::BadAddress(coordinator.to_owned()))?;
    Ok(endpoint
        .connect_timeout(HANDSHAKE_TIMEOUT)
        .http2_keep_alive_interval(KEEP_ALIVE)
        .keep_alive_timeout(KEEP_ALIVE)
        .keep_alive_while_idle(true)
        .tcp_nodelay(true)
        .connect_lazy())
}

/// Delays between attempts: doubling from 0.1 s to 1 s, each with jitter of up to itself, `total` together. So whoever waits
/// for a coordinator is back well before its `--reconnect-grace` of 3 s is over.
///
/// `seed` differs between workers, so that they do not all come back at the same moment.
pub(crate) fn backoff(total: Duration, seed: u64) -> ExponentialBuilder {
    ExponentialBuilder::new()
        .with_min_delay(Duration::from_millis(100))
        .with_max_delay(Duration::from_secs(1))
        .with_jitter()
        .with_jitter_seed(seed)
        .without_max_times()
        .with_total_delay(Some(total))
}

/// Connects and registers, trying for `patience`.
pub(crate) async fn connect(
    channel: &Channel,
    register: &Register,
    patience: Duration,
    seed: u64,
) -> Result<Connection, ConnectionError> {
    (|| connect_once(channel, register))
        .retry(backoff(patience, seed))
        .when(|error| matches!(error, ConnectionError::Lost(_)))
        .notify(|error, delay| tracing::debug!(%error, ?delay, "no connection to the coordinator"))
        .await
}

async fn connect_once(channel: &Channel, register: &Register) -> Result<Connection, ConnectionError> {
    tokio::time::timeout(HANDSHAKE_TIMEOUT, handshake(channel, register)).await.unwrap_or_else(|_| {
        Err(ConnectionError::Lost(format!("no answer within {} s", HANDSHAKE_TIMEOUT.as_secs())))
    })
}

async fn handshake(channel: &Channel, register: &Register) -> Result<Connection, ConnectionError> {
    let (outgoing, queue) = mpsc::channel(OUTGOING_QUEUE);
    let first = WorkerMessage { message: Some(worker_message::Message::Register(register.clone())) };
    // Queued before the call: the coordinator may answer the call only once it has read the registration.
    let first = Outgoing { message: first, _room: None };
    outgoing.try_send(first).map_err(|error| ConnectionError::Lost(error.to_string()))?;
    let mut client = WorkersClient::new(channel.clone()).max_decoding_message_size(MAX_WORKER_MESSAGE);
    let mut incoming =
        client.work(ReceiverStream::new(queue).map(|queued| queued.message)).await?.into_inner();
    match next_message(&mut incoming).await? {
        coordinator_message::Message::Welcome(welcome) => {
            let field_room = Arc::new(Semaphore::new(OUTGOING_FIELDS));
            Ok(Connection { outgoing, field_room, incoming, welcome })
        }
        other => {
            Err(ConnectionError::Refused(format!("the coordinator greets with {other:?}, not with Welcome")))
        }
    }
}

async fn next_message(
    incoming: &mut Streaming<CoordinatorMessage>,
) -> Result<coordinator_message::Message, ConnectionError> {
    loop {
        let Some(message) = incoming.message().await? else {
            return Err(ConnectionError::Lost("the coordinator closed the stream".into()));
        };
        // A kind of message that this version does not know is left out, as proto3 intends.
        if let Some(message) = message.message {
            return Ok(message);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use backon::BackoffBuilder;

    use super::*;

    #[tokio::test]
    async fn an_address_must_be_an_http_url() {
        for address in ["", "127.0.0.1:5000", "ftp://host:1", "http://"] {
            assert!(matches!(channel(address), Err(WorkerError::BadAddress(_))), "{address}");
        }
        assert!(channel("http://127.0.0.1:5000").is_ok());
    }

    #[test]
    fn delays_differ_between_workers_and_end_in_time() {
        let total = Duration::from_secs(10);
        let delays = |seed| backoff(total, seed).build().collect::<Vec<_>>();
        assert_ne!(delays(1), delays(2));
        assert!(delays(1).iter().sum::<Duration>() <= total);
        assert!(delays(1).iter().all(|delay| *delay <= Duration::from_secs(2)));
    }

    #[test]
    fn only_a_lost_coordinator_is_worth_another_try() {
        let refused =
            |code| matches!(ConnectionError::from(Status::new(code, "why")), ConnectionError::Refused(_));
        assert!(refused(Code::FailedPrecondition));
        assert!(!refused(Code::Unavailable));
        assert!(!refused(Code::Unknown));
        assert_eq!(ConnectionError::from(Status::unavailable("gone")).to_string(), "gone");
    }
}
