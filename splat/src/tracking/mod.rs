//! Dense tracks from the key frame to every frame of a view, without trained weights.
//!
//! Each pair of frames is matched both ways: exhaustive search on a small image for jumps, dense inverse search down
//! a pyramid, variational refinement. Forward-backward and photometric agreement decide what is visible and how
//! certain. Tracks to a frame are the direct match with the key frame or a continuation of an earlier frame's
//! tracks, per pixel what most of them agree on, then whichever is more certain.

mod chain;
mod coarse;
mod consistency;
mod densify;
mod exposure;
mod fill;
mod flow;
pub mod learned;
mod matcher;
mod pair;
mod pair_flow;
mod patches;
mod planes;
mod refine;
mod settings;
pub(crate) mod state;
#[cfg(test)]
mod tests;
mod texels;
mod tracker;
mod view;
mod windows;

pub use pair_flow::{DenseFlow, PairFlow, PairFlowError, pair_flow};
pub use settings::TrackingSettings;
pub use state::{StateMisfit, TrackState};
pub use tracker::Tracker;
pub use view::track_view;

/// Where each key-frame pixel of one view is at one frame.
///
/// Pixel positions are in pixels with the centre of the top-left pixel at (0.5, 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct TrackField {
    /// Columns of the key-frame image.
    pub width: u32,
    /// Rows of the key-frame image.
    pub height: u32,
    /// Tracked position `x, y` of every key-frame pixel, row by row.
    pub positions: Vec<[f32; 2]>,
    /// Whether the pixel's surface point is visible at the frame; positions of invisible pixels are guesses.
    pub visible: Vec<bool>,
    /// Standard deviation of the tracked position per axis, pixels.
    pub sigma: Vec<f32>,
}
