//! Progress bars, for a terminal.

use std::{collections::BTreeMap, time::Duration};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use trackersplat_proto::v1::{Failure, JobEvent, JobState, Progress, TaskState, job_event::Event};

use super::{Display, no_worker_text};
use crate::outcome::{Outcome, job_state_label};

const REDRAW: Duration = Duration::from_millis(200);

/// One bar for the job's stage, one for its frames, one per frame and per view that a worker is at.
pub(super) struct Bars {
    coordinator: String,
    all: MultiProgress,
    stage: ProgressBar,
    frames: ProgressBar,
    running: BTreeMap<String, ProgressBar>,
    /// Of the job: decides whose progress the stage bar shows.
    state: JobState,
}

impl Bars {
    pub(super) fn new(coordinator: &str) -> Self {
        let all = MultiProgress::new();
        let stage = all.add(ProgressBar::new(0));
        stage.enable_steady_tick(REDRAW);
        advance(&stage, "{spinner}", 0, 0);
        let frames = all.add(ProgressBar::new(0));
        advance(&frames, " ", 0, 0);
        Self {
            coordinator: coordinator.to_owned(),
            all,
            stage,
            frames,
            running: BTreeMap::new(),
            state: JobState::Unspecified,
        }
    }

    fn progress(&mut self, progress: &Progress) {
        let task = match (progress.frame, progress.view.as_str()) {
            // Handing frames out is over before anybody could read it.
            (0, "") if self.state == JobState::Frames => return,
            // Workers track while the static model is made, whose bar it is.
            (0, "") if self.state == JobState::StaticModel && progress.stage == "tracking" => return,
            (0, "") => return advance(&self.stage, "{spinner}", progress.done, progress.total),
            (0, view) => view_label(view),
            (frame, _) => frame_label(frame),
        };
        let bar = self.running.entry(task).or_insert_with_key(|task| {
            let bar = self.all.add(ProgressBar::new(0));
            bar.set_prefix(task.clone());
            bar
        });
        advance(bar, " ", progress.done, progress.total);
        bar.set_message(format!("{} on {}", progress.stage, progress.worker_id));
    }

    /// A frame or a view has changed its state: nobody is at it any more, unless it was leased.
    fn task(&mut self, task: &str, state: TaskState, failure: Option<&Failure>, attempt: u32, worker: &str) {
        if state != TaskState::Leased
            && let Some(bar) = self.running.remove(task)
        {
            bar.finish_and_clear();
            self.all.remove(&bar);
        }
        if let Some(failure) = failure {
            self.note(&format!("{task} (attempt {attempt}, {worker}): {}", failure.message));
        }
    }
}

fn frame_label(frame: u32) -> String {
    format!("frame {frame}")
}

fn view_label(view: &str) -> String {
    format!("tracks {view}")
}

impl Display for Bars {
    fn event(&mut self, event: &JobEvent, outcome: &Outcome) {
        match &event.event {
            Some(Event::JobState(change)) => {
                self.stage.set_prefix(job_state_label(change.state()));
                self.stage.reset_eta();
                advance(&self.stage, "{spinner}", 0, 0);
                self.state = change.state();
                if self.state == JobState::Frames {
                    self.frames.set_prefix("done");
                }
            }
            Some(Event::FrameState(change)) => {
                let task = frame_label(change.frame);
                self.task(&task, change.state(), change.failure.as_ref(), change.attempt, &change.worker_id);
                let done = outcome.frames_in(TaskState::Done).len();
                self.frames.set_style(style("  {prefix:<14} {bar:30} {pos}/{len}"));
                self.frames.set_length(outcome.frames.len() as u64);
                self.frames.set_position(done as u64);
            }
            Some(Event::TracksState(change)) => {
                let task = view_label(&change.view);
                self.task(&task, change.state(), change.failure.as_ref(), change.attempt, &change.worker_id);
            }
            Some(Event::Progress(progress)) => self.progress(progress),
            Some(Event::Workers(workers)) => {
                let plural = if workers.connected == 1 { "" } else { "s" };
                self.stage.set_message(format!("{} worker{plural}", workers.connected));
            }
            None => {}
        }
    }

    fn no_worker(&mut self, waiting_frames: u32) {
        let text = no_worker_text(waiting_frames, &self.coordinator);
        self.note(&text);
    }

    fn note(&mut self, text: &str) {
        // A terminal that is gone needs no note.
        let _ = self.all.println(text);
    }

    fn finish(&mut self) {
        for bar in self.running.values().chain([&self.stage, &self.frames]) {
            bar.finish_and_clear();
        }
        // As above.
        let _ = self.all.clear();
    }
}

/// No bar without a total, no estimate before the first step or after the last.
fn advance(bar: &ProgressBar, lead: &str, done: u64, total: u64) {
    let template = match (done, total) {
        (_, 0) => format!("{lead} {{prefix:<14}} {{msg}}"),
        (done, total) if done == 0 || done >= total => {
            format!("{lead} {{prefix:<14}} {{bar:30}} {{pos}}/{{len}} {{msg}}")
        }
        _ => format!("{lead} {{prefix:<14}} {{bar:30}} {{pos}}/{{len}} {{msg}}  {{eta}} left"),
    };
    bar.set_style(style(&template));
    bar.set_length(total);
    bar.set_position(done);
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}
