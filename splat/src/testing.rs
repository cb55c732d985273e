//! Small seeded scenes for the tests of this crate.

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    cameras::Camera,
    engine::{Engine, Rendering},
    gaussians::Gaussians,
    raster::CpuEngine,
};

/// What the CPU engine draws.
pub(crate) fn render(gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Rendering {
    CpuEngine::default().render(gaussians, camera, background).expect("the CPU engine draws everything")
}

/// Cameras on an arc of 60°, four units from the origin, looking at it.
pub(crate) fn arc(count: usize, width: u32, height: u32) -> Vec<Camera> {
    (0..count)
        .map(|number| {
            let angle = (number as f64 / (count.max(2) - 1) as f64 - 0.5) * std::f64::consts::FRAC_PI_3;
            let rotation = DMat3::from_rotation_y(angle);
            Camera {
                width,
                height,
                fx: f64::from(width),
                fy: f64::from(width),
                cx: f64::from(width) / 2.0,
                cy: f64::from(height) / 2.0,
                rotation,
                translation: DVec3::new(0.0, 0.0, 4.0),
            }
        })
        .collect()
}

/// `count` opaque, coloured Gaussians in the unit ball, spherical harmonics of degree 1.
pub(crate) fn blobs(count: usize, seed: u64) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |low: f32, high: f32| random.random_range(low..high);
    let mut gaussians = Gaussians::empty(1);
    for _ in 0..count {
        gaussians.means.push([draw(-1.0, 1.0), draw(-0.7, 0.7), draw(-0.7, 0.7)]);
        gaussians.rotations.push([draw(-1.0, 1.0), draw(-1.0, 1.0), draw(-1.0, 1.0), draw(0.1, 1.0)]);
        gaussians.log_scales.push([draw(-3.0, -1.5), draw(-3.0, -1.5), draw(-3.0, -1.5)]);
        gaussians.logit_opacities.push(draw(0.0, 4.0));
        for coefficient in 0..12 {
            gaussians.sh.push(if coefficient < 3 { draw(-1.5, 1.5) } else { draw(-0.1, 0.1) });
        }
    }
    gaussians
}

/// Runs `work` on a pool of its own.
pub(crate) fn on_threads<R: Send>(threads: usize, work: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap_or_else(|error| panic!("a pool of {threads}: {error}"))
        .install(work)
}
