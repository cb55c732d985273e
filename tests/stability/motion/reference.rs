//! The plain way to the same answer: dense least squares over all views with nalgebra, and what first-order
//! propagation predicts of its error.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix3x6, Matrix6, Vector3, Vector6};
use splat::{
    cameras::Camera,
    motion::{MotionField, MotionOrigin, MotionSettings},
};

use super::prescribed::{Sample, Scene, Tracked, effective_samples, major_axes};

/// Where one view sees the Gaussian go.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight<'a> {
    pub camera: &'a Camera,
    pub pixel: DVec2,
    /// Standard deviation per axis of `pixel`, the error of the affine model included.
    pub deviation: f64,
    /// Variance per axis that the shipped path may assume: the track's own, its correlation and the floor.
    pub assumed_variance: f64,
    /// The part of it that the tracks claim, and the floor.
    pub claimed_variance: f64,
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
    // About the centroid, so that samples on a line share their common motion among no other unknowns.
    let centroid = samples.iter().map(|s| s.from * s.weight).sum::<DVec2>() / weight;
    let root = |row: usize| (samples[row].weight / weight).sqrt();
    let design = DMatrix::from_fn(samples.len(), 3, |row, column| {
        let offset = samples[row].from - centroid;
        root(row) * [1.0, offset.x, offset.y][column]
    });
    let right = DMatrix::from_fn(samples.len(), 2, |row, column| {
        root(row) * (samples[row].to - samples[row].from)[column]
    });
    let svd = design.clone().svd(true, true);
    // What lies on a line says nothing of the motion across it.
    let solution = svd.solve(&right, 1e-3 * svd.singular_values.max()).expect("both factors were asked for");
    let offset = mean - centroid;
    let displacement =
        |axis| solution[(0, axis)] + solution[(1, axis)] * offset.x + solution[(2, axis)] * offset.y;
    Affine {
        target: mean + DVec2::new(displacement(0), displacement(1)),
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
    let deviation = scene.noise().deviation();
    let noise = deviation / scene.independent_samples(&seen, camera).sqrt();
    let independent = 1.0 + (effective_samples(&seen) - 1.0) / settings.noise_correlation_area;
    let claimed = deviation.max(LEAST_CLAIM).powi(2);
    let floor = settings.noise_floor.powi(2);
    Some(Sight {
        camera,
        pixel: fit.target,
        deviation: noise.hypot(model_error),
        assumed_variance: claimed.max(fit.residual) / independent + floor,
        claimed_variance: claimed / independent + floor,
    })
}

/// Gauss-Newton on all sights at once from the true position, to convergence; a step is halved until it is one downhill.
pub(super) fn predict(sights: &[Sight<'_>], truth: DVec3) -> Option<Prediction> {
    let first = sights.first()?;
    let at = |offset: Vector3<f64>| truth + DVec3::from_slice(offset.as_slice());
    let cost =
        |offset| linearise(sights, at(offset)).map_or(f64::INFINITY, |(_, right)| right.norm_squared());
    let mut offset = Vector3::zeros();
    for _ in 0..30 {
        let (design, residual) = linearise(sights, at(offset))?;
        let svd = design.svd(true, true);
        let step = svd.solve(&residual, 1e-14 * svd.singular_values.max()).ok()?;
        let mut step = Vector3::new(step[0], step[1], step[2]);
        let before = residual.norm_squared();
        let is_downhill = (0..40).any(|_| {
            let found = cost(offset + step) < before;
            step *= if found { 1.0 } else { 0.5 };
            found
        });
        if !is_downhill {
            break;
        }
        offset += step;
        if !(step.norm() > 1e-14 * offset.norm()) {
            break;
        }
    }
    let position = at(offset);
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

/// Standard deviation of a mean that is found at rest. Each view errs by its share of the significance, which is what its
/// tracks claim or the floor over the significance, and by their true deviation: where the footprint is found errs as well.
pub(super) fn resting_deviation(sights: &[Sight<'_>], mean: DVec3, settings: &MotionSettings) -> f64 {
    let least = (settings.static_floor / settings.static_significance).powi(2);
    let resting: Vec<Sight<'_>> = sights
        .iter()
        .map(|sight| {
            let deviation = sight.claimed_variance.max(least).sqrt() + sight.deviation;
            Sight { assumed_variance: deviation * deviation, ..*sight }
        })
        .collect();
    covariances(&resting, mean).1.trace().sqrt()
}

/// Standard deviation of the position of Gaussian `index` by the rigid motion of the nearest ones of known motion, to first
/// order, those among the `reach` nearest of all, or else the nearest: least squares of their displacements by the information that the shipped path may assume, with the turn free
/// within its true size. `None` if no motion is known.
pub(super) fn led_deviation(
    scene: &impl Tracked,
    field: &MotionField,
    index: usize,
    reach: usize,
    settings: &MotionSettings,
) -> Option<f64> {
    let (gaussians, motion) = (scene.gaussians(), scene.motion());
    let mean = gaussians.mean(index);
    let is_known =
        |other: &usize| matches!(field.origin[*other], MotionOrigin::Solved | MotionOrigin::Static);
    let mut others: Vec<usize> = (0..gaussians.len()).filter(|&other| other != index).collect();
    others.sort_by(|&a, &b| gaussians.mean(a).distance(mean).total_cmp(&gaussians.mean(b).distance(mean)));
    let near: Vec<usize> = others.iter().take(reach).copied().filter(is_known).collect();
    let mut known = if near.is_empty() { others.into_iter().filter(is_known).collect() } else { near };
    known.truncate(settings.neighbours);
    // Units that make both halves of the unknowns alike.
    let size = gaussians.mean(*known.last()?).distance(mean).max(f64::MIN_POSITIVE);
    let unit = known.iter().find_map(|&other| position_covariance(scene, other, settings))?.trace();
    let mut normal = Matrix6::zeros();
    for other in known {
        let Some(information) =
            position_covariance(scene, other, settings).and_then(|c| (c / unit).try_inverse())
        else {
            continue;
        };
        let lever = vector((gaussians.mean(other) - mean) / size);
        let mut by_motion = Matrix3x6::zeros();
        by_motion.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
        by_motion.fixed_view_mut::<3, 3>(0, 3).copy_from(&-lever.cross_matrix());
        normal += by_motion.transpose() * information * by_motion;
    }
    let turn = (motion.turn.angle_between(glam::DQuat::IDENTITY) * size).max(1e-9 * size);
    for axis in 3..6 {
        normal[(axis, axis)] += unit / (turn * turn);
    }
    let covariance = normal.try_inverse()?.fixed_view::<3, 3>(0, 0).trace() * unit;
    covariance.is_finite().then(|| covariance.sqrt())
}

/// Covariance that the shipped path may assume of a position.
fn position_covariance(
    scene: &impl Tracked,
    index: usize,
    settings: &MotionSettings,
) -> Option<Matrix3<f64>> {
    let sights = sights(scene, index, settings);
    (!sights.is_empty()).then(|| covariances(&sights, scene.motion().of(scene.gaussians().mean(index))).1)
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
