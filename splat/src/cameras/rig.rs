//! What a set of cameras has in common.

use glam::{DMat3, DVec3};

use super::Camera;

/// Radius of the scene seen by `cameras`, world units: 1.1 times the largest distance of a camera from their mean, as
/// in 3D Gaussian Splatting; at least a hundredth of the distance to what they look at, for cameras that coincide.
pub fn scene_extent(cameras: &[&Camera]) -> f64 {
    let centres: Vec<DVec3> = cameras.iter().map(|camera| camera.centre()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len() as f64;
    let radius = centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max);
    let looked_at = focus(cameras).distance(mean);
    (1.1 * radius).max(0.01 * looked_at)
}

/// The point nearest to all optical axes in the least-squares sense; for parallel axes, in front of their mean.
pub fn focus(cameras: &[&Camera]) -> DVec3 {
    let mut normal = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    let mut mean = DVec3::ZERO;
    let mut forward = DVec3::ZERO;
    for camera in cameras {
        let axis = camera.rotation.row(2);
        let across = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += across;
        right += across * camera.centre();
        mean += camera.centre() / cameras.len() as f64;
        forward += axis / cameras.len() as f64;
    }
    // The determinant falls with the square of the axes' spread; below a degree the crossing is noise.
    if normal.determinant() > 1e-4 * (cameras.len() as f64).powi(3) {
        return normal.inverse() * right;
    }
    let spread = cameras.iter().map(|camera| camera.centre().distance(mean)).fold(0.0, f64::max);
    mean + forward * if spread > 0.0 { 3.0 * spread } else { 1.0 }
}
