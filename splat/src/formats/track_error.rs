//! Why a track file or blob is not a track field.

use std::path::PathBuf;

use thiserror::Error;

use super::container::ContainerError;

/// Why a track file or blob is not a track field.
#[derive(Debug, Error)]
pub enum TrackError {
    /// Not a track blob, or broken on the way.
    #[error(transparent)]
    Container(#[from] ContainerError),
    /// A track blob of a size that no image has.
    #[error("the track blob is for {width}x{height} pixels, more than an image can have; fetch it again")]
    Size {
        /// Columns that it states.
        width: u32,
        /// Rows that it states.
        height: u32,
    },
    /// The file cannot be opened or is not a zip archive.
    #[error("{}: cannot read: {problem}; give an npz file as numpy.savez writes it", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the operating system or the archive says.
        problem: String,
    },
    /// The archive lacks an array.
    #[error("{}: no array `{expected}`, it holds: {found}", path.display())]
    MissingArray {
        /// The file.
        path: PathBuf,
        /// The name, or names, that were looked for.
        expected: String,
        /// The names that are there.
        found: String,
    },
    /// An array has another shape than it should.
    #[error("{}: array `{array}` has shape {found:?}, expected {expected}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: String,
        /// Its shape.
        found: Vec<u64>,
        /// What it should be.
        expected: String,
    },
    /// An array cannot be read as the numbers it should hold.
    #[error("{}: array `{array}`: {problem}", path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// Name of the array.
        array: String,
        /// What is wrong, and the remedy.
        problem: String,
    },
}
