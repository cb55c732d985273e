//! Gradients of a loss by every parameter of a set of Gaussians.

use super::Gaussians;

/// One gradient array per parameter class, of the shapes of [`Gaussians`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianGradients {
    /// By the world positions, `N × 3`.
    pub means: Vec<[f32; 3]>,
    /// By the stored quaternions `w, x, y, z`, `N × 4`.
    pub rotations: Vec<[f32; 4]>,
    /// By the log scales, `N × 3`.
    pub log_scales: Vec<[f32; 3]>,
    /// By the logit opacities, `N`.
    pub logit_opacities: Vec<f32>,
    /// By the spherical-harmonic coefficients, `N × K × 3`.
    pub sh: Vec<f32>,
}

impl GaussianGradients {
    /// Zero gradients for a set.
    pub fn zeros(gaussians: &Gaussians) -> Self {
        Self {
            means: vec![[0.0; 3]; gaussians.means.len()],
            rotations: vec![[0.0; 4]; gaussians.rotations.len()],
            log_scales: vec![[0.0; 3]; gaussians.log_scales.len()],
            logit_opacities: vec![0.0; gaussians.logit_opacities.len()],
            sh: vec![0.0; gaussians.sh.len()],
        }
    }

    /// Sets every gradient to zero and keeps the memory.
    pub fn clear(&mut self) {
        self.means.as_flattened_mut().fill(0.0);
        self.rotations.as_flattened_mut().fill(0.0);
        self.log_scales.as_flattened_mut().fill(0.0);
        self.logit_opacities.fill(0.0);
        self.sh.fill(0.0);
    }
}
