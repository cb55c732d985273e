//! The CPU engine: differentiable rasterization of 3D Gaussians in blocks of 4 × 4 pixels.
//!
//! One file per stage, each named as the stage: [`project`] → [`bin`] → [`blend`] → [`blend_backward`] →
//! [`project_backward`], strung together by [`Pass`]; a step of a session ends with [`descend`] in place of the last, and
//! [`footprint_moments`] and [`block_moments`] share the first two. The equations are those of 3D Gaussian
//! Splatting (Kerbl et al. 2023, section 4 and 6) over EWA splatting (Zwicker et al. 2001).
//!
//! An image is cut into bands of [`bin::BAND_ROWS`] rows whatever the number of threads; every sum over bands is
//! taken in band order. So the result has the same bytes on one thread and on many.

mod bin;
mod blend;
mod blend_backward;
mod block_moments;
mod blocks;
mod colour;
mod counts;
mod depth_order;
mod descend;
mod engine;
mod footprint_moments;
mod harmonics;
#[cfg(test)]
mod lane_tests;
mod lanes;
mod local;
mod pass;
mod project;
mod project_backward;
mod rows;
mod session;
mod spans;
#[cfg(test)]
mod tests;
mod tile;

pub use counts::{PairCounts, pair_counts};
pub use engine::CpuEngine;
pub use pass::Pass;

/// Points nearer than this to the principal plane are not drawn, in world units.
pub const NEAR_PLANE: f64 = 0.01;

/// Added to the diagonal of every projected covariance, pixels²: no footprint is smaller than a pixel.
pub const LOW_PASS: f64 = 0.3;

/// A pixel on which a Gaussian has less opacity than this does not see it.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;

/// Opacity of one Gaussian on one pixel is clamped here, so that something always shines through.
pub const ALPHA_MAX: f32 = 0.99;

/// Blending stops before the Gaussian that would bring the transmittance below this.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;

/// The slope of the local affine projection is held at the image border plus this share of the half field of view.
pub const FRUSTUM_MARGIN: f64 = 0.3;

/// Least standard deviation of a track, pixels: smaller claims are taken for this one, so that squares of its inverse stay
/// within single precision.
pub const SIGMA_MIN: f32 = 1e-6;

/// Largest one, likewise.
pub const SIGMA_MAX: f32 = 1e6;

/// Displacement per axis, pixels, beyond which a track is no track.
pub const FARTHEST: f64 = 65_536.0;
