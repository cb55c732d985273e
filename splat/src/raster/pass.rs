//! The stages of one view strung together.

use rayon::prelude::*;

use super::{
    bin::{BAND_ROWS, Bins},
    blend::{Band, blend},
    blend_backward::blend_backward,
    blocks::{BandView, RoundLimit},
    descend::{DensityPart, descend},
    local::View,
    project::{CHUNK, project},
    project_backward::{Backward, project_backward},
};
use crate::{
    cameras::Camera,
    engine::DensityStatistics,
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    optim::{Adam, LearningRates},
    simd::Instructions,
};

/// The stages of one view and the memory they share, kept between steps so that no step allocates.
///
/// Each method is a stage; all stages of a pass take the same Gaussians, camera and degree.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    instructions: Instructions,
    bins: Bins,
    bands: Vec<Band>,
    /// What [`Pass::blend`] was told.
    active: Vec<bool>,
    pub(super) limit: RoundLimit,
}

impl Pass {
    /// Empty buffers; kernels use `instructions`.
    pub fn new(instructions: Instructions) -> Self {
        Self { instructions, ..Self::default() }
    }

    /// Stages 1 to 3: renders one view into `image` and, if it is not empty, `alpha`.
    pub fn forward(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        sh_degree: u32,
        background: [f32; 3],
        image: &mut Image,
        alpha: &mut [f32],
    ) {
        self.project(gaussians, camera, sh_degree);
        self.bin(camera, &mut Vec::new());
        self.blend(camera, background, &[], image, alpha);
    }

    /// Stage 1: footprints and colours.
    pub fn project(&mut self, gaussians: &Gaussians, camera: &Camera, sh_degree: u32) {
        project(self.instructions, gaussians, camera, sh_degree, &mut self.bins.projection);
    }

    /// Stage 2: depth order, and the bands' lists. `order` is what it was after an earlier step of the same view, or
    /// empty; it saves time.
    pub fn bin(&mut self, camera: &Camera, order: &mut Vec<u32>) {
        self.bins.sort(camera.height, order);
    }

    /// Stage 3: blends into `image` and, if it is not empty, `alpha`. A later gradient is taken by the `active` Gaussians
    /// only (empty: all).
    pub fn blend(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        active: &[bool],
        image: &mut Image,
        alpha: &mut [f32],
    ) {
        self.active.clear();
        self.active.extend_from_slice(active);
        let (width, height) = (camera.width as usize, camera.height as usize);
        let (bins, active, limit, instructions) = (&self.bins, &self.active, self.limit, self.instructions);
        self.bands.resize_with(bins.bands(), Band::default);
        let band_pixels = (BAND_ROWS * width).max(1);
        let render = |number: usize, band: &mut Band, pixels: &mut [f32], alpha: &mut [f32]| {
            let view = BandView { bins, number, width, height, active, limit };
            blend(instructions, band, &view, background, pixels, alpha);
        };
        let bands = self.bands.par_iter_mut().zip(image.pixels.par_chunks_mut(3 * band_pixels)).enumerate();
        if alpha.is_empty() {
            bands.for_each(|(number, (band, pixels))| render(number, band, pixels, &mut []));
            return;
        }
        bands
            .zip(alpha.par_chunks_mut(band_pixels))
            .for_each(|((number, (band, pixels)), alpha)| render(number, band, pixels, alpha));
    }

    /// Stage 4: sums over the pixels from the gradient by the image, `H × W × 3`, and by alpha, `H × W` or empty.
    pub fn blend_backward(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
    ) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let (bins, active, limit, instructions) = (&self.bins, &self.active, self.limit, self.instructions);
        self.bands.par_iter_mut().enumerate().for_each(|(number, band)| {
            let view = BandView { bins, number, width, height, active, limit };
            let pixels = view.first_row() * width..(view.first_row() + view.rows()) * width;
            let gradient = &image_gradient[3 * pixels.start..3 * pixels.end];
            let alpha_gradient = alpha_gradient.get(pixels).unwrap_or_default();
            blend_backward(instructions, band, &view, background, gradient, alpha_gradient);
        });
    }

    /// Stage 5: writes the gradient by every parameter; zero for Gaussians that the view does not show or that are not
    /// active.
    pub fn project_backward(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        sh_degree: u32,
        gradients: &mut GaussianGradients,
    ) {
        let instructions = self.instructions;
        let backward = self.backward(View::new(camera, gaussians, sh_degree));
        gradients.parts_mut(CHUNK).enumerate().for_each(|(chunk, gradients)| {
            let first = chunk * CHUNK;
            let part = gaussians.part().slice(first..first + gradients.means.len());
            project_backward(instructions, part, &backward, first, gradients);
        });
    }

    /// Stages 5 and 6 in one, without the memory of the gradients: a step of Adam with the gradient by every parameter of
    /// the active Gaussians. Adds to the density statistics.
    pub fn descend(
        &self,
        gaussians: &mut Gaussians,
        camera: &Camera,
        rates: &LearningRates,
        adam: &mut Adam,
        density: &mut DensityStatistics,
    ) {
        let instructions = self.instructions;
        let backward = self.backward(View::new(camera, gaussians, rates.sh_degree));
        let descent = adam.begin_step(gaussians, rates);
        let density = DensityPart::parts(density, CHUNK, [camera.width, camera.height]);
        adam.parts(gaussians, CHUNK).zip(density).enumerate().for_each(|(chunk, (part, density))| {
            descend(instructions, part, &backward, chunk * CHUNK, &descent, density);
        });
    }

    fn backward<'a>(&'a self, view: View<'a>) -> Backward<'a> {
        Backward { view, bins: &self.bins, bands: &self.bands, active: &self.active }
    }
}
