//! The buffers of a rasterization pass, and what they take.

use bytemuck::{Pod, bytes_of};
use splat::{engine::EngineError, gaussians::Gaussians};
use wgpu::{BindingResource, Buffer, BufferBinding, BufferDescriptor, BufferSize, BufferUsages, ErrorFilter};

use crate::{
    device::GpuDevice,
    layout::{GEOMETRY, SUMS, ScanSettings, SortSettings, State, Step, View},
};

/// Elements of one block of the sort and of the scan.
pub(crate) const BLOCK: u64 = 1024;

/// Digits of one pass of the sort.
const DIGITS: u64 = 16;

/// Settings of a kernel start at multiples of this, the largest alignment that a device may ask for.
const SETTING: u64 = 256;

/// Passes of the sort by depth: all bits, four at a time.
pub(crate) const DEPTH_PASSES: u32 = 8;

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

/// Allocates all or none.
pub(crate) fn allocate<const COUNT: usize>(
    device: &GpuDevice,
    requests: [Request; COUNT],
) -> Result<[Buffer; COUNT], EngineError> {
    let total = requests.iter().map(|request| request.bytes).sum();
    if let Some(largest) = requests.iter().map(|request| request.bytes).max()
        && largest > device.max_buffer()
    {
        return Err(EngineError::OutOfResources { needed: largest, available: device.max_buffer() });
    }
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
        Some(_) => Err(EngineError::OutOfResources { needed: total, available: 0 }),
        None => Ok(buffers),
    }
}

/// Parameters as the kernels read them: mean, rotation, log scale and logit opacity of each Gaussian in a row.
pub(crate) fn interleaved(gaussians: &Gaussians) -> Vec<f32> {
    let mut values = Vec::with_capacity(GEOMETRY * gaussians.len());
    for index in 0..gaussians.len() {
        values.extend(gaussians.means[index]);
        values.extend(gaussians.rotations[index]);
        values.extend(gaussians.log_scales[index]);
        values.push(gaussians.logit_opacities[index]);
    }
    values
}

/// The inverse of [`interleaved`].
pub(crate) fn separated(geometry: &[[f32; GEOMETRY]], sh: Vec<f32>, sh_degree: u32) -> Gaussians {
    Gaussians {
        means: geometry.iter().map(|row| [row[0], row[1], row[2]]).collect(),
        rotations: geometry.iter().map(|row| [row[3], row[4], row[5], row[6]]).collect(),
        log_scales: geometry.iter().map(|row| [row[7], row[8], row[9]]).collect(),
        logit_opacities: geometry.iter().map(|row| row[10]).collect(),
        sh,
        sh_degree,
    }
}

/// The parameters of a set.
#[derive(Clone, Debug)]
pub(crate) struct ParameterBuffers {
    pub geometry: Buffer,
    pub sh: Buffer,
}

impl ParameterBuffers {
    /// Uploads a set.
    pub(crate) fn new(device: &GpuDevice, gaussians: &Gaussians) -> Result<Self, EngineError> {
        let values = 4 * gaussians.len() as u64;
        let requests = [
            storage("geometry", GEOMETRY as u64 * values),
            storage("sh", 3 * gaussians.sh_coefficients() as u64 * values),
        ];
        let [geometry, sh] = allocate(device, requests)?;
        device.queue.write_buffer(&geometry, 0, bytemuck::cast_slice(&interleaved(gaussians)));
        device.queue.write_buffer(&sh, 0, bytemuck::cast_slice(&gaussians.sh));
        Ok(Self { geometry, sh })
    }
}

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
        let indirect =
            Request { label: "dispatches", bytes: 32, usage: BufferUsages::STORAGE | BufferUsages::INDIRECT };
        let requests = [
            uniform("step", size_of::<Step>() as u64),
            storage("state", size_of::<State>() as u64),
            indirect,
            uniform("settings", SETTING * (2 * 8 + 3)),
        ];
        let [step, state, dispatches, settings] = allocate(device, requests)?;
        let common = Self { step, state, dispatches, settings };
        for list in 0..2 {
            for pass in 0..8 {
                common.set(device, 8 * list + pass, &SortSettings { list, shift: 4 * pass });
            }
        }
        for list in 0..3 {
            common.set(device, 16 + list, &ScanSettings { list });
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
        self.setting::<SortSettings>(8 * list + pass)
    }

    /// Settings of the scan of `list`.
    pub(crate) fn scan_setting(&self, list: u32) -> BindingResource<'_> {
        self.setting::<ScanSettings>(16 + list)
    }
}

/// A sort's keys and values, twice, and its histogram.
#[derive(Clone, Debug)]
pub(crate) struct SortBuffers {
    pub keys: [Buffer; 2],
    pub values: [Buffer; 2],
    pub histogram: Buffer,
    pub sums: Buffer,
}

impl SortBuffers {
    pub(crate) fn new(device: &GpuDevice, length: u64) -> Result<Self, EngineError> {
        let histogram = DIGITS * length.div_ceil(BLOCK);
        let requests = [
            storage("keys", 4 * length),
            storage("keys", 4 * length),
            storage("values", 4 * length),
            storage("values", 4 * length),
            storage("histogram", 4 * histogram),
            storage("sums of the histogram", 4 * histogram.div_ceil(BLOCK)),
        ];
        let [key, key_out, value, value_out, histogram, sums] = allocate(device, requests)?;
        Ok(Self { keys: [key, key_out], values: [value, value_out], histogram, sums })
    }
}

/// What each Gaussian has in one view.
#[derive(Clone, Debug)]
pub(crate) struct FootprintBuffers {
    pub count: u64,
    pub footprints: Buffer,
    pub reaches: Buffer,
    /// Depths and indices.
    pub depth: SortBuffers,
    /// Intersections by rank in depth order, and the scan's sums.
    pub counts: Buffer,
    pub sums: Buffer,
    pub ranges: Buffer,
}

impl FootprintBuffers {
    pub(crate) fn new(device: &GpuDevice, count: u64) -> Result<Self, EngineError> {
        let requests = [
            storage("footprints", 48 * count),
            storage("reaches", 32 * count),
            storage("counts", 4 * (count + 1)),
            storage("sums of counts", 4 * (count + 1).div_ceil(BLOCK)),
            storage("ranges", 8 * count),
        ];
        let [footprints, reaches, counts, sums, ranges] = allocate(device, requests)?;
        let depth = SortBuffers::new(device, count)?;
        Ok(Self { count, footprints, reaches, depth, counts, sums, ranges })
    }
}

/// What each intersection of a footprint with a tile has.
#[derive(Clone, Debug)]
pub(crate) struct IntersectionBuffers {
    pub capacity: u64,
    /// Tiles and slots.
    pub tiles: SortBuffers,
    pub owners: Buffer,
    /// Shares of the gradient; empty if none is taken.
    pub sums: Buffer,
}

impl IntersectionBuffers {
    pub(crate) fn new(device: &GpuDevice, capacity: u64, has_gradient: bool) -> Result<Self, EngineError> {
        let sums = if has_gradient { 4 * SUMS as u64 * capacity } else { 0 };
        let [owners, sums] = allocate(device, [storage("owners", 4 * capacity), storage("sums", sums)])?;
        Ok(Self { capacity, tiles: SortBuffers::new(device, capacity)?, owners, sums })
    }
}

/// What each tile and pixel has.
#[derive(Clone, Debug)]
pub(crate) struct ImageBuffers {
    pub bounds: Buffer,
    pub rendered: Buffer,
    pub last: Buffer,
}

impl ImageBuffers {
    /// For images of so many pixels and tiles.
    pub(crate) fn new(device: &GpuDevice, pixels: u64, tiles: u64) -> Result<Self, EngineError> {
        let requests =
            [storage("bounds", 8 * tiles), storage("rendered", 16 * pixels), storage("last", 4 * pixels)];
        let [bounds, rendered, last] = allocate(device, requests)?;
        Ok(Self { bounds, rendered, last })
    }
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
    /// For sets of `count` Gaussians and images of so many pixels.
    pub(crate) fn new(
        device: &GpuDevice,
        count: u64,
        coefficients: u64,
        pixels: u64,
    ) -> Result<Self, EngineError> {
        let requests = [
            storage("gradient by the image", 16 * pixels),
            storage("gradient by the geometry", 4 * GEOMETRY as u64 * count),
            storage("gradient by sh", 12 * coefficients * count),
            storage("density", 8 * count),
        ];
        let [image, geometry, sh, density] = allocate(device, requests)?;
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
    /// Zero moments; `active` is empty if all are.
    pub(crate) fn new(
        device: &GpuDevice,
        count: u64,
        coefficients: u64,
        active: &[bool],
    ) -> Result<Self, EngineError> {
        let (geometry, sh) = (4 * GEOMETRY as u64 * count, 12 * coefficients * count);
        let requests = [
            storage("first moments of the geometry", geometry),
            storage("second moments of the geometry", geometry),
            storage("first moments of sh", sh),
            storage("second moments of sh", sh),
            storage("active", 4 * active.len() as u64),
        ];
        let [a, b, c, d, flags] = allocate(device, requests)?;
        let values: Vec<u32> = active.iter().map(|&active| u32::from(active)).collect();
        device.queue.write_buffer(&flags, 0, bytemuck::cast_slice(&values));
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
    /// For images of so many pixels and tiles, and so many steps.
    pub(crate) fn new(device: &GpuDevice, pixels: u64, tiles: u64, steps: u64) -> Result<Self, EngineError> {
        let requests = [
            storage("derivatives of SSIM", 36 * pixels),
            storage("shares of the loss", 8 * tiles),
            storage("losses", 4 * steps),
        ];
        let [derivatives, shares, losses] = allocate(device, requests)?;
        Ok(Self { derivatives, shares, losses })
    }
}

/// Everything that a view is drawn and differentiated with.
#[derive(Clone, Debug)]
pub(crate) struct Buffers {
    pub common: CommonBuffers,
    pub parameters: ParameterBuffers,
    pub footprints: FootprintBuffers,
    pub intersections: IntersectionBuffers,
    pub images: ImageBuffers,
    /// Whether intersections have sums.
    pub has_gradient: bool,
}

impl Buffers {
    /// More room for intersections, after a view had `needed`.
    pub(crate) fn make_room(&mut self, device: &GpuDevice, needed: u32) -> Result<(), EngineError> {
        let wanted = u64::from(needed);
        if needed == u32::MAX {
            return Err(EngineError::OutOfResources { needed: 4 * wanted, available: device.max_buffer() });
        }
        let capacity = (wanted + wanted / 4).min(u64::from(u32::MAX) - 1);
        self.intersections = IntersectionBuffers::new(device, capacity, self.has_gradient)?;
        Ok(())
    }
}

/// Room for intersections to start with: a footprint of a few pixels touches two or three tiles.
pub(crate) fn first_capacity(count: u64, view: &View) -> u64 {
    (4 * count).max(u64::from(view.tile_count())).max(1 << 12)
}
