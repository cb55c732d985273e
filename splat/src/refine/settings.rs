//! How a frame is refined after motion compensation.

use serde::{Deserialize, Serialize};

use crate::settings::{Quality, range};

/// Settings of the refinement. Rates are those of 3D Gaussian Splatting, which TrackerSplat's released code uses for 1000
/// steps per frame, raised here for a third of the steps: on both moving clips the held-out PSNR still grew up to these.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineSettings {
    /// Optimisation steps at most, one view each; 0 leaves the compensated Gaussians as they are.
    #[serde(deserialize_with = "range::steps")]
    pub iterations: u32,
    /// Whether Gaussians that motion compensation calls static are left out of the optimisation.
    pub freeze_static: bool,
    /// Share of static Gaussians from which a frame counts as at rest, if its light is unchanged too: then they are left out
    /// as well, as all that could be learned from such a frame is its noise.
    #[serde(deserialize_with = "range::unit")]
    pub rest_share: f32,
    /// Mean difference of block colours, sRGB 0 to 1, up to which the light counts as unchanged.
    #[serde(deserialize_with = "range::unit")]
    pub rest_light: f32,
    /// Weight of the structural term in the loss, 0 to 1.
    #[serde(deserialize_with = "range::unit")]
    pub dssim_weight: f32,
    /// Rate of the means, in scene extents per step.
    #[serde(deserialize_with = "range::unit")]
    pub mean_rate: f32,
    /// Rate of the quaternions.
    #[serde(deserialize_with = "range::unit")]
    pub rotation_rate: f32,
    /// Rate of the log scales.
    #[serde(deserialize_with = "range::unit")]
    pub log_scale_rate: f32,
    /// Rate of the logit opacities.
    #[serde(deserialize_with = "range::unit")]
    pub logit_opacity_rate: f32,
    /// Rate of the spherical harmonics of degree 0.
    #[serde(deserialize_with = "range::unit")]
    pub sh_dc_rate: f32,
    /// Rate of the higher spherical harmonics.
    #[serde(deserialize_with = "range::unit")]
    pub sh_rest_rate: f32,
    /// Share of every rate that is left at the last step; the rates fall exponentially towards it.
    #[serde(deserialize_with = "range::unit")]
    pub final_rate_share: f32,
    /// Steps over which the loss is compared with the same number before; 0 never stops early.
    pub plateau_window: u32,
    /// The optimisation stops when the loss fell by less than this share from window to window.
    #[serde(deserialize_with = "range::unit")]
    pub plateau_improvement: f32,
}

impl Default for RefineSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl RefineSettings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        Self {
            iterations: match quality {
                Quality::Draft => 100,
                Quality::Balanced => 300,
                Quality::Best => 1000,
            },
            freeze_static: false,
            rest_share: 0.95,
            rest_light: 0.01,
            dssim_weight: 0.2,
            mean_rate: 8e-4,
            rotation_rate: 8e-3,
            log_scale_rate: 0.015,
            logit_opacity_rate: 0.05,
            sh_dc_rate: 5e-3,
            sh_rest_rate: 1.25e-4,
            final_rate_share: 0.1,
            plateau_window: 80,
            plateau_improvement: 0.01,
        }
    }
}
