//! Gradient of a loss by every parameter of a set of Gaussians.

use super::Gaussians;

/// One array per parameter class, laid out as in [`Gaussians`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianGradients {
    /// By the means.
    pub means: Vec<[f32; 3]>,
    /// By the stored quaternions.
    pub rotations: Vec<[f32; 4]>,
    /// By the log scales.
    pub log_scales: Vec<[f32; 3]>,
    /// By the logit opacities.
    pub logit_opacities: Vec<f32>,
    /// By the spherical-harmonic coefficients.
    pub sh: Vec<f32>,
}

impl GaussianGradients {
    /// All zero, for `gaussians`.
    pub fn zeros(gaussians: &Gaussians) -> Self {
        Self {
            means: vec![[0.0; 3]; gaussians.len()],
            rotations: vec![[0.0; 4]; gaussians.len()],
            log_scales: vec![[0.0; 3]; gaussians.len()],
            logit_opacities: vec![0.0; gaussians.len()],
            sh: vec![0.0; gaussians.sh.len()],
        }
    }

    /// Sets everything to zero.
    pub fn clear(&mut self) {
        self.means.fill([0.0; 3]);
        self.rotations.fill([0.0; 4]);
        self.log_scales.fill([0.0; 3]);
        self.logit_opacities.fill(0.0);
        self.sh.fill(0.0);
    }
}
