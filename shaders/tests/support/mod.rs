//! The device that the tests run on, and seeded scenes.
//!
//! `TRACKERSPLAT_TEST_DEVICE` chooses it: a part of a device's name, `gpu:N`, or `none` where a machine is known to have
//! none, which skips what needs one. Without it, tests take a GPU if there is one, software otherwise, and fail if there is
//! neither.
#![allow(dead_code, clippy::print_stderr, reason = "each test program uses a part; skipped tests say so")]

use std::sync::OnceLock;

use splat_shaders::{DeviceChoice, GpuDevice, GpuEngine, devices};

/// The engine of this test program; `None` if the environment says that there is no device.
pub(crate) fn engine() -> Option<&'static GpuEngine> {
    static ENGINE: OnceLock<Option<GpuEngine>> = OnceLock::new();
    let engine = ENGINE.get_or_init(|| {
        let choice = choice()?;
        let device = GpuDevice::open(&choice).unwrap_or_else(|error| {
            panic!("{error}. Software Vulkan will do (Debian: mesa-vulkan-drivers); TRACKERSPLAT_TEST_DEVICE=none skips these tests")
        });
        Some(GpuEngine::new(device).expect("kernels compile on every device"))
    });
    if engine.is_none() {
        eprintln!("skipped: TRACKERSPLAT_TEST_DEVICE=none");
    }
    engine.as_ref()
}

fn choice() -> Option<DeviceChoice> {
    match std::env::var("TRACKERSPLAT_TEST_DEVICE").as_deref() {
        Ok("none") => None,
        Ok(name) => Some(match name.strip_prefix("gpu:").and_then(|number| number.parse().ok()) {
            Some(index) => DeviceChoice::Index(index),
            None => DeviceChoice::Name(name.to_owned()),
        }),
        Err(_) if GpuDevice::open(&DeviceChoice::Auto).is_ok() => Some(DeviceChoice::Auto),
        Err(_) => Some(DeviceChoice::Index(devices().first().map_or(0, |device| device.index))),
    }
}
