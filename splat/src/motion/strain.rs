//! How a Gaussian's axes stretch: where the footprints say so beyond doubt.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::{
    MotionOrigin, MotionSettings, MotionView,
    linear::trace,
    observe::Observation,
    propagate::{Context, State},
    rotation::significant_share,
};
use crate::cameras::Camera;

/// Relative error of a footprint's affine motion along an axis as thick as the thinnest: how much of the axis lies out
/// of the tracked surface. It is the same in all views, so that no number of them averages it away.
const OFF_SURFACE: f64 = 0.3;
/// The same for an infinitely thin Gaussian: perspective and curvature within the footprint.
const LEAST_ERROR: f64 = 0.01;

/// Two views see a tilted disc and its mirror image alike: what is no stretch of the one may be one of the other.
const LEAST_VIEWS: usize = 3;

/// Changes of the logarithms of all Gaussians' scales; zero unless significant.
///
/// An axis `q` whose line turns to `R q` is seen as `A T q ≈ λ T' R q`, with the Jacobian `T` at the old and `T'` at the
/// new mean: one unknown `λ` per axis, which no ill-determined direction enters. The thinnest axis takes no part: it
/// lies out of the surface that the tracks show.
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
            let line = Line {
                axis,
                turned: state.rotation * axis,
                turn_error: state.rotation_error,
                mean,
                moved: mean + state.translation,
            };
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
    let kept = significant_share(strain * strain / total, settings.scale_significance);
    let bound = settings.max_log_strain;
    if kept > 0.0 { (strain * kept).clamp(-bound, bound) } else { 0.0 }
}

/// An axis before and after the motion.
struct Line {
    /// Unit axis before it.
    axis: DVec3,
    /// Unit direction after it.
    turned: DVec3,
    /// Mean square error of the rotation vector between them.
    turn_error: DMat3,
    mean: DVec3,
    moved: DVec3,
}

impl Line {
    /// Logarithm of the stretch and its variance, which grows with the misfit between views, and with how much an error of
    /// the rotation would look like a stretch.
    fn log_stretch(&self, seen: &[&Observation], views: &[MotionView]) -> Option<(f64, f64)> {
        let sights: Vec<Sight> = seen.iter().filter_map(|o| self.sight(o, &views[o.view].camera)).collect();
        if sights.len() < LEAST_VIEWS {
            return None;
        }
        let (mut information, mut right, mut by_turn) = (0.0, 0.0, DVec3::ZERO);
        for Sight { expected, found, variance, by_turn: change } in &sights {
            information += expected.length_squared() / variance;
            right += expected.dot(*found) / variance;
            by_turn += *change / *variance;
        }
        let stretch = right / information;
        let chi_squared: f64 =
            sights.iter().map(|s| (s.found - s.expected * stretch).length_squared() / s.variance).sum();
        let misfit = (chi_squared / (2.0 * sights.len() as f64 - 1.0)).max(1.0);
        let by_turn = by_turn / information;
        // A line seen face-on foreshortens by half of the square of its tilt.
        let by_tilt = 0.5 * trace(self.turn_error);
        let by_turn = by_turn.dot(self.turn_error * by_turn) + by_tilt * by_tilt;
        let variance = misfit / (information * stretch * stretch) + by_turn;
        (stretch > 0.0 && variance.is_finite()).then(|| (stretch.ln(), variance))
    }

    fn sight(&self, Observation { fit, .. }: &Observation, camera: &Camera) -> Option<Sight> {
        let in_view = |[u, v]: [DVec3; 2], direction: DVec3| DVec2::new(u.dot(direction), v.dot(direction));
        let [u, v] = camera.world_jacobian(camera.to_camera(self.moved));
        let before = in_view(camera.world_jacobian(camera.to_camera(self.mean)), self.axis);
        let expected = in_view([u, v], self.turned);
        let variance = before.dot(fit.affine_covariance * before);
        let by_turn = self.turned.cross(u * expected.x + v * expected.y);
        (variance > 0.0 && fit.has_map()).then(|| Sight {
            expected,
            found: fit.affine * before,
            variance,
            by_turn,
        })
    }
}

/// An axis after the motion, in one view; pixels per world unit.
struct Sight {
    /// Unstretched.
    expected: DVec2,
    found: DVec2,
    /// Per component of `found`.
    variance: f64,
    /// Derivative of half of `|expected|²` by the rotation vector.
    by_turn: DVec3,
}
