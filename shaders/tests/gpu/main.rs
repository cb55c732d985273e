//! The GPU engine as its callers see it. `support` says which device these tests run on.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod algorithms;
#[path = "../../examples/gpu_check/doubts.rs"]
mod doubts;
mod golden;
mod moments;
mod probe;
#[path = "../../../splat/benches/scene/mod.rs"]
mod scene;
mod scenes;
mod session;
mod support;
mod thresholds;
mod variants;
