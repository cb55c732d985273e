//! TrackerSplat's released path from tracks to motion, as an ablation to stand beside the robust one.
//!
//! | step | file |
//! |---|---|
//! | affine motion of each footprint, in normalised device coordinates | `fit` |
//! | Gaussians at rest, by a pixel constant | `fixed` |
//! | new means: smallest singular vector of the projection equations | `means` |
//! | new rotations: eigenvectors of the covariance that all views solve for | `covariances` |
//! | median of the neighbours' translations, motion for the rest | `spread` |
//!
//! Written from a description of the released code, never from the code. It keeps what the description calls
//! its defects: visibility and track variance are ignored, eigenvectors are matched by permutation without
//! their signs, the Jacobian is that of the old mean, confidences may be negative, scales are found and thrown
//! away, Gaussians at rest anchor nobody, harmonics do not turn.
//!
//! Where the description calls something an accident of the released kernels, the evident intent stands here:
//! every filled Gaussian passes its motion on, whatever its index, the order of the Gaussians does not matter, the eight
//! nearest neighbours are exact, and what no translation reaches does not turn either.
//! Solves run in double precision where the released code uses single (singular values, eigenvectors), cameras
//! keep their principal point, and what comes out as no number counts as not solved. So this is, if anything,
//! better than what was released.

mod covariances;
mod fit;
mod fixed;
mod means;
mod spread;
#[cfg(test)]
mod tests;

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use super::{MotionField, MotionOrigin, MotionView, OrderCounts};
use crate::{
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    tracking::TrackField,
};
use fit::Affine;

/// Fewest views, plus one, that means, covariances and rest are decided from.
const MIN_VIEWS: usize = 2;
/// Least sum of blending weights over the views.
const MIN_WEIGHT: f64 = 1e-3;
/// Pixels over the views that are not enough.
const TOO_FEW_PIXELS: u32 = 3;

/// What the footprints of each Gaussian say on their own, before neighbours have a say.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnMotion {
    /// World displacement of each mean and its confidence; `None` where a threshold refused it.
    pub translation: Vec<Option<(DVec3, f64)>>,
    /// World rotation of each Gaussian and its confidence; `None` where a threshold or an eigenvalue below zero
    /// refused it.
    pub rotation: Vec<Option<(DQuat, f64)>>,
    /// Gaussians at rest; neither of the above is solved for them.
    pub is_fixed: Vec<bool>,
}

/// What one view sees of one Gaussian.
#[derive(Clone, Copy, Debug)]
struct Sight {
    view: usize,
    /// `Σ alpha T`.
    weight: f64,
    /// The part of `weight` on pixels that stay.
    still_weight: f64,
    pixels: u32,
    /// `None` where the footprint is too small or too faint.
    affine: Option<Affine>,
}

/// A sight that takes part in the solves.
#[derive(Clone, Copy, Debug)]
struct Seen<'a> {
    camera: &'a crate::cameras::Camera,
    weight: f64,
    pixels: u32,
    affine: Affine,
}

/// Translations and rotations from each Gaussian's own footprints.
///
/// # Errors
/// Whatever the engine reports, such as tracks that are not of their camera's size.
pub fn solve(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
) -> Result<OwnMotion, EngineError> {
    let sights = sights(engine, gaussians, views)?;
    let is_fixed: Vec<bool> = sights.par_iter().map(|sights| fixed::is_fixed(sights)).collect();
    let solved = |index: usize| {
        if is_fixed[index] {
            return (None, None);
        }
        let seen: Vec<Seen<'_>> = sights[index].iter().filter_map(|sight| sight.seen(views)).collect();
        if !is_enough(&seen) {
            return (None, None);
        }
        (means::solve(&seen, gaussians.mean(index)), covariances::solve(&seen, gaussians, index))
    };
    let (translation, rotation) = (0..gaussians.len()).into_par_iter().map(solved).unzip();
    Ok(OwnMotion { translation, rotation, is_fixed })
}

/// The released path from end to end.
pub(super) fn estimate(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
) -> Result<MotionField, EngineError> {
    let own = solve(engine, gaussians, views)?;
    let spread = spread::spread(gaussians, &own)?;
    let origin = |index: usize| match (spread.is_fixed[index], own.translation[index]) {
        (true, _) => MotionOrigin::Static,
        (false, Some(_)) => MotionOrigin::Solved,
        (false, None) if spread.is_reached[index] => MotionOrigin::Propagated,
        (false, None) => MotionOrigin::Unsolved,
    };
    Ok(MotionField {
        origin: (0..gaussians.len()).map(origin).collect(),
        translation: spread.translation,
        rotation: spread.rotation,
        information: vec![DMat3::ZERO; gaussians.len()],
        turns_harmonics: false,
        log_scale: vec![DVec3::ZERO; gaussians.len()],
        orders: OrderCounts::default(),
    })
}

impl Sight {
    fn seen<'a>(&self, views: &'a [MotionView]) -> Option<Seen<'a>> {
        let camera = &views[self.view].camera;
        Some(Seen { camera, weight: self.weight, pixels: self.pixels, affine: self.affine? })
    }
}

/// The thresholds that means and covariances share.
fn is_enough(seen: &[Seen<'_>]) -> bool {
    seen.len() > MIN_VIEWS
        && seen.iter().map(|s| s.weight).sum::<f64>() > MIN_WEIGHT
        && seen.iter().map(|s| s.pixels).sum::<u32>() > TOO_FEW_PIXELS
}

/// Two passes per view: the moments of all pixels, and the weight of those that stay.
fn sights(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
) -> Result<Vec<Vec<Sight>>, EngineError> {
    let mut sights = vec![Vec::new(); gaussians.len()];
    for (view, MotionView { camera, tracks }) in views.iter().enumerate() {
        let all =
            engine.footprint_moments(gaussians, camera, &weighted_by_blending(tracks, |_| true), None)?;
        let still = fixed::still_pixels(tracks);
        let still = engine.footprint_moments(
            gaussians,
            camera,
            &weighted_by_blending(tracks, |pixel| still[pixel]),
            None,
        )?;
        let size = DVec2::new(camera.width.into(), camera.height.into());
        sights.par_iter_mut().zip(&all).zip(&still).for_each(|((list, moments), still)| {
            if moments.pixels > 0 {
                list.push(Sight {
                    view,
                    weight: moments.weight,
                    still_weight: still.weight,
                    pixels: moments.pixels,
                    affine: fit::fit(moments, size),
                });
            }
        });
    }
    Ok(sights)
}

/// The tracks with weights of `alpha T` on the pixels that count: no visibility, no variance.
fn weighted_by_blending(tracks: &TrackField, counts: impl Fn(usize) -> bool) -> TrackField {
    TrackField {
        visible: (0..tracks.visible.len()).map(counts).collect(),
        sigma: vec![1.0; tracks.sigma.len()],
        ..tracks.clone()
    }
}
