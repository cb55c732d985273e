//! What a Gaussian file holds, in a few figures.

use serde::{Deserialize, Serialize};

use super::{PlyError, parse_ply};
use crate::gaussians::Gaussians;

/// Figures of a Gaussian file, for people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlySummary {
    /// Number of Gaussians.
    pub count: usize,
    /// Degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Smallest and largest mean per axis, world units; absent in an empty file.
    pub bounds: Option<[[f32; 3]; 2]>,
    /// Opacities in `[0, 1]`; absent in an empty file.
    pub opacity: Option<Percentiles>,
    /// Standard deviations of all three axes, world units; absent in an empty file.
    pub scale: Option<Percentiles>,
}

/// Order statistics of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Smallest value.
    pub min: f64,
    /// 5 % of the values are at most this.
    pub p5: f64,
    /// Median.
    pub p50: f64,
    /// 95 % of the values are at most this.
    pub p95: f64,
    /// Largest value.
    pub max: f64,
}

/// Reads a Gaussian PLY and sums it up.
pub fn inspect(bytes: &[u8]) -> Result<PlySummary, PlyError> {
    let gaussians = parse_ply(bytes)?;
    let opacities = (0..gaussians.len()).map(|index| gaussians.opacity(index)).collect();
    let scales = gaussians.log_scales.as_flattened().iter().map(|&value| f64::from(value).exp()).collect();
    Ok(PlySummary {
        count: gaussians.len(),
        sh_degree: gaussians.sh_degree,
        bounds: bounds(&gaussians),
        opacity: percentiles(opacities),
        scale: percentiles(scales),
    })
}

fn bounds(gaussians: &Gaussians) -> Option<[[f32; 3]; 2]> {
    let first = *gaussians.means.first()?;
    Some(gaussians.means.iter().fold([first, first], |[low, high], mean| {
        [
            std::array::from_fn(|axis| low[axis].min(mean[axis])),
            std::array::from_fn(|axis| high[axis].max(mean[axis])),
        ]
    }))
}

/// Nearest-rank percentiles.
fn percentiles(mut values: Vec<f64>) -> Option<Percentiles> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let at = |percent: usize| values[(values.len() * percent).div_ceil(100).saturating_sub(1).min(last)];
    Some(Percentiles { min: values[0], p5: at(5), p50: at(50), p95: at(95), max: values[last] })
}
