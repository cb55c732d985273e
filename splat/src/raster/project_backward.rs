//! Stage 5: from the gradient of a footprint to the gradient of the Gaussian's parameters, in f64.

use glam::{DMat3, DVec3};

use super::{
    bin::Bins,
    blend::Band,
    blend_backward::FootprintGradient,
    colour,
    project::{Footprint, LocalProjection, View, local_projection},
};
use crate::{
    cameras::Camera,
    gaussians::Gaussians,
    simd::{Simd, prefetch, simd_kernel},
};

/// Gaussians whose sums are asked for ahead.
const AHEAD: usize = 4;

/// Gradients of consecutive Gaussians by their parameters, of the shapes of `GaussianGradients`.
pub(super) struct GradientChunk<'a> {
    pub means: &'a mut [[f32; 3]],
    pub rotations: &'a mut [[f32; 4]],
    pub log_scales: &'a mut [[f32; 3]],
    pub logit_opacities: &'a mut [f32],
    pub sh: &'a mut [f32],
    /// By the projected mean, per pixel.
    pub projected_means: &'a mut [[f32; 2]],
}

impl GradientChunk<'_> {
    #[inline(always)]
    fn set(&mut self, place: usize, geometry: &GeometryGradient) {
        self.means[place] = geometry.mean;
        self.rotations[place] = geometry.rotation;
        self.log_scales[place] = geometry.log_scale;
        self.logit_opacities[place] = geometry.logit_opacity;
        self.projected_means[place] = geometry.projected_mean;
    }
}

simd_kernel! {
    /// Writes the gradients of the Gaussians from `first` on; zero for those that the view does not show or that are not
    /// `active` (empty: all are).
    pub(super) fn project_backward(
        gaussians: &Gaussians,
        bins: &Bins,
        bands: &[Band],
        view: &View<'_>,
        active: &[bool],
        first: usize,
        gradients: GradientChunk<'_>,
    ) = project_backward_kernel
}

#[inline(always)]
fn project_backward_kernel<S: Simd>(
    gaussians: &Gaussians,
    bins: &Bins,
    bands: &[Band],
    view: &View<'_>,
    active: &[bool],
    first: usize,
    mut gradients: GradientChunk<'_>,
) {
    let stride = gaussians.sh_coefficients() * 3;
    let count = gradients.means.len();
    for place in 0..count {
        let index = first + place;
        prefetch_sums(bins, bands, first + (place + AHEAD).min(count - 1));
        let footprint = &bins.projection.footprints[index];
        let is_wanted = bins.projection.is_visible(index) && active.get(index).copied().unwrap_or(true);
        let mut geometry = GeometryGradient::default();
        if is_wanted {
            let gradient = sum_over_bands(bins, bands, index);
            let sh = &mut gradients.sh[place * stride..(place + 1) * stride];
            geometry = gradient_of(gaussians, index, footprint, view, &gradient, sh);
        }
        // Beyond single precision there is no direction to follow; a step of infinity would spread.
        if !(is_wanted && geometry.is_finite()) {
            geometry = GeometryGradient::default();
            gradients.sh[place * stride..(place + 1) * stride].fill(0.0);
        }
        gradients.set(place, &geometry);
    }
}

/// Bands keep their sums in depth order, which is no order in memory.
#[inline(always)]
fn prefetch_sums(bins: &Bins, bands: &[Band], index: usize) {
    let (first_band, places) = bins.places_of(index);
    for (band, &place) in bands[first_band..].iter().zip(places) {
        prefetch(&band.sums[place as usize]);
    }
}

#[inline(always)]
fn sum_over_bands(bins: &Bins, bands: &[Band], index: usize) -> FootprintGradient {
    let mut gradient = FootprintGradient::default();
    let (first_band, places) = bins.places_of(index);
    for (band, &place) in bands[first_band..].iter().zip(places) {
        gradient.add(&band.sums[place as usize]);
    }
    gradient
}

/// Gradient of the loss by the geometry of one Gaussian.
#[derive(Clone, Copy, Debug, Default)]
struct GeometryGradient {
    /// By the world mean.
    mean: [f32; 3],
    /// By the stored quaternion `w, x, y, z`.
    rotation: [f32; 4],
    /// By the logarithm of the scales.
    log_scale: [f32; 3],
    /// By the logit of the opacity.
    logit_opacity: f32,
    /// By the projected mean, per pixel.
    projected_mean: [f32; 2],
    /// By the colour; every spherical-harmonic gradient is a share of it.
    colour: [f32; 3],
}

impl GeometryGradient {
    #[inline(always)]
    fn is_finite(&self) -> bool {
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        finite(&self.mean)
            && finite(&self.rotation)
            && finite(&self.log_scale)
            && self.logit_opacity.is_finite()
            && finite(&self.projected_mean)
            && finite(&self.colour)
    }
}

/// Turns the gradient of a footprint into that of its Gaussian, number `index`; writes the colour's share to
/// `sh_gradient` (`K × 3`).
#[inline(always)]
fn gradient_of(
    gaussians: &Gaussians,
    index: usize,
    footprint: &Footprint,
    view: &View<'_>,
    gradient: &FootprintGradient,
    sh_gradient: &mut [f32],
) -> GeometryGradient {
    let camera = view.camera;
    let Some(local) = local_projection(gaussians, index, camera) else {
        sh_gradient.fill(0.0);
        return GeometryGradient::default();
    };
    let projected_mean = mean_gradient(footprint, gradient);
    let spread = spread_gradient(footprint, gradient, &local);
    let rows = [local.axes * spread[0], local.axes * spread[1]];
    let in_camera = camera_gradient(camera, &local, projected_mean, rows);
    let [red, green, blue] = gradient.colour;
    let colour = [red as f32, green as f32, blue as f32];
    let from_colour = colour::backward(gaussians, index, view.centre, view.sh_degree, colour, sh_gradient);
    let mean = camera.rotation.transpose() * in_camera + from_colour;
    let axes = outer(local.rows[0], spread[0]) + outer(local.rows[1], spread[1]);
    let (log_scale, [w, x, y, z]) = axes_gradient(gaussians, index, &local, axes);
    GeometryGradient {
        mean: mean.as_vec3().to_array(),
        rotation: [w as f32, x as f32, y as f32, z as f32],
        log_scale: log_scale.as_vec3().to_array(),
        logit_opacity: (gradient.v * (1.0 - footprint.opacity)) as f32,
        projected_mean: [projected_mean[0] as f32, projected_mean[1] as f32],
        colour,
    }
}

#[inline(always)]
fn outer(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

/// By the projected mean: alpha's exponent falls with `d` along the row and with `dy` across.
#[inline(always)]
fn mean_gradient(footprint: &Footprint, gradient: &FootprintGradient) -> [f64; 2] {
    let x = footprint.inverse_conditional * gradient.v_d;
    let y = -footprint.slope * x + footprint.inverse_yy * gradient.v_y;
    [x, y]
}

/// By the two rows of `J W R diag(exp(s))`, through `inverse_conditional`, `slope` and `inverse_yy`.
#[inline(always)]
fn spread_gradient(
    footprint: &Footprint,
    gradient: &FootprintGradient,
    local: &LocalProjection,
) -> [DVec3; 2] {
    let (k, s) = (footprint.inverse_conditional, footprint.slope);
    let by_variance = 0.5 * k * k * gradient.v_dd;
    let by_slope = footprint.inverse_yy * k * gradient.v_dy;
    let by_yy_alone = 0.5 * gradient.v_yy * footprint.inverse_yy * footprint.inverse_yy;
    // The variance along a row is the square of what is left of `across` besides its share along `along`: written so, no
    // product of a needle's length with itself has to cancel.
    let [across, along] = local.spread;
    let rest = across - along * s;
    [
        rest * (2.0 * by_variance) + along * by_slope,
        rest * (by_slope - 2.0 * s * by_variance) + along * (2.0 * by_yy_alone - s * by_slope),
    ]
}

/// By the mean in camera axes, through the projected mean and through the Jacobian's entries.
#[inline(always)]
fn camera_gradient(camera: &Camera, local: &LocalProjection, mean: [f64; 2], rows: [DVec3; 2]) -> DVec3 {
    let inverse_z = 1.0 / local.camera.z;
    let jacobian = [camera.rotation * rows[0], camera.rotation * rows[1]];
    let position = [local.camera.x, local.camera.y];
    let focal = [camera.fx, camera.fy];
    let mut gradient = DVec3::ZERO;
    for axis in 0..2 {
        let scale = focal[axis] * inverse_z;
        gradient[axis] += mean[axis] * scale;
        gradient.z -= mean[axis] * scale * position[axis] * inverse_z;
        // J[axis][axis] = f / z and J[axis][z] = -f · slope / z.
        gradient.z -= jacobian[axis][axis] * scale * inverse_z;
        let by_z_entry = jacobian[axis].z * scale;
        gradient.z += by_z_entry * local.slope[axis] * inverse_z;
        if !local.clamped[axis] {
            gradient[axis] -= by_z_entry * inverse_z;
            gradient.z += by_z_entry * local.slope[axis] * inverse_z;
        }
    }
    gradient
}

/// By log scales and quaternion, from the gradient by `R diag(exp(s))`.
#[inline(always)]
fn axes_gradient(
    gaussians: &Gaussians,
    index: usize,
    local: &LocalProjection,
    axes: DMat3,
) -> (DVec3, [f64; 4]) {
    let log_scale = DVec3::new(
        axes.x_axis.dot(local.axes.x_axis),
        axes.y_axis.dot(local.axes.y_axis),
        axes.z_axis.dot(local.axes.z_axis),
    );
    let scale = gaussians.log_scales[index].map(|value| f64::from(value).exp());
    let by_rotation =
        DMat3::from_cols(axes.x_axis * scale[0], axes.y_axis * scale[1], axes.z_axis * scale[2]);
    (log_scale, quaternion_gradient(gaussians, index, by_rotation))
}

#[inline(always)]
fn quaternion_gradient(gaussians: &Gaussians, index: usize, g: DMat3) -> [f64; 4] {
    let q = gaussians.rotation(index);
    let (w, x, y, z) = (q.w, q.x, q.y, q.z);
    // g.col(c)[r] is the gradient by entry (r, c) of the rotation matrix.
    let at = |row: usize, column: usize| g.col(column)[row];
    let by_unit = [
        2.0 * (z * (at(1, 0) - at(0, 1)) + y * (at(0, 2) - at(2, 0)) + x * (at(2, 1) - at(1, 2))),
        2.0 * (y * (at(0, 1) + at(1, 0)) + z * (at(0, 2) + at(2, 0)) + w * (at(2, 1) - at(1, 2)))
            - 4.0 * x * (at(1, 1) + at(2, 2)),
        2.0 * (x * (at(0, 1) + at(1, 0)) + z * (at(1, 2) + at(2, 1)) + w * (at(0, 2) - at(2, 0)))
            - 4.0 * y * (at(0, 0) + at(2, 2)),
        2.0 * (x * (at(0, 2) + at(2, 0)) + y * (at(1, 2) + at(2, 1)) + w * (at(1, 0) - at(0, 1)))
            - 4.0 * z * (at(0, 0) + at(1, 1)),
    ];
    let unit = [w, x, y, z];
    let along: f64 = (0..4).map(|i| unit[i] * by_unit[i]).sum();
    let norm = gaussians.rotations[index].iter().map(|&value| f64::from(value).powi(2)).sum::<f64>().sqrt();
    if !(norm > 0.0 && norm.is_finite()) {
        return [0.0; 4];
    }
    std::array::from_fn(|i| (by_unit[i] - unit[i] * along) / norm)
}
