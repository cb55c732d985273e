//! Which devices there are, and one of them opened.

mod account;
mod choice;
mod health;

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use thiserror::Error;
use wgpu::{
    Adapter, Backends, Device, DeviceDescriptor, DeviceType, Features, Instance, InstanceDescriptor,
    InstanceFlags, Limits, MemoryBudgetThresholds, Queue, SubmissionIndex,
};

pub(crate) use self::account::{Account, Reservation};
pub use self::choice::{DeviceChoice, choose, real_gpus};
use self::health::{Health, Poll};

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
    /// Where it sits, such as `0000:c1:00.0`; empty where the driver does not say.
    pub pci_bus: String,
    /// Memory that jobs can have, bytes, where the driver says: a card's own, else the largest it sees. Unknown for software.
    pub memory: Option<u64>,
    /// Largest buffer that a kernel can see, bytes.
    pub max_binding: u64,
    /// Optional capabilities: `subgroup` and `timestamps` have a use, see [`GpuDevice::with_subgroups`]; `f16` and `int64` are
    /// told only.
    pub features: Vec<&'static str>,
}

/// Why no device was opened.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// Nobody can say what is meant.
    #[error("`{text}` is neither the number of a GPU, such as gpu:0, nor a part of a name")]
    Unreadable {
        /// What was written.
        text: String,
    },
    /// Nothing fits.
    #[error("no GPU fits `{choice}`; this machine has: {found}")]
    NotFound {
        /// What was asked for.
        choice: DeviceChoice,
        /// What there is.
        found: String,
    },
    /// Several fit.
    #[error("several GPUs fit `{name}`: {found}; give the number of one")]
    Ambiguous {
        /// What was asked for.
        name: String,
        /// Those that fit.
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

/// Parts of the names of software adapters, lower case, for drivers that do not say what they are.
const SOFTWARE: [&str; 4] = ["llvmpipe", "lavapipe", "swiftshader", "microsoft basic render"];

impl DeviceKind {
    fn of(kind: DeviceType, name: &str) -> Self {
        let name = name.to_lowercase();
        if SOFTWARE.iter().any(|software| name.contains(software)) {
            return Self::Software;
        }
        match kind {
            DeviceType::DiscreteGpu => Self::Discrete,
            DeviceType::IntegratedGpu => Self::Integrated,
            DeviceType::VirtualGpu => Self::Virtual,
            DeviceType::Cpu => Self::Software,
            DeviceType::Other => Self::Unknown,
        }
    }

    /// The kind as people and scripts read it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Discrete => "discrete",
            Self::Integrated => "integrated",
            Self::Virtual => "virtual",
            Self::Software => "software",
            Self::Unknown => "unknown",
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
        let kind = DeviceKind::of(info.device_type, &info.name);
        let has = adapter.features();
        let optional = [
            (Features::SUBGROUP, "subgroup"),
            (Features::SHADER_F16, "f16"),
            (Features::SHADER_INT64, "int64"),
            (Features::TIMESTAMP_QUERY, "timestamps"),
        ];
        Self {
            index,
            kind,
            memory: memory(adapter, kind),
            name: info.name,
            backend: info.backend.to_string(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            pci_bus: info.device_pci_bus_id,
            max_binding: adapter.limits().max_storage_buffer_binding_size,
            features: optional
                .iter()
                .filter(|(feature, _)| has.contains(*feature))
                .map(|(_, name)| *name)
                .collect(),
        }
    }

    /// Name, backend and driver: what decides how results are rounded.
    pub fn label(&self) -> String {
        let driver = if self.driver.is_empty() { String::new() } else { format!(", {}", self.driver) };
        format!("{} ({}{driver})", self.name, self.backend)
    }

    /// The choice of this very device, whatever its number has become.
    pub fn itself(&self) -> DeviceChoice {
        DeviceChoice::Itself { label: self.label(), pci_bus: self.pci_bus.clone(), index: self.index }
    }
}

/// Memory of a device, where its driver says.
#[cfg(not(target_vendor = "apple"))]
fn memory(adapter: &Adapter, kind: DeviceKind) -> Option<u64> {
    const DEVICE_LOCAL: u32 = 1;
    if kind == DeviceKind::Software {
        // What such drivers say is a constant of theirs; they use the memory of the host.
        return None;
    }
    // SAFETY: the handles are only asked for properties, and nothing of them outlives the adapter.
    let memory = unsafe {
        let adapter = adapter.as_hal::<wgpu::hal::api::Vulkan>()?;
        let instance = adapter.shared_instance().raw_instance();
        instance.get_physical_device_memory_properties(adapter.raw_physical_device())
    };
    let heaps = &memory.memory_heaps[..memory.memory_heap_count as usize];
    let has_its_own = matches!(kind, DeviceKind::Discrete | DeviceKind::Virtual);
    let counts = |flags: u32| !has_its_own || flags & DEVICE_LOCAL != 0;
    heaps.iter().filter(|heap| counts(heap.flags.as_raw())).map(|heap| heap.size).max()
}

/// Memory of a device: no driver here says.
#[cfg(target_vendor = "apple")]
fn memory(_adapter: &Adapter, _kind: DeviceKind) -> Option<u64> {
    None
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
    // Other processes take memory of the same device. Where the driver says how much of it this one may have at present (Vulkan with
    // VK_EXT_memory_budget, DirectX 12), a buffer beyond it is refused; else the driver may grant more than there is and
    // move it to the host, or lose the device.
    descriptor.memory_budget_thresholds =
        MemoryBudgetThresholds { for_resource_creation: Some(SHARE_OF_BUDGET), for_device_loss: None };
    pollster::block_on(Instance::new(descriptor).enumerate_adapters(Backends::all()))
}

/// Size from which subgroups are taken without being asked for: smaller ones leave more to add up afterwards than the sixteen
/// threads of the form without (`wgsl/shared/group_scan.wgsl`).
const WORTHWHILE_SUBGROUP: u32 = 16;

/// Per cent of what the driver says a process may have: the rest is for what the driver takes itself.
const SHARE_OF_BUDGET: u8 = 97;

/// An opened device.
#[derive(Debug)]
pub struct GpuDevice {
    pub(crate) device: Device,
    pub(crate) queue: Queue,
    description: DeviceDescription,
    label: String,
    limits: Limits,
    account: Arc<Account>,
    uses_subgroups: bool,
    health: Arc<Health>,
    /// The upload whose staging buffer may still be in use.
    pub(crate) uploading: Mutex<Option<SubmissionIndex>>,
    patience: Duration,
    poll: Poll,
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
        let description = choose(choice, &descriptions)?.clone();
        Self::request(&adapters[description.index], description)
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
        Ok(Self {
            health: Health::of(&device),
            device,
            queue,
            label: description.label(),
            limits,
            account: Account::new(description.memory),
            uses_subgroups,
            uploading: Mutex::default(),
            patience: health::patience(description.kind),
            poll: health::poll,
            description,
        })
    }

    /// Lets all jobs together take so many bytes at most, and no more than [`DeviceDescription::memory`]; without it, they may ask
    /// for that, or, where it is not known, for what the driver grants, which it does not tell before.
    pub fn with_memory_limit(self, bytes: u64) -> Self {
        Self { account: Account::limited(bytes, self.description.memory), ..self }
    }

    /// Says how long one submission, a step or a pass, may take until the device counts as lost, if nothing else ends meanwhile;
    /// without it, two minutes, half an hour with software.
    pub fn with_patience(self, patience: Duration) -> Self {
        Self { patience, ..self }
    }

    /// Waits in another way.
    #[cfg(test)]
    pub(crate) fn with_poll(self, poll: Poll) -> Self {
        Self { poll, ..self }
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

    /// What buffers take, see [`GpuDevice::with_memory_limit`].
    pub(crate) fn account(&self) -> &Arc<Account> {
        &self.account
    }

    /// What it is.
    pub fn description(&self) -> &DeviceDescription {
        &self.description
    }

    /// [`DeviceDescription::label`].
    pub(crate) fn label(&self) -> &str {
        &self.label
    }

    /// Largest buffer that a kernel can see, bytes.
    pub(crate) fn max_buffer(&self) -> u64 {
        // Kernels count words in 32 bits, and the last row of workgroups reaches some beyond the end: 65 535 blocks of 1024.
        let counted = 4 * u64::from(u32::MAX - (1 << 27));
        self.limits.max_buffer_size.min(self.limits.max_storage_buffer_binding_size).min(counted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn software_is_known_by_its_name_where_the_driver_is_silent() {
        let kind = |name| DeviceKind::of(DeviceType::Other, name);
        assert_eq!(kind("SwiftShader Device (LLVM 10.0.0)"), DeviceKind::Software);
        assert_eq!(kind("Some Card"), DeviceKind::Unknown);
        assert_eq!(DeviceKind::of(DeviceType::VirtualGpu, "Venus (llvmpipe)"), DeviceKind::Software);
        assert_eq!(DeviceKind::of(DeviceType::Cpu, "x"), DeviceKind::Software);
    }
}
