//! What each view says about each Gaussian.

use glam::{DMat2, DVec2};
use rayon::prelude::*;

use super::{
    MotionSettings, MotionView,
    fit2d::{self, Fit},
    moments::FootprintMoments,
};
use crate::{
    cameras::Camera,
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    raster::LOW_PASS,
};

/// One view's fit of one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Observation {
    /// Index of the view.
    pub view: usize,
    pub fit: Fit,
    /// Mean transmittance of what lies before the Gaussian, 0 to 1.
    pub transmittance: f64,
}

/// The observations of every Gaussian, views in ascending order.
pub(super) fn observe(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
    settings: &MotionSettings,
) -> Result<Vec<Vec<Observation>>, EngineError> {
    let mut observations = vec![Vec::new(); gaussians.len()];
    for (view, MotionView { camera, tracks }) in views.iter().enumerate() {
        if (tracks.width, tracks.height) != (camera.width, camera.height) {
            return Err(EngineError::InvalidInput(format!(
                "tracks of view {view} are {}×{}, its camera is {}×{}; track at the camera's size",
                tracks.width, tracks.height, camera.width, camera.height
            )));
        }
        let moments = engine.footprint_moments(gaussians, camera, tracks, None)?;
        if moments.len() != gaussians.len() {
            return Err(EngineError::InvalidInput(format!(
                "engine {} gave {} footprints for {} Gaussians",
                engine.name(),
                moments.len(),
                gaussians.len()
            )));
        }
        observations.par_iter_mut().zip(&moments).enumerate().for_each(|(index, (list, moments))| {
            list.extend(
                observation(gaussians, index, camera, moments, settings)
                    .map(|(fit, transmittance)| Observation { view, fit, transmittance }),
            );
        });
    }
    observations.par_iter_mut().for_each(|list| trust_unoccluded(list, settings));
    Ok(observations)
}

fn observation(
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
    moments: &FootprintMoments,
    settings: &MotionSettings,
) -> Option<(Fit, f64)> {
    if moments.blend_weight.is_nan() || moments.blend_weight <= 0.0 {
        return None;
    }
    let position = camera.to_camera(gaussians.mean(index));
    let projected = camera.project(position)?;
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let fit = fit2d::fit(moments, projected, size, settings)?;
    if !camera.contains(fit.target) {
        return None;
    }
    let [u, v] = camera.world_jacobian(position);
    let covariance = gaussians.covariance(index);
    let (uu, uv, vv) = (u.dot(covariance * u), u.dot(covariance * v), v.dot(covariance * v));
    let footprint = DMat2::from_cols(DVec2::new(uu + LOW_PASS, uv), DVec2::new(uv, vv + LOW_PASS));
    // The integral of `opacity · exp(-½ dᵀ S⁻¹ d)` over the image plane.
    let unoccluded =
        gaussians.opacity(index) * std::f64::consts::TAU * footprint.determinant().max(0.0).sqrt();
    let transmittance = (moments.blend_weight / unoccluded).clamp(0.0, 1.0);
    transmittance.is_finite().then_some((fit, transmittance))
}

/// Drops views that hardly see the Gaussian and trusts the others by how well they see it, relative to the
/// best: a pixel in front of a hidden Gaussian tracks its occluder.
fn trust_unoccluded(observations: &mut Vec<Observation>, settings: &MotionSettings) {
    let best = observations.iter().map(|o| o.transmittance).fold(0.0, f64::max);
    observations.retain(|o| o.transmittance >= settings.min_relative_transmittance * best && best > 0.0);
    for observation in observations {
        observation.fit.variance *= best / observation.transmittance;
    }
}
