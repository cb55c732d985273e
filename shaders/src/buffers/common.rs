//! Settings of the kernels, and what they know about the step.

use bytemuck::{Pod, bytes_of};
use splat::engine::EngineError;
use wgpu::{BindingResource, BufferBinding, BufferSize, BufferUsages};

use super::{Buffer, Request, allocate, storage, uniform};
use crate::{
    device::GpuDevice,
    layout::{ScanSettings, SortSettings, State, Step},
};

/// Settings of a kernel start at multiples of this, the largest alignment that a device may ask for.
const SETTING: u64 = 256;

/// Passes of the sort by depth: all bits, eight at a time.
pub(crate) const DEPTH_PASSES: u32 = 4;

/// What is there once: settings of the kernels, and what they know about the step.
#[derive(Clone, Debug)]
pub(crate) struct CommonBuffers {
    pub step: Buffer,
    pub state: Buffer,
    /// Numbers of workgroups, written by `plan`.
    pub dispatches: Buffer,
    settings: Buffer,
}

impl CommonBuffers {
    pub(crate) fn new(device: &GpuDevice) -> Result<Self, EngineError> {
        let indirect = Request {
            label: "dispatches",
            bytes: 32,
            usage: BufferUsages::STORAGE | BufferUsages::INDIRECT | BufferUsages::COPY_SRC,
        };
        let requests = [
            uniform("step", size_of::<Step>() as u64),
            storage("state", size_of::<State>() as u64),
            indirect,
            uniform("settings", SETTING * u64::from(2 * DEPTH_PASSES + 3)),
        ];
        let [step, state, dispatches, settings] = allocate(device, requests)?;
        let common = Self { step, state, dispatches, settings };
        for list in 0..2 {
            for pass in 0..DEPTH_PASSES {
                common.set(device, DEPTH_PASSES * list + pass, &SortSettings { list, shift: 8 * pass });
            }
        }
        for list in 0..3 {
            common.set(device, 2 * DEPTH_PASSES + list, &ScanSettings { list });
        }
        Ok(common)
    }

    fn set<T: Pod>(&self, device: &GpuDevice, place: u32, value: &T) {
        device.queue.write_buffer(&self.settings, u64::from(place) * SETTING, bytes_of(value));
    }

    fn setting<T>(&self, place: u32) -> BindingResource<'_> {
        BindingResource::Buffer(BufferBinding {
            buffer: &self.settings,
            offset: u64::from(place) * SETTING,
            size: BufferSize::new(size_of::<T>() as u64),
        })
    }

    /// Settings of pass `pass` of the sort of `list`.
    pub(crate) fn sort_setting(&self, list: u32, pass: u32) -> BindingResource<'_> {
        self.setting::<SortSettings>(DEPTH_PASSES * list + pass)
    }

    /// Settings of the scan of `list`.
    pub(crate) fn scan_setting(&self, list: u32) -> BindingResource<'_> {
        self.setting::<ScanSettings>(2 * DEPTH_PASSES + list)
    }
}
