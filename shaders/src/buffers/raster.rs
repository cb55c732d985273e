//! What a view is drawn and differentiated with.

use splat::engine::EngineError;

use super::{
    BLOCK, Buffer, CommonBuffers, ParameterBuffers, Request, Size, admit_instead, allocate, storage, total,
};
use crate::{device::GpuDevice, layout::SUMS};

/// Digits of one pass of the sort.
pub(crate) const DIGITS: u64 = 256;

/// A sort's keys and values, twice, and its histogram.
#[derive(Clone, Debug)]
pub(crate) struct SortBuffers {
    pub keys: [Buffer; 2],
    pub values: [Buffer; 2],
    pub histogram: Buffer,
    pub sums: Buffer,
}

impl SortBuffers {
    fn requests(length: u64) -> [Request; 6] {
        let histogram = DIGITS * length.div_ceil(BLOCK);
        [
            storage("keys", 4 * length),
            storage("keys", 4 * length),
            storage("values", 4 * length),
            storage("values", 4 * length),
            storage("histogram", 4 * histogram),
            storage("sums of the histogram", 4 * histogram.div_ceil(BLOCK)),
        ]
    }

    pub(crate) fn new(device: &GpuDevice, length: u64) -> Result<Self, EngineError> {
        let [key, key_out, value, value_out, histogram, sums] = allocate(device, Self::requests(length))?;
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
    fn requests(count: u64) -> [Request; 5] {
        [
            storage("footprints", 48 * count),
            storage("reaches", 32 * count),
            storage("counts", 4 * (count + 1)),
            storage("sums of counts", 4 * (count + 1).div_ceil(BLOCK)),
            storage("ranges", 8 * count),
        ]
    }

    pub(crate) fn new(device: &GpuDevice, count: u64) -> Result<Self, EngineError> {
        let [footprints, reaches, counts, sums, ranges] = allocate(device, Self::requests(count))?;
        let depth = SortBuffers::new(device, count)?;
        Ok(Self { count, footprints, reaches, depth, counts, sums, ranges })
    }
}

/// What each intersection of a footprint with a tile has.
#[derive(Clone, Debug)]
pub(crate) struct IntersectionBuffers {
    /// Tiles and slots.
    pub tiles: SortBuffers,
    pub owners: Buffer,
    /// Shares of the gradient; empty if none is taken.
    pub sums: Buffer,
}

impl IntersectionBuffers {
    fn requests(capacity: u64, has_gradient: bool) -> [Request; 2] {
        let sums = if has_gradient { 4 * SUMS as u64 * capacity } else { 0 };
        [storage("owners", 4 * capacity), storage("sums", sums)]
    }

    pub(crate) fn new(device: &GpuDevice, capacity: u64, has_gradient: bool) -> Result<Self, EngineError> {
        let [owners, sums] = allocate(device, Self::requests(capacity, has_gradient))?;
        Ok(Self { tiles: SortBuffers::new(device, capacity)?, owners, sums })
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
    fn requests(pixels: u64, tiles: u64) -> [Request; 3] {
        [storage("bounds", 8 * tiles), storage("rendered", 16 * pixels), storage("last", 4 * pixels)]
    }

    /// For images of so many pixels and tiles.
    pub(crate) fn new(device: &GpuDevice, pixels: u64, tiles: u64) -> Result<Self, EngineError> {
        let [bounds, rendered, last] = allocate(device, Self::requests(pixels, tiles))?;
        Ok(Self { bounds, rendered, last })
    }
}

/// Everything that a view is drawn and differentiated with.
#[derive(Clone, Debug)]
pub(crate) struct Buffers {
    pub size: Size,
    pub common: CommonBuffers,
    pub parameters: ParameterBuffers,
    pub footprints: FootprintBuffers,
    pub intersections: IntersectionBuffers,
    pub images: ImageBuffers,
}

impl Buffers {
    /// All buffers of a size.
    pub(crate) fn requests(size: &Size) -> Vec<Request> {
        let groups: [&[Request]; 5] = [
            &ParameterBuffers::requests(size.count, size.coefficients),
            &FootprintBuffers::requests(size.count),
            &SortBuffers::requests(size.count),
            &Self::of_intersections(size),
            &ImageBuffers::requests(size.pixels, size.tiles),
        ];
        groups.concat()
    }

    /// Allocates what a view of a set takes beside its parameters; `size` fits the set.
    pub(crate) fn new(
        device: &GpuDevice,
        parameters: ParameterBuffers,
        size: &Size,
    ) -> Result<Self, EngineError> {
        Ok(Self {
            size: *size,
            common: CommonBuffers::new(device)?,
            parameters,
            footprints: FootprintBuffers::new(device, size.count)?,
            intersections: IntersectionBuffers::new(device, size.capacity, size.has_gradient)?,
            images: ImageBuffers::new(device, size.pixels, size.tiles)?,
        })
    }

    /// Replaces the buffers of the intersections by those of another capacity. Nothing changes where it is seen before that there is no
    /// room; the old ones are freed before the new ones are made, so nothing may be bound to them or be at work on them.
    pub(crate) fn resize(&mut self, device: &GpuDevice, size: Size) -> Result<(), EngineError> {
        let [old, new] = [self.size, size].map(|size| Self::of_intersections(&size));
        admit_instead(device, &new, total(&old))?;
        self.intersections = IntersectionBuffers::new(device, 0, size.has_gradient)?;
        self.intersections = IntersectionBuffers::new(device, size.capacity, size.has_gradient)?;
        self.size = size;
        Ok(())
    }

    fn of_intersections(size: &Size) -> Vec<Request> {
        let of_lists = IntersectionBuffers::requests(size.capacity, size.has_gradient);
        [&of_lists[..], &SortBuffers::requests(size.capacity)].concat()
    }
}

impl Size {
    /// More room for intersections, after a view had `needed`.
    pub(crate) fn with_room(self, device: &GpuDevice, needed: u32) -> Result<Self, EngineError> {
        let wanted = u64::from(needed);
        // As many as the device can count, or more.
        if needed == u32::MAX {
            return Err(EngineError::OutOfResources { needed: 4 * wanted, available: device.max_buffer() });
        }
        Ok(Self { capacity: (wanted + wanted / 4).min(u64::from(u32::MAX) - 1), ..self })
    }
}

/// Room for intersections to start with: a footprint of a few pixels touches two or three tiles.
pub(crate) fn first_capacity(count: u64, tiles: u64) -> u64 {
    (4 * count).max(tiles).max(1 << 12)
}
