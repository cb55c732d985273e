//! Settings of the dense tracks.

use serde::{Deserialize, Serialize};

use super::learned::OnnxSettings;
use crate::settings::{Quality, range};

/// How dense tracks are found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackingSettings {
    /// Images whose longer side has more pixels than this are matched at half their resolution or less; 16 to 65 536,
    /// default 400, with `draft` 160, with `best` 1600. What moves by a pixel is found to a tenth of one, so little is lost.
    #[serde(deserialize_with = "range::whole::<16, 65_536, _>")]
    pub full_side: u32,
    /// Images whose longer side has more pixels than this are matched at a quarter of their resolution or less; 16 to
    /// 65 536, default 65 536, with `draft` 320.
    #[serde(deserialize_with = "range::whole::<16, 65_536, _>")]
    pub quarter_side: u32,
    /// Images are halved until their longer side is at most this many pixels; 16 to 65 536, default 800, with `best`
    /// 1600.
    #[serde(deserialize_with = "range::whole::<16, 65_536, _>")]
    pub max_side: u32,
    /// Images of the exhaustive search are halved until their longer side is at most this many pixels; 16 to 256,
    /// default 100, with `draft` 80. Its time grows with the fourth power, and with the square of the area that changes
    /// between two frames.
    #[serde(deserialize_with = "range::whole::<16, 256, _>")]
    pub search_side: u32,
    /// Largest displacement between two frames along either axis that the exhaustive search finds, as a fraction of the
    /// width; 0 to 1, default 0.4.
    #[serde(deserialize_with = "range::unit")]
    pub search_radius: f32,
    /// Whether colour is matched instead of brightness alone: surer, and slower; default true. The exhaustive search
    /// always sees colour.
    pub colour: bool,
    /// Distances in frames over which tracks are chained besides the direct match with the key frame; up to 16 of 1 to
    /// 1000, none twice, default 1 and 2, with `draft` 1, with `best` 1, 2, 4 and 8.
    #[serde(deserialize_with = "range::gaps")]
    pub gaps: Vec<u32>,
    /// Frames of a view that a worker tracks before the next view has its turn; 1 to 100 000, default 16. The tracks are
    /// the same whatever it is.
    #[serde(deserialize_with = "range::whole::<1, 100_000, _>")]
    pub window: u32,
    /// Levels whose longer side has more pixels than this are refined without matching patches; 0 to 65 536, default
    /// 400, with `best` 1600.
    #[serde(deserialize_with = "range::whole::<0, 65_536, _>")]
    pub patch_side: u32,
    /// Distance of neighbouring patches at the full resolution of the pyramid, pixels; half of it, rounded up, at all
    /// others; 1 to 8, default 3, with `draft` 5, with `best` 2.
    #[serde(deserialize_with = "range::whole::<1, 8, _>")]
    pub patch_stride: u32,
    /// Descent steps per patch and level; 1 to 1000, default 8, with `best` 16.
    #[serde(deserialize_with = "range::whole::<1, 1000, _>")]
    pub patch_iterations: u32,
    /// Weight of smoothness against colour constancy; 0 to a million, default 100.
    #[serde(deserialize_with = "range::weight")]
    pub smoothness: f32,
    /// Linearisations of the variational refinement per level; 0 (off) to 100, default 2, with `draft` 1, with `best` 3.
    #[serde(deserialize_with = "range::whole::<0, 100, _>")]
    pub smoothing_warps: u32,
    /// Half side of the windows that share one displacement in the refinement, pixels; 0 to 10, default 3. Up to 4 are
    /// fast.
    #[serde(deserialize_with = "range::whole::<0, 10, _>")]
    pub smoothing_window: u32,
    /// Sweeps of the variational refinement per linearisation; 0 (off) to 1000, default 10.
    #[serde(deserialize_with = "range::whole::<0, 1000, _>")]
    pub smoothing_iterations: u32,
    /// Forward-backward error above which a pixel is called hidden, in pixels of the resolution that is matched (see
    /// `full_side`); above 0, default 1.5.
    #[serde(deserialize_with = "range::distance")]
    pub consistency: f32,
    /// Correlation of the surroundings below which a textured pixel is called hidden; -1 to 1, default 0.5.
    #[serde(deserialize_with = "range::correlation")]
    pub correlation: f32,
    /// Standard deviation that no track goes below, pixels; above 0, default 0.008.
    #[serde(deserialize_with = "range::distance")]
    pub sigma_floor: f32,
    /// Standard deviation added to the guesses of hidden pixels, pixels; above 0, default 16.
    #[serde(deserialize_with = "range::distance")]
    pub hidden_sigma: f32,
    /// How images reach a learned tracker; without effect on the built-in one. docs/trackers.md says which of the other
    /// settings a learned tracker knows.
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
            full_side: 400,
            quarter_side: 65_536,
            max_side: 800,
            search_side: 100,
            search_radius: 0.4,
            colour: true,
            gaps: vec![1, 2],
            window: 16,
            patch_side: 400,
            patch_stride: 3,
            patch_iterations: 8,
            smoothness: 100.0,
            smoothing_warps: 2,
            smoothing_window: 3,
            smoothing_iterations: 10,
            consistency: 1.5,
            correlation: 0.5,
            sigma_floor: 0.008,
            hidden_sigma: 16.0,
            onnx: OnnxSettings::default(),
        };
        match quality {
            Quality::Draft => Self {
                full_side: 160,
                quarter_side: 320,
                search_side: 80,
                gaps: vec![1],
                patch_stride: 5,
                smoothing_warps: 1,
                ..balanced
            },
            Quality::Balanced => balanced,
            Quality::Best => Self {
                full_side: 1600,
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
