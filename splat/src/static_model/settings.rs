//! How the key frame is reconstructed.

use serde::{Deserialize, Serialize};

use crate::{
    gaussians::sh,
    settings::{Quality, range},
};

/// Settings of the static model. Rates and thresholds are those of 3D Gaussian Splatting (Kerbl et al. 2023, section 5
/// and 7.1) unless stated otherwise, on a schedule short enough for a frame of a clip.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StaticModelSettings {
    /// Optimisation steps at most, one view each.
    #[serde(deserialize_with = "range::steps")]
    pub max_steps: u32,
    /// Gaussians at most.
    #[serde(deserialize_with = "range::gaussians")]
    pub max_gaussians: usize,
    /// Points drawn in the cameras' common frustum when the clip has no structure-from-motion points.
    #[serde(deserialize_with = "range::gaussians")]
    pub random_points: usize,
    /// Highest spherical-harmonic degree, 0 to 3.
    #[serde(deserialize_with = "range::degree")]
    pub sh_degree: u32,
    /// Training views that each spherical-harmonic coefficient needs: the degree is lowered until there are enough, as
    /// colours that a few views leave undetermined are wrong from every other side. 0 asks for none.
    pub sh_views_per_coefficient: u32,
    /// Steps after which the degree is raised by one.
    pub sh_degree_interval: u32,
    /// Weight of the structural term in the loss, 0 to 1.
    #[serde(deserialize_with = "range::unit")]
    pub dssim_weight: f32,
    /// First step after which Gaussians are densified.
    pub densify_from: u32,
    /// Share of `max_steps` after which the number of Gaussians no longer grows, 0 to 1.
    #[serde(deserialize_with = "range::unit")]
    pub densify_until: f32,
    /// Steps between two densifications.
    pub densify_interval: u32,
    /// Mean gradient norm by the projected mean above which a Gaussian is cloned or split, in units of half the image.
    pub densify_gradient: f32,
    /// Gaussians larger than this share of the scene extent are split, smaller ones cloned.
    #[serde(deserialize_with = "range::unit")]
    pub split_extent: f32,
    /// Gaussians of less opacity are removed.
    #[serde(deserialize_with = "range::unit")]
    pub prune_opacity: f32,
    /// Gaussians larger than this share of the scene extent are removed.
    #[serde(deserialize_with = "range::unit")]
    pub prune_extent: f32,
    /// Rate of the means at the first step, in scene extents per step.
    #[serde(deserialize_with = "range::unit")]
    pub mean_rate: f32,
    /// Rate of the means at the last step, in scene extents per step.
    #[serde(deserialize_with = "range::unit")]
    pub mean_rate_final: f32,
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
    /// Steps over which the loss is compared with the same number before; 0 never stops early.
    pub plateau_window: u32,
    /// The optimisation stops when the loss fell by less than this share from window to window.
    #[serde(deserialize_with = "range::unit")]
    pub plateau_improvement: f32,
}

impl StaticModelSettings {
    /// The spherical-harmonic degree that `views` training views determine.
    pub fn sh_degree_for(&self, views: usize) -> u32 {
        let needed = |degree| sh::coefficients(degree) * self.sh_views_per_coefficient as usize;
        (0..=self.sh_degree.min(sh::MAX_DEGREE)).rev().find(|&degree| needed(degree) <= views).unwrap_or(0)
    }
}

impl Default for StaticModelSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl StaticModelSettings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        let (max_steps, max_gaussians) = match quality {
            Quality::Draft => (800, 20_000),
            Quality::Balanced => (2_000, 40_000),
            Quality::Best => (6_000, 100_000),
        };
        Self {
            max_steps,
            max_gaussians,
            random_points: 10_000,
            sh_degree: 3,
            sh_views_per_coefficient: 2,
            sh_degree_interval: max_steps / 6,
            dssim_weight: 0.2,
            densify_from: 200,
            densify_until: 0.6,
            densify_interval: 100,
            densify_gradient: 3e-4,
            split_extent: 0.01,
            prune_opacity: 0.005,
            prune_extent: 0.1,
            mean_rate: 1.6e-4,
            mean_rate_final: 1.6e-6,
            rotation_rate: 1e-3,
            log_scale_rate: 5e-3,
            logit_opacity_rate: 0.05,
            sh_dc_rate: 2.5e-3,
            sh_rest_rate: 1.25e-4,
            plateau_window: 200,
            plateau_improvement: 0.002,
        }
    }
}
