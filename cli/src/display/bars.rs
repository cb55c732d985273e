//! Progress bars, for a terminal.

use std::{collections::BTreeMap, time::Duration};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use trackersplat_proto::v1::{FrameState, JobEvent, JobState, Progress, job_event::Event};

use super::{Display, no_worker_text};
use crate::outcome::{Outcome, job_state_label};

const REDRAW: Duration = Duration::from_millis(200);

/// One bar for the job's stage, one for its frames, one per frame that is being computed.
pub(super) struct Bars {
    coordinator: String,
    all: MultiProgress,
    stage: ProgressBar,
    frames: ProgressBar,
    running: BTreeMap<u32, ProgressBar>,
}

impl Bars {
    pub(super) fn new(coordinator: &str) -> Self {
        let all = MultiProgress::new();
        let stage = all.add(ProgressBar::new(0));
        stage.set_style(style("{spinner} {prefix:<14} {bar:30} {pos}/{len} {elapsed} {msg}"));
        stage.enable_steady_tick(REDRAW);
        let frames = all.add(ProgressBar::new(0));
        frames.set_style(style("  {prefix:<14} {bar:30} {pos}/{len} {msg}"));
        frames.set_prefix("frames");
        Self { coordinator: coordinator.to_owned(), all, stage, frames, running: BTreeMap::new() }
    }

    fn progress(&mut self, progress: &Progress) {
        if progress.frame == 0 {
            self.stage.set_prefix(progress.stage.clone());
            self.stage.set_length(progress.total);
            self.stage.set_position(progress.done);
            return;
        }
        let bar = self.running.entry(progress.frame).or_insert_with(|| {
            let bar = self.all.add(ProgressBar::new(0));
            bar.set_style(style("  {prefix:<14} {bar:30} {pos}/{len} {msg}"));
            bar.set_prefix(format!("frame {}", progress.frame));
            bar
        });
        bar.set_length(progress.total);
        bar.set_position(progress.done);
        bar.set_message(format!("{} on {}", progress.stage, progress.worker_id));
    }
}

impl Display for Bars {
    fn event(&mut self, event: &JobEvent, outcome: &Outcome) {
        match &event.event {
            Some(Event::JobState(change)) => {
                self.stage.set_prefix(job_state_label(change.state()));
                self.stage.set_length(0);
                self.stage.set_position(0);
                let is_on_workers = change.state() == JobState::Frames;
                self.stage.set_message(if is_on_workers { "on the workers" } else { "" });
            }
            Some(Event::FrameState(change)) => {
                if change.state() != FrameState::Leased
                    && let Some(bar) = self.running.remove(&change.frame)
                {
                    bar.finish_and_clear();
                    self.all.remove(&bar);
                }
                if let Some(failure) = &change.failure {
                    self.note(&format!(
                        "frame {} (attempt {}, {}): {}",
                        change.frame, change.attempt, change.worker_id, failure.message
                    ));
                }
                self.frames.set_length(outcome.frames.len() as u64);
                self.frames.set_position(outcome.frames_in(FrameState::Done).len() as u64);
            }
            Some(Event::Progress(progress)) => self.progress(progress),
            Some(Event::Workers(workers)) => {
                self.frames.set_message(format!("{} workers", workers.connected));
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

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}
