//! Stage 5: from the gradient of a footprint to the gradient of the Gaussian's parameters, in f64.

use glam::{DMat3, DVec3};

use super::{
    blend_backward::FootprintGradient,
    colour,
    project::{Footprint, LocalProjection, local_projection},
};
use crate::{cameras::Camera, gaussians::Gaussians};

/// Gradient of the loss by the geometry of one Gaussian.
#[derive(Clone, Copy, Debug, Default)]
pub struct GeometryGradient {
    /// By the world mean.
    pub mean: [f32; 3],
    /// By the stored quaternion `w, x, y, z`.
    pub rotation: [f32; 4],
    /// By the logarithm of the scales.
    pub log_scale: [f32; 3],
    /// By the logit of the opacity.
    pub logit_opacity: f32,
    /// By the projected mean, per pixel.
    pub projected_mean: [f32; 2],
}

impl GeometryGradient {
    pub(super) fn is_finite(&self) -> bool {
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        finite(&self.mean)
            && finite(&self.rotation)
            && finite(&self.log_scale)
            && self.logit_opacity.is_finite()
            && finite(&self.projected_mean)
    }
}

/// Turns the gradient of a footprint into that of its Gaussian; adds the colour's share to `sh_gradient` (`K × 3`).
pub fn project_backward(
    gaussians: &Gaussians,
    footprint: &Footprint,
    camera: &Camera,
    centre: DVec3,
    sh_degree: u32,
    gradient: &FootprintGradient,
    sh_gradient: &mut [f32],
) -> GeometryGradient {
    let index = footprint.index as usize;
    let Some(local) = local_projection(gaussians, index, camera) else {
        return GeometryGradient::default();
    };
    let projected_mean = mean_gradient(footprint, gradient);
    let spread = spread_gradient(footprint, gradient, &local);
    let rows = [local.axes * spread[0], local.axes * spread[1]];
    let in_camera = camera_gradient(camera, &local, projected_mean, rows);
    let colour_gradient = gradient.colour.map(|value| value as f32);
    let from_colour = colour::backward(gaussians, index, centre, sh_degree, colour_gradient, sh_gradient);
    let mean = camera.rotation.transpose() * in_camera + from_colour;
    let axes = outer(local.rows[0], spread[0]) + outer(local.rows[1], spread[1]);
    let (log_scale, rotation) = axes_gradient(gaussians, index, &local, axes);
    GeometryGradient {
        mean: mean.as_vec3().to_array(),
        rotation: rotation.map(|value| value as f32),
        log_scale: log_scale.as_vec3().to_array(),
        logit_opacity: (gradient.v * (1.0 - footprint.opacity)) as f32,
        projected_mean: projected_mean.map(|value| value as f32),
    }
}

fn outer(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

/// By the projected mean: alpha's exponent falls with `d` along the row and with `dy` across.
fn mean_gradient(footprint: &Footprint, gradient: &FootprintGradient) -> [f64; 2] {
    let x = footprint.inverse_conditional * gradient.v_d;
    let y = -footprint.slope * x + footprint.inverse_yy * gradient.v_y;
    [x, y]
}

/// By the two rows of `J W R diag(exp(s))`, through `inverse_conditional`, `slope` and `inverse_yy`.
fn spread_gradient(
    footprint: &Footprint,
    gradient: &FootprintGradient,
    local: &LocalProjection,
) -> [DVec3; 2] {
    let (k, s) = (footprint.inverse_conditional, footprint.slope);
    let by_conditional = -0.5 * gradient.v_dd;
    let by_slope = k * gradient.v_dy;
    let by_yy_alone = 0.5 * gradient.v_yy * footprint.inverse_yy * footprint.inverse_yy;
    // k = 1 / (xx - xy² / yy) and s = xy / yy.
    let xx = -k * k * by_conditional;
    let xy = 2.0 * k * k * s * by_conditional + footprint.inverse_yy * by_slope;
    let yy = -k * k * s * s * by_conditional - s * footprint.inverse_yy * by_slope + by_yy_alone;
    let [across, along] = local.spread;
    [across * (2.0 * xx) + along * xy, across * xy + along * (2.0 * yy)]
}

/// By the mean in camera axes, through the projected mean and through the Jacobian's entries.
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
