//! Every setting of a reconstruction, in one place: the same structs are the settings file, the command line's
//! `--set KEY=VALUE`, and the JSON on the wire.

use serde::{Deserialize, Serialize};

use crate::{
    motion::MotionSettings, refine::RefineSettings, static_model::StaticModelSettings,
    tracking::TrackingSettings,
};

/// How much time to trade for accuracy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quality {
    /// A look at the result.
    Draft,
    /// The default.
    #[default]
    Balanced,
    /// The paper's budget.
    Best,
}

/// What the masks of a clip are for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskUse {
    /// They mark the moving region that is reported apart.
    #[default]
    Evaluate,
    /// They mark the pixels that count in training; everything else is ignored.
    Train,
}

/// Whether frames start from tracked motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionSource {
    /// From the tracks, by motion compensation.
    #[default]
    Tracks,
    /// From the static model as it is: the baseline.
    None,
}

/// Everything that, with the clip, decides the result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Seed of every random choice.
    pub seed: u64,
    /// Colour behind everything, sRGB in `[0, 1]`.
    pub background: [f32; 3],
    /// What the clip's masks are for.
    pub masks: MaskUse,
    /// Where frames start from.
    pub motion_source: MotionSource,
    /// Reconstruction of the key frame.
    pub static_model: StaticModelSettings,
    /// Dense tracks.
    pub tracking: TrackingSettings,
    /// Motion compensation.
    pub motion: MotionSettings,
    /// Photometric refinement of a frame.
    pub refine: RefineSettings,
}

impl Default for Settings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl Settings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        Self {
            seed: 0,
            background: [0.0; 3],
            masks: MaskUse::default(),
            motion_source: MotionSource::default(),
            static_model: StaticModelSettings::preset(quality),
            tracking: TrackingSettings::preset(quality),
            motion: MotionSettings::preset(quality),
            refine: RefineSettings::preset(quality),
        }
    }
}
