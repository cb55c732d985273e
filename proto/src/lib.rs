//! The wire of trackersplat: `trackersplat.v1` over gRPC.
//!
//! `PROTOCOL.md` beside this crate says what every call and every status code means and which action follows.

pub mod failure;
pub mod ids;
mod windows;

/// Messages and services of `trackersplat.v1`; the comments of the `.proto` files are the reference.
#[allow(
    missing_docs,
    clippy::doc_markdown,
    clippy::large_enum_variant,
    clippy::allow_attributes_without_reason,
    reason = "generated from documented .proto files"
)]
pub mod v1 {
    tonic::include_proto!("trackersplat.v1");
}

/// Largest message between a worker and the coordinator, either way: the tracks of a view over some 400 000 frames.
pub const MAX_WORKER_MESSAGE: usize = 64 << 20;

/// Bytes of data per streamed chunk, well below gRPC's limit of 4 MiB a message.
pub const CHUNK_BYTES: usize = 256 << 10;
