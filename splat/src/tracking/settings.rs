//! Settings of the dense tracks.

use serde::{Deserialize, Serialize};

use super::learned::OnnxSettings;
use crate::settings::Quality;

/// How dense tracks are found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackingSettings {
    /// Images are halved until their longer side is at most this many pixels; 16 and up, default 800.
    pub max_side: u32,
    /// Images of the exhaustive search are halved until their longer side is at most this many pixels; 16 to 256,
    /// default 100. Its time grows with the fourth power; 80 in the draft preset.
    pub search_side: u32,
    /// Largest displacement between two frames that the exhaustive search finds, as a fraction of the width; 0 to 1,
    /// default 0.4.
    pub search_radius: f32,
    /// Whether colour is matched instead of brightness alone: surer, and slower; default true. The exhaustive search
    /// always sees colour.
    pub colour: bool,
    /// Distances in frames over which tracks are chained besides the direct match with the key frame; each at least
    /// 1, default 1 and 2.
    pub gaps: Vec<u32>,
    /// Levels whose longer side has more pixels than this are refined without matching patches; default 400.
    pub patch_side: u32,
    /// Distance of neighbouring patches, pixels; 1 to 8, default 3.
    pub patch_stride: u32,
    /// Descent steps per patch and level; 1 and up, default 12.
    pub patch_iterations: u32,
    /// Weight of smoothness against colour constancy; 0 and up, default 100.
    pub smoothness: f32,
    /// Linearisations of the variational refinement per level; 0 (off) and up, default 2.
    pub smoothing_warps: u32,
    /// Half side of the windows that share one displacement in the refinement, pixels; 0 to 10, default 3.
    pub smoothing_window: u32,
    /// Sweeps of the variational refinement per linearisation; 0 (off) and up, default 10.
    pub smoothing_iterations: u32,
    /// Forward-backward error above which a pixel is called hidden, pixels; above 0, default 1.5.
    pub consistency: f32,
    /// Correlation of the surroundings below which a textured pixel is called hidden; -1 to 1, default 0.5.
    pub correlation: f32,
    /// Standard deviation that no track goes below, pixels; above 0, default 0.028.
    pub sigma_floor: f32,
    /// Standard deviation added to the guesses of hidden pixels, pixels; above 0, default 16.
    pub hidden_sigma: f32,
    /// How images reach a learned tracker; without effect on the built-in one.
    pub onnx: OnnxSettings,
}

impl Default for TrackingSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl TrackingSettings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        let balanced = Self {
            max_side: 800,
            search_side: 100,
            search_radius: 0.4,
            colour: true,
            gaps: vec![1, 2],
            patch_side: 400,
            patch_stride: 3,
            patch_iterations: 12,
            smoothness: 100.0,
            smoothing_warps: 2,
            smoothing_window: 3,
            smoothing_iterations: 10,
            consistency: 1.5,
            correlation: 0.5,
            sigma_floor: 0.028,
            hidden_sigma: 16.0,
            onnx: OnnxSettings::default(),
        };
        match quality {
            Quality::Draft => Self {
                max_side: 400,
                search_side: 80,
                gaps: vec![1],
                patch_side: 200,
                patch_stride: 4,
                patch_iterations: 8,
                smoothing_warps: 1,
                ..balanced
            },
            Quality::Balanced => balanced,
            Quality::Best => Self {
                max_side: 1600,
                gaps: vec![1, 2, 4, 8],
                patch_side: 1600,
                patch_stride: 2,
                patch_iterations: 16,
                smoothing_warps: 3,
                ..balanced
            },
        }
    }
}
