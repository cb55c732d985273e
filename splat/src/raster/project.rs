//! Stage 1: each Gaussian's footprint, colour and depth in one view.
//!
//! Works in f64: the cost is per Gaussian, not per pixel, and needles of aspect ratio 1e4 lose all of f32's digits
//! in the determinant of their projected covariance.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{ALPHA_MIN, FRUSTUM_MARGIN, LOW_PASS, NEAR_PLANE, bin::BAND_ROWS, colour};
use crate::{
    cameras::Camera,
    gaussians::Gaussians,
    simd::{Instructions, Simd, simd_kernel},
};

/// Gaussians per parallel task.
pub(super) const CHUNK: usize = 512;

/// All Gaussians in one view, in their order.
#[derive(Clone, Debug, Default)]
pub(super) struct Projection {
    /// Meaningless for those that reach no pixel.
    pub footprints: Vec<Footprint>,
    /// Camera z, world units; NaN for those that reach no pixel.
    pub depths: Vec<f64>,
    /// Bands of rows that they touch; none for those that reach no pixel.
    pub bands: Vec<BandRange>,
}

impl Projection {
    /// Whether the bounding box of a Gaussian's footprint reaches a pixel.
    pub(super) fn is_visible(&self, index: usize) -> bool {
        !self.depths[index].is_nan()
    }
}

/// Consecutive bands.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BandRange {
    /// The first.
    pub first: u32,
    /// One past the last.
    pub end: u32,
}

/// One Gaussian in one view.
///
/// The exponent at pixel offset `(ex, ey)` from the mean is written row by row,
/// `½ (ex - slope · ey)² · inverse_conditional + ½ ey² · inverse_yy`, which has no cancellation however thin and
/// slanted the footprint is: `slope = cov_xy / cov_yy` is the regression line through the row centres and
/// `1 / inverse_conditional = cov_xx - cov_xy² / cov_yy` the variance along a row.
#[derive(Clone, Copy, Debug, Default)]
#[repr(align(64))]
pub(super) struct Footprint {
    /// Projected mean, pixels.
    pub mean: [f64; 2],
    /// Row centre shift per row, `cov_xy / cov_yy`.
    pub slope: f64,
    /// Variance along a row, pixels².
    pub conditional: f64,
    /// Its inverse, 1 / pixels².
    pub inverse_conditional: f64,
    /// Inverse of the variance across rows, 1 / pixels².
    pub inverse_yy: f64,
    /// Opacity in `[0, 1]`.
    pub opacity: f64,
    /// Natural logarithm of the opacity.
    pub log_opacity: f64,
    /// Exponent at which alpha falls to [`ALPHA_MIN`], `ln(opacity / ALPHA_MIN)`.
    pub reach: f64,
    /// Rows between the mean and the end of the reach, pixels.
    pub half_height: f64,
    /// Rows between the mean and the rightmost point in reach, pixels.
    pub row_of_rightmost: f64,
    /// Colour seen from the camera, not below 0.
    pub colour: [f32; 3],
}

/// The local affine projection of one Gaussian, shared by this stage and its gradient.
pub(super) struct LocalProjection {
    /// Mean in camera axes.
    pub camera: DVec3,
    /// `x / z` and `y / z` after the clamp to the widened frustum.
    pub slope: [f64; 2],
    /// Whether the clamp was active, per axis.
    pub clamped: [bool; 2],
    /// Rows of `J W`: derivative of the pixel position by the world position.
    pub rows: [DVec3; 2],
    /// `R diag(exp(s))`: world axes of the Gaussian.
    pub axes: DMat3,
    /// The two rows of `J W R diag(exp(s))`.
    pub spread: [DVec3; 2],
}

/// `None` behind the near plane.
#[inline(always)]
pub(super) fn local_projection(
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
) -> Option<LocalProjection> {
    let point = camera.to_camera(gaussians.mean(index));
    if !(point.z > NEAR_PLANE) {
        return None;
    }
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let (slope_x, clamped_x) = clamp_slope(point.x / point.z, camera.fx, camera.cx, width);
    let (slope_y, clamped_y) = clamp_slope(point.y / point.z, camera.fy, camera.cy, height);
    let (scale_x, scale_y) = (camera.fx / point.z, camera.fy / point.z);
    let to_world = camera.rotation.transpose();
    let rows = [
        to_world * DVec3::new(scale_x, 0.0, -scale_x * slope_x),
        to_world * DVec3::new(0.0, scale_y, -scale_y * slope_y),
    ];
    let [a, b, c] = gaussians.log_scales[index];
    let scale = DVec3::new(a.into(), b.into(), c.into()).exp();
    let axes = DMat3::from_quat(gaussians.rotation(index)) * DMat3::from_diagonal(scale);
    let from_axes = axes.transpose();
    let spread = [from_axes * rows[0], from_axes * rows[1]];
    Some(LocalProjection {
        camera: point,
        slope: [slope_x, slope_y],
        clamped: [clamped_x, clamped_y],
        rows,
        axes,
        spread,
    })
}

#[inline(always)]
fn clamp_slope(slope: f64, focal: f64, principal: f64, size: f64) -> (f64, bool) {
    let margin = FRUSTUM_MARGIN * 0.5 * size / focal;
    let low = -(principal / focal + margin);
    let high = (size - principal) / focal + margin;
    if slope < low {
        return (low, true);
    }
    if slope > high {
        return (high, true);
    }
    (slope, false)
}

/// Projects every Gaussian; spherical harmonics up to `sh_degree`.
pub(super) fn project(
    instructions: Instructions,
    gaussians: &Gaussians,
    camera: &Camera,
    sh_degree: u32,
    projection: &mut Projection,
) {
    let count = gaussians.len();
    projection.footprints.resize(count, Footprint::default());
    projection.depths.resize(count, f64::NAN);
    projection.bands.resize(count, BandRange::default());
    let view = View { camera, centre: camera.centre(), sh_degree };
    let arrays = (
        projection.footprints.par_chunks_mut(CHUNK),
        projection.depths.par_chunks_mut(CHUNK),
        projection.bands.par_chunks_mut(CHUNK),
    );
    arrays.into_par_iter().enumerate().for_each(|(chunk, (footprints, depths, bands))| {
        project_chunk(instructions, gaussians, &view, chunk * CHUNK, footprints, depths, bands);
    });
}

/// A view as the stages of a Gaussian need it.
pub(super) struct View<'a> {
    pub camera: &'a Camera,
    /// Of the camera, world units.
    pub centre: DVec3,
    pub sh_degree: u32,
}

simd_kernel! {
    /// The Gaussians from `first` on.
    fn project_chunk(
        gaussians: &Gaussians,
        view: &View<'_>,
        first: usize,
        footprints: &mut [Footprint],
        depths: &mut [f64],
        bands: &mut [BandRange],
    ) = project_kernel
}

/// Plain double precision that gains from three-operand instructions.
#[inline(always)]
fn project_kernel<S: Simd>(
    gaussians: &Gaussians,
    view: &View<'_>,
    first: usize,
    footprints: &mut [Footprint],
    depths: &mut [f64],
    bands: &mut [BandRange],
) {
    for (place, slot) in footprints.iter_mut().enumerate() {
        let projected = footprint(gaussians, first + place, view);
        (depths[place], bands[place]) = match projected {
            Some((footprint, depth, band_range)) => {
                *slot = footprint;
                (depth, band_range)
            }
            None => (f64::NAN, BandRange::default()),
        };
    }
}

#[inline(always)]
fn footprint(gaussians: &Gaussians, index: usize, view: &View<'_>) -> Option<(Footprint, f64, BandRange)> {
    let camera = view.camera;
    let opacity = gaussians.opacity(index);
    let log_opacity = opacity.ln();
    let reach = log_opacity - f64::from(ALPHA_MIN).ln();
    if !(reach >= 0.0) {
        return None;
    }
    let local = local_projection(gaussians, index, camera)?;
    let mean = [
        camera.fx * local.camera.x / local.camera.z + camera.cx,
        camera.fy * local.camera.y / local.camera.z + camera.cy,
    ];
    let [across, along] = local.spread;
    let (xx, xy, yy) =
        (across.length_squared() + LOW_PASS, across.dot(along), along.length_squared() + LOW_PASS);
    let slope = xy / yy;
    let conditional = conditional_variance(across, along, yy);
    if !(mean[0].is_finite() && mean[1].is_finite() && xx.is_finite() && yy.is_finite() && conditional > 0.0)
    {
        return None;
    }
    let (half_width, half_height) = ((2.0 * reach * xx).sqrt(), (2.0 * reach * yy).sqrt());
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let outside = mean[0] + half_width < 0.5
        || mean[0] - half_width > width - 0.5
        || mean[1] + half_height < 0.5
        || mean[1] - half_height > height - 0.5;
    if outside {
        return None;
    }
    let first_row = (mean[1] - half_height - 0.5).max(0.0) as usize;
    let last_row = (mean[1] + half_height - 0.5).min(height - 1.0) as usize;
    let colour = colour::seen_from(gaussians, index, view.centre, view.sh_degree);
    if !colour.iter().all(|channel| channel.is_finite()) {
        return None;
    }
    let bands = BandRange { first: (first_row / BAND_ROWS) as u32, end: (last_row / BAND_ROWS + 1) as u32 };
    let footprint = Footprint {
        mean,
        slope,
        conditional,
        inverse_conditional: 1.0 / conditional,
        inverse_yy: 1.0 / yy,
        opacity,
        log_opacity,
        reach,
        half_height,
        row_of_rightmost: half_width * xy / xx,
        colour,
    };
    Some((footprint, local.camera.z, bands))
}

/// `cov_xx - cov_xy² / cov_yy` as a sum of non-negative terms (Lagrange's identity), exact for needles.
#[inline(always)]
pub(super) fn conditional_variance(across: DVec3, along: DVec3, yy: f64) -> f64 {
    let unblurred = across.cross(along).length_squared() + LOW_PASS * across.length_squared();
    LOW_PASS + unblurred / yy
}
