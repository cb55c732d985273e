//! The buffers of a device: what a pass and a training session take, known before it is taken.

mod common;
mod moments;
pub(crate) mod parameters;
mod raster;
mod training;

use std::{ops::Deref, sync::Arc};

use splat::engine::EngineError;
use wgpu::{BufferDescriptor, BufferUsages, ErrorFilter};

pub(crate) use self::{
    common::{CommonBuffers, DEPTH_PASSES},
    moments::MomentBuffers,
    parameters::{ParameterBuffers, separated},
    raster::{Buffers, DIGITS, FootprintBuffers, IntersectionBuffers, SortBuffers, first_capacity},
    training::{GradientBuffers, LossBuffers, OptimiserBuffers, training_image, training_requests},
};
use crate::device::{GpuDevice, Reservation};

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

/// A buffer on the device, and its part of what the device has to give.
#[derive(Clone, Debug)]
pub(crate) struct Buffer {
    buffer: wgpu::Buffer,
    /// After the buffer: it is freed before it is given back.
    _held: Arc<Reservation>,
}

impl Deref for Buffer {
    type Target = wgpu::Buffer;

    fn deref(&self) -> &wgpu::Buffer {
        &self.buffer
    }
}

/// All bytes of the requests.
pub(crate) fn total(requests: &[Request]) -> u64 {
    requests.iter().map(|request| request.bytes).fold(0, u64::saturating_add)
}

/// Whether the device would grant all of them, before the first is made; with the figures if not.
pub(crate) fn admit(device: &GpuDevice, requests: &[Request]) -> Result<(), EngineError> {
    admit_instead(device, requests, 0)
}

/// The same when so many of the bytes that are held now are given back first.
pub(crate) fn admit_instead(
    device: &GpuDevice,
    requests: &[Request],
    returned: u64,
) -> Result<(), EngineError> {
    device.account().admit(total(requests), returned)?;
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
    let mut held = device.account().reserve(total(&requests))?;
    let scope = device.device.push_error_scope(ErrorFilter::OutOfMemory);
    let buffers = requests.map(|request| {
        let buffer = device.device.create_buffer(&BufferDescriptor {
            label: Some(request.label),
            // A binding must not be empty, and copies are of whole words.
            size: request.bytes.max(32).next_multiple_of(4),
            usage: request.usage,
            mapped_at_creation: false,
        });
        Buffer { buffer, _held: Arc::new(held.split(request.bytes)) }
    });
    match pollster::block_on(scope.pop()) {
        // The driver says that it has no more, not how much it has.
        Some(_) => Err(EngineError::OutOfResources { needed: total(&requests), available: 0 }),
        None => Ok(buffers),
    }
}
