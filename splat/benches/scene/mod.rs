//! The scene of the benchmarks: Gaussians that fill the frustum, about 65 blended per pixel at any number of them.
#![allow(dead_code, reason = "each benchmark uses a part")]

mod npz;

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, gaussians::Gaussians, image::Image};

#[allow(unused_imports, reason = "each benchmark uses a part")]
pub(crate) use npz::read;

/// Vertices of the coarse grid that the target image is interpolated from.
const GRID: (usize, usize) = (16, 9);

/// What to generate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SceneSize {
    /// Number of Gaussians.
    pub(crate) gaussians: usize,
    /// Image columns.
    pub(crate) width: u32,
    /// Image rows.
    pub(crate) height: u32,
    /// Spherical-harmonic degree, 0 to 3.
    pub(crate) sh_degree: u32,
}

/// One training view of one set of Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Scene {
    /// In the frustum of the camera, depth 2 to 6, log-normal sizes, opacity `sigmoid(N(0, 1.5))`.
    pub(crate) gaussians: Gaussians,
    /// At the origin, looking along +z; focal length 0.8 widths.
    pub(crate) camera: Camera,
    /// A smooth random image.
    pub(crate) target: Image,
}

impl Scene {
    /// Size of this scene.
    pub(crate) fn size(&self) -> SceneSize {
        SceneSize {
            gaussians: self.gaussians.len(),
            width: self.camera.width,
            height: self.camera.height,
            sh_degree: self.gaussians.sh_degree,
        }
    }
}

/// The scene of a size, the same on every machine. Sets of the same number differ only in their harmonics.
pub(crate) fn generate(size: SceneSize) -> Scene {
    Scene {
        gaussians: gaussians(size.gaussians, size.sh_degree),
        camera: camera(size.width, size.height),
        target: target(size.width as usize, size.height as usize),
    }
}

fn camera(width: u32, height: u32) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    Camera {
        width,
        height,
        fx: 0.8 * w,
        fy: 0.8 * w,
        cx: 0.5 * w,
        cy: 0.5 * h,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    }
}

fn gaussians(count: usize, sh_degree: u32) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(1234 + count as u64);
    // Smaller the more there are, so that as many lie over each pixel.
    let log_size = (0.02 * (50_000.0 / count as f64).sqrt()).ln();
    let mut set = Gaussians::empty(sh_degree);
    let kept = 3 * set.sh_coefficients();
    for _ in 0..count {
        let depth = random.random_range(2.0..6.0);
        // Half the field of view at focal length 0.8 widths is 0.625; a little more, so that the border is covered.
        let x = random.random_range(-1.0..1.0) * 0.625 * 1.05 * depth;
        let y = random.random_range(-1.0..1.0) * 0.625 * (9.0 / 16.0) * 1.05 * depth;
        set.means.push([x, y, depth].map(|value: f64| value as f32));
        let common = log_size + 0.4 * normal(&mut random);
        set.log_scales.push(std::array::from_fn(|_| (common + 0.4 * normal(&mut random)) as f32));
        let quaternion: [f64; 4] = std::array::from_fn(|_| normal(&mut random));
        let norm = quaternion.iter().map(|value| value * value).sum::<f64>().sqrt();
        set.rotations.push(quaternion.map(|value| (value / norm) as f32));
        set.logit_opacities.push((1.5 * normal(&mut random)) as f32);
        let sh: [f32; 48] = std::array::from_fn(|coefficient| {
            let flat = random.random_range(-1.5..1.5);
            let rest = 0.1 * normal(&mut random);
            if coefficient < 3 { flat as f32 } else { rest as f32 }
        });
        set.sh.extend_from_slice(&sh[..kept]);
    }
    set
}

/// Box–Muller.
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}

fn target(width: usize, height: usize) -> Image {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (columns, rows) = GRID;
    let vertices: Vec<[f64; 3]> =
        (0..columns * rows).map(|_| std::array::from_fn(|_| random.random::<f64>())).collect();
    let mut pixels = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        let (row, down) = cell(y, height, rows);
        for x in 0..width {
            let (column, right) = cell(x, width, columns);
            let vertex = |dx, dy| vertices[(row + dy) * columns + column + dx];
            for channel in 0..3 {
                let mix = |a: f64, b: f64, share: f64| a + share * (b - a);
                let above = mix(vertex(0, 0)[channel], vertex(1, 0)[channel], right);
                let below = mix(vertex(0, 1)[channel], vertex(1, 1)[channel], right);
                pixels.push(mix(above, below, down) as f32);
            }
        }
    }
    Image { width: width as u32, height: height as u32, pixels }
}

/// Cell and share within it of position `at` of `count`, the first on the first and the last on the last vertex.
fn cell(at: usize, count: usize, vertices: usize) -> (usize, f64) {
    let place = at as f64 * (vertices - 1) as f64 / count.saturating_sub(1).max(1) as f64;
    let cell = (place as usize).min(vertices - 2);
    (cell, place - cell as f64)
}
