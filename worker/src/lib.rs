//! The worker: owns one device, leases frames and tracks of views from a coordinator, runs them and reports the results.
//!
//! | file | idea |
//! |---|---|
//! | `run.rs` | what a worker does with each message, from registration to dismissal |
//! | `setup.rs` | how a worker is set up, and why it ends |
//! | `connection.rs` | one bidirectional stream to the coordinator, and getting it back |
//! | `job.rs` | a frame job from the wire to a report |
//! | `tracks.rs` | the tracks of a view from the wire to a report |
//! | `ahead.rs` | the next frame's inputs, loaded while the present one is computed |
//! | `inputs.rs` | checked conversion of a frame job's blobs to what `splat` takes |
//! | `blobs.rs` | verified bulk, from the store's directory or through the coordinator |

mod ahead;
mod blobs;
mod connection;
mod inputs;
mod job;
mod run;
mod setup;
#[cfg(test)]
mod test_coordinator;
mod tracks;

pub use run::run;
pub use setup::{Exit, WorkerError, WorkerOptions};
