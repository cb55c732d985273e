//! The wire of trackersplat: `trackersplat.v1` over gRPC.

/// Messages and services of `trackersplat.v1`; the comments of the `.proto` files are the reference.
#[allow(missing_docs, clippy::doc_markdown, reason = "generated from documented .proto files")]
pub mod v1 {
    tonic::include_proto!("trackersplat.v1");
}
