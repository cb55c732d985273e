//! The parameters of a set on the device.

use splat::{engine::EngineError, gaussians::Gaussians};

use super::{Buffer, Request, allocate, storage};
use crate::{device::GpuDevice, layout::GEOMETRY, transfer::write};

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

/// Whether the arrays belong together.
pub(crate) fn check_lengths(gaussians: &Gaussians) -> Result<(), EngineError> {
    let count = gaussians.len();
    let lengths = [
        ("rotations", gaussians.rotations.len(), count),
        ("log_scales", gaussians.log_scales.len(), count),
        ("logit_opacities", gaussians.logit_opacities.len(), count),
        ("sh", gaussians.sh.len(), 3 * gaussians.sh_coefficients() * count),
    ];
    match lengths.into_iter().find(|(_, found, wanted)| found != wanted) {
        None => Ok(()),
        Some((property, found, wanted)) => Err(EngineError::InvalidInput(format!(
            "`{property}` has {found} values, {wanted} are needed for {count} Gaussians; export the set again"
        ))),
    }
}

/// The parameters of a set.
#[derive(Clone, Debug)]
pub(crate) struct ParameterBuffers {
    pub geometry: Buffer,
    pub sh: Buffer,
}

impl ParameterBuffers {
    pub(crate) fn requests(count: u64, coefficients: u64) -> [Request; 2] {
        [storage("geometry", 4 * GEOMETRY as u64 * count), storage("sh", 12 * coefficients * count)]
    }

    /// Uploads a set, whose parameters need not be finite but there.
    pub(crate) fn new(device: &GpuDevice, gaussians: &Gaussians) -> Result<Self, EngineError> {
        check_lengths(gaussians)?;
        let requests = Self::requests(gaussians.len() as u64, gaussians.sh_coefficients() as u64);
        let [geometry, sh] = allocate(device, requests)?;
        write(device, &geometry, &interleaved(gaussians))?;
        write(device, &sh, &gaussians.sh)?;
        Ok(Self { geometry, sh })
    }
}
