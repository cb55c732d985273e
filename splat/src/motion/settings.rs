//! Settings of motion compensation.

use serde::{Deserialize, Serialize};

use crate::settings::{Quality, range};

/// Which path leads from footprints to motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LiftMethod {
    /// Robust fits, Gauss-Newton lift, one sparse solve over the neighbours.
    #[default]
    Robust,
    /// TrackerSplat's released path with its thresholds and defects, as an ablation: no other setting of motion
    /// compensation applies to it.
    Reference,
}

/// How Gaussians are moved from tracks.
///
/// Pixels are those of the track fields. The discard thresholds follow the paper and its public code where
/// they are known there; the rest follow from the noise of dense trackers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionSettings {
    /// Which path leads from footprints to motion; default `robust`.
    pub lift: LiftMethod,
    /// Least sum of blending weights `alpha * T` of a footprint that counts as observed in a view; default
    /// 1e-3, as in the public code.
    #[serde(deserialize_with = "range::magnitude")]
    pub min_blend_weight: f64,
    /// Least number of visible pixels of a footprint that counts as observed; default 2, as in the public
    /// code.
    pub min_pixels: u32,
    /// Least `√det` of a footprint's covariance, px², for a model beyond a translation; default 0.06, what the public
    /// code asks for at 640×360.
    #[serde(deserialize_with = "range::magnitude")]
    pub min_footprint_area: f64,
    /// Least visible share of a footprint's blending weight, 0 to 1; default 0.6. Where most of it vanishes,
    /// what remains is likely another surface at its rim.
    #[serde(deserialize_with = "range::share")]
    pub min_visible_share: f64,
    /// Least mean transmittance before a Gaussian in the key frame, relative to the view that sees it best there, 0 to 1;
    /// default 0.1. Pixels in front of a hidden Gaussian track its occluder.
    #[serde(deserialize_with = "range::share")]
    pub min_relative_transmittance: f64,
    /// Least number of views that a position is solved from; default 2, as in the paper. A single view still
    /// counts along the directions it sees once neighbours give the depth.
    #[serde(deserialize_with = "range::few")]
    pub min_views: usize,
    /// Passes over the pixels that fit footprints of two surfaces again with robust weights; default 3, `draft`
    /// 1. Zero trusts every visible track alike.
    #[serde(deserialize_with = "range::steps")]
    pub reweighting_passes: u32,
    /// Expected change of a footprint's shape, standard deviation of `A - I`; default 0.3. Ties the displacement of small or
    /// noisy footprints to a translation; rotation and scale are found without it.
    #[serde(deserialize_with = "range::magnitude")]
    pub expected_strain: f64,
    /// Area over which track errors are alike, px², at least 1; default 16, the 4×4 px that dense trackers
    /// match on after densification.
    #[serde(deserialize_with = "range::magnitude")]
    pub noise_correlation_area: f64,
    /// Standard deviation, px, that no track counts as surer than when a frame is moved; default 0.1. Surer ones would drag
    /// the others of their footprint along.
    #[serde(deserialize_with = "range::magnitude")]
    pub least_track_sigma: f64,
    /// Standard deviation, px, of what no track sees: mixed surfaces and pixel rounding; default 0.05.
    #[serde(deserialize_with = "range::magnitude")]
    pub noise_floor: f64,
    /// Displacement, px, below which a footprint does not move whatever the noise; default 0.2, as in the
    /// public code.
    #[serde(deserialize_with = "range::magnitude")]
    pub static_floor: f64,
    /// Displacement over its standard deviation below which a footprint does not move; default 3, which 1 % of resting
    /// footprints exceed. The deviation is what the tracks claim, up to twice that where the residual says so. A strain of
    /// the same significance is motion too.
    #[serde(deserialize_with = "range::magnitude")]
    pub static_significance: f64,
    /// Share of the observing views, weighted by how well they see it, that must find a Gaussian at rest; default 0.5. A
    /// motion beyond doubt that explains more views refutes them.
    #[serde(deserialize_with = "range::share")]
    pub static_share: f64,
    /// Reprojection error over its standard deviation beyond which a view is an outlier; default 4.
    #[serde(deserialize_with = "range::magnitude")]
    pub outlier_significance: f64,
    /// Reprojection error, px, that is never an outlier; default 1: a Gaussian's mean lies off the tracked
    /// surface.
    #[serde(deserialize_with = "range::magnitude")]
    pub outlier_floor: f64,
    /// Largest standard deviation of a solved position, as a share of its depth; default 0.02. Beyond it the
    /// neighbours decide: footprints that straddle two motions know neither.
    #[serde(deserialize_with = "range::magnitude")]
    pub max_relative_deviation: f64,
    /// Expected rotation, standard deviation in radians; default 1. Ties weakly determined rotations to none.
    #[serde(deserialize_with = "range::magnitude")]
    pub expected_rotation: f64,
    /// Rotation over its standard deviation below which a Gaussian does not turn; larger ones, `s` times as significant, keep
    /// `1 - s⁻⁴` of themselves. Default 3 (3 % of unturned Gaussians exceed it in three dimensions).
    #[serde(deserialize_with = "range::magnitude")]
    pub rotation_significance: f64,
    /// Stretch of an axis over its standard deviation below which a Gaussian keeps its scale; default 4: a wrong
    /// scale costs more than a missing one.
    #[serde(deserialize_with = "range::magnitude")]
    pub scale_significance: f64,
    /// Largest change of the logarithm of a scale; default 0.2.
    #[serde(deserialize_with = "range::magnitude")]
    pub max_log_strain: f64,
    /// Nearest neighbours per Gaussian; default 12, `draft` 8 (the paper's).
    #[serde(deserialize_with = "range::few")]
    pub neighbours: usize,
    /// Longest edge between neighbours, in medians of the distance to the farthest of the nearest neighbours;
    /// default 8.
    #[serde(deserialize_with = "range::magnitude")]
    pub max_edge: f64,
    /// Expected departure of neighbours from moving as one rigid body, as a share of their distance; default
    /// 0.1.
    #[serde(deserialize_with = "range::magnitude")]
    pub neighbour_strain: f64,
    /// Colour difference between neighbours that halves their tie, as a distance in the sRGB cube; default
    /// 0.4, because texture differs within a body too.
    #[serde(deserialize_with = "range::magnitude")]
    pub colour_scale: f64,
    /// Longest chain of neighbours along which an unobserved Gaussian takes its motion; default 30: the
    /// whole of a body, as what stays behind at its old place shows.
    #[serde(deserialize_with = "range::few")]
    pub max_hops: usize,
    /// Agreeing neighbours that an unobserved Gaussian needs to follow them; default 1.
    #[serde(deserialize_with = "range::few")]
    pub min_support: usize,
    /// Rounds of robust reweighting of the neighbours' field; default 3, `draft` 2. Zero leaves the solved
    /// motions as they are.
    #[serde(deserialize_with = "range::few")]
    pub field_rounds: usize,
    /// Most steps of conjugate gradients per round; default 20.
    #[serde(deserialize_with = "range::few")]
    pub field_steps: usize,
}

impl Default for MotionSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl MotionSettings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        let is_draft = quality == Quality::Draft;
        Self {
            lift: LiftMethod::default(),
            min_blend_weight: 1e-3,
            min_pixels: 2,
            min_footprint_area: 0.06,
            min_visible_share: 0.6,
            min_relative_transmittance: 0.1,
            min_views: 2,
            reweighting_passes: if is_draft { 1 } else { 3 },
            expected_strain: 0.3,
            noise_correlation_area: 16.0,
            least_track_sigma: 0.1,
            noise_floor: 0.05,
            static_floor: 0.2,
            static_significance: 3.0,
            static_share: 0.5,
            outlier_significance: 4.0,
            outlier_floor: 1.0,
            max_relative_deviation: 0.02,
            expected_rotation: 1.0,
            rotation_significance: 3.0,
            scale_significance: 4.0,
            max_log_strain: 0.2,
            neighbours: if is_draft { 8 } else { 12 },
            max_edge: 8.0,
            neighbour_strain: 0.1,
            colour_scale: 0.4,
            max_hops: 30,
            min_support: 1,
            field_rounds: if is_draft { 2 } else { 3 },
            field_steps: 20,
        }
    }
}
