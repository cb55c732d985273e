//! The GPU engine as its callers see it. `support` says which device these tests run on.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod algorithms;
mod golden;
mod moments;
mod probe;
mod scenes;
mod session;
mod support;
mod variants;
