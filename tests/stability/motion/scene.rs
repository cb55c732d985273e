//! Cameras, Gaussians and rigid motions to draw cases from.

use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, gaussians::Gaussians};

pub(super) const WIDTH: u32 = 640;
pub(super) const HEIGHT: u32 = 480;

pub(super) fn random(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Standard normal, by Box and Muller.
pub(super) fn normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random_range(0.0..1.0f64)).ln()).sqrt();
    radius * random.random_range(0.0..std::f64::consts::TAU).cos()
}

/// Uniform on the sphere.
pub(super) fn direction(random: &mut ChaCha8Rng) -> DVec3 {
    DVec3::new(normal(random), normal(random), normal(random)).normalize_or(DVec3::X)
}

/// `x ↦ about + turn · (x − about) + shift`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rigid {
    pub turn: DQuat,
    pub about: DVec3,
    pub shift: DVec3,
}

impl Rigid {
    pub(super) const REST: Self = Self { turn: DQuat::IDENTITY, about: DVec3::ZERO, shift: DVec3::ZERO };

    pub(super) fn of(self, x: DVec3) -> DVec3 {
        self.about + self.turn * (x - self.about) + self.shift
    }

    /// A turn by `degrees` about a random axis through `about`, and a shift of the given length.
    pub(super) fn random(random: &mut ChaCha8Rng, about: DVec3, degrees: f64, length: f64) -> Self {
        let turn = DQuat::from_axis_angle(direction(random), degrees.to_radians());
        Self { turn, about, shift: direction(random) * length }
    }
}

/// A camera at `eye` whose axis goes through `target`; any roll.
pub(super) fn look_at(eye: DVec3, target: DVec3, fov_degrees: f64) -> Camera {
    let forward = (target - eye).normalize();
    let right = forward.any_orthonormal_vector();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    let focal = f64::from(WIDTH) / 2.0 / (fov_degrees.to_radians() / 2.0).tan();
    Camera {
        width: WIDTH,
        height: HEIGHT,
        fx: focal,
        fy: focal,
        cx: f64::from(WIDTH) / 2.0,
        cy: f64::from(HEIGHT) / 2.0,
        rotation,
        translation: -(rotation * eye),
    }
}

/// Where the cameras of a case stand.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rig {
    pub views: usize,
    /// Angle between the first and the last, seen from what they look at.
    pub baseline_degrees: f64,
    /// Field of view across the width.
    pub fov_degrees: f64,
    /// Distance from what they look at, world units.
    pub distance: f64,
    pub target: DVec3,
}

impl Rig {
    pub(super) const USUAL: Self =
        Self { views: 6, baseline_degrees: 60.0, fov_degrees: 60.0, distance: 4.0, target: DVec3::ZERO };

    pub(super) fn cameras(&self) -> Vec<Camera> {
        (0..self.views)
            .map(|view| {
                let share = if self.views > 1 { view as f64 / (self.views - 1) as f64 - 0.5 } else { 0.0 };
                let angle = (share * self.baseline_degrees).to_radians();
                let away = DVec3::new(angle.cos(), angle.sin(), 0.0) * self.distance;
                look_at(self.target + away, self.target, self.fov_degrees)
            })
            .collect()
    }

    /// World units that are `pixels` wide at the target.
    pub(super) fn length_of(&self, pixels: f64) -> f64 {
        let half_width = self.distance * (self.fov_degrees.to_radians() / 2.0).tan();
        pixels * half_width / (f64::from(WIDTH) / 2.0)
    }
}

/// Adds a flat Gaussian, a hundredth as thick as wide, that turns its face to `facing` up to 40°.
pub(super) fn add_disc(
    gaussians: &mut Gaussians,
    random: &mut ChaCha8Rng,
    mean: DVec3,
    facing: DVec3,
    deviation: f64,
) {
    let tilt = DQuat::from_axis_angle(direction(random), random.random_range(0.0..0.7));
    let spin = DQuat::from_rotation_z(random.random_range(0.0..6.0));
    let turn = tilt * DQuat::from_rotation_arc(DVec3::Z, facing.normalize()) * spin;
    let oblong = random.random_range(0.7..1.0f64);
    gaussians.means.push(mean.as_vec3().to_array());
    gaussians.rotations.push([turn.w, turn.x, turn.y, turn.z].map(|c| c as f32));
    gaussians.log_scales.push([1.0, oblong, 0.01].map(|share: f64| (share * deviation).ln() as f32));
    gaussians.logit_opacities.push(random.random_range(0.5..3.0));
    gaussians.sh.extend([0.1, 0.2, 0.3]);
}

/// `count` discs in a ball of radius `radius` about `centre`, facing +x, each `deviation` wide.
pub(super) fn discs(
    random: &mut ChaCha8Rng,
    count: usize,
    centre: DVec3,
    radius: f64,
    deviation: f64,
) -> Gaussians {
    let mut gaussians = Gaussians::empty(0);
    for _ in 0..count {
        let mean = centre + direction(random) * radius * random.random_range(0.0..1.0f64).cbrt();
        add_disc(&mut gaussians, random, mean, DVec3::X, deviation);
    }
    gaussians
}
