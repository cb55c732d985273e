//! The device that tests of the GPU engine give to the program.

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
    let (code, said) = program::run(["devices", "--json", "--quiet"]);
    assert_eq!(code, 0, "{said}");
    serde_json::from_str(&said).unwrap_or_else(|error| panic!("{error}:\n{said}"))
}

/// A GPU if there is one, else software, else what `TRACKERSPLAT_TEST_DEVICE` says: a part of a name, `gpu:N`, or `none`, which
/// skips what needs a device.
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
        None => device["auto"] == true,
    };
    let software = || gpus.iter().find(|device| wanted.is_none() && device["kind"] == "software");
    let device = gpus.iter().find(fits).or_else(software).unwrap_or_else(|| {
        panic!(
            "no device for {wanted:?} among {gpus:?}. Software Vulkan will do (Debian: mesa-vulkan-drivers); \
             TRACKERSPLAT_TEST_DEVICE=none skips these tests"
        )
    });
    Some(TestDevice { argument: text(device, "device"), name: text(device, "name") })
}
