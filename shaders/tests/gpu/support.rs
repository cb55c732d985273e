//! The device that the tests run on, and seeded scenes.
//!
//! `TRACKERSPLAT_TEST_DEVICE` chooses it: a part of a device's name, `gpu:N`, or `none` where a machine is known to have
//! none, which skips what needs one. Without it, tests take a GPU if there is one, software otherwise, and fail if there is
//! neither.
#![allow(dead_code, clippy::print_stderr, reason = "each test program uses a part; skipped tests say so")]

use std::sync::OnceLock;

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, gaussians::Gaussians, tracking::TrackField};
use splat_shaders::{DeviceChoice, GpuDevice, GpuEngine, devices};

/// The engine of this test program; `None` if the environment says that there is no device.
pub(crate) fn engine() -> Option<&'static GpuEngine> {
    static ENGINE: OnceLock<Option<GpuEngine>> = OnceLock::new();
    let engine = ENGINE.get_or_init(|| {
        choice()?;
        Some(GpuEngine::new(open()).expect("kernels compile on every device"))
    });
    if engine.is_none() {
        eprintln!("skipped: TRACKERSPLAT_TEST_DEVICE=none");
    }
    engine.as_ref()
}

/// The same on the other form of the kernels, with or without subgroups; `None` if the device has one form only.
pub(crate) fn other_engine() -> Option<&'static GpuEngine> {
    static ENGINE: OnceLock<Option<GpuEngine>> = OnceLock::new();
    let engine = ENGINE.get_or_init(|| {
        let uses_subgroups = engine()?.device().uses_subgroups();
        let other = open().with_subgroups(!uses_subgroups);
        if other.uses_subgroups() == uses_subgroups {
            return None;
        }
        Some(GpuEngine::new(other).expect("kernels compile on every device"))
    });
    if engine.is_none() {
        eprintln!("skipped: the device has no subgroups");
    }
    engine.as_ref()
}

/// Every form of the engine that the device can run.
pub(crate) fn engines() -> impl Iterator<Item = &'static GpuEngine> {
    engine().into_iter().chain(other_engine())
}

/// The device of this test program; the environment must not say that there is none.
pub(crate) fn open() -> GpuDevice {
    let choice = choice().expect("callers have asked for the engine first");
    GpuDevice::open(&choice).unwrap_or_else(|error| {
        panic!("{error}. Software Vulkan will do (Debian: mesa-vulkan-drivers); TRACKERSPLAT_TEST_DEVICE=none skips these tests")
    })
}

fn choice() -> Option<DeviceChoice> {
    match std::env::var("TRACKERSPLAT_TEST_DEVICE").as_deref() {
        Ok("none") => None,
        Ok(one) => Some(one.parse().unwrap_or_else(|error| panic!("TRACKERSPLAT_TEST_DEVICE: {error}"))),
        Err(_) if GpuDevice::open(&DeviceChoice::Auto).is_ok() => Some(DeviceChoice::Auto),
        Err(_) => Some(DeviceChoice::Index(devices().first().map_or(0, |device| device.index))),
    }
}

/// Cameras on an arc of 60°, four units from the origin, looking at it.
pub(crate) fn arc(count: usize, width: u32, height: u32) -> Vec<Camera> {
    (0..count)
        .map(|number| {
            let angle = (number as f64 / (count.max(2) - 1) as f64 - 0.5) * std::f64::consts::FRAC_PI_3;
            Camera {
                width,
                height,
                fx: f64::from(width),
                fy: f64::from(width),
                cx: f64::from(width) / 2.0,
                cy: f64::from(height) / 2.0,
                rotation: DMat3::from_rotation_y(angle),
                translation: DVec3::new(0.0, 0.0, 4.0),
            }
        })
        .collect()
}

/// `count` opaque, coloured Gaussians about the origin, spherical harmonics of the given degree.
pub(crate) fn blobs(count: usize, sh_degree: u32, seed: u64) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |low: f32, high: f32| random.random_range(low..high);
    let mut gaussians = Gaussians::empty(sh_degree);
    for _ in 0..count {
        gaussians.means.push([draw(-1.0, 1.0), draw(-0.7, 0.7), draw(-0.7, 0.7)]);
        gaussians.rotations.push([draw(-1.0, 1.0), draw(-1.0, 1.0), draw(-1.0, 1.0), draw(0.1, 1.0)]);
        gaussians.log_scales.push([draw(-3.0, -1.5), draw(-3.0, -1.5), draw(-3.0, -1.5)]);
        gaussians.logit_opacities.push(draw(0.0, 4.0));
        for value in 0..3 * gaussians.sh_coefficients() {
            gaussians.sh.push(if value < 3 { draw(-1.5, 1.5) } else { draw(-0.1, 0.1) });
        }
    }
    gaussians
}

/// Numbers between -1 and 1.
pub(crate) fn seeds(count: usize) -> Vec<f32> {
    (0..count).map(|place| (place as f32 * 12.9898).sin()).collect()
}

/// Bent, noisy tracks, those of one side `jump` px further, hidden pixels and claims from 0.01 to 3 px.
pub(crate) fn rough_tracks(camera: &Camera, jump: f64, seed: u64) -> TrackField {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut field = TrackField {
        width: camera.width,
        height: camera.height,
        positions: Vec::new(),
        visible: Vec::new(),
        sigma: Vec::new(),
    };
    let pixels = (0..camera.height).flat_map(|row| (0..camera.width).map(move |column| (column, row)));
    for (column, row) in pixels {
        let (x, y) = (f64::from(column) + 0.5, f64::from(row) + 0.5);
        let sigma: f64 = 0.01 * 300f64.powf(random.random_range(0.0..1.0));
        let jump = if x + 0.3 * y > 40.0 { jump } else { 0.0 };
        let mut noise = || sigma * random.random_range(-1.7..1.7);
        let bend = 0.07 * x * x / f64::from(camera.width);
        let target = [x + 3.0 + 0.05 * y + bend + jump + noise(), y - 2.0 - 0.03 * x + noise()];
        field.positions.push(target.map(|value| value as f32));
        field.visible.push(random.random_range(0.0..1.0) > 0.1);
        field.sigma.push(sigma as f32);
    }
    field
}
