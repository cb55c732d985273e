//! A room corner covered with flat Gaussians, cameras before it, and how it moves: exact ground truth for motion
//! compensation.
#![allow(dead_code, reason = "each benchmark uses a part")]

use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, gaussians::Gaussians, tracking::TrackField};

/// Length of the corner's edges, world units.
pub(crate) const SIDE: f64 = 1.5;
/// Distance of the cameras from the corner's middle.
const DISTANCE: f64 = 4.5;
/// Height of the cameras above the floor, as an angle seen from the corner's middle.
const ELEVATION: f64 = 35.0;
/// Bending, radians per world unit of height.
const CURVATURE: f64 = 0.25;
const SHIFT: DVec3 = DVec3::new(0.10, -0.06, 0.08);

/// Diagonal of the corner.
pub(crate) fn extent() -> f64 {
    3f64.sqrt() * SIDE
}

fn middle() -> DVec3 {
    DVec3::splat(0.5 * SIDE)
}

/// `count` Gaussians in the planes `x = 0`, `y = 0`, `z = 0`, each third in one, spun at random; their thin axis, a
/// twentieth to a half of the others, along the normal. The larger the fewer, so that they always cover the walls.
pub(crate) fn gaussians(count: usize, seed: u64) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let spacing = (3.0 * SIDE * SIDE / count.max(1) as f64).sqrt();
    let mut set = Gaussians::empty(0);
    for index in 0..count {
        let wall = index % 3;
        let mut mean = [0.0; 3];
        for axis in (0..3).filter(|&axis| axis != wall) {
            mean[axis] = random.random_range(0.0..SIDE);
        }
        set.means.push(mean.map(|value| value as f32));
        let tilt = DQuat::from_rotation_arc(DVec3::Z, DVec3::AXES[wall]);
        let spin = tilt * DQuat::from_rotation_z(random.random_range(0.0..std::f64::consts::TAU));
        set.rotations.push([spin.w, spin.x, spin.y, spin.z].map(|value| value as f32));
        let [long, short] = [0.75..1.0, 0.5..0.75].map(|range| spacing * random.random_range(range));
        let thin = short * random.random_range(0.05f64.ln()..0.5f64.ln()).exp();
        set.log_scales.push([long, short, thin].map(|scale| scale.ln() as f32));
        set.logit_opacities.push(random.random_range(1.0..3.0));
        set.sh.extend((0..3).map(|_| random.random_range(-0.3f32..0.3)));
    }
    set
}

/// `count` cameras on an arc of ± `half_angle` degrees that look at the corner's middle.
pub(crate) fn arc(count: usize, half_angle: f64, (width, height): (u32, u32)) -> Vec<Camera> {
    (0..count)
        .map(|number| {
            let share = if count > 1 { number as f64 / (count - 1) as f64 } else { 0.5 };
            let azimuth = (45.0 + half_angle * (2.0 * share - 1.0)).to_radians();
            let elevation = ELEVATION.to_radians();
            let level = elevation.cos();
            let towards = DVec3::new(level * azimuth.cos(), level * azimuth.sin(), elevation.sin());
            look_at(middle() + towards * DISTANCE, middle(), (width, height))
        })
        .collect()
}

fn look_at(eye: DVec3, target: DVec3, (width, height): (u32, u32)) -> Camera {
    let forward = (target - eye).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    let (w, h) = (f64::from(width), f64::from(height));
    // The corner fills the height of the image.
    let focal = 1.4 * h;
    let (cx, cy) = (0.5 * w, 0.5 * h);
    Camera { width, height, fx: focal, fy: focal, cx, cy, rotation, translation: -(rotation * eye) }
}

/// How the corner moves; nothing in it stays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motion {
    /// A turn of 8° and a shift.
    Rigid,
    /// Smooth bending about a horizontal axis, ±11°, and a shift.
    Bend,
}

impl Motion {
    /// For tables.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Rigid => "rigid",
            Self::Bend => "bending",
        }
    }

    /// Where a point goes.
    pub(crate) fn of(self, point: DVec3) -> DVec3 {
        let x = point - middle();
        let moved = match self {
            Self::Rigid => {
                let axis = DVec3::new(0.3, -0.2, 1.0).normalize();
                DQuat::from_axis_angle(axis, 8f64.to_radians()) * x
            }
            Self::Bend => bent(x),
        };
        middle() + moved + SHIFT
    }

    /// Derivative of the new by the old position.
    pub(crate) fn gradient(self, point: DVec3) -> DMat3 {
        const STEP: f64 = 1e-5;
        let column =
            |axis: DVec3| (self.of(point + axis * STEP) - self.of(point - axis * STEP)) / (2.0 * STEP);
        DMat3::from_cols(column(DVec3::X), column(DVec3::Y), column(DVec3::Z))
    }

    /// How a surface with that normal turns at a point: its normal to the new normal, its tangents by the polar
    /// decomposition of their gradient. Tracks show no more than that of a motion that also shears.
    pub(crate) fn turn(self, point: DVec3, normal: DVec3) -> DQuat {
        let gradient = self.gradient(point);
        let (u, v) = normal.any_orthonormal_pair();
        let (new_u, new_v) = (gradient * u, gradient * v);
        let new_normal = new_u.cross(new_v).normalize();
        let mut turn =
            DMat3::from_cols(new_u, new_v, new_normal) * DMat3::from_cols(u, v, u.cross(v)).transpose();
        // Newton's iteration; strains of a few tenths settle in five steps.
        for _ in 0..12 {
            turn = (turn + turn.inverse().transpose()) * 0.5;
        }
        DQuat::from_mat3(&turn).normalize()
    }
}

/// Lines along the vertical become arcs in the plane of the vertical and the diagonal; those of the neutral surface
/// keep their length.
fn bent(x: DVec3) -> DVec3 {
    let across = DVec3::new(1.0, 1.0, 0.0).normalize();
    // The vertical walls reach from the neutral surface as far to either side: ±13 % of stretch.
    let neutral = -0.25 * 2f64.sqrt() * SIDE;
    let (height, depth) = (x.z, x.dot(across) - neutral);
    let radius = 1.0 / CURVATURE;
    let angle = CURVATURE * height;
    let new_height = (radius - depth) * angle.sin();
    let new_depth = radius - (radius - depth) * angle.cos();
    x + across * (new_depth - depth) + DVec3::Z * (new_height - height)
}

/// The wall, and the point on it, that a pixel sees; walls are infinite.
fn surface(camera: &Camera, column: u32, row: u32) -> Option<(usize, DVec3)> {
    let slope = DVec3::new(
        (f64::from(column) + 0.5 - camera.cx) / camera.fx,
        (f64::from(row) + 0.5 - camera.cy) / camera.fy,
        1.0,
    );
    let (origin, ray) = (camera.centre(), camera.rotation.transpose() * slope);
    let distances = (0..3).map(|wall| (wall, -origin[wall] / ray[wall])).filter(|&(_, s)| s > 0.0);
    let (wall, distance) = distances.min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some((wall, origin + ray * distance))
}

/// Exact tracks of the corner, of which one wall or all may move; they claim a standard deviation of `sigma`.
pub(crate) fn tracks(camera: &Camera, motion: Motion, wall: Option<usize>, sigma: f32) -> TrackField {
    let (width, height) = (camera.width, camera.height);
    let pixels = width as usize * height as usize;
    let mut field = TrackField {
        width,
        height,
        positions: Vec::with_capacity(pixels),
        visible: Vec::with_capacity(pixels),
        sigma: vec![sigma; pixels],
    };
    for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column))) {
        let centre = [column as f32 + 0.5, row as f32 + 0.5];
        let target = match surface(camera, column, row) {
            Some((on, point)) if wall.is_none_or(|wall| wall == on) => {
                camera.project_world(motion.of(point)).map(|pixel| pixel.as_vec2().to_array())
            }
            _ => Some(centre),
        };
        field.visible.push(target.is_some());
        field.positions.push(target.unwrap_or(centre));
    }
    field
}
