//! Which devices there are, and one of them opened.

use std::{
    fmt,
    sync::{Arc, Mutex, PoisonError},
};

use splat::engine::EngineError;
use thiserror::Error;
use wgpu::{
    Adapter, Backends, Device, DeviceDescriptor, DeviceType, Features, Instance, InstanceDescriptor,
    InstanceFlags, Limits, Queue,
};

/// What sort of device it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceKind {
    /// A card with memory of its own.
    Discrete,
    /// Part of the processor, sharing its memory.
    Integrated,
    /// A device handed through by a hypervisor.
    Virtual,
    /// A program that behaves like a device: right, and slower than the CPU engine.
    Software,
    /// The driver does not say.
    Unknown,
}

/// A device that this machine offers.
#[derive(Clone, Debug)]
pub struct DeviceDescription {
    /// Number among all devices, for [`DeviceChoice::Index`].
    pub index: usize,
    /// The driver's name for it.
    pub name: String,
    /// What sort of device it is.
    pub kind: DeviceKind,
    /// `vulkan`, `metal` or `dx12`.
    pub backend: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer that a kernel can see, bytes.
    pub max_binding: u64,
    /// Optional capabilities: `subgroup` and `timestamps` have a use, see [`GpuDevice::with_subgroups`]; `f16` and `int64` are
    /// told only.
    pub features: Vec<&'static str>,
}

/// Which device to open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best that is no software: discrete before integrated before the others.
    Auto,
    /// By its number in [`devices`].
    Index(usize),
    /// The first whose name contains this, upper and lower case alike.
    Name(String),
}

/// Why no device was opened.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// Nothing fits.
    #[error("no GPU fits `{choice}`; this machine has: {found}")]
    NotFound {
        /// What was asked for.
        choice: DeviceChoice,
        /// What there is.
        found: String,
    },
    /// The driver refused.
    #[error("cannot open {name}: {reason}; see whether its driver works")]
    Refused {
        /// The device.
        name: String,
        /// What the driver said.
        reason: String,
    },
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => write!(f, "auto"),
            Self::Index(index) => write!(f, "gpu:{index}"),
            Self::Name(name) => write!(f, "{name}"),
        }
    }
}

impl DeviceKind {
    fn of(kind: DeviceType) -> Self {
        match kind {
            DeviceType::DiscreteGpu => Self::Discrete,
            DeviceType::IntegratedGpu => Self::Integrated,
            DeviceType::VirtualGpu => Self::Virtual,
            DeviceType::Cpu => Self::Software,
            DeviceType::Other => Self::Unknown,
        }
    }

    /// Order of preference of [`DeviceChoice::Auto`]; `None` is never chosen.
    fn preference(self) -> Option<u8> {
        match self {
            Self::Discrete => Some(0),
            Self::Integrated => Some(1),
            Self::Virtual => Some(2),
            Self::Unknown => Some(3),
            Self::Software => None,
        }
    }
}

impl DeviceDescription {
    fn new(index: usize, adapter: &Adapter) -> Self {
        let info = adapter.get_info();
        let has = adapter.features();
        let optional = [
            (Features::SUBGROUP, "subgroup"),
            (Features::SHADER_F16, "f16"),
            (Features::SHADER_INT64, "int64"),
            (Features::TIMESTAMP_QUERY, "timestamps"),
        ];
        Self {
            index,
            name: info.name,
            kind: DeviceKind::of(info.device_type),
            backend: info.backend.to_string(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            max_binding: adapter.limits().max_storage_buffer_binding_size,
            features: optional
                .iter()
                .filter(|(feature, _)| has.contains(*feature))
                .map(|(_, name)| *name)
                .collect(),
        }
    }
}

/// The devices of this machine, software ones included, in the order in which [`DeviceChoice::Index`] counts.
pub fn devices() -> Vec<DeviceDescription> {
    adapters().iter().enumerate().map(|(index, adapter)| DeviceDescription::new(index, adapter)).collect()
}

fn adapters() -> Vec<Adapter> {
    let mut descriptor = InstanceDescriptor::new_without_display_handle();
    descriptor.backends = Backends::VULKAN | Backends::METAL | Backends::DX12;
    // Indirect dispatches are written by `plan` alone, within the limits; wgpu's own check is a dispatch for each.
    descriptor.flags = InstanceFlags::empty();
    pollster::block_on(Instance::new(descriptor).enumerate_adapters(Backends::all()))
}

/// Size from which subgroups are taken without being asked for: smaller ones leave more to add up afterwards than the sixteen
/// threads of the form without (`wgsl/shared/group_scan.wgsl`).
const WORTHWHILE_SUBGROUP: u32 = 16;

/// What went wrong on a device outside of the calls that return errors.
#[derive(Debug, Default)]
struct Fault {
    lost: Option<String>,
    error: Option<String>,
}

/// An opened device.
#[derive(Debug)]
pub struct GpuDevice {
    pub(crate) device: Device,
    pub(crate) queue: Queue,
    description: DeviceDescription,
    limits: Limits,
    memory_limit: Option<u64>,
    uses_subgroups: bool,
    fault: Arc<Mutex<Fault>>,
}

impl GpuDevice {
    /// Opens a device.
    pub fn open(choice: &DeviceChoice) -> Result<Self, DeviceError> {
        let adapters = adapters();
        let descriptions: Vec<_> = adapters
            .iter()
            .enumerate()
            .map(|(index, adapter)| DeviceDescription::new(index, adapter))
            .collect();
        let chosen = choose(choice, &descriptions)
            .ok_or_else(|| DeviceError::NotFound { choice: choice.clone(), found: listed(&descriptions) })?;
        let description = descriptions[chosen].clone();
        Self::request(&adapters[chosen], description)
    }

    fn request(adapter: &Adapter, description: DeviceDescription) -> Result<Self, DeviceError> {
        let offered = adapter.limits();
        // Kernels keep to the defaults; only sizes of buffers follow the device.
        let limits = Limits {
            max_buffer_size: offered.max_buffer_size,
            max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
            ..Limits::defaults()
        };
        let descriptor = DeviceDescriptor {
            label: Some("trackersplat"),
            // What there is of them: timestamps are for figures only, and no stage needs subgroups.
            required_features: adapter.features() & (Features::TIMESTAMP_QUERY | Features::SUBGROUP),
            required_limits: limits.clone(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).map_err(|error| {
            DeviceError::Refused { name: description.name.clone(), reason: error.to_string() }
        })?;
        let uses_subgroups = device.features().contains(Features::SUBGROUP)
            && adapter.get_info().subgroup_min_size >= WORTHWHILE_SUBGROUP;
        let fault = Arc::new(Mutex::new(Fault::default()));
        let lost = Arc::clone(&fault);
        device.set_device_lost_callback(move |_, message| {
            let mut fault = lost.lock().unwrap_or_else(PoisonError::into_inner);
            fault.lost.get_or_insert(message);
        });
        let failed = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut fault = failed.lock().unwrap_or_else(PoisonError::into_inner);
            fault.error.get_or_insert(error.to_string());
        }));
        Ok(Self { device, queue, description, limits, memory_limit: None, uses_subgroups, fault })
    }

    /// Lets jobs take so many bytes at most; without it, jobs take what the driver grants, which it does not tell before.
    pub fn with_memory_limit(self, bytes: u64) -> Self {
        Self { memory_limit: Some(bytes), ..self }
    }

    /// Says whether stages run in their form for subgroups, where the device has any. The results are the same to the byte;
    /// this is for comparing times, and for a driver whose subgroups are broken. Without it, [`GpuDevice::open`] decides.
    pub fn with_subgroups(self, wanted: bool) -> Self {
        let uses_subgroups = wanted && self.device.features().contains(Features::SUBGROUP);
        Self { uses_subgroups, ..self }
    }

    /// Whether stages run in their form for subgroups.
    pub fn uses_subgroups(&self) -> bool {
        self.uses_subgroups
    }

    /// See [`GpuDevice::with_memory_limit`].
    pub(crate) fn memory_limit(&self) -> Option<u64> {
        self.memory_limit
    }

    /// What it is.
    pub fn description(&self) -> &DeviceDescription {
        &self.description
    }

    /// Largest buffer that a kernel can see, bytes.
    pub(crate) fn max_buffer(&self) -> u64 {
        // Kernels count words in 32 bits, and the last row of workgroups reaches some beyond the end: 65 535 blocks of 1024.
        let counted = 4 * u64::from(u32::MAX - (1 << 27));
        self.limits.max_buffer_size.min(self.limits.max_storage_buffer_binding_size).min(counted)
    }

    /// Whether the device still does what it is told.
    pub(crate) fn check(&self) -> Result<(), EngineError> {
        let fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        match (&fault.lost, &fault.error) {
            (Some(lost), _) => Err(EngineError::DeviceLost(format!("{}: {lost}", self.description.name))),
            (None, Some(error)) => {
                Err(EngineError::DeviceLost(format!("{}: {error}", self.description.name)))
            }
            (None, None) => Ok(()),
        }
    }
}

fn choose(choice: &DeviceChoice, devices: &[DeviceDescription]) -> Option<usize> {
    match choice {
        DeviceChoice::Auto => {
            let ranked = devices.iter().filter_map(|device| Some((device.kind.preference()?, device.index)));
            ranked.min().map(|(_, index)| index)
        }
        DeviceChoice::Index(index) => (*index < devices.len()).then_some(*index),
        DeviceChoice::Name(name) => {
            let name = name.to_lowercase();
            devices.iter().position(|device| device.name.to_lowercase().contains(&name))
        }
    }
}

fn listed(devices: &[DeviceDescription]) -> String {
    if devices.is_empty() {
        return "none (is a Vulkan, Metal or DirectX 12 driver installed?)".to_owned();
    }
    let one = |device: &DeviceDescription| {
        let software =
            if device.kind == DeviceKind::Software { ", software: only by its name or number" } else { "" };
        format!("gpu:{} {} ({}{software})", device.index, device.name, device.backend)
    };
    devices.iter().map(one).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(index: usize, name: &str, kind: DeviceKind) -> DeviceDescription {
        DeviceDescription {
            index,
            name: name.to_owned(),
            kind,
            backend: "vulkan".to_owned(),
            driver: String::new(),
            max_binding: 0,
            features: Vec::new(),
        }
    }

    #[test]
    fn auto_takes_the_best_card_and_never_software() {
        let software = device(0, "llvmpipe", DeviceKind::Software);
        assert_eq!(choose(&DeviceChoice::Auto, &[]), None);
        assert_eq!(choose(&DeviceChoice::Auto, std::slice::from_ref(&software)), None);
        let all = [
            software,
            device(1, "built in", DeviceKind::Integrated),
            device(2, "Card A", DeviceKind::Discrete),
            device(3, "Card B", DeviceKind::Discrete),
        ];
        assert_eq!(choose(&DeviceChoice::Auto, &all), Some(2));
        assert_eq!(choose(&DeviceChoice::Name("card b".to_owned()), &all), Some(3));
        assert_eq!(choose(&DeviceChoice::Name("llvm".to_owned()), &all), Some(0));
        assert_eq!(choose(&DeviceChoice::Name("card c".to_owned()), &all), None);
        assert_eq!(choose(&DeviceChoice::Index(1), &all), Some(1));
        assert_eq!(choose(&DeviceChoice::Index(4), &all), None);
    }

    #[test]
    fn what_there_is_is_told() {
        let text = listed(&[device(0, "llvmpipe", DeviceKind::Software)]);
        assert!(text.contains("gpu:0 llvmpipe") && text.contains("software"), "{text}");
        assert!(listed(&[]).contains("driver"));
    }
}
