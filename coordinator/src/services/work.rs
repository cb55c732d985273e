//! The `Workers` service: one stream per worker.

use std::{panic::AssertUnwindSafe, time::Duration};

use futures::FutureExt;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use trackersplat_proto::{
    ids::check_worker_id,
    v1::{
        CoordinatorMessage, Dismiss, Register, Welcome, WorkerMessage, coordinator_message,
        worker_message::Message, workers_server::Workers,
    },
};

use super::state_failed;
use crate::{
    hub::{OUTGOING_QUEUE, Registered, SharedHub},
    keys::VERSION,
    queue::SessionId,
    store::StoreError,
};

/// Longest wait for the first message.
const REGISTER_WITHIN: Duration = Duration::from_secs(10);
/// Heartbeat periods without any message after which a stream is dead, and the shortest such time: a worker that
/// computes on every core may be late.
const SILENT_PERIODS: u32 = 30;
const SHORTEST_PATIENCE: Duration = Duration::from_secs(30);

/// What workers say to the coordinator.
pub(crate) struct WorkService {
    hub: SharedHub,
}

impl WorkService {
    pub(crate) fn new(hub: SharedHub) -> Self {
        Self { hub }
    }
}

#[tonic::async_trait]
impl Workers for WorkService {
    type WorkStream = ReceiverStream<Result<CoordinatorMessage, Status>>;

    async fn work(
        &self,
        request: Request<Streaming<WorkerMessage>>,
    ) -> Result<Response<Self::WorkStream>, Status> {
        let mut incoming = request.into_inner();
        let register = registration(&mut incoming).await?;
        let (outgoing, receiver) = mpsc::channel(OUTGOING_QUEUE);
        // Before the registration, so that no lease overtakes it.
        let welcome = coordinator_message::Message::Welcome(welcome(&self.hub));
        let welcome = CoordinatorMessage { message: Some(welcome) };
        outgoing.try_send(Ok(welcome)).map_err(|error| Status::internal(error.to_string()))?;
        let stream = WorkerStream { hub: self.hub.clone(), incoming, outgoing };
        tokio::spawn(stream.serve(register));
        Ok(Response::new(ReceiverStream::new(receiver)))
    }
}

/// One worker's stream. It runs as a task of its own and never drops a change half-way: it waits for the end of the
/// stream only between two messages.
struct WorkerStream {
    hub: SharedHub,
    incoming: Streaming<WorkerMessage>,
    outgoing: mpsc::Sender<Result<CoordinatorMessage, Status>>,
}

impl WorkerStream {
    async fn serve(mut self, register: Register) {
        let ended = self.register_and_converse(&register).await;
        let status = ended.unwrap_or_else(|error| Some(state_failed(&self.hub, error)));
        if let Some(status) = status {
            // A worker that is gone needs no status.
            let _ = self.outgoing.try_send(Err(status));
        }
    }

    async fn register_and_converse(&mut self, register: &Register) -> Result<Option<Status>, StoreError> {
        let Registered { session, close } = self.hub.register(register, self.outgoing.clone()).await?;
        // Nothing of the conversation is used after a panic.
        let ended = AssertUnwindSafe(self.converse(session, &close)).catch_unwind().await;
        if ended.is_err() {
            tracing::error!(worker_id = register.worker_id, "the worker's stream panicked");
            self.hub.report_panicked(session).await?;
        }
        self.hub.disconnected(session).await?;
        ended.unwrap_or_else(|_| {
            Ok(Some(Status::internal("the coordinator has a defect; its log says which. Connect again")))
        })
    }

    /// Handles a worker's messages until its stream ends. A status if it is this side that ends it.
    async fn converse(
        &mut self,
        session: SessionId,
        close: &CancellationToken,
    ) -> Result<Option<Status>, StoreError> {
        let options = &self.hub.options;
        let patience = options.heartbeat_interval * SILENT_PERIODS;
        let patience = patience.max(options.lease_duration).max(SHORTEST_PATIENCE);
        loop {
            let message = tokio::select! {
                message = tokio::time::timeout(patience, self.incoming.message()) => message,
                () = self.outgoing.closed() => return Ok(None),
                () = close.cancelled() => return Ok(Some(self.closing_status())),
            };
            let message = match message {
                Ok(Ok(Some(message))) => message,
                Ok(Ok(None) | Err(_)) => return Ok(None),
                Err(_) => {
                    return Ok(Some(Status::deadline_exceeded("no message of the worker; connect again")));
                }
            };
            match message.message {
                Some(Message::LeaseRequest(_)) => self.hub.lease_requested(session).await?,
                Some(Message::Heartbeat(heartbeat)) => self.hub.heartbeat(session, heartbeat).await,
                Some(Message::Field(report)) => self.hub.field_reported(session, report).await?,
                Some(Message::Report(report)) => self.hub.report(session, report).await?,
                Some(Message::GoingAway(going)) => {
                    self.hub.going_away(session, &going.reason).await?;
                    return Ok(None);
                }
                Some(Message::Register(_)) => {
                    return Ok(Some(Status::invalid_argument("a worker registers once per stream")));
                }
                // A kind of message that this version does not know is left out, as proto3 intends.
                None => {}
            }
        }
    }

    fn closing_status(&self) -> Status {
        if !self.hub.shutdown.is_cancelled() {
            return Status::failed_precondition(
                "another process registered as this worker, or this one read nothing; give every worker its own id",
            );
        }
        if self.hub.options.dismiss_workers_when_idle {
            // Whoever started the workers with this coordinator waits for them.
            let dismiss = Dismiss { reason: "the coordinator shuts down".into() };
            let message = Some(coordinator_message::Message::Dismiss(dismiss));
            let _ = self.outgoing.try_send(Ok(CoordinatorMessage { message }));
        }
        Status::unavailable("the coordinator shuts down; connect again when it is back")
    }
}

async fn registration(incoming: &mut Streaming<WorkerMessage>) -> Result<Register, Status> {
    let first = tokio::time::timeout(REGISTER_WITHIN, incoming.message()).await;
    let first = first.map_err(|_| Status::deadline_exceeded("no Register within 10 s; connect again"))??;
    let Some(WorkerMessage { message: Some(Message::Register(register)) }) = first else {
        return Err(Status::invalid_argument("the first message of a worker must be Register"));
    };
    check_worker_id(&register.worker_id).map_err(|error| Status::invalid_argument(error.to_string()))?;
    if register.version != VERSION {
        return Err(Status::failed_precondition(format!(
            "the worker is version {}, the coordinator {VERSION}; start a worker of the same version",
            register.version
        )));
    }
    Ok(register)
}

fn welcome(hub: &SharedHub) -> Welcome {
    let milliseconds = |duration: Duration| u32::try_from(duration.as_millis()).unwrap_or(u32::MAX);
    Welcome {
        heartbeat_interval_ms: milliseconds(hub.options.heartbeat_interval),
        lease_duration_ms: milliseconds(hub.options.lease_duration),
        store_directory: hub.blob_folder().display().to_string(),
        store_probe: Some(hub.probe.clone()),
    }
}
