//! The new position of a Gaussian from where its views see it.

use glam::{DMat3, DVec2, DVec3};

use super::{MotionSettings, linear::outer};
use crate::cameras::Camera;

/// Most Gauss-Newton steps; convergence is quadratic from the rays' intersection, so few are ever taken.
const STEPS: usize = 8;
/// Residual, in standard deviations, from which a view's pull stops growing (95 % efficient for normal
/// noise).
const HUBER: f64 = 1.345;
/// Median squared residual of two components of unit variance, `2 ln 2`.
const MEDIAN_SQUARE: f64 = 2.0 * std::f64::consts::LN_2;
/// How far the variance of tracks may exceed their claim before their views count as wrong.
const MOST_EXCESS: f64 = 9.0;
/// Most pairs of views that are tried as a consistent core.
const MAX_PAIRS: usize = 66;

/// Where one view sees the Gaussian at the new frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sighting<'a> {
    pub camera: &'a Camera,
    pub pixel: DVec2,
    /// Variance per axis, px².
    pub variance: f64,
    /// Share of `variance` that is doubt whether the pixel lies on the right surface.
    pub doubt: f64,
}

/// A solved position.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Lift {
    /// New minus old mean, world units.
    pub translation: DVec3,
    /// Inverse covariance of `translation`, 1 / world unit²; singular along directions that no view sees.
    pub information: DMat3,
    /// Sightings that agree with the solution, by their index in the input.
    pub inliers: Vec<usize>,
    /// Whether the views alone determine the position; otherwise neighbours must supply the missing
    /// directions.
    pub is_determined: bool,
    /// Whether they would without the doubt of their footprints; views that agree in spite of it speak against it.
    pub is_determined_if_undoubted: bool,
}

/// Triangulates a displaced mean by Gauss-Newton on pixels, robust to views whose track is wrong.
///
/// If not all views agree, the largest set around a consistent pair of views does (exhaustive RANSAC). `None`
/// if no set of more than half of the views agrees, or if the position is behind a camera that claims to see
/// it.
pub(super) fn solve(sightings: &[Sighting<'_>], mean: DVec3, settings: &MotionSettings) -> Option<Lift> {
    let problem = Problem { sightings, mean, settings };
    let everyone: Vec<usize> = (0..sightings.len()).collect();
    if everyone.is_empty() {
        return None;
    }
    if let Some(position) = problem.refine_from_rays(&everyone)
        && problem.inliers(position).len() == everyone.len()
    {
        return problem.lift(position, everyone);
    }
    let core = problem.consistent_core()?;
    let position = problem.refine_from_rays(&core)?;
    let inliers = problem.inliers(position);
    let is_majority = 2 * inliers.len() > everyone.len() && inliers.len() >= everyone.len().min(3);
    if !is_majority {
        return None;
    }
    let position = problem.refine_from_rays(&inliers)?;
    let inliers = problem.inliers_by_scale(position);
    let position = problem.refine_from_rays(&inliers)?;
    (2 * inliers.len() > everyone.len()).then(|| problem.lift(position, inliers)).flatten()
}

/// A position that the sightings `voters` find unchanged.
pub(super) fn at_rest(
    sightings: &[Sighting<'_>],
    voters: Vec<usize>,
    mean: DVec3,
    settings: &MotionSettings,
) -> Option<Lift> {
    Problem { sightings, mean, settings }.lift(mean, voters)
}

/// How many sightings agree with an unchanged position, by the measure of [`solve`].
pub(super) fn agreeing_at_rest(sightings: &[Sighting<'_>], mean: DVec3, settings: &MotionSettings) -> usize {
    Problem { sightings, mean, settings }.inliers(mean).len()
}

#[derive(Clone, Copy)]
struct Problem<'a> {
    sightings: &'a [Sighting<'a>],
    mean: DVec3,
    settings: &'a MotionSettings,
}

impl Problem<'_> {
    fn refine_from_rays(&self, members: &[usize]) -> Option<DVec3> {
        let start = self.intersect_rays(members)?;
        Some(self.refine(start, members))
    }

    /// Precision of the prior that nothing moves farther than ten times its distance from the farthest camera:
    /// far below that of any track, it only decides directions that no view sees. A camera that the mean all but
    /// touches says nothing about how far things move.
    fn prior_precision(&self, members: &[usize]) -> f64 {
        let depths = members.iter().map(|&m| self.sightings[m].camera.to_camera(self.mean).z);
        1e-2 / depths.fold(0.0, f64::max).powi(2).max(f64::MIN_POSITIVE)
    }

    /// The point closest to the members' viewing rays, in pixels at the depth of the old mean.
    ///
    /// Linear and solved about the old mean, so that a far world origin costs no precision.
    fn intersect_rays(&self, members: &[usize]) -> Option<DVec3> {
        let mut normal = DMat3::from_diagonal(DVec3::splat(self.prior_precision(members)));
        let mut right = DVec3::ZERO;
        for &member in members {
            let Sighting { camera, pixel, variance, .. } = self.sightings[member];
            let slope = DVec3::new((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy, 1.0);
            let ray = (camera.rotation.transpose() * slope).normalize();
            let depth = camera.to_camera(self.mean).z;
            let pixels_per_unit = camera.fx.abs().min(camera.fy.abs()) / depth;
            let weight = pixels_per_unit.powi(2) / variance;
            let across = (DMat3::IDENTITY - outer(ray, ray)) * weight;
            normal += across;
            right += across * (camera.centre() - self.mean);
        }
        let position = self.mean + normal.inverse() * right;
        (position.is_finite() && self.is_in_front(position, members)).then_some(position)
    }

    fn is_in_front(&self, position: DVec3, members: &[usize]) -> bool {
        members.iter().all(|&m| self.sightings[m].camera.project_world(position).is_some())
    }

    /// Gauss-Newton with Huber weights; a step is halved until it lowers the cost and stays in front of the
    /// cameras.
    fn refine(&self, start: DVec3, members: &[usize]) -> DVec3 {
        let mut position = start;
        let mut cost = self.cost(position, members);
        for _ in 0..STEPS {
            let (normal, gradient) = self.normal_equations(position, members);
            let ridge = DMat3::from_diagonal(DVec3::splat(self.prior_precision(members)));
            let step = (normal + ridge).inverse() * gradient;
            if !step.is_finite() {
                return position;
            }
            let accepted = (0..4).find_map(|halvings| {
                let candidate = position + step * 0.5f64.powi(halvings);
                let candidate_cost = self.cost(candidate, members);
                (candidate_cost < cost).then_some((candidate, candidate_cost))
            });
            let Some((better, lower)) = accepted else { return position };
            let has_converged = cost - lower <= 1e-12 * cost;
            (position, cost) = (better, lower);
            if has_converged {
                return position;
            }
        }
        position
    }

    /// Residual in pixels; `None` behind the camera.
    fn residual(&self, position: DVec3, member: usize) -> Option<DVec2> {
        let sighting = &self.sightings[member];
        Some(sighting.pixel - sighting.camera.project_world(position)?)
    }

    fn cost(&self, position: DVec3, members: &[usize]) -> f64 {
        members
            .iter()
            .map(|&member| {
                let Some(residual) = self.residual(position, member) else { return f64::INFINITY };
                let e = (residual.length_squared() / self.sightings[member].variance).sqrt();
                if e <= HUBER { 0.5 * e * e } else { HUBER * (e - 0.5 * HUBER) }
            })
            .sum()
    }

    /// `Σ ω TᵀT` and `Σ ω Tᵀ r`.
    fn normal_equations(&self, position: DVec3, members: &[usize]) -> (DMat3, DVec3) {
        let (mut normal, mut gradient) = (DMat3::ZERO, DVec3::ZERO);
        for &member in members {
            let Some(residual) = self.residual(position, member) else { continue };
            let Sighting { camera, variance, .. } = self.sightings[member];
            let e = (residual.length_squared() / variance).sqrt();
            let weight = (HUBER / e.max(HUBER)) / variance;
            let [u, v] = camera.world_jacobian(camera.to_camera(position));
            normal += (outer(u, u) + outer(v, v)) * weight;
            gradient += (u * residual.x + v * residual.y) * weight;
        }
        (normal, gradient)
    }

    /// Squared reprojection error over the largest that still counts as agreement.
    fn disagreement(&self, position: DVec3, member: usize) -> f64 {
        let Some(residual) = self.residual(position, member) else { return f64::INFINITY };
        let by_noise = self.settings.outlier_significance.powi(2) * self.sightings[member].variance;
        residual.length_squared() / by_noise.max(self.settings.outlier_floor.powi(2)).max(f64::MIN_POSITIVE)
    }

    fn inliers(&self, position: DVec3) -> Vec<usize> {
        (0..self.sightings.len()).filter(|&m| self.disagreement(position, m) <= 1.0).collect()
    }

    /// The inliers if the tracks err by as much more than they claim as the median of the views shows: a core
    /// that agrees by chance would otherwise shut out right views.
    fn inliers_by_scale(&self, position: DVec3) -> Vec<usize> {
        let by_noise = |&member: &usize| {
            let residual = self.residual(position, member)?;
            Some(residual.length_squared() / self.sightings[member].variance)
        };
        let members: Vec<usize> = (0..self.sightings.len()).collect();
        let mut squares: Vec<f64> = members.iter().filter_map(by_noise).collect();
        squares.sort_by(f64::total_cmp);
        let median = squares.get(squares.len() / 2).copied().unwrap_or(0.0);
        let scale = (median / MEDIAN_SQUARE).clamp(1.0, MOST_EXCESS);
        members.into_iter().filter(|&m| self.disagreement(position, m) <= scale).collect()
    }

    /// The inliers of the pair of views with which the views agree best (truncated squares).
    fn consistent_core(&self) -> Option<Vec<usize>> {
        let count = self.sightings.len();
        let pairs: Vec<[usize; 2]> = (0..count).flat_map(|a| (a + 1..count).map(move |b| [a, b])).collect();
        let stride = pairs.len().div_ceil(MAX_PAIRS).max(1);
        let score = |position: DVec3| -> f64 {
            (0..count).map(|member| self.disagreement(position, member).min(1.0)).sum()
        };
        let (_, position) = pairs
            .iter()
            .step_by(stride)
            .filter_map(|pair| self.intersect_rays(pair))
            .map(|position| (score(position), position))
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        let core = self.inliers(position);
        (core.len() >= 2).then_some(core)
    }

    /// The normal matrix, divided by the misfit where the views disagree more than they claim.
    fn information(&self, position: DVec3, inliers: &[usize]) -> DMat3 {
        let (normal, _) = self.normal_equations(position, inliers);
        let chi_squared: f64 = inliers
            .iter()
            .filter_map(|&m| Some(self.residual(position, m)?.length_squared() / self.sightings[m].variance))
            .sum();
        let freedom = (2.0 * inliers.len() as f64 - 3.0).max(1.0);
        normal * (1.0 / (chi_squared / freedom).max(1.0))
    }

    /// The information if every footprint follows the right surface.
    fn undoubted_information(&self, position: DVec3, inliers: &[usize]) -> DMat3 {
        let undoubted: Vec<Sighting<'_>> = self
            .sightings
            .iter()
            .map(|seen| Sighting { variance: seen.variance * (1.0 - seen.doubt), doubt: 0.0, ..*seen })
            .collect();
        Problem { sightings: &undoubted, ..*self }.information(position, inliers)
    }

    fn lift(&self, position: DVec3, inliers: Vec<usize>) -> Option<Lift> {
        if !self.is_in_front(position, &inliers) {
            return None;
        }
        let information = self.information(position, &inliers);
        let depth = self.sightings[*inliers.first()?].camera.to_camera(position).z;
        let least = (self.settings.max_relative_deviation * depth).powi(-2);
        let are_enough = inliers.len() >= self.settings.min_views.max(2);
        let is_determined = are_enough && is_above(information, least);
        // Two views always agree with a point somewhere along the epipolar line.
        let is_determined_if_undoubted = is_determined
            || are_enough
                && inliers.len() > 2
                && is_above(self.undoubted_information(position, &inliers), least);
        let translation = position - self.mean;
        (translation.is_finite() && information.is_finite()).then_some(Lift {
            translation,
            information,
            inliers,
            is_determined,
            is_determined_if_undoubted,
        })
    }
}

/// Whether every eigenvalue of a symmetric matrix exceeds `bound`: whether what remains after taking it away
/// is positive definite.
fn is_above(matrix: DMat3, bound: f64) -> bool {
    let rest = (matrix - DMat3::from_diagonal(DVec3::splat(bound))) * (1.0 / bound);
    let leading = rest.x_axis.x * rest.y_axis.y - rest.x_axis.y * rest.y_axis.x;
    rest.x_axis.x > 0.0 && leading > 0.0 && rest.determinant() > 0.0
}
