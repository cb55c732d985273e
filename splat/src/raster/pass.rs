//! The stages of one view strung together.

use rayon::prelude::*;

use super::{
    bin::Bins,
    blend::{Band, blend},
    blend_backward::{FootprintGradient, Replay, blend_backward},
    project::project,
    project_backward::{GeometryGradient, project_backward},
};
use crate::{
    cameras::Camera,
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
};

/// The stages of one view and the memory they share, kept between steps so that no step allocates.
///
/// Each method is a stage; all stages of a pass take the same Gaussians, camera and degree.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    bins: Bins,
    bands: Vec<Band>,
    replays: Vec<Replay>,
    by_entry: Vec<FootprintGradient>,
    by_footprint: Vec<FootprintGradient>,
    computed: Vec<(GeometryGradient, [f32; 48])>,
}

impl Pass {
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
        self.bin(camera);
        self.blend(camera, background, image, alpha);
    }

    /// Stage 1: footprints and colours.
    pub fn project(&mut self, gaussians: &Gaussians, camera: &Camera, sh_degree: u32) {
        project(gaussians, camera, sh_degree, self.bins.unsorted());
    }

    /// Stage 2: depth order, and the bands' lists.
    pub fn bin(&mut self, camera: &Camera) {
        self.bins.sort(camera.height);
    }

    /// Stage 3: blends into `image` and, if it is not empty, `alpha`.
    pub fn blend(&mut self, camera: &Camera, background: [f32; 3], image: &mut Image, alpha: &mut [f32]) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let bins = &self.bins;
        self.bands.resize_with(bins.bands(), Band::default);
        self.bands.par_iter_mut().enumerate().for_each(|(number, band)| {
            band.reset(number, width, height);
            blend(bins, number, band);
        });
        for band in &self.bands {
            compose(band, background, &mut image.pixels, alpha);
        }
    }

    /// Stage 4: the gradient of each footprint from that of the image, `H × W × 3`, and of alpha, `H × W` or empty.
    /// Gaussians that are not `active` (empty: all are) get none.
    pub fn blend_backward(
        &mut self,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
        active: &[bool],
    ) {
        let bins = &self.bins;
        self.replays.resize_with(bins.bands(), Replay::default);
        self.by_entry.clear();
        self.by_entry.resize(bins.entries.len(), FootprintGradient::default());
        let mut rest = self.by_entry.as_mut_slice();
        let mut work = Vec::with_capacity(bins.bands());
        for (number, (band, replay)) in self.bands.iter().zip(&mut self.replays).enumerate() {
            let (own, others) = rest.split_at_mut(bins.band(number).len());
            rest = others;
            work.push((number, band, replay, own));
        }
        work.into_par_iter().for_each(|(number, band, replay, gradients)| {
            replay.reset(band, background, image_gradient, alpha_gradient);
            blend_backward(bins, number, band, active, replay, gradients);
        });
        let by_entry = &self.by_entry;
        (0..bins.footprints.len())
            .into_par_iter()
            .with_min_len(256)
            .map(|position| {
                let mut total = FootprintGradient::default();
                for &entry in bins.entries_of(position) {
                    total.add(&by_entry[entry as usize]);
                }
                total
            })
            .collect_into_vec(&mut self.by_footprint);
    }

    /// Stage 5: writes the gradient by the parameters of the active Gaussians that the view shows; others' stay as they
    /// are.
    pub fn project_backward(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        sh_degree: u32,
        active: &[bool],
        gradients: &mut GaussianGradients,
    ) {
        let centre = camera.centre();
        let stride = gaussians.sh_coefficients() * 3;
        let is_active = |index: usize| active.get(index).copied().unwrap_or(true);
        let bins = &self.bins;
        bins.footprints
            .par_iter()
            .zip(&self.by_footprint)
            .with_min_len(256)
            .map(|(footprint, gradient)| {
                let mut sh = [0.0f32; 48];
                if !is_active(footprint.index as usize) {
                    return (GeometryGradient::default(), sh);
                }
                let geometry = project_backward(
                    gaussians,
                    footprint,
                    camera,
                    centre,
                    sh_degree,
                    gradient,
                    &mut sh[..stride],
                );
                if !(geometry.is_finite() && sh.iter().all(|value| value.is_finite())) {
                    // Beyond single precision there is no direction to follow; a step of infinity would spread.
                    return (GeometryGradient::default(), [0.0; 48]);
                }
                (geometry, sh)
            })
            .collect_into_vec(&mut self.computed);
        for (footprint, (geometry, sh)) in bins.footprints.iter().zip(&self.computed) {
            let index = footprint.index as usize;
            gradients.means[index] = geometry.mean;
            gradients.rotations[index] = geometry.rotation;
            gradients.log_scales[index] = geometry.log_scale;
            gradients.logit_opacities[index] = geometry.logit_opacity;
            gradients.sh[index * stride..(index + 1) * stride].copy_from_slice(&sh[..stride]);
        }
    }

    /// The Gaussians that the view shows, each with the gradient by its projected mean, per pixel, after stage 5.
    pub fn visible(&self) -> impl Iterator<Item = (usize, [f32; 2])> {
        let footprints = self.bins.footprints.iter();
        footprints
            .zip(&self.computed)
            .map(|(footprint, (geometry, _))| (footprint.index as usize, geometry.projected_mean))
    }
}

fn compose(band: &Band, background: [f32; 3], pixels: &mut [f32], alpha: &mut [f32]) {
    for row in 0..band.rows {
        for x in 0..band.width {
            let (place, pixel) = (row * band.stride + x, (band.first_row + row) * band.width + x);
            let transmittance = band.transmittance[place].abs();
            for channel in 0..3 {
                pixels[3 * pixel + channel] =
                    band.colour[channel][place] + transmittance * background[channel];
            }
            if let Some(value) = alpha.get_mut(pixel) {
                *value = 1.0 - transmittance;
            }
        }
    }
}
