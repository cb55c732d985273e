//! Gaussian files (PLY), track files (npz) and the blobs that coordinator and workers exchange.

pub(crate) mod byte_planes;
pub mod container;
pub mod ply;
pub mod track_blob;
pub mod track_error;
pub mod track_npz;
pub mod track_state;

pub use self::track_error::TrackError;
