//! The coordinator: ingests a clip, reconstructs the static model, hands the tracks of views and frames
//! to workers, and puts the results together.
//!
//! | module | idea |
//! |---|---|
//! | [`queue`] | which task goes to which worker, and the states of jobs and tasks: pure tables, time is a parameter |
//! | [`store`] | the state on disk, one SQLite file |
//! | [`blobs`] | bulk bytes named by digest |
//! | `hub` | where jobs, workers and clients meet: one lock orders every change |
//! | `ledger` | which track fields of a job there are |
//! | `driver` | a job from submission to its end, one file per stage |
//! | `services` | the gRPC services of `trackersplat.v1`; `proto/PROTOCOL.md` is their reference |
//! | `remote_clip` | a clip in an object store becomes a local one |
//! | [`assembly`] | the finished frames become files |

pub mod assembly;
pub mod blobs;
mod compute;
mod convert;
mod driver;
mod failure;
mod hub;
mod keys;
mod ledger;
mod model;
mod options;
mod output;
pub mod queue;
mod remote_clip;
mod request;
mod serve;
mod services;
pub mod store;
#[cfg(test)]
mod tests;

pub use options::ServeOptions;
pub use remote_clip::StoreOptions;
pub use serve::{Running, ServeError, serve};
