//! What each view says about each Gaussian.

use std::borrow::Cow;

use glam::{DMat2, DVec2};
use rayon::prelude::*;

use super::{
    MotionSettings, MotionView,
    fit2d::{self, Fit},
    moments::FootprintMoments,
    reweighting::Reweighting,
};
use crate::{
    cameras::Camera,
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    image::Mask,
    raster::LOW_PASS,
    tracking::TrackField,
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
    let mut observations: Vec<Vec<Observation>> =
        (0..gaussians.len()).map(|_| Vec::with_capacity(views.len())).collect();
    let mut clearest = vec![0.0; gaussians.len()];
    let reweighting = Reweighting {
        passes: settings.reweighting_passes,
        noise_correlation_area: settings.noise_correlation_area,
        noise_floor: settings.noise_floor,
    };
    for (view, MotionView { camera, tracks }) in views.iter().enumerate() {
        if (tracks.width, tracks.height) != (camera.width, camera.height) {
            return Err(EngineError::InvalidInput(format!(
                "tracks of view {view} are {}×{}, its camera is {}×{}; track at the camera's size",
                tracks.width, tracks.height, camera.width, camera.height
            )));
        }
        let tracks = within_image(camera, tracks);
        let moments = engine.footprint_moments(gaussians, camera, &tracks, Some(&reweighting))?;
        if moments.len() != gaussians.len() {
            return Err(EngineError::InvalidInput(format!(
                "engine {} gave {} footprints for {} Gaussians",
                engine.name(),
                moments.len(),
                gaussians.len()
            )));
        }
        let lists = observations.par_iter_mut().zip(&mut clearest).zip(&moments).enumerate();
        lists.for_each(|(index, ((list, clearest), moments))| {
            let Some(transmittance) = transmittance(gaussians, index, camera, moments) else { return };
            *clearest = transmittance.max(*clearest);
            let fit = observed_fit(gaussians, index, camera, moments, settings);
            list.extend(fit.map(|fit| Observation { view, fit, transmittance }));
        });
    }
    let lists = observations.par_iter_mut().zip(&clearest);
    lists.for_each(|(list, &clearest)| trust_unoccluded(list, clearest, settings));
    Ok(observations)
}

/// The tracks without those that claim to see a point outside of the image.
fn within_image<'a>(camera: &Camera, tracks: &'a TrackField) -> Cow<'a, TrackField> {
    let is_inside = |position: &[f32; 2]| camera.contains(DVec2::from_array(position.map(f64::from)));
    // The engine refuses fields whose parts differ in length.
    let pixels = tracks.visible.iter().zip(&tracks.positions).enumerate();
    let leave: Vec<usize> = pixels
        .filter(|(_, (visible, position))| **visible && !is_inside(position))
        .map(|(pixel, _)| pixel)
        .collect();
    if leave.is_empty() {
        return Cow::Borrowed(tracks);
    }
    let mut tracks = tracks.clone();
    for pixel in leave {
        tracks.visible[pixel] = false;
    }
    Cow::Owned(tracks)
}

/// The tracks without those that end outside of a mask of the target frame: what a mask leaves out of training is no
/// place to move to. Tracks of another size than the mask stay as they are.
pub fn within_mask(tracks: &TrackField, mask: &Mask) -> TrackField {
    let mut tracks = tracks.clone();
    if (mask.width, mask.height) != (tracks.width, tracks.height) {
        return tracks;
    }
    let (width, height) = (f64::from(mask.width), f64::from(mask.height));
    for (visible, position) in tracks.visible.iter_mut().zip(&tracks.positions) {
        let [x, y] = position.map(f64::from);
        let is_in_image = x >= 0.0 && y >= 0.0 && x < width && y < height;
        let inside = || mask.inside.get(y as usize * mask.width as usize + x as usize) == Some(&true);
        *visible &= is_in_image && inside();
    }
    tracks
}

/// The tracks, none of them surer than a standard deviation in pixels. Pixels count by the inverse of their variance: where
/// a footprint shows what rests and what moves, the rest is known ten times as well, and would hold what moves.
pub fn no_surer_than(tracks: &TrackField, least: f64) -> TrackField {
    let mut tracks = tracks.clone();
    for sigma in &mut tracks.sigma {
        // What is not a number stays none.
        *sigma = if f64::from(*sigma) < least { least as f32 } else { *sigma };
    }
    tracks
}

/// Mean transmittance of what lies before a Gaussian in the key frame, 0 to 1, whatever its tracks say; `None` where it leaves
/// no trace in the image.
fn transmittance(
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
    moments: &FootprintMoments,
) -> Option<f64> {
    if moments.blend_weight.is_nan() || moments.blend_weight <= 0.0 {
        return None;
    }
    let [u, v] = camera.world_jacobian(camera.to_camera(gaussians.mean(index)));
    let covariance = gaussians.covariance(index);
    let (uu, uv, vv) = (u.dot(covariance * u), u.dot(covariance * v), v.dot(covariance * v));
    let footprint = DMat2::from_cols(DVec2::new(uu + LOW_PASS, uv), DVec2::new(uv, vv + LOW_PASS));
    // The integral of `opacity · exp(-½ dᵀ S⁻¹ d)` over the image plane.
    let unoccluded =
        gaussians.opacity(index) * std::f64::consts::TAU * footprint.determinant().max(0.0).sqrt();
    let transmittance = (moments.blend_weight / unoccluded).clamp(0.0, 1.0);
    transmittance.is_finite().then_some(transmittance)
}

fn observed_fit(
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
    moments: &FootprintMoments,
    settings: &MotionSettings,
) -> Option<Fit> {
    let projected = camera.project_world(gaussians.mean(index))?;
    let fit = fit2d::fit(moments, projected, settings)?;
    camera.contains(fit.target).then_some(fit)
}

/// Drops views that hardly see the Gaussian, relative to the view that sees it most clearly in the key frame, be it hidden
/// there at the target: a pixel in front of a hidden Gaussian tracks its occluder. Trusts the others by how well they see
/// it, relative to the best of them.
fn trust_unoccluded(observations: &mut Vec<Observation>, clearest: f64, settings: &MotionSettings) {
    observations
        .retain(|o| o.transmittance >= settings.min_relative_transmittance * clearest && clearest > 0.0);
    let best = observations.iter().map(|o| o.transmittance).fold(0.0, f64::max);
    for observation in observations {
        observation.fit.variance *= best / observation.transmittance;
    }
}
