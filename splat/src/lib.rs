//! The mathematics of trackersplat.
//!
//! Everything here is a function from data to data: no network, no async, no clock, no global state, and the
//! same bytes for the same input whatever the number of threads. One room per idea:
//!
//! | room | what it holds |
//! |---|---|
//! | [`gaussians`] | sets of 3D Gaussians, spherical harmonics, frame deltas, validation |
//! | [`cameras`] | pinhole cameras, lens distortion, projection and its Jacobian |
//! | [`clip`] | a clip on disk: views, frames, masks, data-set layouts |
//! | [`formats`] | Gaussian files (PLY) and track files (npz) |
//! | [`raster`] | the CPU engine: project, bin, blend, and their gradients |
//! | [`simd`] | sixteen numbers at a time, and the choice of instruction set |
//! | [`loss`], [`optim`], [`metrics`] | L1 + D-SSIM, Adam, PSNR and SSIM |
//! | [`static_model`] | reconstruction of the key frame |
//! | [`tracking`] | dense tracks from the key frame to every frame |
//! | [`motion`] | footprint moments, 2D motion models, the lift to 3D |
//! | [`refine`] | photometric refinement of one frame |

pub mod cameras;
pub mod clip;
pub mod engine;
pub mod formats;
pub mod frame;
pub mod gaussians;
pub mod image;
pub mod loss;
pub mod metrics;
pub mod motion;
pub mod optim;
pub mod raster;
pub mod refine;
pub mod settings;
pub mod simd;
pub mod static_model;
#[cfg(test)]
mod testing;
pub mod tracking;
