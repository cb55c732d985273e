//! Gaussian files (PLY), track files (npz) and the blobs that coordinator and workers exchange.

pub mod ply;
