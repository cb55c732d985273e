//! Watching a job until it ends, over lost connections.

use std::time::Duration;

use tokio::{
    sync::mpsc::UnboundedReceiver,
    time::{Instant, sleep, sleep_until},
};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, Streaming, transport::Channel};
use trackersplat_proto::v1::{
    JobEvent, WatchRequest, WorkersChanged, job_event::Event, jobs_client::JobsClient,
};

use crate::{display::Display, error::CliError, outcome::Outcome};

/// How long the coordinator may be away.
const PATIENCE: Duration = Duration::from_secs(60);
const RETRY_EVERY: Duration = Duration::from_millis(500);
/// How long frames wait without a worker before that is said: workers take a moment to start.
const NO_WORKER_GRACE: Duration = Duration::from_secs(3);

/// Follows a job to its end, and shows notes from elsewhere in between. `None`: `stop` was cancelled first.
pub(crate) async fn follow(
    client: &mut JobsClient<Channel>,
    job_id: &str,
    after: u64,
    display: &mut dyn Display,
    notes: &mut UnboundedReceiver<String>,
    stop: &CancellationToken,
) -> Result<Option<Outcome>, CliError> {
    let mut follower = Follower {
        outcome: Outcome { last_sequence: after, ..Outcome::default() },
        display,
        notes,
        waiting: None,
    };
    let mut unreachable_since: Option<Instant> = None;
    loop {
        let request =
            WatchRequest { job_id: job_id.to_owned(), after_sequence: follower.outcome.last_sequence };
        let watched = tokio::select! {
            () = stop.cancelled() => return Ok(None),
            watched = client.watch(request) => watched,
        };
        let status = match watched {
            Ok(events) => {
                unreachable_since = None;
                tokio::select! {
                    () = stop.cancelled() => return Ok(None),
                    ended = follower.read(events.into_inner()) => match ended {
                        Ok(()) => return Ok(Some(follower.outcome)),
                        Err(status) => status,
                    },
                }
            }
            Err(status) => status,
        };
        let since = *unreachable_since.get_or_insert_with(Instant::now);
        if !may_come_back(&status) || since.elapsed() > PATIENCE {
            return Err(status.into());
        }
        tracing::debug!(%status, "lost sight of the job, looking again");
        if stop.run_until_cancelled(sleep(RETRY_EVERY)).await.is_none() {
            return Ok(None);
        }
    }
}

fn may_come_back(status: &Status) -> bool {
    matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::Internal)
}

struct Follower<'a> {
    outcome: Outcome,
    display: &'a mut dyn Display,
    /// What else happens meanwhile.
    notes: &'a mut UnboundedReceiver<String>,
    /// Frames that wait without a worker, and when that is to be said.
    waiting: Option<(u32, Instant)>,
}

impl Follower<'_> {
    /// Reads one stream to its end. The coordinator ends it once the job has ended and every event is sent.
    async fn read(&mut self, mut events: Streaming<JobEvent>) -> Result<(), Status> {
        loop {
            tokio::select! {
                event = events.message() => match event? {
                    Some(event) => self.observe(&event),
                    None => return Ok(()),
                },
                Some(note) = self.notes.recv() => self.display.note(&note),
                frames = frames_without_worker(self.waiting) => {
                    self.display.no_worker(frames);
                    self.waiting = None;
                }
            }
        }
    }

    fn observe(&mut self, event: &JobEvent) {
        self.outcome.observe(event);
        if let Some(Event::Workers(WorkersChanged { connected, waiting_frames })) = &event.event {
            let is_waiting = *connected == 0 && *waiting_frames > 0;
            self.waiting = is_waiting.then(|| (*waiting_frames, Instant::now() + NO_WORKER_GRACE));
        }
        self.display.event(event, &self.outcome);
    }
}

async fn frames_without_worker(waiting: Option<(u32, Instant)>) -> u32 {
    let Some((frames, say_at)) = waiting else { return std::future::pending().await };
    sleep_until(say_at).await;
    frames
}
