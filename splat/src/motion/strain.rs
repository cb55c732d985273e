//! How a Gaussian's axes stretch: where the footprints say so beyond doubt.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::{
    MotionOrigin, MotionSettings, MotionView,
    observe::Observation,
    propagate::{Context, State},
};
use crate::cameras::Camera;

/// Relative error of a footprint's affine motion along an axis as thick as the thinnest: how much of the axis lies out
/// of the tracked surface. It is the same in all views, so that no number of them averages it away.
const OFF_SURFACE: f64 = 0.3;
/// The same for an infinitely thin Gaussian: perspective and curvature within the footprint.
const LEAST_ERROR: f64 = 0.01;

/// Changes of the logarithms of all Gaussians' scales; zero unless significant.
///
/// An axis `q` whose line turns to `R q` is seen as `A T q ≈ λ T' R q`, with the Jacobian `T` at the old and `T'` at the
/// new mean: one unknown `λ` per axis, which no ill-determined direction enters. The thinnest axis takes no part: it
/// lies out of the surface that the tracks show. What exceeds the significance counts by the share of its square that
/// does (positive-part James-Stein).
pub(super) fn log_strains(
    states: &[State],
    observations: &[Vec<Observation>],
    views: &[MotionView],
    context: &Context<'_>,
) -> Vec<DVec3> {
    let settings = context.settings;
    let of = |index: usize| {
        let state = &states[index];
        let Some(own) = state.own.as_ref().filter(|_| state.origin == MotionOrigin::Solved) else {
            return DVec3::ZERO;
        };
        let seen: Vec<&Observation> = own.inliers.iter().map(|&k| &observations[index][k]).collect();
        let gaussians = context.gaussians;
        let log_scales = gaussians.log_scales[index].map(f64::from);
        let thinnest = (0..3).fold(0, |least, k| if log_scales[k] < log_scales[least] { k } else { least });
        let axes = DMat3::from_quat(gaussians.rotation(index));
        let mean = gaussians.mean(index);
        let mut strains = DVec3::ZERO;
        for k in (0..3).filter(|&k| k != thinnest) {
            let axis = axes.col(k);
            let line = Line { axis, turned: state.rotation * axis, mean, moved: mean + state.translation };
            let off_surface = OFF_SURFACE * (log_scales[thinnest] - log_scales[k]).exp();
            strains[k] = line
                .log_stretch(&seen, views)
                .map_or(0.0, |(strain, variance)| significant(strain, variance, off_surface, settings));
        }
        strains
    };
    (0..states.len()).into_par_iter().map(of).collect()
}

fn significant(strain: f64, variance: f64, off_surface: f64, settings: &MotionSettings) -> f64 {
    let total = variance + off_surface.powi(2) + LEAST_ERROR.powi(2);
    let kept = 1.0 - settings.scale_significance.powi(2) * total / (strain * strain);
    let bound = settings.max_log_strain;
    if kept > 0.0 { (strain * kept).clamp(-bound, bound) } else { 0.0 }
}

/// An axis before and after the motion.
struct Line {
    /// Unit axis before it.
    axis: DVec3,
    /// Unit direction after it.
    turned: DVec3,
    mean: DVec3,
    moved: DVec3,
}

impl Line {
    /// Logarithm of the stretch and its variance, which grows with the misfit between views.
    fn log_stretch(&self, seen: &[&Observation], views: &[MotionView]) -> Option<(f64, f64)> {
        let in_view = |camera: &Camera, at: DVec3, direction: DVec3| {
            let [u, v] = camera.world_jacobian(camera.to_camera(at));
            DVec2::new(u.dot(direction), v.dot(direction))
        };
        let lines: Vec<(DVec2, DVec2, f64)> = seen
            .iter()
            .filter_map(|Observation { view, fit, .. }| {
                let camera = &views[*view].camera;
                let before = in_view(camera, self.mean, self.axis);
                let expected = in_view(camera, self.moved, self.turned);
                let variance = before.dot(fit.affine_covariance * before);
                (variance > 0.0).then(|| (expected, fit.affine * before, variance))
            })
            .collect();
        let (mut information, mut right) = (0.0, 0.0);
        for (expected, found, variance) in &lines {
            information += expected.length_squared() / variance;
            right += expected.dot(*found) / variance;
        }
        let stretch = right / information;
        let chi_squared: f64 = lines
            .iter()
            .map(|(expected, found, variance)| (*found - *expected * stretch).length_squared() / variance)
            .sum();
        let misfit = (chi_squared / (2.0 * lines.len() as f64 - 1.0)).max(1.0);
        let variance = misfit / (information * stretch * stretch);
        (stretch > 0.0 && variance.is_finite()).then(|| (stretch.ln(), variance))
    }
}
