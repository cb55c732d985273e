//! The 2D motion of one footprint in one view.

use glam::{DMat2, DVec2};

use super::{
    MotionSettings,
    moments::{Displacements, FootprintMoments},
    order::{Candidates, Order},
};

/// An expected strain of zero asks for translations only; this is as good and keeps the ridge finite.
const LEAST_STRAIN: f64 = 1e-6;

/// Share of its visible weight that a footprint must keep in reweighting to be found at rest: what straddles something
/// that moves may be part of it.
const UNCONTESTED: f64 = 0.9;
/// Where reweighting left less than this, the other surface's distance is not estimated from it.
const LEAST_KEPT: f64 = 0.01;

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
    /// Share of `variance` that is doubt whether the footprint follows the right one of two surfaces, and that other
    /// views can dispel: not where it follows the smaller part of its pixels.
    pub doubt: f64,
    /// The model that the tracks support. What a static footprint shows of a displacement is still in `target`: a
    /// Gaussian that moves along one view's ray rests there, and only all views together decide.
    pub order: Order,
    /// Root mean square per axis of what the model leaves, pixels.
    pub residual: f64,
    /// The 2×2 affine part.
    pub gradient: DMat2,
    /// The affine part of the affine model whatever the order, for what only all views together decide: a strain that
    /// is left out of every view on its own would vote for none.
    pub affine: DMat2,
    /// Covariance of a row of `affine`, and of `gradient`, as what a lower order leaves out is known no better; both
    /// rows have the same.
    pub gradient_covariance: DMat2,
}

/// Fits the footprint's motion and evaluates it at the Gaussian's own projected mean.
///
/// The order of the model is the one that the tracks support, see [`Candidates::select`]. Its gradient is the
/// posterior mean under `A ~ I ± expected_strain`, which equals a ridge of `noise² / (pixels · strain²)` on the
/// footprint's covariance. `None` where the footprint does not count as observed.
pub(super) fn fit(
    moments: &FootprintMoments,
    projected_mean: DVec2,
    image_size: DVec2,
    settings: &MotionSettings,
) -> Option<Fit> {
    if !is_observed(moments, settings) {
        return None;
    }
    let footprint = Displacements::of(moments)?;
    let has_extent = determinant_ndc(&footprint, image_size) >= settings.min_determinant;
    let independent_pixels = footprint.independent_pixels(settings.noise_correlation_area);

    // The tracker's own variance sets the first ridge; the residual may then reveal more noise than it
    // claims.
    let claimed = footprint.track_variance;
    let first = Candidates::new(&footprint, ridge(claimed, independent_pixels, settings));
    let noise = claimed.max(residual_variance(first.affine_residual_power(), footprint.pixels));
    let ridge = ridge(noise, independent_pixels, settings);
    let candidates = Candidates::new(&footprint, ridge);
    let order = match has_extent {
        true => candidates.select(noise, independent_pixels),
        false => Order::Translation,
    };

    let regularised = footprint.source + DMat2::from_diagonal(DVec2::splat(ridge));
    let gradient_covariance = match has_extent {
        true => regularised.inverse() * (noise / independent_pixels),
        false => DMat2::from_diagonal(DVec2::splat(settings.expected_strain.powi(2))),
    };
    let offset = projected_mean - footprint.centroid;
    let displacement = footprint.mean + candidates.gradient(order) * offset;
    let extrapolation = offset.dot(gradient_covariance * offset).max(0.0);
    let claimed_share = if noise > 0.0 { claimed / noise } else { 1.0 };
    let variance = noise / independent_pixels + extrapolation;
    let undoubted = variance + settings.noise_floor.powi(2);
    let wrong_surface = wrong_surface(moments);
    let total = (undoubted + wrong_surface).max(f64::MIN_POSITIVE);
    let claimed_variance = variance * claimed_share + settings.noise_floor.powi(2);

    let still = (settings.static_significance.powi(2) * claimed_variance).max(settings.static_floor.powi(2));
    let is_static = kept(moments) >= UNCONTESTED
        && displacement.length_squared() <= still
        && candidates.is_rigid(claimed, independent_pixels, settings);
    let order = if is_static { Order::Static } else { order };
    let fit = Fit {
        target: projected_mean + displacement,
        displacement,
        variance: undoubted + wrong_surface,
        claimed_variance,
        doubt: if kept(moments) > 0.5 { wrong_surface / total } else { 0.0 },
        order,
        residual: (0.5 * candidates.residual_power(order)).sqrt(),
        gradient: DMat2::IDENTITY + candidates.gradient(order),
        affine: DMat2::IDENTITY + if has_extent { candidates.gradient(Order::Affine) } else { DMat2::ZERO },
        gradient_covariance,
    };
    fit.is_finite().then_some(fit)
}

/// Whether enough of the footprint is seen at both frames.
fn is_observed(moments: &FootprintMoments, settings: &MotionSettings) -> bool {
    moments.blend_weight > settings.min_blend_weight
        && moments.pixels >= settings.min_pixels.max(1)
        && moments.visible > settings.min_visible_share * moments.blend_weight
}

/// Share of the visible blending weight that reweighting left.
fn kept(moments: &FootprintMoments) -> f64 {
    // `Σ w σ²` with `w = alpha T / σ²` is a sum of blending weights.
    moments.variance / moments.visible
}

/// Variance per axis, px², of which of two surfaces the Gaussian belongs to: to the other one with the probability of its
/// share `1 − kept`, at a squared distance of `contest / (kept (1 − kept))`.
fn wrong_surface(moments: &FootprintMoments) -> f64 {
    moments.contest / kept(moments).max(LEAST_KEPT)
}

fn ridge(noise: f64, pixels: f64, settings: &MotionSettings) -> f64 {
    noise / (pixels * settings.expected_strain.max(LEAST_STRAIN).powi(2))
}

fn determinant_ndc(footprint: &Displacements, image_size: DVec2) -> f64 {
    let scale = 4.0 / (image_size.x * image_size.y);
    footprint.source.determinant() * scale * scale
}

/// Unbiased variance per axis of what the affine model leaves of both; zero where nothing is left to estimate
/// it from.
fn residual_variance(power: f64, pixels: f64) -> f64 {
    // Three parameters per axis; the floor of one keeps tiny footprints from inflating their own residual.
    0.5 * power * pixels / (pixels - 3.0).max(1.0)
}

impl Fit {
    fn is_finite(&self) -> bool {
        self.target.is_finite()
            && self.variance.is_finite()
            && self.claimed_variance.is_finite()
            && self.doubt.is_finite()
            && self.residual.is_finite()
            && self.gradient.is_finite()
            && self.affine.is_finite()
            && self.gradient_covariance.is_finite()
    }
}
