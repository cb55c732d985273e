//! `watch`: follows a job until it ends.

use clap::Args;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Failure, JobEvent, job_event::Event};

use crate::{
    args::CoordinatorArgs,
    client,
    display::{self, Display},
    error::CliError,
    follow::follow,
    interrupt,
    logs::LogArgs,
    outcome::{Outcome, job_state_label, task_state_label},
    stdout, table,
};

/// Arguments of `watch`.
#[derive(Args, Debug)]
pub(crate) struct WatchArgs {
    /// The job, as `submit` or `list` print it.
    job: String,

    #[command(flatten)]
    coordinator: CoordinatorArgs,

    /// Leave out events up to this sequence number.
    #[arg(long, value_name = "SEQUENCE", default_value_t = 0)]
    after: u64,

    /// Print every event as a line of JSON.
    #[arg(long)]
    json: bool,
}

pub(super) async fn run(args: WatchArgs, logs: &LogArgs) -> Result<(), CliError> {
    let address = &args.coordinator.coordinator;
    let mut client = client::connect(address).await?;
    let interrupted = interrupt::token()?;
    let unread = interrupted.child_token();
    let mut display: Box<dyn Display> = if args.json {
        Box::new(JsonLines { unread: unread.clone() })
    } else {
        display::choose(logs, address)
    };
    let (_, mut no_notes) = mpsc::unbounded_channel();
    let followed = follow(&mut client, &args.job, args.after, display.as_mut(), &mut no_notes, &unread).await;
    display.finish();
    let followed = followed?;
    if unread.is_cancelled() && !interrupted.is_cancelled() {
        return Ok(());
    }
    let Some(outcome) = followed else {
        return Err(CliError::Interrupted("interrupted; the job goes on, watch it again".to_owned()));
    };
    if !args.json && !outcome.frames.is_empty() {
        stdout::line(table::frames(&outcome));
    }
    outcome.result()
}

/// Every event as a line of JSON on standard output.
struct JsonLines {
    /// Cancelled when the reader has left: nothing more is wanted.
    unread: CancellationToken,
}

impl Display for JsonLines {
    fn event(&mut self, event: &JobEvent, _outcome: &Outcome) {
        if !stdout::line(to_json(event)) {
            self.unread.cancel();
        }
    }

    fn no_worker(&mut self, _waiting_frames: u32) {}

    fn note(&mut self, _text: &str) {}

    fn finish(&mut self) {}
}

fn to_json(event: &JobEvent) -> Value {
    let reason = |failure: &Option<Failure>| {
        failure.as_ref().map(|failure| json!({ "kind": failure.kind().label(), "message": failure.message }))
    };
    let what = match &event.event {
        Some(Event::JobState(change)) => {
            json!({ "job_state": { "state": job_state_label(change.state()), "failure": reason(&change.failure) } })
        }
        Some(Event::FrameState(change)) => json!({ "frame_state": {
            "frame": change.frame,
            "state": task_state_label(change.state()),
            "attempt": change.attempt,
            "worker_id": change.worker_id,
            "failure": reason(&change.failure),
            "seconds": change.seconds,
            "report": serde_json::from_str::<Value>(&change.report_json).unwrap_or(Value::Null),
        } }),
        Some(Event::TracksState(change)) => json!({ "tracks_state": {
            "view": change.view,
            "state": task_state_label(change.state()),
            "attempt": change.attempt,
            "worker_id": change.worker_id,
            "failure": reason(&change.failure),
            "seconds": change.seconds,
        } }),
        Some(Event::Progress(progress)) => json!({ "progress": {
            "stage": progress.stage,
            "frame": progress.frame,
            "view": progress.view,
            "done": progress.done,
            "total": progress.total,
            "worker_id": progress.worker_id,
        } }),
        Some(Event::Workers(workers)) => json!({ "workers": {
            "connected": workers.connected,
            "waiting_frames": workers.waiting_frames,
        } }),
        None => Value::Null,
    };
    json!({ "sequence": event.sequence, "job_id": event.job_id, "event": what })
}

#[cfg(test)]
mod tests {
    use trackersplat_proto::v1::TaskState;

    use super::*;
    use crate::outcome::tests::frame_event;

    #[test]
    fn an_event_is_one_line_that_a_script_can_read() {
        let text = to_json(&frame_event(7, 3, TaskState::Done)).to_string();
        assert_eq!(text.lines().count(), 1);
        let value: Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(value["sequence"], 7);
        assert_eq!(value["event"]["frame_state"]["state"], "done");
        assert_eq!(value["event"]["frame_state"]["report"]["after"][0]["psnr"], 30.0);
    }
}
