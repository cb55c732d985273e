//! What neighbours make of the motions: a median of translations, rest that closes in, and motion for those
//! without.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::OwnMotion;
use crate::{
    engine::EngineError,
    gaussians::Gaussians,
    motion::{
        MotionSettings,
        neighbours::{Neighbour, Neighbourhood},
    },
};

/// Nearest neighbours of each Gaussian.
const NEIGHBOURS: usize = 8;
/// Fixed neighbours that fix a Gaussian.
const FIXED_NEIGHBOURS: usize = 6;
/// Most rounds of either closure.
const ROUNDS: usize = 100;

/// The motion of every Gaussian.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Spread {
    pub translation: Vec<DVec3>,
    pub rotation: Vec<DQuat>,
    /// Whether a translation of its own or of others reached the Gaussian.
    pub is_reached: Vec<bool>,
    pub is_fixed: Vec<bool>,
}

/// A value with the confidence that it is passed on with.
type Estimate = Option<(DVec3, f64)>;

/// Filters and passes on; Gaussians at rest carry others' motion like any other, and only then stay.
pub(super) fn spread(gaussians: &Gaussians, own: &OwnMotion) -> Result<Spread, EngineError> {
    let nearest = nearest(gaussians)?;
    let is_fixed = close_fixed(own.is_fixed.clone(), &nearest);
    let influence = influence(&nearest);
    let translation = fill(median(&own.translation, &nearest), &influence);
    let turn = |solved: &Option<(DQuat, f64)>| {
        // The shorter way round: `q` and `-q` are the same rotation.
        solved
            .map(|(turn, confidence)| (if turn.w < 0.0 { -turn } else { turn }.to_scaled_axis(), confidence))
    };
    let rotation = fill(own.rotation.iter().map(turn).collect(), &influence);
    let is_moved = |index: usize| !is_fixed[index] && translation[index].is_some();
    let kept = |estimates: &[Estimate], index: usize| match estimates[index] {
        Some((value, _)) if is_moved(index) => value,
        _ => DVec3::ZERO,
    };
    let count = gaussians.len();
    Ok(Spread {
        translation: (0..count).map(|index| kept(&translation, index)).collect(),
        rotation: (0..count).map(|index| DQuat::from_scaled_axis(kept(&rotation, index))).collect(),
        is_reached: translation.iter().map(Option::is_some).collect(),
        is_fixed,
    })
}

fn nearest(gaussians: &Gaussians) -> Result<Vec<Vec<Neighbour>>, EngineError> {
    let all = MotionSettings { neighbours: NEIGHBOURS, max_edge: f64::MAX, ..MotionSettings::default() };
    Ok(Neighbourhood::new(gaussians, &all)?.nearest)
}

/// Each solved translation becomes the upper median, by component, of those of its solved neighbours.
fn median(solved: &[Estimate], nearest: &[Vec<Neighbour>]) -> Vec<Estimate> {
    (0..solved.len())
        .into_par_iter()
        .map(|index| {
            let (own, confidence) = solved[index]?;
            let around: Vec<DVec3> = nearest[index].iter().filter_map(|n| Some(solved[n.index]?.0)).collect();
            if around.is_empty() {
                return Some((own, confidence));
            }
            let middle = |axis: usize| {
                let mut values: Vec<f64> = around.iter().map(|value| value[axis]).collect();
                values.sort_by(f64::total_cmp);
                values[values.len() / 2]
            };
            Some((DVec3::new(middle(0), middle(1), middle(2)), confidence))
        })
        .collect()
}

/// Gaussians among fixed ones become fixed, round by round.
fn close_fixed(mut is_fixed: Vec<bool>, nearest: &[Vec<Neighbour>]) -> Vec<bool> {
    for _ in 0..ROUNDS {
        let snapshot = &is_fixed;
        let closed: Vec<usize> = (0..snapshot.len())
            .into_par_iter()
            .filter(|&index| {
                let fixed = nearest[index].iter().filter(|n| snapshot[n.index]).count();
                !snapshot[index] && fixed >= FIXED_NEIGHBOURS
            })
            .collect();
        if closed.is_empty() {
            break;
        }
        for index in closed {
            is_fixed[index] = true;
        }
    }
    is_fixed
}

/// For every Gaussian those that count it among their neighbours, in index order, with the weight
/// `exp(−d / |d|)` of the distance among all distances of the sender.
fn influence(nearest: &[Vec<Neighbour>]) -> Vec<Vec<(usize, f64)>> {
    let mut influence = vec![Vec::new(); nearest.len()];
    for (sender, list) in nearest.iter().enumerate() {
        let norm = list.iter().map(|n| n.distance * n.distance).sum::<f64>().sqrt();
        for neighbour in list {
            // Neighbours at no distance at all are as near as can be.
            let relative = if norm > 0.0 { neighbour.distance / norm } else { 0.0 };
            influence[neighbour.index].push((sender, (-relative).exp()));
        }
    }
    influence
}

/// Passes values on from the filled to their neighbours, ring by ring, by confidence and distance.
///
/// Negative confidences can cancel; a value that comes out as no number is as good as none.
fn fill(mut values: Vec<Estimate>, influence: &[Vec<(usize, f64)>]) -> Vec<Estimate> {
    for _ in 0..ROUNDS {
        let snapshot = &values;
        let filled: Vec<(usize, (DVec3, f64))> = (0..snapshot.len())
            .into_par_iter()
            .filter(|&index| snapshot[index].is_none())
            .filter_map(|index| Some((index, blended(snapshot, &influence[index])?)))
            .collect();
        if filled.is_empty() {
            break;
        }
        for (index, value) in filled {
            values[index] = Some(value);
        }
    }
    values
}

fn blended(values: &[Estimate], senders: &[(usize, f64)]) -> Estimate {
    let (mut sum, mut weight, mut count) = (DVec3::ZERO, 0.0, 0u32);
    for &(sender, nearness) in senders {
        if let Some((value, confidence)) = values[sender] {
            sum += value * (confidence * nearness);
            weight += confidence * nearness;
            count += 1;
        }
    }
    let value = sum / weight;
    (count > 0 && value.is_finite()).then(|| (value, weight / f64::from(count)))
}
