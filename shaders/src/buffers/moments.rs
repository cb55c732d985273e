//! What footprints are measured with, beyond what they are listed with.

use splat::{engine::EngineError, tracking::TrackField};

use super::{Buffer, Request, Size, allocate, storage};
use crate::{
    device::GpuDevice,
    layout::{Expectation, Moments},
    transfer::write,
};

/// The tracks of a view, and sums and moments under them.
#[derive(Clone, Debug)]
pub(crate) struct MomentBuffers {
    pub positions: Buffer,
    pub sigmas: Buffer,
    /// Per Gaussian.
    pub expectations: Buffer,
    /// Number of Gaussians that are wanted, and which.
    pub wanted: Buffer,
    /// Per intersection.
    pub sums: Buffer,
    /// In the order of those that are wanted.
    pub moments: Buffer,
}

impl MomentBuffers {
    pub(crate) fn requests(size: &Size) -> [Request; 6] {
        let Size { count, pixels, capacity, .. } = *size;
        let record = size_of::<Moments>() as u64;
        [
            storage("tracked positions", 8 * pixels),
            storage("deviations of tracks", 4 * pixels),
            storage("expectations", size_of::<Expectation>() as u64 * count),
            storage("wanted footprints", 4 * (count + 1)),
            // A binding holds one at least.
            storage("sums of tiles", record * capacity.max(1)),
            storage("moments", record * count.max(1)),
        ]
    }

    /// Uploads the tracks.
    pub(crate) fn new(device: &GpuDevice, size: &Size, tracks: &TrackField) -> Result<Self, EngineError> {
        let [positions, sigmas, expectations, wanted, sums, moments] =
            allocate(device, Self::requests(size))?;
        let shown = tracks.sigma.iter().zip(&tracks.visible);
        let sigma: Vec<f32> = shown.map(|(&sigma, &visible)| if visible { sigma } else { 0.0 }).collect();
        write(device, &positions, &tracks.positions)?;
        write(device, &sigmas, &sigma)?;
        Ok(Self { positions, sigmas, expectations, wanted, sums, moments })
    }

    /// Says by what the next pass reweights each Gaussian's pixels, and whose moments it is to give.
    pub(crate) fn ask(
        &self,
        device: &GpuDevice,
        expectations: &[Expectation],
        wanted: &[u32],
    ) -> Result<(), EngineError> {
        let numbers: Vec<u32> = std::iter::once(wanted.len() as u32).chain(wanted.iter().copied()).collect();
        write(device, &self.wanted, &numbers)?;
        write(device, &self.expectations, expectations)
    }
}
