//! Gaussian PLY files in the layout of the original 3D Gaussian Splatting (Inria), as viewers expect it.
//!
//! Binary little endian; per vertex `x y z`, normals (zero), `f_dc_0..2`, `f_rest_*` channel by channel, logit
//! `opacity`, natural-log `scale_0..2`, quaternion `rot_0..3` as w, x, y, z. Reading takes the properties in any order
//! and skips what it does not know.

mod header;
mod read;
mod summary;
#[cfg(test)]
mod tests;
mod write;

use std::path::PathBuf;

use thiserror::Error;

pub use self::{
    read::{parse_ply, read_ply},
    summary::{Percentiles, PlySummary, inspect},
    write::write_ply,
};
use crate::gaussians::sh;

/// Why a file is not a set of Gaussians.
#[derive(Debug, Error)]
pub enum PlyError {
    /// Any of the below, in a named file.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: Box<PlyError>,
    },
    /// The operating system could not read it.
    #[error("cannot read: {0}")]
    Io(#[from] std::io::Error),
    /// It does not start as a PLY file does.
    #[error("not a PLY file: the first line is not `ply`; give a Gaussian PLY in the Inria layout")]
    NotPly,
    /// The header breaks the PLY format, or is of a size that no Gaussian file has.
    #[error("malformed PLY header, line {line}: {problem}; export the file again")]
    Header {
        /// Counting from 1.
        line: usize,
        /// What is wrong there.
        problem: String,
    },
    /// Text or big-endian encoding.
    #[error(
        "PLY encoding `{0}` is not supported; convert the file to `binary_little_endian 1.0` with splat-transform"
    )]
    Encoding(String),
    /// PlayCanvas compressed PLY.
    #[error(
        "this is a compressed PLY (PlayCanvas chunks with packed vertices); convert with splat-transform to a plain PLY"
    )]
    Compressed,
    /// A property that every Gaussian needs is missing.
    #[error(
        "vertex property `{0}` is missing; give a Gaussian PLY in the Inria layout, a plain point cloud has no Gaussians"
    )]
    MissingProperty(String),
    /// A property of a Gaussian is stored as an integer.
    #[error(
        "vertex property `{property}` has type `{found}`, expected `float` or `double`; export the file again"
    )]
    WrongType {
        /// Its name.
        property: String,
        /// Its type.
        found: String,
    },
    /// The number of `f_rest` properties belongs to no degree.
    #[error("{0} `f_rest` properties, expected 0, 9, 24 or 45 (spherical harmonics of degree 0 to 3)")]
    HarmonicCount(usize),
    /// The file ends early.
    #[error(
        "truncated: the header states {stated} vertices, the file ends in vertex {found}; copy the file again"
    )]
    Truncated {
        /// Vertices that the header states.
        stated: u64,
        /// Whole vertices that are there.
        found: u64,
    },
    /// A parameter is not a finite number.
    #[error(
        "vertex {vertex}, property `{property}` is {value}; remove such Gaussians, with splat-transform --filter-nan for instance"
    )]
    NotFinite {
        /// Counting from 0.
        vertex: u64,
        /// Name of the property.
        property: String,
        /// What is stored.
        value: f64,
    },
}

/// Names of the properties that carry parameters, in the order of a written file without its normals.
fn parameter_names(sh_degree: u32) -> Vec<String> {
    let numbered = |stem: &str, count: usize| (0..count).map(|i| format!("{stem}_{i}")).collect::<Vec<_>>();
    let mut names: Vec<String> = ["x", "y", "z"].map(String::from).into();
    names.extend(numbered("f_dc", 3));
    names.extend(numbered("f_rest", 3 * (sh::coefficients(sh_degree) - 1)));
    names.push("opacity".into());
    names.extend(numbered("scale", 3));
    names.extend(numbered("rot", 4));
    names
}
