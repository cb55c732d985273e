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

type Tree = ImmutableKdTree<f64, 3>;

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
    /// Median distance to the farthest of the nearest neighbours, world units, of the Gaussians whose
    /// neighbours do not all have the same mean; zero if there are none.
    pub spacing: f64,
}

impl Neighbourhood {
    /// Finds the `settings.neighbours` nearest neighbours, no farther than `settings.max_edge` spacings.
    ///
    /// Gaussians of equal mean should be next to each other: they share one point of the tree, whose search
    /// would otherwise visit all of them for each.
    pub(super) fn new(gaussians: &Gaussians, settings: &MotionSettings) -> Result<Self, EngineError> {
        let places = Places::new(gaussians);
        let mut nearest = vec![Vec::new(); gaussians.len()];
        if places.finite.len() < 2 || settings.neighbours == 0 {
            return Ok(Self { nearest, spacing: 0.0 });
        }
        let tree = Tree::new_from_slice(&places.points).map_err(|error| {
            EngineError::InvalidInput(format!(
                "no neighbour tree for {} Gaussians: {error}; use fewer",
                places.points.len()
            ))
        })?;
        let lists: Vec<Vec<Neighbour>> = (0..places.finite.len())
            .into_par_iter()
            .map(|rank| neighbours_of(rank, &places, &tree, gaussians, settings))
            .collect();
        for (&index, list) in places.finite.iter().zip(lists) {
            nearest[index] = list;
        }
        let spacing = median_reach(&nearest);
        let longest = settings.max_edge * spacing;
        nearest.par_iter_mut().for_each(|list| list.retain(|neighbour| neighbour.distance <= longest));
        Ok(Self { nearest, spacing })
    }

    /// Who counts a Gaussian among its nearest without being among the Gaussian's own.
    pub(super) fn incoming(&self) -> Incoming {
        let is_mutual = |from: usize, to: usize| self.nearest[to].iter().any(|back| back.index == from);
        let one_way: Vec<(usize, Neighbour)> = (0..self.nearest.len())
            .into_par_iter()
            .flat_map_iter(|from| {
                let ties = self.nearest[from].iter().filter(move |tie| !is_mutual(from, tie.index));
                ties.map(move |tie| (tie.index, Neighbour { index: from, ..*tie }))
            })
            .collect();
        let mut starts = vec![0; self.nearest.len() + 1];
        for &(to, _) in &one_way {
            starts[to + 1] += 1;
        }
        for index in 1..starts.len() {
            starts[index] += starts[index - 1];
        }
        let mut next = starts.clone();
        let nobody = Neighbour { index: 0, distance: 0.0, affinity: 0.0 };
        let mut ties = vec![nobody; one_way.len()];
        for (to, tie) in one_way {
            ties[next[to]] = tie;
            next[to] += 1;
        }
        Incoming { starts, ties }
    }
}

/// One-way ties by the Gaussian that they lead to.
pub(super) struct Incoming {
    /// Where the ties to each Gaussian begin in `ties`, and one past the last of all.
    starts: Vec<usize>,
    ties: Vec<Neighbour>,
}

impl Incoming {
    /// The ties to a Gaussian, those from the first Gaussians first.
    pub(super) fn to(&self, index: usize) -> &[Neighbour] {
        &self.ties[self.starts[index]..self.starts[index + 1]]
    }
}

/// Distinct means, and which Gaussians have them.
struct Places {
    points: Vec<[f64; 3]>,
    /// Gaussians with a finite mean, ascending.
    finite: Vec<usize>,
    /// Place of each of them.
    place_of: Vec<usize>,
    /// Of each place the first of its Gaussians in `finite`, and one past the last of all.
    starts: Vec<usize>,
}

impl Places {
    fn new(gaussians: &Gaussians) -> Self {
        let finite: Vec<usize> =
            (0..gaussians.len()).filter(|&index| gaussians.mean(index).is_finite()).collect();
        let (mut points, mut starts, mut place_of) = (Vec::new(), Vec::new(), Vec::new());
        for (rank, &index) in finite.iter().enumerate() {
            let point = gaussians.mean(index).to_array();
            if points.last() != Some(&point) {
                points.push(point);
                starts.push(rank);
            }
            place_of.push(points.len() - 1);
        }
        starts.push(finite.len());
        Self { points, finite, place_of, starts }
    }

    fn members(&self, place: usize) -> &[usize] {
        &self.finite[self.starts[place]..self.starts[place + 1]]
    }
}

/// The neighbours of a Gaussian, given by its rank among the finite ones: those of the same mean first.
fn neighbours_of(
    rank: usize,
    places: &Places,
    tree: &Tree,
    gaussians: &Gaussians,
    settings: &MotionSettings,
) -> Vec<Neighbour> {
    let (own, place) = (places.finite[rank], places.place_of[rank]);
    let beside = places.members(place);
    let position = rank - places.starts[place];
    // Beginning with the next, so that no Gaussian becomes the neighbour of all others.
    let beside = (1..beside.len()).map(|step| (beside[(position + step) % beside.len()], 0.0));
    let missing = settings.neighbours.saturating_sub(beside.len());
    beside
        .chain(around(place, missing, places, tree))
        .take(settings.neighbours)
        .map(|(index, distance)| Neighbour {
            index,
            distance,
            affinity: affinity(gaussians, own, index, settings),
        })
        .collect()
}

/// Gaussians at the `count` places nearest to another, with their distances, nearest first.
fn around(place: usize, count: usize, places: &Places, tree: &Tree) -> impl Iterator<Item = (usize, f64)> {
    // One more, because a place is its own nearest.
    let count = NonZero::new(count).map(|count| count.saturating_add(1));
    let found = count
        .map(|count| tree.query(&places.points[place]).nearest_n::<SquaredEuclidean<f64>>(count).execute());
    let mut others: Vec<(usize, f64)> = found
        .into_iter()
        .flatten()
        .map(|item| (item.item as usize, item.distance.max(0.0).sqrt()))
        .filter(|&(other, _)| other != place)
        .collect();
    others.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    others.into_iter().flat_map(|(other, distance)| places.members(other).iter().map(move |&i| (i, distance)))
}

fn median_reach(nearest: &[Vec<Neighbour>]) -> f64 {
    let mut reach: Vec<f64> = nearest
        .iter()
        .filter_map(|list| list.last())
        .map(|last| last.distance)
        .filter(|&d| d > 0.0)
        .collect();
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
