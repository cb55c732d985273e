//! The same mathematics once more: double precision, one pixel and one Gaussian at a time, from the published equations.
//!
//! Nothing here calls the code under test.

pub(crate) mod blend;
pub(crate) mod gradient;
pub(crate) mod project;
pub(crate) mod real;
pub(crate) mod render;
pub(crate) mod ssim;

/// Unit roundoff of single precision.
pub(crate) const ROUNDOFF_32: f64 = 1.0 / 16_777_216.0;

/// Unit roundoff of double precision.
pub(crate) const ROUNDOFF_64: f64 = ROUNDOFF_32 * ROUNDOFF_32 / 32.0;
