//! Weighted moments of a Gaussian's footprint under a track field.

use glam::{DMat2, DVec2};

/// Moments of one Gaussian in one view, accumulated centred (see `goldens`: pixel minus centroid, tracked position
/// minus tracked centroid), so that single precision suffices for the sums.
///
/// The weight of a pixel is its blending weight `alpha * T` divided by the variance of its track, times what
/// reweighting leaves of it; zero where the track is not visible or no finite number.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootprintMoments {
    /// Sum of the blending weights `alpha * T` over **all** pixels of the footprint, visible or not.
    pub blend_weight: f64,
    /// The same sum over the pixels that entered the moments, before any reweighting.
    pub visible: f64,
    /// Sum of the weights that entered the moments.
    pub weight: f64,
    /// Sum of the squared weights that entered the moments: `weight² / weight_squared` is the effective number of pixels.
    pub weight_squared: f64,
    /// Number of pixels that entered the moments.
    pub pixels: u32,
    /// Weighted mean pixel position, pixels.
    pub centroid: [f64; 2],
    /// Weighted mean tracked position, pixels.
    pub tracked_centroid: [f64; 2],
    /// `Σ w (du du, du dv, dv dv)` with `(du, dv)` the pixel minus the centroid.
    pub source: [f64; 3],
    /// `Σ w (eu du, eu dv, ev du, ev dv)` with `(eu, ev)` the tracked position minus the tracked centroid.
    pub cross: [f64; 4],
    /// `Σ w (eu² + ev²)`.
    pub target: f64,
    /// `Σ w σ²`, the track variance summed with the weights.
    pub variance: f64,
    /// What an affine map left of the tracks before reweighting, px² per axis; zero without reweighting.
    pub contest: f64,
}

/// The same in displacements, divided by the weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Displacements {
    /// Weighted mean pixel, pixels.
    pub centroid: DVec2,
    /// Weighted mean displacement, pixels.
    pub mean: DVec2,
    /// Covariance of the pixels, px².
    pub source: DMat2,
    /// Covariance `Σ w a dᵀ / Σ w` of displacement `a` and pixel `d`, both from their means, px².
    pub strain: DMat2,
    /// Mean of `|a|²`, px²: both axes.
    pub power: f64,
    /// Mean variance per axis that the tracks claim, px².
    pub track_variance: f64,
    /// Effective number of pixels, at least 1.
    pub pixels: f64,
}

impl Displacements {
    /// `None` where no pixel entered the moments or they are no finite numbers.
    pub(super) fn of(m: &FootprintMoments) -> Option<Self> {
        let is_sound = m.weight > 0.0 && m.weight_squared > 0.0 && m.weight.is_finite();
        if !is_sound {
            return None;
        }
        let scale = m.weight.recip();
        let [uu, uv, vv] = m.source.map(|sum| sum * scale);
        let [eu_du, eu_dv, ev_du, ev_dv] = m.cross.map(|sum| sum * scale);
        let source = DMat2::from_cols(DVec2::new(uu, uv), DVec2::new(uv, vv));
        let cross = DMat2::from_cols(DVec2::new(eu_du, ev_du), DVec2::new(eu_dv, ev_dv));
        let centroid = DVec2::from_array(m.centroid);
        let found = Self {
            centroid,
            mean: DVec2::from_array(m.tracked_centroid) - centroid,
            source,
            strain: cross - source,
            power: (m.target * scale - 2.0 * trace(cross) + trace(source)).max(0.0),
            track_variance: m.variance * scale,
            pixels: (m.weight / m.weight_squared * m.weight).max(1.0),
        };
        let is_finite = found.mean.is_finite()
            && found.source.is_finite()
            && found.strain.is_finite()
            && (found.power + found.track_variance + found.pixels).is_finite();
        is_finite.then_some(found)
    }

    /// Effective number of pixels whose track errors are independent, if they are alike over `area`, px².
    pub(super) fn independent_pixels(&self, area: f64) -> f64 {
        1.0 + (self.pixels - 1.0) / area.max(1.0)
    }

    /// What the best affine map leaves of `power`.
    pub(super) fn affine_residual_power(&self) -> f64 {
        // Far below any pixel's size: only decides directions in which the footprint has no extent.
        let regularised = self.source + DMat2::from_diagonal(DVec2::splat(1e-9));
        let explained = trace(self.strain * regularised.inverse() * self.strain.transpose());
        (self.power - explained).max(0.0)
    }
}

pub(super) fn trace(m: DMat2) -> f64 {
    m.x_axis.x + m.y_axis.y
}
