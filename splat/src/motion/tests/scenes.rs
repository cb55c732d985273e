//! A room corner covered with Gaussians, cameras around it, and the tracks of a rigid motion of the whole.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{cameras::Camera, gaussians::Gaussians, motion::MotionView, tracking::TrackField};

/// A rigid motion `x ↦ turn · x + shift`.
#[derive(Clone, Copy)]
pub(super) struct Rigid {
    pub turn: DQuat,
    pub shift: DVec3,
}

impl Rigid {
    pub(super) const REST: Self = Self { turn: DQuat::IDENTITY, shift: DVec3::ZERO };

    pub(super) fn of(self, x: DVec3) -> DVec3 {
        self.turn * x + self.shift
    }
}

pub(super) fn look_at(eye: DVec3, target: DVec3) -> Camera {
    let forward = (target - eye).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    Camera {
        width: 96,
        height: 64,
        fx: 90.0,
        fy: 88.0,
        cx: 47.0,
        cy: 33.5,
        rotation,
        translation: -(rotation * eye),
    }
}

/// `count` cameras on an arc of ±40° before the corner, 4.5 units away, at changing heights.
pub(super) fn cameras(count: usize) -> Vec<Camera> {
    (0..count)
        .map(|k| {
            let share = if count > 1 { k as f64 / (count - 1) as f64 } else { 0.5 };
            let azimuth = (5.0 + 80.0 * share).to_radians();
            let height = [1.8, 2.8][k % 2];
            look_at(DVec3::new(4.0 * azimuth.cos(), 4.0 * azimuth.sin(), height), DVec3::splat(0.75))
        })
        .collect()
}

/// `count` flat Gaussians lying in the three planes `x = 0`, `y = 0`, `z = 0`, off their creases.
pub(super) fn corner(count: usize, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut gaussians = Gaussians::empty(1);
    for i in 0..count {
        let plane = i % 3;
        let mut mean = [0.0f32; 3];
        for axis in (0..3).filter(|&axis| axis != plane) {
            mean[axis] = rng.random_range(0.35..1.45);
        }
        gaussians.means.push(mean);
        // Thin axis last, along the plane's normal, after a spin about it.
        let tilt = DQuat::from_rotation_arc(
            DVec3::Z,
            DVec3::from_array([0, 1, 2].map(|a| f64::from(u8::from(a == plane)))),
        );
        let q = tilt * DQuat::from_rotation_z(rng.random_range(0.0..6.0));
        let norm = rng.random_range(0.5..2.0);
        gaussians.rotations.push([q.w, q.x, q.y, q.z].map(|c| (c * norm) as f32));
        let scale = |rng: &mut ChaCha8Rng| rng.random_range(0.03f32..0.07).ln();
        gaussians.log_scales.push([scale(&mut rng), scale(&mut rng), 1e-3f32.ln()]);
        gaussians.logit_opacities.push(rng.random_range(0.5..2.0));
        gaussians.sh.extend((0..12).map(|_| rng.random_range(-0.3f32..0.3)));
    }
    gaussians
}

/// The point of the corner's nearest wall on the ray through a pixel centre.
pub(super) fn surface(camera: &Camera, column: u32, row: u32) -> Option<DVec3> {
    let slope = DVec3::new(
        (f64::from(column) + 0.5 - camera.cx) / camera.fx,
        (f64::from(row) + 0.5 - camera.cy) / camera.fy,
        1.0,
    );
    let (origin, ray) = (camera.centre(), camera.rotation.transpose() * slope);
    let nearest =
        (0..3).map(|axis| -origin[axis] / ray[axis]).filter(|&s| s > 0.0).fold(f64::INFINITY, f64::min);
    nearest.is_finite().then(|| origin + ray * nearest)
}

/// Exact tracks of the corner under a motion that may differ from point to point; `sigma` is what they claim.
pub(super) fn tracks(camera: &Camera, motion: impl Fn(DVec3) -> DVec3, sigma: f32) -> TrackField {
    let pixels = (camera.width * camera.height) as usize;
    let mut field = TrackField {
        width: camera.width,
        height: camera.height,
        positions: Vec::with_capacity(pixels),
        visible: Vec::with_capacity(pixels),
        sigma: vec![sigma; pixels],
    };
    for row in 0..camera.height {
        for column in 0..camera.width {
            let target = surface(camera, column, row).and_then(|x| camera.project_world(motion(x)));
            let target = target.filter(|pixel| camera.contains(*pixel));
            field.visible.push(target.is_some());
            field.positions.push(target.map_or([f32::NAN; 2], |t| t.as_vec2().to_array()));
        }
    }
    field
}

pub(super) fn views(
    cameras: &[Camera],
    motion: impl Fn(DVec3) -> DVec3 + Copy,
    sigma: f32,
) -> Vec<MotionView> {
    cameras
        .iter()
        .map(|camera| MotionView { camera: camera.clone(), tracks: Arc::new(tracks(camera, motion, sigma)) })
        .collect()
}

/// Adds independent uniform noise of the given standard deviation per axis, which the tracks then claim.
pub(super) fn add_noise(views: &mut [MotionView], deviation: f64, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let half_width = deviation * 3.0f64.sqrt();
    for view in views {
        let field = Arc::make_mut(&mut view.tracks);
        field.sigma.fill(deviation as f32);
        for position in &mut field.positions {
            for axis in position {
                *axis += rng.random_range(-half_width..half_width) as f32;
            }
        }
    }
}
