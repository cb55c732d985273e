//! New rotations from the covariance that all views solve for.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector6};

use super::Seen;
use crate::{cameras::Camera, gaussians::Gaussians};

/// Least determinant of the normal matrix over the total weight.
const MIN_DETERMINANT: f64 = 1e-9;
/// Sum of the absolute residuals, px², over the total weight, from which on a solution is refused.
const MAX_ERROR: f64 = 0.5;
/// The slope of a ray is clamped to this multiple of the image border's, as in 3D Gaussian Splatting.
const SLOPE_CLAMP: f64 = 1.3;
/// Far above the few sweeps that a 3×3 matrix takes.
const MAX_SWEEPS: usize = 200;

const PERMUTATIONS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// Rotation and confidence: the eigenvectors of the covariance whose projections are `A S Aᵀ` in every view, in
/// the order nearest to the old axes.
///
/// Their signs are as the eigenvalue solver leaves them, so that most results are no rotation of the old axes.
pub(super) fn solve(seen: &[Seen<'_>], gaussians: &Gaussians, index: usize) -> Option<(DQuat, f64)> {
    let equations: Vec<Equation> = seen.iter().flat_map(|view| equations(view, gaussians, index)).collect();
    let (covariance, confidence) = solve_covariance(&equations, seen)?;
    let (axes, deviations) = axes(covariance)?;
    let old = gaussians.rotation(index);
    let old_deviations = gaussians.log_scales[index].map(|log| f64::from(log).exp());
    let ordered = nearest_order(axes, deviations, DMat3::from_quat(old), old_deviations);
    let turn = (DQuat::from_mat3(&ordered) * old.conjugate()).normalize();
    (turn.is_finite() && confidence.is_finite()).then_some((turn, confidence))
}

/// `coefficients · (xx, xy, xz, yy, yz, zz) = value`, with the weight of its view.
struct Equation {
    coefficients: Vector6<f64>,
    value: f64,
    weight: f64,
}

fn equations(view: &Seen<'_>, gaussians: &Gaussians, index: usize) -> [Equation; 3] {
    let [u, v] = clamped_jacobian(view.camera, gaussians.mean(index));
    let covariance = gaussians.covariance(index);
    let footprint = glam::DMat2::from_cols(
        DVec2::new(u.dot(covariance * u), v.dot(covariance * u)),
        DVec2::new(u.dot(covariance * v), v.dot(covariance * v)),
    );
    let moved = view.affine.gradient * footprint * view.affine.gradient.transpose();
    let equation = |a: DVec3, b: DVec3, value: f64| Equation {
        coefficients: Vector6::new(
            a.x * b.x,
            a.x * b.y + a.y * b.x,
            a.x * b.z + a.z * b.x,
            a.y * b.y,
            a.y * b.z + a.z * b.y,
            a.z * b.z,
        ),
        value,
        weight: view.weight,
    };
    [equation(u, u, moved.x_axis.x), equation(u, v, moved.y_axis.x), equation(v, v, moved.y_axis.y)]
}

/// Jacobian of the pixel position at the old mean.
fn clamped_jacobian(camera: &Camera, mean: DVec3) -> [DVec3; 2] {
    let position = camera.to_camera(mean);
    let limit = |size: u32, focal: f64| SLOPE_CLAMP * 0.5 * f64::from(size) / focal;
    let clamp = |slope: f64, limit: f64| slope.clamp(-limit.abs(), limit.abs());
    let x = clamp(position.x / position.z, limit(camera.width, camera.fx));
    let y = clamp(position.y / position.z, limit(camera.height, camera.fy));
    camera.world_jacobian(DVec3::new(x * position.z, y * position.z, position.z))
}

/// Weighted least squares by explicit inverse of the 6×6 normal matrix; covariance and confidence.
fn solve_covariance(equations: &[Equation], seen: &[Seen<'_>]) -> Option<(DMat3, f64)> {
    let mut normal = Matrix6::zeros();
    let mut right = Vector6::zeros();
    for Equation { coefficients, value, weight } in equations {
        normal += coefficients * coefficients.transpose() * *weight;
        right += coefficients * (value * weight);
    }
    let weight: f64 = seen.iter().map(|view| view.weight).sum();
    let determinant = (normal / weight).determinant().abs();
    if !(determinant > MIN_DETERMINANT) {
        return None;
    }
    let solution = normal.try_inverse()? * right;
    let error: f64 =
        equations.iter().map(|e| (e.coefficients.dot(&solution) - e.value).abs()).sum::<f64>() / weight;
    if !(error < MAX_ERROR) {
        return None;
    }
    let ratio = determinant / MIN_DETERMINANT;
    // One for determinants beyond the range of numbers.
    let by_determinant = if ratio.is_finite() { (ratio - 1.0) / (ratio + 1.0) } else { 1.0 };
    let confidence = weight / (1.0 + weight) * by_determinant * (1.0 - error);
    let [xx, xy, xz, yy, yz, zz] = solution.into();
    let covariance = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
    Some((covariance, confidence))
}

/// Eigenvectors and square roots of the eigenvalues; `None` if one is negative.
fn axes(covariance: DMat3) -> Option<([DVec3; 3], [f64; 3])> {
    if !covariance.is_finite() {
        return None;
    }
    let matrix = Matrix3::from_column_slice(&covariance.to_cols_array());
    let SymmetricEigen { eigenvectors, eigenvalues } =
        SymmetricEigen::try_new(matrix, f64::EPSILON, MAX_SWEEPS)?;
    if eigenvalues.iter().any(|&value| value < 0.0) {
        return None;
    }
    let axis = |k: usize| {
        let column = eigenvectors.column(k);
        DVec3::new(column[0], column[1], column[2])
    };
    Some(([0, 1, 2].map(axis), [0, 1, 2].map(|k| eigenvalues[k].sqrt())))
}

/// The axes as columns, in the order with the least sum of absolute differences to the old axes and deviations.
fn nearest_order(axes: [DVec3; 3], deviations: [f64; 3], old: DMat3, old_deviations: [f64; 3]) -> DMat3 {
    let distance = |order: &[usize; 3]| -> f64 {
        (0..3)
            .map(|k| {
                let turned = (axes[order[k]] - old.col(k)).abs().element_sum();
                turned + (deviations[order[k]] - old_deviations[k]).abs()
            })
            .sum()
    };
    let best = PERMUTATIONS.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let [x, y, z] = *best.unwrap_or(&PERMUTATIONS[0]);
    DMat3::from_cols(axes[x], axes[y], axes[z])
}
