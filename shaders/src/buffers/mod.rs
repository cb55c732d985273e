//! The buffers of a device: what a pass and a training session take, known before it is taken.

mod common;
mod moments;
pub(crate) mod parameters;
mod raster;
mod training;

use splat::engine::EngineError;
use wgpu::{Buffer, BufferDescriptor, BufferUsages, ErrorFilter};

pub(crate) use self::{
    common::{CommonBuffers, DEPTH_PASSES},
    moments::MomentBuffers,
    parameters::{ParameterBuffers, separated},
    raster::{Buffers, DIGITS, FootprintBuffers, IntersectionBuffers, SortBuffers, first_capacity},
    training::{GradientBuffers, LossBuffers, OptimiserBuffers, training_image, training_requests},
};
use crate::device::GpuDevice;

/// Elements of one block of the sort and of the scan.
pub(crate) const BLOCK: u64 = 1024;

/// How much there is to hold.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Size {
    /// Gaussians.
    pub count: u64,
    /// Spherical-harmonic coefficients per Gaussian and channel.
    pub coefficients: u64,
    /// Pixels and tiles of the largest view.
    pub pixels: u64,
    pub tiles: u64,
    /// Intersections of footprints with tiles.
    pub capacity: u64,
    /// Whether intersections have sums.
    pub has_gradient: bool,
}

/// A buffer that is wanted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Request {
    pub label: &'static str,
    pub bytes: u64,
    pub usage: BufferUsages,
}

/// A buffer that kernels read and write.
pub(crate) fn storage(label: &'static str, bytes: u64) -> Request {
    let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
    Request { label, bytes, usage }
}

/// A buffer of settings.
pub(crate) fn uniform(label: &'static str, bytes: u64) -> Request {
    Request { label, bytes, usage: BufferUsages::UNIFORM | BufferUsages::COPY_DST }
}

/// Whether the device would grant all of them, before the first is made; with the figures if not.
pub(crate) fn admit(device: &GpuDevice, requests: &[Request]) -> Result<(), EngineError> {
    let needed: u64 = requests.iter().map(|request| request.bytes).sum();
    if let Some(available) = device.memory_limit()
        && needed > available
    {
        return Err(EngineError::OutOfResources { needed, available });
    }
    match requests.iter().map(|request| request.bytes).max() {
        Some(largest) if largest > device.max_buffer() => {
            Err(EngineError::OutOfResources { needed: largest, available: device.max_buffer() })
        }
        _ => Ok(()),
    }
}

/// Allocates all or none.
pub(crate) fn allocate<const COUNT: usize>(
    device: &GpuDevice,
    requests: [Request; COUNT],
) -> Result<[Buffer; COUNT], EngineError> {
    admit(device, &requests)?;
    let scope = device.device.push_error_scope(ErrorFilter::OutOfMemory);
    let buffers = requests.map(|request| {
        device.device.create_buffer(&BufferDescriptor {
            label: Some(request.label),
            // A binding must not be empty, and copies are of whole words.
            size: request.bytes.max(32).next_multiple_of(4),
            usage: request.usage,
            mapped_at_creation: false,
        })
    });
    match pollster::block_on(scope.pop()) {
        // The driver says that it has no more, not how much it has.
        Some(_) => Err(EngineError::OutOfResources {
            needed: requests.iter().map(|request| request.bytes).sum(),
            available: 0,
        }),
        None => Ok(buffers),
    }
}
