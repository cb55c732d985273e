//! The [`Engine`] that the stages make.

use super::{footprint_moments, pass::Pass, session::CpuSession};
use crate::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput, check_size},
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    simd::Instructions,
    tracking::TrackField,
};

/// The CPU engine; runs on the rayon pool that it is called from.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuEngine {
    instructions: Instructions,
}

impl CpuEngine {
    /// An engine whose kernels use `instructions`; the default detects them.
    pub fn new(instructions: Instructions) -> Self {
        Self { instructions }
    }

    /// Gradient of `Σ image · image_gradient + Σ alpha · alpha_gradient` by every parameter; `image_gradient` is
    /// `H × W × 3`, `alpha_gradient` `H × W` or empty. The camera has at least one pixel.
    pub fn render_backward(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
    ) -> GaussianGradients {
        let mut pass = Pass::new(self.instructions);
        let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
        let degree = gaussians.sh_degree;
        pass.forward(gaussians, camera, degree, background, &mut image, &mut []);
        pass.blend_backward(camera, background, image_gradient, alpha_gradient);
        let mut gradients = GaussianGradients::zeros(gaussians);
        pass.project_backward(gaussians, camera, degree, &mut gradients);
        gradients
    }
}

impl Engine for CpuEngine {
    fn name(&self) -> &str {
        "cpu"
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        check_size(camera)?;
        let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
        let mut alpha = vec![0.0; image.pixel_count()];
        let mut pass = Pass::new(self.instructions);
        pass.forward(gaussians, camera, gaussians.sh_degree, background, &mut image, &mut alpha);
        Ok(Rendering { image, alpha })
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        check_size(camera)?;
        footprint_moments::footprint_moments(self.instructions, gaussians, camera, tracks, reweighting)
    }

    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Ok(Box::new(CpuSession::new(input, self.instructions)?))
    }
}
