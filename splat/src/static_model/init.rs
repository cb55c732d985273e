//! The Gaussians that the optimisation starts from.

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::SfmPoint;
use crate::{
    cameras::{Camera, rig::focus},
    gaussians::{Gaussians, logit, sh},
};

/// Opacity of a new Gaussian.
const INITIAL_OPACITY: f64 = 0.1;

/// Neighbours whose mean distance is a new Gaussian's size.
const NEIGHBOURS: usize = 3;

/// One isotropic Gaussian per point, as large as the distance to its neighbours.
pub(super) fn from_points(points: &[SfmPoint], sh_degree: u32) -> Gaussians {
    let positions: Vec<[f64; 3]> = points.iter().map(|point| point.position.to_array()).collect();
    let spacing = neighbour_distances(&positions);
    let stride = sh::coefficients(sh_degree) * 3;
    let mut gaussians = Gaussians::empty(sh_degree);
    for (point, distance) in points.iter().zip(spacing) {
        gaussians.means.push(point.position.as_vec3().to_array());
        gaussians.rotations.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.log_scales.push([distance.ln() as f32; 3]);
        gaussians.logit_opacities.push(logit(INITIAL_OPACITY) as f32);
        let first = gaussians.sh.len();
        gaussians.sh.resize(first + stride, 0.0);
        for channel in 0..3 {
            gaussians.sh[first + channel] = (point.colour[channel] - 0.5) / sh::C0 as f32;
        }
    }
    gaussians
}

/// Root mean square distance of each point to its nearest neighbours, floored at a millionth of the largest
/// distance from the first point so that duplicates keep a size.
fn neighbour_distances(positions: &[[f64; 3]]) -> Vec<f64> {
    let first = DVec3::from(positions[0]);
    let span = positions.iter().map(|&p| DVec3::from(p).distance(first)).fold(0.0, f64::max);
    let floor = if span > 0.0 { span * 1e-6 } else { 1.0 };
    if positions.len() <= NEIGHBOURS {
        return vec![(span / 2.0).max(floor); positions.len()];
    }
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(positions) else {
        return vec![(span / 2.0).max(floor); positions.len()];
    };
    let count = std::num::NonZero::<usize>::MIN.saturating_add(NEIGHBOURS);
    positions
        .iter()
        .map(|position| {
            let found = tree.query(position).nearest_n::<SquaredEuclidean<f64>>(count).execute();
            // The nearest of all is the point itself.
            let squares: f64 = found.iter().skip(1).map(|neighbour| neighbour.distance).sum();
            (squares / NEIGHBOURS as f64).sqrt().max(floor)
        })
        .collect()
}

/// Grey points drawn evenly from the ball around the cameras' focus, kept where at least half of the cameras, and
/// never fewer than two, see them.
pub(super) fn random_points(cameras: &[&Camera], count: usize, random: &mut ChaCha8Rng) -> Vec<SfmPoint> {
    let focus = focus(cameras);
    let mean_distance =
        cameras.iter().map(|camera| camera.centre().distance(focus)).sum::<f64>() / cameras.len() as f64;
    let enough = cameras.len().div_ceil(2).max(2.min(cameras.len()));
    let mut points = Vec::new();
    // A ball that no two cameras share would never fill; the bound keeps the draw finite.
    for _ in 0..count.saturating_mul(100) {
        if points.len() == count {
            break;
        }
        let offset: [f64; 3] = std::array::from_fn(|_| random.random_range(-1.0..1.0));
        let offset = DVec3::from(offset);
        if offset.length_squared() > 1.0 {
            continue;
        }
        let position = focus + offset * mean_distance;
        let seen = cameras.iter().filter(|camera| sees(camera, position, mean_distance)).count();
        if seen >= enough {
            points.push(SfmPoint { position, colour: [0.5; 3] });
        }
    }
    points
}

fn sees(camera: &Camera, position: DVec3, distance: f64) -> bool {
    let point = camera.to_camera(position);
    point.z > 0.05 * distance && camera.project(point).is_some_and(|pixel| camera.contains(pixel))
}
