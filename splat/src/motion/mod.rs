//! Motion compensation: footprint moments → 2D motion → lift to 3D → regularised field.
//!
//! | step | file |
//! |---|---|
//! | sums over a footprint's pixels, robust to other surfaces | `moments`, `reweighting` |
//! | motion of each footprint, with its order and uncertainty | `fit2d`, `order` |
//! | which views see a Gaussian, and how well | `observe` |
//! | Gaussians at rest | `static_test` |
//! | new positions, robust to wrong views | `lift` |
//! | rotations from neighbours and from the footprints' deformation | `rotation` |
//! | changes of scale, where beyond doubt | `strain` |
//! | motion of unobserved Gaussians from agreeing neighbours | `propagate` |
//! | the neighbours' field as one sparse solve | `regularize` |
//! | moving the Gaussians | `apply` |
//! | what single views say and the lift believes, to measure | `sightings` |
//! | the released code's own path, to compare with | `reference` |
//! | an order that the input's order does not change | `value_order` |
//!
//! Solves run in double precision; sums are in the order of the Gaussians' values, so that the result depends
//! neither on the number of threads nor on the order of the Gaussians.

mod apply;
mod fit2d;
mod lift;
mod linear;
pub mod moments;
mod neighbours;
mod observe;
mod order;
mod propagate;
pub mod reference;
mod regularize;
pub mod reweighting;
mod rotation;
mod settings;
pub mod sightings;
mod static_test;
mod strain;
#[cfg(test)]
mod tests;
mod value_order;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use apply::apply;
pub use observe::{no_surer_than, within_mask};
pub use order::OrderCounts;
pub use settings::{LiftMethod, MotionSettings};

use crate::{
    engine::{Engine, EngineError},
    gaussians::Gaussians,
};
use lift::Sighting;
use neighbours::Neighbourhood;
use observe::Observation;
use propagate::{Context, State};
use rotation::{Deformation, Expectation, Member};
use value_order::ValueOrder;

/// How a Gaussian's motion was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionOrigin {
    /// Its footprints do not move beyond the track noise; or, where a single view or none finds it so, those of its neighbours
    /// do not.
    Static,
    /// Solved from its own footprints.
    Solved,
    /// Taken from its neighbours' field.
    Propagated,
    /// Neither: it stays as it was.
    Unsolved,
}

/// Motion of every Gaussian from the key frame to one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionField {
    /// World displacement of each mean.
    pub translation: Vec<glam::DVec3>,
    /// World rotation of each Gaussian about its mean.
    pub rotation: Vec<glam::DQuat>,
    /// How each motion was found.
    pub origin: Vec<MotionOrigin>,
    /// Information matrix of each translation, 1 / world unit², from the views that agree with it: of Gaussians at rest those
    /// that find them so. Zero where nothing was observed, and singular where the views do not determine a position.
    pub information: Vec<glam::DMat3>,
    /// Whether the spherical harmonics turn with the Gaussians.
    pub turns_harmonics: bool,
    /// Change of the logarithm of each Gaussian's scales, along its own axes; zero unless significant.
    pub log_scale: Vec<glam::DVec3>,
    /// Which models the footprints got; all zero on the reference path, which knows affine maps only.
    pub orders: OrderCounts,
}

/// One view's camera and its tracks from the key frame to the target frame.
#[derive(Clone, Debug)]
pub struct MotionView {
    /// Where the view was taken from.
    pub camera: crate::cameras::Camera,
    /// Tracks, of the camera's size.
    pub tracks: std::sync::Arc<crate::tracking::TrackField>,
}

/// A step of [`estimate`], in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotionStage {
    /// Moments and fits of all footprints.
    Observe,
    /// The nearest neighbours.
    Neighbours,
    /// Who rests, and the positions of those who do not.
    Lift,
    /// Rotations of the solved.
    Turn,
    /// Motion for the unobserved.
    Propagate,
    /// The neighbours' field.
    Regularise,
}

/// Motion of every Gaussian of the static model to the frame that the tracks lead to.
///
/// Depends on the Gaussians' values, not on their order; equal Gaussians move alike.
///
/// # Errors
/// [`EngineError::InvalidInput`] if tracks and camera of a view differ in size; otherwise whatever the engine
/// reports.
pub fn estimate(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
    settings: &MotionSettings,
) -> Result<MotionField, EngineError> {
    estimate_staged(engine, gaussians, views, settings, &mut |_| ())
}

/// [`estimate`], with a call as each stage is entered: for those who time them. The reference path has no stages.
///
/// # Errors
/// Those of [`estimate`].
pub fn estimate_staged(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
    settings: &MotionSettings,
    entered: &mut dyn FnMut(MotionStage),
) -> Result<MotionField, EngineError> {
    let order = ValueOrder::of(gaussians);
    let sorted = order.sorted(gaussians);
    let field = match settings.lift {
        LiftMethod::Robust => estimate_in_order(engine, &sorted, views, settings, entered)?,
        LiftMethod::Reference => reference::estimate(engine, &sorted, views)?,
    };
    Ok(order.restored(field))
}

fn estimate_in_order(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    views: &[MotionView],
    settings: &MotionSettings,
    entered: &mut dyn FnMut(MotionStage),
) -> Result<MotionField, EngineError> {
    entered(MotionStage::Observe);
    let observations = observe::observe(engine, gaussians, views, settings)?;
    estimate_observed(gaussians, &observations, views, settings, entered)
}

fn estimate_observed(
    gaussians: &Gaussians,
    observations: &[Vec<Observation>],
    views: &[MotionView],
    settings: &MotionSettings,
    entered: &mut dyn FnMut(MotionStage),
) -> Result<MotionField, EngineError> {
    entered(MotionStage::Neighbours);
    let neighbourhood = Neighbourhood::new(gaussians, settings)?;
    let context = Context { gaussians, neighbourhood: &neighbourhood, settings };
    entered(MotionStage::Lift);
    let mut states: Vec<State> = observations
        .par_iter()
        .enumerate()
        .map(|(index, observations)| solve_alone(gaussians.mean(index), observations, views, settings))
        .collect();
    propagate::retract_unverified(&mut states, &context);
    entered(MotionStage::Turn);
    turn_solved(&mut states, observations, views, &context);
    entered(MotionStage::Propagate);
    propagate::propagate(&mut states, &context);
    if propagate::accept_doubted(&mut states) {
        turn_solved(&mut states, observations, views, &context);
        propagate::propagate(&mut states, &context);
    }
    if propagate::accept_resting(&mut states) {
        propagate::propagate(&mut states, &context);
    }
    entered(MotionStage::Regularise);
    regularize::regularize(&mut states, &context);
    Ok(field(&states, observations, views, &context))
}

/// What a Gaussian's own footprints say about its translation.
fn solve_alone(
    mean: DVec3,
    observations: &[Observation],
    views: &[MotionView],
    settings: &MotionSettings,
) -> State {
    let sightings: Vec<Sighting<'_>> = observations
        .iter()
        .map(|o| Sighting {
            camera: &views[o.view].camera,
            pixel: o.fit.target,
            variance: o.fit.variance,
            doubt: o.fit.doubt,
        })
        .collect();
    let resting = |voters: Vec<usize>| {
        // However badly two views tell the depth of what does not move for either, a motion along both rays is less likely.
        let is_determined = voters.len() > 1;
        let own = lift::at_rest(&sightings, voters, mean, settings);
        let origin = if is_determined { MotionOrigin::Static } else { MotionOrigin::Unsolved };
        State { is_seen_at_rest: true, ..State::unmoved(origin, own) }
    };
    let agreeing = || lift::agreeing_at_rest(&sightings, mean, settings);
    let lift = || lift::solve(&sightings, mean, settings);
    let voters = static_test::voters_for_rest(observations, settings);
    let lift = match voters {
        None => lift(),
        Some(voters) if voters.len() == observations.len() => return resting(voters),
        Some(voters) => match lift().filter(|lift| static_test::refutes(lift, agreeing(), settings)) {
            None => return resting(voters),
            moved => moved,
        },
    };
    let Some(lift) = lift else {
        return State::unmoved(MotionOrigin::Unsolved, None);
    };
    if !lift.is_determined {
        return State::unmoved(MotionOrigin::Unsolved, Some(lift));
    }
    State { translation: lift.translation, own: Some(lift), ..State::unmoved(MotionOrigin::Solved, None) }
}

/// Rotations of the solved Gaussians, from solved neighbours and their own footprints' deformation.
fn turn_solved(
    states: &mut [State],
    observations: &[Vec<Observation>],
    views: &[MotionView],
    context: &Context<'_>,
) {
    let snapshot: &[State] = states;
    let rotations: Vec<_> = (0..snapshot.len())
        .into_par_iter()
        .filter_map(|index| {
            let state = &snapshot[index];
            let own = state.own.as_ref().filter(|_| state.origin == MotionOrigin::Solved)?;
            let neighbours = context.neighbourhood.nearest[index].iter().filter_map(|n| {
                let other = &snapshot[n.index];
                let lift = other.own.as_ref().filter(|_| other.origin == MotionOrigin::Solved)?;
                Some(context.member(index, n.index, n.affinity, other, lift.information))
            });
            let itself = context.member(index, index, 1.0, state, own.information);
            let members: Vec<Member> = std::iter::once(itself).chain(neighbours).collect();
            let deformations: Vec<Deformation<'_>> = own
                .inliers
                .iter()
                .map(|&k| &observations[index][k])
                .map(|o| Deformation { camera: &views[o.view].camera, fit: &o.fit })
                .collect();
            let axes = rotation::lift_axes(context.gaussians, index, own.translation, &deformations);
            let spacing = context.neighbourhood.spacing;
            let expectation = Expectation::unturned(own.translation, context.settings);
            let motion = rotation::fit_rigid_motion(&members, &axes, &expectation, spacing, context.settings);
            Some((index, motion))
        })
        .collect();
    for (index, motion) in rotations {
        states[index].rotation = motion.rotation;
        states[index].rotation_error = motion.rotation_error;
    }
}

fn field(
    states: &[State],
    observations: &[Vec<Observation>],
    views: &[MotionView],
    context: &Context<'_>,
) -> MotionField {
    MotionField {
        translation: states.iter().map(|state| state.translation).collect(),
        rotation: states.iter().map(|state| state.rotation).collect(),
        origin: states.iter().map(|state| state.origin).collect(),
        information: states
            .iter()
            .map(|s| s.own.as_ref().map_or(DMat3::ZERO, |own| own.information))
            .collect(),
        turns_harmonics: true,
        log_scale: strain::log_strains(states, observations, views, context),
        orders: OrderCounts::of(observations.iter().flatten().map(|observation| observation.fit.order)),
    }
}
