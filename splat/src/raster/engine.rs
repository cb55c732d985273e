//! The stages strung together, and the [`Engine`] they make.

use rayon::prelude::*;

use super::{
    bin::Bins,
    blend::{Band, blend},
    blend_backward::{FootprintGradient, Replay, blend_backward},
    footprint_moments,
    project::project,
    project_backward::{GeometryGradient, project_backward},
    session::CpuSession,
};
use crate::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    motion::moments::FootprintMoments,
    tracking::TrackField,
};

/// The CPU engine; runs on the rayon pool that it is called from.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuEngine;

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
        Ok(render(gaussians, camera, background))
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        footprint_moments::footprint_moments(gaussians, camera, tracks)
    }

    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Ok(Box::new(CpuSession::new(input)?))
    }
}

/// Everything a forward and a backward pass over one view need, kept between steps.
#[derive(Clone, Debug, Default)]
pub(super) struct Pass {
    pub(super) bins: Bins,
    bands: Vec<Band>,
    replays: Vec<Replay>,
    by_entry: Vec<FootprintGradient>,
}

impl Pass {
    /// Projects, sorts and blends one view into `image` and, if it is not empty, `alpha`.
    pub(super) fn forward(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        sh_degree: u32,
        background: [f32; 3],
        image: &mut Image,
        alpha: &mut [f32],
    ) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        project(gaussians, camera, sh_degree, self.bins.unsorted());
        self.bins.sort(camera.height);
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

    /// Gradient of each footprint of the last forward pass, in depth order.
    pub(super) fn backward(
        &mut self,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
        active: &[bool],
    ) -> Vec<FootprintGradient> {
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
            .collect()
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

/// Renders one view, spherical harmonics at the set's own degree.
pub fn render(gaussians: &Gaussians, camera: &Camera, background: [f32; 3]) -> Rendering {
    let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
    let mut alpha = vec![0.0; image.pixel_count()];
    Pass::default().forward(gaussians, camera, gaussians.sh_degree, background, &mut image, &mut alpha);
    Rendering { image, alpha }
}

/// Gradient of `Σ image · image_gradient + Σ alpha · alpha_gradient` by every parameter; `image_gradient` is
/// `H × W × 3`, `alpha_gradient` `H × W` or empty.
pub fn render_backward(
    gaussians: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    image_gradient: &[f32],
    alpha_gradient: &[f32],
) -> GaussianGradients {
    let mut pass = Pass::default();
    let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
    pass.forward(gaussians, camera, gaussians.sh_degree, background, &mut image, &mut []);
    let by_footprint = pass.backward(background, image_gradient, alpha_gradient, &[]);
    let mut gradients = GaussianGradients::zeros(gaussians);
    scatter(gaussians, camera, gaussians.sh_degree, &pass.bins, &by_footprint, &[], &mut gradients);
    gradients
}

/// Turns footprint gradients into parameter gradients of the `active` Gaussians (empty: all); returns the geometry's.
pub(super) fn scatter(
    gaussians: &Gaussians,
    camera: &Camera,
    sh_degree: u32,
    bins: &Bins,
    by_footprint: &[FootprintGradient],
    active: &[bool],
    gradients: &mut GaussianGradients,
) -> Vec<GeometryGradient> {
    let centre = camera.centre();
    let stride = gaussians.sh_coefficients() * 3;
    let is_active = |index: usize| active.get(index).copied().unwrap_or(true);
    let computed: Vec<(GeometryGradient, [f32; 48])> = bins
        .footprints
        .par_iter()
        .zip(by_footprint)
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
        .collect();
    for (footprint, (geometry, sh)) in bins.footprints.iter().zip(&computed) {
        let index = footprint.index as usize;
        gradients.means[index] = geometry.mean;
        gradients.rotations[index] = geometry.rotation;
        gradients.log_scales[index] = geometry.log_scale;
        gradients.logit_opacities[index] = geometry.logit_opacity;
        gradients.sh[index * stride..(index + 1) * stride].copy_from_slice(&sh[..stride]);
    }
    computed.into_iter().map(|(geometry, _)| geometry).collect()
}
