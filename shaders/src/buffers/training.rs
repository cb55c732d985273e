//! What a training session takes beyond a pass.

use splat::engine::EngineError;

use super::{Buffer, Buffers, Request, Size, allocate, storage};
use crate::{device::GpuDevice, layout::GEOMETRY, transfer::write};

/// Everything that a session takes: `images` are the pixels of each training image and
/// whether it is packed, `active` the flags of the Gaussians and
/// `steps` the losses that the device remembers.
pub(crate) fn training_requests(
    size: &Size,
    images: impl Iterator<Item = (u64, bool)>,
    active: usize,
    steps: usize,
) -> Vec<Request> {
    let groups: [&[Request]; 4] = [
        &Buffers::requests(size),
        &GradientBuffers::requests(size),
        &OptimiserBuffers::requests(size, active),
        &LossBuffers::requests(size, steps),
    ];
    groups
        .concat()
        .into_iter()
        .chain(images.map(|(pixels, is_packed)| training_image(pixels, is_packed)))
        .collect()
}

/// Colour of every pixel of a training image, and whether it counts.
pub(crate) fn training_image(pixels: u64, is_packed: bool) -> Request {
    storage("training image", if is_packed { 4 * pixels } else { 16 * pixels })
}

/// Gradients by pixels and by parameters, and what densification decides by.
#[derive(Clone, Debug)]
pub(crate) struct GradientBuffers {
    pub image: Buffer,
    pub geometry: Buffer,
    pub sh: Buffer,
    pub density: Buffer,
}

impl GradientBuffers {
    fn requests(size: &Size) -> [Request; 4] {
        let Size { count, coefficients, pixels, .. } = *size;
        [
            storage("gradient by the image", 16 * pixels),
            storage("gradient by the geometry", 4 * GEOMETRY as u64 * count),
            storage("gradient by sh", 12 * coefficients * count),
            storage("density", 8 * count),
        ]
    }

    pub(crate) fn new(device: &GpuDevice, size: &Size) -> Result<Self, EngineError> {
        let [image, geometry, sh, density] = allocate(device, Self::requests(size))?;
        Ok(Self { image, geometry, sh, density })
    }
}

/// What the optimiser keeps per parameter, and which Gaussians it leaves alone.
#[derive(Clone, Debug)]
pub(crate) struct OptimiserBuffers {
    /// First and second moments of the geometry, then of the spherical harmonics.
    pub moments: [Buffer; 4],
    pub active: Buffer,
}

impl OptimiserBuffers {
    fn requests(size: &Size, active: usize) -> [Request; 5] {
        let (geometry, sh) = (4 * GEOMETRY as u64 * size.count, 12 * size.coefficients * size.count);
        [
            storage("first moments of the geometry", geometry),
            storage("second moments of the geometry", geometry),
            storage("first moments of sh", sh),
            storage("second moments of sh", sh),
            storage("active", 4 * active as u64),
        ]
    }

    /// Zero moments; `active` is empty if all are.
    pub(crate) fn new(device: &GpuDevice, size: &Size, active: &[bool]) -> Result<Self, EngineError> {
        let [a, b, c, d, flags] = allocate(device, Self::requests(size, active.len()))?;
        let values: Vec<u32> = active.iter().map(|&active| u32::from(active)).collect();
        write(device, &flags, &values)?;
        Ok(Self { moments: [a, b, c, d], active: flags })
    }
}

/// What the loss of a view needs; the images' gradient is among the [`GradientBuffers`].
#[derive(Clone, Debug)]
pub(crate) struct LossBuffers {
    pub derivatives: Buffer,
    pub shares: Buffer,
    /// Of the last steps.
    pub losses: Buffer,
}

impl LossBuffers {
    fn requests(size: &Size, steps: usize) -> [Request; 3] {
        let Size { pixels, tiles, .. } = *size;
        [
            storage("derivatives of SSIM", 36 * pixels),
            storage("shares of the loss", 8 * tiles),
            storage("losses", 4 * steps as u64),
        ]
    }

    /// With room for the losses of so many steps.
    pub(crate) fn new(device: &GpuDevice, size: &Size, steps: usize) -> Result<Self, EngineError> {
        let [derivatives, shares, losses] = allocate(device, Self::requests(size, steps))?;
        Ok(Self { derivatives, shares, losses })
    }
}
