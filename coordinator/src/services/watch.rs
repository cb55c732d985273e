//! Watching a job: stored events from the database in order, so that nothing can be missed, then transient ones as
//! they happen.

use std::ops::ControlFlow;

use tokio::sync::{
    broadcast::error::RecvError,
    mpsc::{self, Sender},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use trackersplat_proto::v1::JobEvent;

use super::{STREAM_QUEUE, state_failed};
use crate::hub::{Notice, SharedHub};

/// Events that are read from the database at once.
const PAGE: u32 = 256;

pub(super) fn watch(hub: SharedHub, job_id: String, after: u64) -> ReceiverStream<Result<JobEvent, Status>> {
    let (sender, receiver) = mpsc::channel(STREAM_QUEUE);
    tokio::spawn(async move {
        let mut watcher = Watcher { hub, job_id, last: after, sender };
        if let ControlFlow::Break(Some(status)) = watcher.run().await {
            // A client that is gone needs no status.
            let _ = watcher.sender.send(Err(status)).await;
        }
    });
    ReceiverStream::new(receiver)
}

/// Goes on, or ends with a status for the client or without.
type Flow = ControlFlow<Option<Status>>;

struct Watcher {
    hub: SharedHub,
    job_id: String,
    /// Sequence number of the last stored event that was sent.
    last: u64,
    sender: Sender<Result<JobEvent, Status>>,
}

impl Watcher {
    async fn run(&mut self) -> Flow {
        // Subscribed before the first read: what happens in between is noticed twice, never missed.
        let mut notices = self.hub.subscribe();
        self.send_stored().await?;
        if let Some(workers) = self.hub.workers_now(&self.job_id, self.last).await {
            self.send(workers).await?;
        }
        let shutdown = self.hub.shutdown.clone();
        loop {
            let client = self.sender.clone();
            let notice = tokio::select! {
                notice = notices.recv() => notice,
                () = client.closed() => return ControlFlow::Break(None),
                () = shutdown.cancelled() => {
                    self.send_stored().await?;
                    let reason = "the coordinator shuts down; watch again from the last sequence number when it is back";
                    return ControlFlow::Break(Some(Status::unavailable(reason)));
                }
            };
            match notice {
                Ok(Notice::Stored(job)) if *job == *self.job_id => self.send_stored().await?,
                Ok(Notice::Transient(job, event)) if *job == *self.job_id => self.send_transient(event),
                // Transient events may be lost on a slow client; stored ones are read again.
                Err(RecvError::Lagged(_)) => self.send_stored().await?,
                Ok(_) => {}
                Err(RecvError::Closed) => return ControlFlow::Break(None),
            }
        }
    }

    /// Sends what is stored after the last event. Breaks once the job has ended and everything is sent.
    async fn send_stored(&mut self) -> Flow {
        loop {
            // Read before the events: an end that is seen here is among them.
            let job = match self.hub.store.job(&self.job_id).await {
                Ok(job) => job,
                Err(error) => return self.failed(error),
            };
            let events = match self.hub.store.events_after(&self.job_id, self.last, PAGE).await {
                Ok(events) => events,
                Err(error) => return self.failed(error),
            };
            for event in events {
                self.last = event.sequence;
                self.send(event).await?;
            }
            let Some(job) = job else { return ControlFlow::Break(None) };
            if self.last < job.last_sequence() {
                continue;
            }
            return match job.state() {
                Ok(state) if state.has_ended() => ControlFlow::Break(None),
                Ok(_) => ControlFlow::Continue(()),
                Err(error) => self.failed(error),
            };
        }
    }

    async fn send(&mut self, event: JobEvent) -> Flow {
        match self.sender.send(Ok(event)).await {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(None),
        }
    }

    fn send_transient(&mut self, event: trackersplat_proto::v1::job_event::Event) {
        let event = JobEvent { sequence: self.last, job_id: self.job_id.clone(), event: Some(event) };
        // Dropped when the client is slow: the next one says more.
        let _ = self.sender.try_send(Ok(event));
    }

    fn failed(&self, error: crate::store::StoreError) -> Flow {
        ControlFlow::Break(Some(state_failed(&self.hub, error)))
    }
}
