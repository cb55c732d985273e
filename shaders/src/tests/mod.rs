//! Stage by stage against straightforward references.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod layout;
mod lost;
mod memory;
mod moments;
mod optimisation;
mod projection;
mod sorting;
mod stages;
#[path = "../../tests/gpu/support.rs"]
pub(crate) mod support;

use crate::{
    engine::Context,
    program::{Dispatch, record},
};

/// Runs dispatches.
fn run(context: &Context, dispatches: &[Dispatch]) {
    let mut encoder = context.device.device.create_command_encoder(&Default::default());
    record(&mut encoder, "test", dispatches);
    context.device.queue.submit([encoder.finish()]);
}
