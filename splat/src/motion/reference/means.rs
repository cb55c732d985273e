//! New means from the projection equations of all views.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix4xX, SVD, Vector4};

use super::Seen;

/// Singular value of a solution from which on it is refused.
const MAX_SINGULAR_VALUE: f64 = 1.0;
/// Sum of the absolute algebraic errors, normalised device coordinates times depth, from which on a solution is
/// refused.
const MAX_ERROR: f64 = 2.0;
/// Far above the dozen sweeps that a matrix of this size takes.
const MAX_SWEEPS: usize = 200;

/// Displacement and confidence: the homogeneous point that fits the equations `(c_x − n_x c_w) · X = 0` and
/// `(c_y − n_y c_w) · X = 0` of all views, none weighted.
///
/// The confidence `(1 − e) / (1 + σ)` is negative for algebraic errors `e` between one and the limit of two.
pub(super) fn solve(seen: &[Seen<'_>], mean: DVec3) -> Option<(DVec3, f64)> {
    let mut rows = Vec::with_capacity(2 * seen.len());
    for view in seen {
        let projected = view.camera.project_world(mean)?;
        rows.extend(equations(view, view.affine.of(projected)));
    }
    let (point, singular_value) = null_vector(&rows)?;
    if !(singular_value < MAX_SINGULAR_VALUE) {
        return None;
    }
    let position = point / point.w;
    let error: f64 = rows.iter().map(|row| row.dot(&position).abs()).sum();
    if !(error < MAX_ERROR) {
        return None;
    }
    let confidence = (1.0 - error) / (1.0 + singular_value);
    let translation = DVec3::new(position.x, position.y, position.z) - mean;
    translation.is_finite().then_some((translation, confidence))
}

/// The rows of a view that sees the point at `pixel`.
fn equations(view: &Seen<'_>, pixel: DVec2) -> [Vector4<f64>; 2] {
    let camera = view.camera;
    let by_axis = camera.rotation.transpose();
    let row = |axis: DVec3, offset: f64| Vector4::new(axis.x, axis.y, axis.z, offset);
    let x = row(by_axis.x_axis, camera.translation.x);
    let y = row(by_axis.y_axis, camera.translation.y);
    let z = row(by_axis.z_axis, camera.translation.z);
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    [
        (x * camera.fx + z * (camera.cx - pixel.x)) * (2.0 / width),
        (y * camera.fy + z * (camera.cy - pixel.y)) * (2.0 / height),
    ]
}

/// The left singular vector of the smallest singular value, and that value.
fn null_vector(rows: &[Vector4<f64>]) -> Option<(Vector4<f64>, f64)> {
    let stack = Matrix4xX::from_columns(rows);
    if !stack.iter().all(|value| value.is_finite()) {
        return None;
    }
    let svd = SVD::try_new(stack, true, false, f64::EPSILON, MAX_SWEEPS)?;
    let vectors = svd.u?;
    Some((vectors.column(3).into_owned(), svd.singular_values[3]))
}
