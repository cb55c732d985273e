//! `devices`: what a worker can run on here.

use clap::Args;
use comfy_table::CellAlignment;
use serde::Serialize;
use splat::{engine::Engine, raster::CpuEngine, simd::Instructions};
use splat_shaders::{DeviceDescription, real_gpus};

use super::{cores, print_json};
use crate::{error::CliError, stdout, table};

/// Arguments of `devices`.
#[derive(Args, Debug)]
pub(crate) struct DevicesArgs {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A device and the engine that drives it.
#[derive(Debug, Serialize)]
struct Device {
    /// What `--device` calls it.
    device: String,
    /// Number among the GPUs; absent for the processor.
    index: Option<usize>,
    engine: String,
    name: String,
    /// `cpu`, `discrete`, `integrated`, `virtual`, `software` or `unknown`.
    kind: String,
    backend: Option<String>,
    driver: Option<String>,
    /// Memory that jobs can have, where it is known.
    memory_bytes: Option<u64>,
    /// Of the processor.
    threads: Option<usize>,
    /// Instruction sets of the processor; optional capabilities of a GPU.
    features: Vec<String>,
    /// Whether `--device auto` takes it.
    auto: bool,
}

pub(super) fn run(args: DevicesArgs) -> Result<(), CliError> {
    let devices = all(&splat_shaders::devices());
    if args.json {
        return print_json(&devices);
    }
    let header = ["device", "name", "kind", "backend", "driver", "memory GiB", "threads", "features", "auto"];
    let mut table = table::empty(&header);
    for device in devices {
        let gibibytes = device.memory_bytes.map(|bytes| format!("{:.1}", bytes as f64 / f64::from(1 << 30)));
        table.add_row([
            device.device,
            device.name,
            device.kind,
            device.backend.unwrap_or_default(),
            device.driver.unwrap_or_default(),
            gibibytes.unwrap_or_default(),
            device.threads.map(|threads| threads.to_string()).unwrap_or_default(),
            device.features.join(" "),
            if device.auto { "takes it".to_owned() } else { String::new() },
        ]);
    }
    for column in table.column_iter_mut().skip(5).take(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    stdout::line(&table);
    Ok(())
}

/// The processor and every GPU.
fn all(gpus: &[DeviceDescription]) -> Vec<Device> {
    let best = real_gpus(gpus).first().map(|device| device.index);
    let mut devices = vec![cpu(best.is_none())];
    devices.extend(gpus.iter().map(|device| gpu(device, best)));
    devices
}

fn gpu(device: &DeviceDescription, best: Option<usize>) -> Device {
    Device {
        device: format!("gpu:{}", device.index),
        index: Some(device.index),
        engine: "gpu".to_owned(),
        name: device.name.clone(),
        kind: device.kind.label().to_owned(),
        backend: Some(device.backend.clone()),
        driver: Some(device.driver.clone()),
        memory_bytes: device.memory,
        threads: None,
        features: device.features.iter().map(|feature| (*feature).to_owned()).collect(),
        auto: best == Some(device.index),
    }
}

fn cpu(auto: bool) -> Device {
    // Linux only; elsewhere the architecture has to do.
    let told = |file| std::fs::read_to_string(file).unwrap_or_default();
    let name = model_name(&told("/proc/cpuinfo")).unwrap_or(std::env::consts::ARCH).to_owned();
    let features = Instructions::available().map(|instructions| instructions.set().to_string()).collect();
    Device {
        device: "cpu".to_owned(),
        index: None,
        engine: CpuEngine::default().name().to_owned(),
        name,
        kind: "cpu".to_owned(),
        backend: None,
        driver: None,
        memory_bytes: memory(&told("/proc/meminfo")),
        threads: Some(cores()),
        features,
        auto,
    }
}

fn model_name(processors: &str) -> Option<&str> {
    let line = processors.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim())
}

fn memory(told: &str) -> Option<u64> {
    let line = told.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kibibytes)
}

#[cfg(test)]
mod tests {
    use splat_shaders::DeviceKind;

    use super::*;

    #[test]
    fn the_processor_has_a_name_where_the_system_tells() {
        let told = "processor\t: 0\nmodel name\t: Fast One @ 3 GHz\nflags\t: a b\n";
        assert_eq!(model_name(told), Some("Fast One @ 3 GHz"));
        assert_eq!(model_name(""), None);
        assert_eq!(memory("MemTotal:       32 kB\nMemFree: 1 kB\n"), Some(32768));
        assert_eq!(memory(""), None);
        assert!(cpu(true).threads >= Some(1) && !cpu(true).name.is_empty());
    }

    #[test]
    fn auto_takes_exactly_one_device_and_no_software() {
        let description = |index, kind| DeviceDescription {
            index,
            name: "x".to_owned(),
            kind,
            backend: "vulkan".to_owned(),
            driver: String::new(),
            memory: None,
            max_binding: 0,
            pci_bus: String::new(),
            features: Vec::new(),
        };
        let taken = |kinds: &[DeviceKind]| {
            let gpus: Vec<_> =
                kinds.iter().enumerate().map(|(index, kind)| description(index, *kind)).collect();
            let taken: Vec<_> =
                all(&gpus).iter().filter(|device| device.auto).map(|device| device.device.clone()).collect();
            taken.join(" ")
        };
        assert_eq!(taken(&[]), "cpu");
        assert_eq!(taken(&[DeviceKind::Software]), "cpu");
        assert_eq!(taken(&[DeviceKind::Software, DeviceKind::Integrated, DeviceKind::Discrete]), "gpu:2");
        assert_eq!(taken(&[DeviceKind::Discrete, DeviceKind::Discrete]), "gpu:0");
    }
}
