//! The 2D affine motion of one footprint in one view.

use glam::{DMat2, DVec2};

use super::{MotionSettings, moments::FootprintMoments};

/// An expected strain of zero asks for translations only; this is as good and keeps the ridge finite.
const LEAST_STRAIN: f64 = 1e-6;

/// How a footprint moves: `x ↦ target + gradient · (x − m)` about the projected mean `m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    /// Where the projected mean goes, pixels.
    pub target: DVec2,
    /// `target` minus the projected mean.
    pub displacement: DVec2,
    /// Variance of `target` per axis, px².
    pub variance: f64,
    /// The part of `variance` that the tracks claim; the rest was found in the residual.
    pub claimed_variance: f64,
    /// The 2×2 affine part.
    pub gradient: DMat2,
    /// Covariance of a row of `gradient`; both rows have the same.
    pub gradient_covariance: DMat2,
}

/// Fits the footprint's motion and evaluates it at the Gaussian's own projected mean.
///
/// The affine part is the posterior mean under `A ~ I ± expected_strain`, which equals a ridge of
/// `noise² / (pixels · strain²)` on the footprint's covariance: small footprints come out as translations.
/// `None` where the footprint does not count as observed.
pub(super) fn fit(
    moments: &FootprintMoments,
    projected_mean: DVec2,
    image_size: DVec2,
    settings: &MotionSettings,
) -> Option<Fit> {
    if !is_observed(moments, settings) {
        return None;
    }
    let footprint = Footprint::of(moments);
    let is_affine = footprint.determinant_ndc(image_size) >= settings.min_determinant;
    let independent_pixels =
        1.0 + (footprint.pixels - 1.0).max(0.0) / settings.noise_correlation_area.max(1.0);

    // The tracker's own variance sets the first ridge; the residual may then reveal more noise than it
    // claims.
    let claimed = footprint.track_variance;
    let first = footprint.gradient(is_affine, ridge(claimed, independent_pixels, settings));
    let noise = claimed.max(footprint.residual_variance(first));
    let ridge = ridge(noise, independent_pixels, settings);
    let gradient = footprint.gradient(is_affine, ridge);

    let regularised = footprint.source + DMat2::from_diagonal(DVec2::splat(ridge));
    let gradient_covariance = match is_affine {
        true => regularised.inverse() * (noise / independent_pixels),
        false => DMat2::from_diagonal(DVec2::splat(settings.expected_strain.powi(2))),
    };
    let offset = projected_mean - footprint.centroid;
    let displacement_at_centroid = footprint.tracked_centroid - footprint.centroid;
    let displacement = displacement_at_centroid + (gradient - DMat2::IDENTITY) * offset;
    let extrapolation = offset.dot(gradient_covariance * offset).max(0.0);
    let claimed_share = if noise > 0.0 { claimed / noise } else { 1.0 };
    let variance = noise / independent_pixels + extrapolation;
    let fit = Fit {
        target: projected_mean + displacement,
        displacement,
        variance: variance + settings.noise_floor.powi(2),
        claimed_variance: variance * claimed_share + settings.noise_floor.powi(2),
        gradient,
        gradient_covariance,
    };
    fit.is_finite().then_some(fit)
}

/// Whether enough of the footprint is seen at both frames.
fn is_observed(moments: &FootprintMoments, settings: &MotionSettings) -> bool {
    // `Σ w σ²` with `w = alpha T visible / σ²` is the visible blending weight.
    let visible = moments.variance;
    moments.blend_weight > settings.min_blend_weight
        && moments.pixels >= settings.min_pixels.max(1)
        && visible > settings.min_visible_share * moments.blend_weight
        && moments.weight > 0.0
        && moments.weight.is_finite()
        && moments.weight_squared > 0.0
}

fn ridge(noise: f64, pixels: f64, settings: &MotionSettings) -> f64 {
    noise / (pixels * settings.expected_strain.max(LEAST_STRAIN).powi(2))
}

/// Moments divided by the weight.
struct Footprint {
    centroid: DVec2,
    tracked_centroid: DVec2,
    source: DMat2,
    /// `Σ w e dᵀ / W`, with `e` the tracked and `d` the original offset.
    cross: DMat2,
    target_power: f64,
    track_variance: f64,
    /// Effective number of pixels.
    pixels: f64,
}

impl Footprint {
    fn of(m: &FootprintMoments) -> Self {
        let scale = 1.0 / m.weight;
        let [uu, uv, vv] = m.source.map(|s| s * scale);
        let [eu_du, eu_dv, ev_du, ev_dv] = m.cross.map(|c| c * scale);
        Self {
            centroid: DVec2::from_array(m.centroid),
            tracked_centroid: DVec2::from_array(m.tracked_centroid),
            source: DMat2::from_cols(DVec2::new(uu, uv), DVec2::new(uv, vv)),
            cross: DMat2::from_cols(DVec2::new(eu_du, ev_du), DVec2::new(eu_dv, ev_dv)),
            target_power: m.target * scale,
            track_variance: m.variance * scale,
            pixels: (m.weight / m.weight_squared * m.weight).max(1.0),
        }
    }

    fn determinant_ndc(&self, image_size: DVec2) -> f64 {
        let scale = 4.0 / (image_size.x * image_size.y);
        self.source.determinant() * scale * scale
    }

    /// Ridge regression of the tracked offsets towards the identity.
    fn gradient(&self, is_affine: bool, ridge: f64) -> DMat2 {
        if !is_affine {
            return DMat2::IDENTITY;
        }
        let regularised = self.source + DMat2::from_diagonal(DVec2::splat(ridge));
        DMat2::IDENTITY + (self.cross - self.source) * regularised.inverse()
    }

    /// Unbiased variance per axis of what `gradient` leaves unexplained; zero where nothing is left to
    /// estimate it from.
    fn residual_variance(&self, gradient: DMat2) -> f64 {
        let explained = 2.0 * trace(gradient * self.cross.transpose());
        let model = trace(gradient * self.source * gradient.transpose());
        let per_axis = 0.5 * (self.target_power - explained + model).max(0.0);
        // Three parameters per axis; the floor of one keeps tiny footprints from inflating their own
        // residual.
        per_axis * self.pixels / (self.pixels - 3.0).max(1.0)
    }
}

fn trace(m: DMat2) -> f64 {
    m.x_axis.x + m.y_axis.y
}

impl Fit {
    fn is_finite(&self) -> bool {
        self.target.is_finite()
            && self.variance.is_finite()
            && self.claimed_variance.is_finite()
            && self.gradient.is_finite()
            && self.gradient_covariance.is_finite()
    }
}
