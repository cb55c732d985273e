//! Which Gaussians lie next to which, and how much they belong together.

use std::num::NonZero;

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::MotionSettings;
use crate::{
    engine::EngineError,
    gaussians::{Gaussians, sh},
};

/// A tie between two Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Neighbour {
    pub index: usize,
    /// Distance between the means, world units.
    pub distance: f64,
    /// How alike their colours are, 0 to 1.
    pub affinity: f64,
}

/// The nearest neighbours of every Gaussian.
#[derive(Clone, Debug)]
pub(super) struct Neighbourhood {
    /// Nearest first, ties by index; none for Gaussians without a finite mean.
    pub nearest: Vec<Vec<Neighbour>>,
    /// Median distance to the farthest of the nearest neighbours, world units; zero if there is none.
    pub spacing: f64,
}

impl Neighbourhood {
    /// Finds the `settings.neighbours` nearest neighbours, no farther than `settings.max_edge` spacings.
    pub(super) fn new(gaussians: &Gaussians, settings: &MotionSettings) -> Result<Self, EngineError> {
        let finite: Vec<usize> =
            (0..gaussians.len()).filter(|&index| gaussians.mean(index).is_finite()).collect();
        let points: Vec<[f64; 3]> = finite.iter().map(|&index| gaussians.mean(index).to_array()).collect();
        let mut nearest = vec![Vec::new(); gaussians.len()];
        if points.len() < 2 || settings.neighbours == 0 {
            return Ok(Self { nearest, spacing: 0.0 });
        }
        let tree: ImmutableKdTree<f64, 3> = ImmutableKdTree::new_from_slice(&points).map_err(|error| {
            EngineError::InvalidInput(format!(
                "no neighbour tree for {} Gaussians: {error}; use fewer",
                points.len()
            ))
        })?;
        // One more, because a Gaussian is its own nearest.
        let count = NonZero::new(settings.neighbours + 1).unwrap_or(NonZero::<usize>::MIN);
        let lists: Vec<Vec<Neighbour>> = points
            .par_iter()
            .zip(&finite)
            .map(|(point, &own)| {
                let found = tree.query(point).nearest_n::<SquaredEuclidean<f64>>(count).execute();
                let mut list: Vec<Neighbour> = found
                    .into_iter()
                    .map(|item| (finite[item.item as usize], item.distance.max(0.0).sqrt()))
                    .filter(|&(index, _)| index != own)
                    .map(|(index, distance)| Neighbour {
                        index,
                        distance,
                        affinity: affinity(gaussians, own, index, settings),
                    })
                    .collect();
                list.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.index.cmp(&b.index)));
                list.truncate(settings.neighbours);
                list
            })
            .collect();
        for (&index, list) in finite.iter().zip(lists) {
            nearest[index] = list;
        }
        let spacing = median_reach(&nearest);
        let longest = settings.max_edge * spacing;
        nearest.par_iter_mut().for_each(|list| list.retain(|neighbour| neighbour.distance <= longest));
        Ok(Self { nearest, spacing })
    }

    /// The ties in both directions: with every tie its reverse, each list in index order.
    pub(super) fn symmetric(&self) -> Vec<Vec<Neighbour>> {
        let mut both = self.nearest.clone();
        for (from, list) in self.nearest.iter().enumerate() {
            for neighbour in list {
                both[neighbour.index].push(Neighbour { index: from, ..*neighbour });
            }
        }
        both.par_iter_mut().for_each(|list| {
            list.sort_by_key(|neighbour| neighbour.index);
            list.dedup_by_key(|neighbour| neighbour.index);
        });
        both
    }
}

fn median_reach(nearest: &[Vec<Neighbour>]) -> f64 {
    let mut reach: Vec<f64> =
        nearest.iter().filter_map(|list| list.last()).map(|neighbour| neighbour.distance).collect();
    if reach.is_empty() {
        return 0.0;
    }
    let middle = reach.len() / 2;
    *reach.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Cauchy weight of the difference of the view-independent colours; symmetric.
fn affinity(gaussians: &Gaussians, a: usize, b: usize, settings: &MotionSettings) -> f64 {
    let colour = |index: usize| -> DVec3 {
        let of = gaussians.sh_of(index);
        DVec3::new(of[0].into(), of[1].into(), of[2].into()) * sh::C0
    };
    let difference = (colour(a) - colour(b)).length_squared();
    let scale = settings.colour_scale.powi(2).max(f64::MIN_POSITIVE);
    let affinity = 1.0 / (1.0 + difference / scale);
    if affinity.is_finite() { affinity } else { 0.0 }
}
