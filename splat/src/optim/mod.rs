//! Adam over the parameter classes of a set of Gaussians, and the schedule of its steps.

mod adam;
mod schedule;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

pub(crate) use self::adam::{AdamPart, Descent};
pub use self::{
    adam::Adam,
    schedule::{Epochs, Plateau},
};

/// Step size per parameter class.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearningRates {
    /// Means, world units per step.
    pub mean: f32,
    /// Quaternions.
    pub rotation: f32,
    /// Log scales.
    pub log_scale: f32,
    /// Logit opacities.
    pub logit_opacity: f32,
    /// Spherical harmonics of degree 0.
    pub sh_dc: f32,
    /// Spherical harmonics of degrees 1 to `sh_degree`.
    pub sh_rest: f32,
    /// Highest degree that is evaluated and optimised now, at most the set's own.
    pub sh_degree: u32,
}
