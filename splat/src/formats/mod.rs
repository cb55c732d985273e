//! Gaussian files (PLY), track files (npz) and the blobs that coordinator and workers exchange.

pub(crate) mod byte_planes;
pub mod container;
pub mod ply;
