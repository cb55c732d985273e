//! The plain way to the same answer: dense least squares over all views with nalgebra, and what first-order
//! propagation predicts of its error.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};
use splat::{cameras::Camera, motion::MotionSettings};

use super::prescribed::{Noise, Sample, Scene, Tracked, major_axes};

/// Where one view sees the Gaussian go.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight<'a> {
    pub camera: &'a Camera,
    pub pixel: DVec2,
    /// Standard deviation per axis of `pixel`, the error of the affine model included.
    pub deviation: f64,
    /// Variance per axis that the shipped path may assume: the track's own, its correlation and the floor.
    pub assumed_variance: f64,
}

/// What the views of one Gaussian determine.
#[derive(Clone, Copy, Debug)]
pub(super) struct Prediction {
    /// Least squares over all right views.
    pub position: DVec3,
    /// Standard deviation of `position`, all directions together.
    pub deviation: f64,
    /// Standard deviation in the worst direction that the shipped path may assume.
    pub assumed: f64,
    /// From the first camera that sees it.
    pub depth: f64,
    /// Views that see it, wrong ones not counted.
    pub views: usize,
}

/// Standard deviation that exact tracks claim, pixels.
pub(super) const LEAST_CLAIM: f64 = 1e-3;

fn vector(v: DVec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

/// A footprint's motion `to = from + a + B (from − mean)` by weighted least squares.
struct Affine {
    /// Where the mean goes.
    target: DVec2,
    /// `‖B‖`.
    strain: f64,
    /// Weighted mean square per axis of what remains.
    residual: f64,
}

fn affine(samples: &[Sample], mean: DVec2) -> Affine {
    let weight: f64 = samples.iter().map(|s| s.weight).sum();
    let root = |row: usize| (samples[row].weight / weight).sqrt();
    let design = DMatrix::from_fn(samples.len(), 3, |row, column| {
        let offset = samples[row].from - mean;
        root(row) * [1.0, offset.x, offset.y][column]
    });
    let right = DMatrix::from_fn(samples.len(), 2, |row, column| {
        root(row) * (samples[row].to - samples[row].from)[column]
    });
    let svd = design.clone().svd(true, true);
    let solution = svd.solve(&right, 1e-12 * svd.singular_values.max()).expect("both factors were asked for");
    Affine {
        target: mean + DVec2::new(solution[(0, 0)], solution[(0, 1)]),
        strain: solution.rows(1, 2).norm(),
        residual: 0.5 * (design * &solution - right).norm_squared(),
    }
}

/// What the right views say about Gaussian `index`.
pub(super) fn sights<'a>(scene: &'a impl Tracked, index: usize, settings: &MotionSettings) -> Vec<Sight<'a>> {
    let mean = scene.gaussians().mean(index);
    let right = scene.cameras().iter().filter(|camera| !scene.has_outlier(mean, camera));
    right.filter_map(|camera| sight(scene, index, camera, settings)).collect()
}

fn sight<'a>(
    scene: &impl Tracked,
    index: usize,
    camera: &'a Camera,
    settings: &MotionSettings,
) -> Option<Sight<'a>> {
    let mean = scene.gaussians().mean(index);
    let projected = camera.project_world(mean)?;
    let exact = camera.project_world(scene.motion().of(mean)).filter(|&pixel| camera.contains(pixel))?;
    let all = scene.samples(index, camera, true);
    let weight = |samples: &[Sample]| samples.iter().map(|s| s.weight).sum::<f64>();
    let visible = |samples: Vec<Sample>| samples.into_iter().filter(|s| s.is_visible).collect::<Vec<_>>();
    let blend_weight = weight(&all);
    let seen = visible(all);
    let is_observed = weight(&seen) > settings.min_visible_share * blend_weight
        && blend_weight > settings.min_blend_weight
        && seen.len() >= settings.min_pixels as usize;
    if !is_observed {
        return None;
    }
    let fit = affine(&seen, projected);
    let noiseless = affine(&visible(scene.samples(index, camera, false)), projected);
    let centroid = seen.iter().map(|s| s.from * s.weight).sum::<DVec2>() / weight(&seen);
    // A fit may as well take the centroid's motion for the mean's.
    let model_error =
        (noiseless.target - exact).length() + (centroid - projected).length() * noiseless.strain;
    let effective = weight(&seen).powi(2) / seen.iter().map(|s| s.weight * s.weight).sum::<f64>();
    let noise = match scene.noise() {
        Noise::Independent(deviation) => deviation / effective.sqrt(),
        Noise::Alike(deviation) => deviation,
    };
    let independent = 1.0 + (effective - 1.0) / settings.noise_correlation_area;
    let claimed = scene.noise().deviation().max(LEAST_CLAIM).powi(2);
    let assumed_variance = claimed.max(fit.residual) / independent + settings.noise_floor.powi(2);
    Some(Sight { camera, pixel: fit.target, deviation: noise.hypot(model_error), assumed_variance })
}

/// Gauss-Newton on all sights at once from the true position, to convergence.
pub(super) fn predict(sights: &[Sight<'_>], truth: DVec3) -> Option<Prediction> {
    let first = sights.first()?;
    let mut offset = Vector3::zeros();
    for _ in 0..30 {
        let (design, residual) = linearise(sights, truth + DVec3::from_slice(offset.as_slice()))?;
        let svd = design.svd(true, true);
        let step = svd.solve(&residual, 1e-14 * svd.singular_values.max()).ok()?;
        let step = Vector3::new(step[0], step[1], step[2]);
        offset += step;
        if !(step.norm() > 1e-14 * offset.norm()) {
            break;
        }
    }
    let position = truth + DVec3::from_slice(offset.as_slice());
    let (covariance, assumed) = covariances(sights, truth);
    let depth = first.camera.to_camera(truth).z;
    let assumed = assumed.symmetric_eigenvalues().max().max(0.0).sqrt();
    Some(Prediction { position, deviation: covariance.trace().sqrt(), assumed, depth, views: sights.len() })
}

fn linearise(sights: &[Sight<'_>], at: DVec3) -> Option<(DMatrix<f64>, DVector<f64>)> {
    let mut design = DMatrix::zeros(2 * sights.len(), 3);
    let mut right = DVector::zeros(2 * sights.len());
    for (row, sight) in sights.iter().enumerate() {
        let weight = sight.assumed_variance.sqrt().recip();
        let residual = sight.pixel - sight.camera.project_world(at)?;
        let jacobian = sight.camera.world_jacobian(sight.camera.to_camera(at));
        for axis in 0..2 {
            design.row_mut(2 * row + axis).copy_from(&(vector(jacobian[axis]) * weight).transpose());
            right[2 * row + axis] = residual[axis] * weight;
        }
    }
    Some((design, right))
}

/// Covariance of the least-squares position under the true noise, and the one that follows from the assumed noise.
fn covariances(sights: &[Sight<'_>], at: DVec3) -> (Matrix3<f64>, Matrix3<f64>) {
    let (mut normal, mut spread) = (Matrix3::zeros(), Matrix3::zeros());
    for sight in sights {
        let [u, v] = sight.camera.world_jacobian(sight.camera.to_camera(at)).map(vector);
        let power = u * u.transpose() + v * v.transpose();
        normal += power / sight.assumed_variance;
        spread += power * (sight.deviation / sight.assumed_variance).powi(2);
    }
    // Scaled to a unit trace, so that the pseudo-inverse's cut-off is relative.
    let scale = normal.trace();
    let eigen = (normal / scale).symmetric_eigen();
    let inverse = eigen.eigenvectors
        * Matrix3::from_diagonal(&eigen.eigenvalues.map(|value| 1.0 / value.max(1e-15)))
        * eigen.eigenvectors.transpose()
        / scale;
    (inverse * spread * inverse, inverse)
}

/// Standard deviation in radians of the rotation that least squares on every tracked point of a Gaussian gives, its
/// translation free as well. Points err by the noise of the tracks and by a share of the footprint's size.
pub(super) fn rotation_deviation(scene: &Scene, index: usize, share: f64) -> Option<f64> {
    let centre = scene.motion.of(scene.gaussians.mean(index));
    let (mut normal, mut spread) = (Matrix6::zeros(), Matrix6::zeros());
    // Rotations about the mean in units that make both halves of the unknowns alike.
    let size = major_axes(&scene.gaussians, index)[0].length();
    for camera in scene.cameras() {
        let samples = scene.samples(index, camera, false);
        let pixels_per_unit = camera.fx / camera.to_camera(centre).z;
        let variance = scene.noise.deviation().powi(2) + (share * size * pixels_per_unit).powi(2);
        for sample in samples.iter().filter(|sample| sample.is_visible) {
            let point = scene.motion.of(sample.point);
            let lever = (point - centre) / size;
            for row in camera.world_jacobian(camera.to_camera(point)) {
                let turn = lever.cross(row);
                let row = Vector6::new(row.x, row.y, row.z, turn.x, turn.y, turn.z);
                normal += row * row.transpose() * sample.weight;
                spread += row * row.transpose() * sample.weight * sample.weight * variance;
            }
        }
    }
    let inverse = normal.try_inverse()?;
    let covariance = inverse * spread * inverse;
    let turn = covariance.fixed_view::<3, 3>(3, 3).trace().sqrt() / size;
    turn.is_finite().then_some(turn)
}
