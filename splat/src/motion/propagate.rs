//! Motion for the Gaussians that the tracks do not determine, from those that they do.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::{
    MotionOrigin, MotionSettings,
    lift::Lift,
    linear::{solve, trace},
    neighbours::{Neighbour, Neighbourhood},
    rotation::{Expectation, Member, RigidMotion, fit_rigid_motion},
};
use crate::gaussians::Gaussians;

/// What is known of one Gaussian's motion so far.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub origin: MotionOrigin,
    pub translation: DVec3,
    pub rotation: DQuat,
    /// Mean square error of the rotation vector, radians².
    pub rotation_error: DMat3,
    /// What its own footprints say: of a solved Gaussian everything, of another the directions that were
    /// seen.
    pub own: Option<Lift>,
    /// Whether most of its own views find it at rest.
    pub is_seen_at_rest: bool,
}

impl State {
    /// Neither moved nor turned.
    pub(super) fn unmoved(origin: MotionOrigin, own: Option<Lift>) -> Self {
        Self {
            origin,
            translation: DVec3::ZERO,
            rotation: DQuat::IDENTITY,
            rotation_error: DMat3::ZERO,
            own,
            is_seen_at_rest: false,
        }
    }

    fn is_known(&self) -> bool {
        self.origin != MotionOrigin::Unsolved
    }
}

/// What a Gaussian's neighbourhood is measured with.
pub(super) struct Context<'a> {
    pub gaussians: &'a Gaussians,
    pub neighbourhood: &'a Neighbourhood,
    pub settings: &'a MotionSettings,
}

impl Context<'_> {
    /// Information about a motion that was not measured: it is known to the strain of a neighbourhood.
    fn indirect_information(&self) -> DMat3 {
        let deviation = self.settings.neighbour_strain * self.neighbourhood.spacing;
        DMat3::from_diagonal(DVec3::splat(deviation.max(1e-150).powi(-2)))
    }

    /// Standard deviation of a motion that is taken from these neighbours.
    fn prediction_deviation(&self, members: &[Neighbour]) -> f64 {
        let distance = members.iter().map(|n| n.distance).sum::<f64>() / members.len().max(1) as f64;
        self.settings.neighbour_strain * (distance + 0.1 * self.neighbourhood.spacing)
    }

    pub(super) fn member(
        &self,
        centre: usize,
        index: usize,
        affinity: f64,
        state: &State,
        information: DMat3,
    ) -> Member {
        Member {
            offset: self.gaussians.mean(index) - self.gaussians.mean(centre),
            translation: state.translation,
            information,
            affinity,
        }
    }

    /// Followers turn as those whom they follow do on average, give or take the strain of a neighbourhood, unless the
    /// displacements say otherwise: of few neighbours, or of those in a line, these do not determine a rotation.
    fn expectation(&self, consensus: &Consensus, states: &[State]) -> Expectation {
        let deviation = self.settings.neighbour_strain;
        let mut mean = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
        for member in &consensus.members {
            let turn = states[member.index].rotation;
            // `q` and `-q` are the same rotation.
            let side = if mean.dot(turn) < 0.0 { -1.0 } else { 1.0 };
            let error = trace(states[member.index].rotation_error) + deviation * deviation;
            mean += turn * (side * member.affinity / error.max(f64::MIN_POSITIVE));
        }
        let is_turned = mean.xyz() != DVec3::ZERO && mean.length_squared() > 0.0 && mean.is_finite();
        let rotation = if is_turned { mean.normalize() } else { DQuat::IDENTITY };

        Expectation { translation: consensus.translation, rotation, deviation }
    }

    /// The neighbours of known motion that move most alike, and the motion in their middle.
    fn consensus(&self, centre: usize, states: &[State]) -> Option<Consensus> {
        let list = &self.neighbourhood.nearest[centre];
        let known: Vec<Neighbour> = list.iter().copied().filter(|n| states[n.index].is_known()).collect();
        let mean = |index: usize| self.gaussians.mean(index);
        let carried = |n: &Neighbour| {
            // What the neighbour's rigid motion would do at the centre.
            let state = &states[n.index];
            let lever = mean(centre) - mean(n.index);
            state.translation + state.rotation * lever - lever
        };
        let agree = |a: &Neighbour, b: &Neighbour| {
            let tolerance = 2.0 * self.settings.neighbour_strain * (a.distance + b.distance)
                + 0.1 * self.neighbourhood.spacing;
            (carried(a) - carried(b)).length() <= tolerance
        };
        let support = |candidate: &Neighbour| -> f64 {
            known.iter().filter(|other| agree(candidate, other)).map(|other| other.affinity).sum()
        };
        let mut best: Option<(f64, &Neighbour)> = None;
        for candidate in &known {
            let support = support(candidate);
            // Nearest first, so that a tie goes to the nearer.
            if best.is_none_or(|(most, _)| support > most) {
                best = Some((support, candidate));
            }
        }
        let (_, leader) = best?;
        let members: Vec<Neighbour> = known.iter().copied().filter(|other| agree(leader, other)).collect();
        Some(Consensus { translation: carried(leader), known: known.len(), members })
    }
}

struct Consensus {
    /// Displacement of the centre by its best supported neighbour.
    translation: DVec3,
    /// Neighbours of known motion.
    known: usize,
    /// Those of them that agree.
    members: Vec<Neighbour>,
}

/// Takes back solutions that only two views support and that a majority of the neighbours contradicts: a
/// track that is wrong along the epipolar line passes every test of its own.
pub(super) fn retract_unverified(states: &mut [State], context: &Context<'_>) {
    let snapshot: &[State] = states;
    let retracted: Vec<usize> = (0..snapshot.len())
        .into_par_iter()
        .filter(|&index| {
            let state = &snapshot[index];
            let is_unverified = state.origin == MotionOrigin::Solved
                && state.own.as_ref().is_some_and(|own| own.inliers.len() < 3);
            if !is_unverified {
                return false;
            }
            let Some(consensus) = context.consensus(index, snapshot) else { return false };
            let farthest = consensus.members.last().map_or(0.0, |member| member.distance);
            let tolerance = 4.0 * context.settings.neighbour_strain * farthest
                + 0.1 * context.neighbourhood.spacing
                + deviation(state);
            2 * consensus.members.len() > consensus.known
                && consensus.members.len() >= context.settings.min_support
                && (state.translation - consensus.translation).length() > tolerance
        })
        .collect();
    for index in retracted {
        states[index] = State::unmoved(MotionOrigin::Unsolved, None);
    }
}

/// Three standard deviations of a solved translation in its worst direction, bounded from above.
fn deviation(state: &State) -> f64 {
    let Some(own) = &state.own else { return 0.0 };
    let covariance = own.information.inverse();
    let trace = trace(covariance);
    if trace.is_finite() { 3.0 * trace.max(0.0).sqrt() } else { 0.0 }
}

/// Takes positions that only doubt about the surfaces under their footprints left unsolved, where no neighbour
/// knows better; whether there are any.
pub(super) fn accept_doubted(states: &mut [State]) -> bool {
    let mut any = false;
    for state in states.iter_mut().filter(|state| !state.is_known() && !state.is_seen_at_rest) {
        if let Some(own) = state.own.take_if(|own| own.is_determined_if_undoubted) {
            let solved = State::unmoved(MotionOrigin::Solved, None);
            *state = State { translation: own.translation, own: Some(own), ..solved };
            any = true;
        }
    }
    any
}

/// Lets Gaussians rest that a single view sees at rest, and of which no neighbour knows better; whether there are any.
pub(super) fn accept_resting(states: &mut [State]) -> bool {
    let mut any = false;
    for state in states.iter_mut().filter(|state| !state.is_known() && state.is_seen_at_rest) {
        state.origin = MotionOrigin::Static;
        any = true;
    }
    any
}

/// Fills unsolved Gaussians from agreeing neighbours, one ring of neighbours per hop.
///
/// Each hop reads the states before it, so that the result does not depend on the order of the Gaussians.
/// Where too few neighbours agree the Gaussian stays unsolved.
pub(super) fn propagate(states: &mut [State], context: &Context<'_>) {
    for _ in 0..context.settings.max_hops {
        let snapshot: &[State] = states;
        let filled: Vec<(usize, State)> = (0..snapshot.len())
            .into_par_iter()
            .filter(|&index| !snapshot[index].is_known())
            .filter_map(|index| Some((index, follow_neighbours(index, snapshot, context)?)))
            .collect();
        if filled.is_empty() {
            return;
        }
        for (index, state) in filled {
            states[index] = state;
        }
    }
}

fn follow_neighbours(index: usize, states: &[State], context: &Context<'_>) -> Option<State> {
    let consensus = context.consensus(index, states)?;
    if consensus.members.len() < context.settings.min_support.max(1) {
        return None;
    }
    let are_at_rest = consensus.members.iter().all(|n| states[n.index].origin == MotionOrigin::Static);
    let State { own, is_seen_at_rest, .. } = &states[index];
    if are_at_rest && (own.is_none() || *is_seen_at_rest) {
        return Some(State { origin: MotionOrigin::Static, ..states[index].clone() });
    }
    let indirect = context.indirect_information();
    let members: Vec<Member> = consensus
        .members
        .iter()
        .map(|n| {
            let state = &states[n.index];
            let solved = state.own.as_ref().filter(|_| state.origin == MotionOrigin::Solved);
            let information = solved.map_or(indirect, |own| own.information);
            context.member(index, n.index, n.affinity, state, information)
        })
        .collect();
    let RigidMotion { mut translation, rotation, rotation_error } = fit_rigid_motion(
        &members,
        &[],
        &context.expectation(&consensus, states),
        context.neighbourhood.spacing,
        context.settings,
    );
    let deviation = context.prediction_deviation(&consensus.members);
    let pull = own.as_ref().and_then(|own| pull(own, translation, deviation, context.settings));
    if *is_seen_at_rest && pull.is_none() {
        // Neighbours of another body.
        return Some(State { origin: MotionOrigin::Static, ..states[index].clone() });
    }
    translation += pull.unwrap_or(DVec3::ZERO);
    let own = own.clone().filter(|_| pull.is_some());
    let origin = MotionOrigin::Propagated;
    Some(State { origin, translation, rotation, rotation_error, own, is_seen_at_rest: false })
}

/// How far what a Gaussian's own views see moves it from its neighbours' prediction, whose standard deviation is
/// given: all the way along the directions that they see, not at all along the others. `None` if both contradict
/// each other.
fn pull(own: &Lift, prediction: DVec3, deviation: f64, settings: &MotionSettings) -> Option<DVec3> {
    let difference = own.translation - prediction;
    let prior = deviation * deviation;
    // `(H⁻¹ + τ² I)⁻¹ = H (I + τ² H)⁻¹` needs no inverse of the singular `H`.
    let solved = solve(DMat3::IDENTITY + own.information * prior, difference)?;
    let innovation = own.information * solved;
    let is_plausible = difference.dot(innovation) <= settings.outlier_significance.powi(2);
    (is_plausible && innovation.is_finite()).then_some(innovation * prior)
}
