//! Where a job is, while it runs: bars on a terminal, structured lines elsewhere.

mod bars;
mod lines;

use std::io::IsTerminal;

use trackersplat_proto::v1::JobEvent;

use crate::{logs::LogArgs, outcome::Outcome};

/// Shows a job's events as they come.
pub(crate) trait Display {
    /// An event, already part of the outcome.
    fn event(&mut self, event: &JobEvent, outcome: &Outcome);

    /// Frames wait and no worker is connected.
    fn no_worker(&mut self, waiting_frames: u32);

    /// Something else that a person should know now.
    fn note(&mut self, text: &str);

    /// Leaves the screen in order.
    fn finish(&mut self);
}

/// The display for this standard error. `coordinator` is the address that people are told to start workers with.
pub(crate) fn choose(logs: &LogArgs, coordinator: &str) -> Box<dyn Display> {
    let wants_bars = std::io::stderr().is_terminal() && !logs.log_json && !logs.quiet && logs.verbose == 0;
    if wants_bars {
        return Box::new(bars::Bars::new(coordinator));
    }
    Box::new(lines::Lines::new(coordinator))
}

/// What to say when no worker is there.
fn no_worker_text(waiting_frames: u32, coordinator: &str) -> String {
    format!(
        "no worker connected, {waiting_frames} frames wait: start one with `trackersplat worker --coordinator {coordinator}`"
    )
}
