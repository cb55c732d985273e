//! The device that tests of the GPU engine give to the program.

use std::process::Command;

use serde_json::Value;

use crate::program;

/// `--device` for the program, and the name of the device.
pub struct TestDevice {
    /// By its number.
    pub argument: String,
    /// As the driver says.
    pub name: String,
}

/// What `devices --json` says.
///
/// # Panics
/// If the program fails.
pub fn listed() -> Vec<Value> {
    // Drivers write what they like to stderr.
    let ended =
        Command::new(program::path()).args(["devices", "--json"]).output().expect("the program starts");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    serde_json::from_slice(&ended.stdout).expect("JSON")
}

/// Software that behaves like a GPU, which is slow enough to be killed in the middle of a frame, or what
/// `TRACKERSPLAT_TEST_DEVICE` says: a part of a name, `gpu:N`, or `none`, which skips what needs a device.
///
/// # Panics
/// If there is none and nobody said so.
#[allow(clippy::print_stderr, reason = "skipped tests say so")]
pub fn device() -> Option<TestDevice> {
    let wanted = std::env::var("TRACKERSPLAT_TEST_DEVICE").ok().map(|wanted| wanted.to_lowercase());
    if wanted.as_deref() == Some("none") {
        eprintln!("skipped: TRACKERSPLAT_TEST_DEVICE=none");
        return None;
    }
    let gpus: Vec<Value> = listed().into_iter().filter(|device| device["engine"] == "gpu").collect();
    let text = |device: &Value, key: &str| device[key].as_str().unwrap_or_default().to_owned();
    let fits = |device: &&Value| match &wanted {
        Some(wanted) => {
            text(device, "device") == *wanted || text(device, "name").to_lowercase().contains(wanted)
        }
        None => device["kind"] == "software",
    };
    let device = gpus.iter().find(fits).unwrap_or_else(|| {
        panic!(
            "no device for {wanted:?} among {gpus:?}. Software Vulkan will do (Debian: mesa-vulkan-drivers); \
             TRACKERSPLAT_TEST_DEVICE=none skips these tests"
        )
    });
    Some(TestDevice { argument: text(device, "device"), name: text(device, "name") })
}
