//! Dense tracks from the key frame to every frame of a view.

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

use serde::{Deserialize, Serialize};

use crate::settings::Quality;

/// How dense tracks are found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackingSettings {}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl TrackingSettings {
    /// The settings of a quality level.
    pub fn preset(_quality: Quality) -> Self {
        Self {}
    }
}

/// Tracks every pixel of frame 0 of one view to each later frame.
///
/// `load(i)` gives frame `i` of `frame_count` (0 is the key frame); `emit(i, field)` takes the field of frame `i`,
/// in ascending order from 1. The first error of either ends the work.
pub fn track_view<E>(
    _frame_count: usize,
    _load: &mut dyn FnMut(usize) -> Result<std::sync::Arc<crate::image::Image>, E>,
    _settings: &TrackingSettings,
    _emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<(), E> {
    unimplemented!("lands with the tracking commit")
}
