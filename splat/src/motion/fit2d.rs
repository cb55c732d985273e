//! The 2D motion of one footprint in one view.

use glam::{DMat2, DVec2};

use super::{
    MotionSettings,
    moments::{Displacements, FootprintMoments, trace},
    order::{Candidates, Order},
};

/// An expected strain of zero asks for translations only; this is as good and keeps the ridge finite.
const LEAST_STRAIN: f64 = 1e-6;

/// Share of its visible weight that a footprint must keep in reweighting to be found at rest, unless it is the noise that
/// lost it: what straddles something that moves may be part of it.
const UNCONTESTED: f64 = 0.9;
/// Share of what the affine model left at first that another surface must explain to contest a footprint.
const CONTESTED: f64 = 0.5;
/// Where reweighting left less than this, the other surface's distance is not estimated from it.
const LEAST_KEPT: f64 = 0.01;
/// How much the variance of tracks may exceed their claim, where no other surface explains it, before a footprint counts
/// as moving: twice the deviations.
const MOST_EXCESS: f64 = 4.0;
/// px²: what the sums may err by in the narrow direction of a footprint. One that is no wider has no affine map.
const LEAST_EXTENT: f64 = 1e-5;
/// Variance of an entry of the affine map that is not known: as good as infinite.
const NO_MAP: f64 = 1e12;
/// Effective pixels below which a footprint cannot show two surfaces.
const LEAST_CONTESTED: f64 = 4.0;

/// How a footprint moves: `x ↦ target + gradient · (x − m)` about the projected mean `m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    /// Where the projected mean goes, pixels.
    pub target: DVec2,
    /// Variance of `target` per axis, px².
    pub variance: f64,
    /// The part of `variance` that the tracks claim, or err by without another surface's doing.
    pub resting_variance: f64,
    /// Share of `variance` that is doubt whether the footprint follows the right one of two surfaces, and that other
    /// views can dispel: not where it follows the smaller part of its pixels.
    pub doubt: f64,
    /// The model that the tracks support. What a static footprint shows of a displacement is still in `target`: a
    /// Gaussian that moves along one view's ray rests there, and only all views together decide.
    pub order: Order,
    /// The 2×2 affine part of the chosen model.
    pub gradient: DMat2,
    /// The affine part by least squares, whatever the order and without any expectation, for what only all views
    /// together decide: what every view leaves out, or pulls towards no strain, would be counted once per view.
    pub affine: DMat2,
    /// Covariance of a row of `affine`; both rows have the same.
    pub affine_covariance: DMat2,
}

/// Fits the footprint's motion and evaluates it at the Gaussian's own projected mean.
///
/// The order of the model is the one that the tracks support, see [`Candidates::select`]. Its gradient is the
/// posterior mean under `A ~ I ± expected_strain`, which equals a ridge of `noise² / (pixels · strain²)` on the
/// footprint's covariance. `None` where the footprint does not count as observed.
pub(super) fn fit(
    moments: &FootprintMoments,
    projected_mean: DVec2,
    settings: &MotionSettings,
) -> Option<Fit> {
    if !is_observed(moments, settings) {
        return None;
    }
    let footprint = Displacements::of(moments)?;
    let contest = Contest::of(moments, &footprint);
    let independent_pixels = footprint.independent_pixels(settings.noise_correlation_area);

    // The tracker's own variance sets the first ridge; the residual may then reveal more noise than it
    // claims.
    let claimed = footprint.track_variance;
    let first = Candidates::new(&footprint, ridge(claimed, independent_pixels, settings));
    let noise =
        claimed.max(contest.noise(residual_variance(first.affine_residual_power(), footprint.pixels)));
    let ridge = ridge(noise, independent_pixels, settings);
    let candidates = Candidates::new(&footprint, ridge);
    let has_extent = footprint.source.determinant() >= settings.min_footprint_area.powi(2);
    let order = match has_extent {
        true => candidates.select(noise, independent_pixels),
        false => Order::Translation,
    };

    let pixel_variance = noise / independent_pixels;
    let offset = projected_mean - footprint.centroid;
    let displacement = footprint.mean + candidates.gradient(order) * offset;
    let expected = (footprint.source + DMat2::from_diagonal(DVec2::splat(ridge))).inverse() * pixel_variance;
    let extrapolation = match has_extent {
        true => offset.dot(expected * offset).max(0.0),
        false => offset.length_squared() * settings.expected_strain.powi(2),
    };
    let variance = pixel_variance + extrapolation;
    let floor = settings.noise_floor.powi(2);
    let wrong_surface = contest.wrong_surface();
    let total = (variance + floor + wrong_surface).max(f64::MIN_POSITIVE);

    let resting = if contest.is_contested() { claimed } else { noise.min(MOST_EXCESS * claimed) };
    let resting_share = if noise > 0.0 { resting / noise } else { 1.0 };
    let resting_variance = variance * resting_share + floor;
    let still = (settings.static_significance.powi(2) * resting_variance).max(settings.static_floor.powi(2));
    let is_static = !contest.is_contested()
        && displacement.length_squared() <= still
        && candidates.is_rigid(resting, independent_pixels, settings);

    let (affine, affine_covariance) = affine_map(&footprint, pixel_variance);
    let fit = Fit {
        target: projected_mean + displacement,
        variance: variance + floor + wrong_surface,
        resting_variance,
        doubt: if contest.kept > 0.5 { wrong_surface / total } else { 0.0 },
        order: if is_static { Order::Static } else { order },
        gradient: DMat2::IDENTITY + candidates.gradient(order),
        affine,
        affine_covariance,
    };
    fit.is_finite().then_some(fit)
}

/// The affine part by least squares, and the covariance of a row of it.
fn affine_map(footprint: &Displacements, pixel_variance: f64) -> (DMat2, DMat2) {
    let source = footprint.source;
    match source.determinant() > LEAST_EXTENT * trace(source) {
        true => (DMat2::IDENTITY + footprint.strain * source.inverse(), source.inverse() * pixel_variance),
        false => (DMat2::IDENTITY, DMat2::from_diagonal(DVec2::splat(NO_MAP))),
    }
}

/// Whether enough of the footprint is seen at both frames.
fn is_observed(moments: &FootprintMoments, settings: &MotionSettings) -> bool {
    moments.blend_weight > settings.min_blend_weight
        && moments.pixels >= settings.min_pixels.max(1)
        && moments.visible > settings.min_visible_share * moments.blend_weight
}

/// What reweighting tells of another surface in the footprint.
#[derive(Clone, Copy, Debug)]
struct Contest {
    /// Share of the visible blending weight that reweighting left, in (0, 1].
    kept: f64,
    /// What the affine model left before, px² per axis.
    before: f64,
    /// The part of it that one surface's noise does not explain: Welsch weights keep the same share of normal errors'
    /// weight and of their power, but of two surfaces' power next to nothing.
    between: f64,
}

impl Contest {
    fn of(moments: &FootprintMoments, footprint: &Displacements) -> Self {
        // `Σ w σ²` with `w = alpha T / σ²` is a sum of blending weights.
        let kept = (moments.variance / moments.visible).clamp(LEAST_KEPT, 1.0);
        let after = residual_variance(footprint.affine_residual_power(), footprint.pixels);
        let between = if footprint.pixels < LEAST_CONTESTED { 0.0 } else { moments.contest - after / kept };
        Self { kept, before: moments.contest, between: between.max(0.0) }
    }

    /// Variance of the tracks if they leave `residual` after reweighting: as much more as the weights took from it, but no
    /// more than there was. What turns or grows loses weight by its strain too.
    fn noise(&self, residual: f64) -> f64 {
        if self.before > 0.0 { (residual / self.kept).min(self.before.max(residual)) } else { residual }
    }

    fn is_contested(&self) -> bool {
        self.kept < UNCONTESTED && self.between > CONTESTED * self.before
    }

    /// Variance per axis, px², of which of two surfaces the Gaussian belongs to: to the other one with the probability of
    /// its share `1 − kept`, at a squared distance of `between / (kept (1 − kept))`.
    fn wrong_surface(&self) -> f64 {
        self.between / self.kept
    }
}

fn ridge(noise: f64, pixels: f64, settings: &MotionSettings) -> f64 {
    noise / (pixels * settings.expected_strain.max(LEAST_STRAIN).powi(2))
}

/// Unbiased variance per axis of what the affine model leaves of both; zero where nothing is left to estimate
/// it from.
fn residual_variance(power: f64, pixels: f64) -> f64 {
    // Three parameters per axis; the floor of one keeps tiny footprints from inflating their own residual.
    0.5 * power * pixels / (pixels - 3.0).max(1.0)
}

impl Fit {
    /// Whether the footprint is wide enough to show a deformation.
    pub(super) fn has_map(&self) -> bool {
        self.affine_covariance.x_axis.x < NO_MAP
    }

    fn is_finite(&self) -> bool {
        self.target.is_finite()
            && self.variance.is_finite()
            && self.resting_variance.is_finite()
            && self.doubt.is_finite()
            && self.gradient.is_finite()
            && self.affine.is_finite()
            && self.affine_covariance.is_finite()
    }
}
