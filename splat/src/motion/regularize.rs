//! The neighbours' field: one sparse least-squares problem over all moving Gaussians.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{
    MotionOrigin,
    propagate::{Context, State},
};

/// Strain beyond which an edge crosses a motion boundary and lets go.
const BOUNDARY_STRAIN: f64 = 0.25;
/// Tie between a moving and a resting Gaussian, relative to one between two moving ones: most such edges
/// cross a boundary, but the foot of a bending pole does not.
const REST_AFFINITY: f64 = 0.1;
/// Squared residual norm, relative to the first, at which conjugate gradients stop.
const RELATIVE_RESIDUAL: f64 = 1e-16;

/// Replaces the translations of moving Gaussians by the minimum of
/// `Σ (d−d̂)ᵀ H (d−d̂) + Σ λ_ij |d_i − d_j − r_ij|²`, where `r_ij` is what the rotations of both ends say about
/// their difference.
///
/// `λ_ij` is the precision of a neighbour's prediction, `1 / (neighbour_strain · distance)²`, times the
/// colour affinity and a redescending weight that stops the field at motion boundaries. Gaussians at rest
/// stay at rest and anchor their neighbours. Each round is solved by block-Jacobi conjugate gradients with a
/// bounded number of steps; all sums are in index order.
pub(super) fn regularize(states: &mut [State], context: &Context<'_>) {
    let moving: Vec<usize> = (0..states.len())
        .filter(|&i| matches!(states[i].origin, MotionOrigin::Solved | MotionOrigin::Propagated))
        .collect();
    if moving.is_empty() || context.settings.field_steps == 0 {
        return;
    }
    let mut position_of = vec![None; states.len()];
    for (position, &index) in moving.iter().enumerate() {
        position_of[index] = Some(position);
    }
    let edges = edges(states, context, &moving, &position_of);
    for _ in 0..context.settings.field_rounds {
        let system = System::new(states, context, &moving, &edges);
        let start: Vec<DVec3> = moving.iter().map(|&index| states[index].translation).collect();
        let solution = system.solve(start, context.settings.field_steps);
        for (&index, translation) in moving.iter().zip(solution) {
            if translation.is_finite() {
                states[index].translation = translation;
            }
        }
    }
}

/// One direction of a tie.
struct Edge {
    /// Index of the other end.
    to: usize,
    /// Its place among the unknowns, if it moves.
    unknown: Option<usize>,
    precision: f64,
    /// Expected `d_from − d_to`.
    offset: DVec3,
    /// Difference that ends the tie.
    tolerance: f64,
}

fn edges(
    states: &[State],
    context: &Context<'_>,
    moving: &[usize],
    position_of: &[Option<usize>],
) -> Vec<Vec<Edge>> {
    let symmetric = context.neighbourhood.symmetric();
    let spacing = context.neighbourhood.spacing;
    moving
        .par_iter()
        .map(|&from| {
            symmetric[from]
                .iter()
                .filter(|n| states[n.index].origin != MotionOrigin::Unsolved)
                .filter_map(|n| {
                    let distance = n.distance + 0.1 * spacing;
                    let is_at_rest = states[n.index].origin == MotionOrigin::Static;
                    let label = if is_at_rest { REST_AFFINITY } else { 1.0 };
                    let precision =
                        label * n.affinity / (context.settings.neighbour_strain * distance).powi(2);
                    let lever = context.gaussians.mean(from) - context.gaussians.mean(n.index);
                    let turns = [states[from].rotation, states[n.index].rotation];
                    let offset = turns.iter().map(|turn| *turn * lever - lever).sum::<DVec3>() * 0.5;
                    let edge = Edge {
                        to: n.index,
                        unknown: position_of[n.index],
                        precision,
                        offset,
                        tolerance: BOUNDARY_STRAIN * distance,
                    };
                    (precision.is_finite() && precision > 0.0).then_some(edge)
                })
                .collect()
        })
        .collect()
}

/// A symmetric positive definite block system, one 3×3 block row per moving Gaussian.
struct System {
    diagonal: Vec<DMat3>,
    /// Inverse of the diagonal blocks.
    preconditioner: Vec<DMat3>,
    /// Unknown and weight of each coupling.
    couplings: Vec<Vec<(usize, f64)>>,
    right: Vec<DVec3>,
}

impl System {
    fn new(states: &[State], context: &Context<'_>, moving: &[usize], edges: &[Vec<Edge>]) -> Self {
        let rows: Vec<_> =
            moving.par_iter().zip(edges).map(|(&index, edges)| row(states, context, index, edges)).collect();
        let mut system = Self {
            diagonal: Vec::new(),
            preconditioner: Vec::new(),
            couplings: Vec::new(),
            right: Vec::new(),
        };
        for (diagonal, couplings, right) in rows {
            let inverse = diagonal.inverse();
            // A row that nothing determines keeps its start: its residual is zero.
            system.preconditioner.push(if inverse.is_finite() { inverse } else { DMat3::IDENTITY });
            system.diagonal.push(diagonal);
            system.couplings.push(couplings);
            system.right.push(right);
        }
        system
    }

    fn times(&self, x: &[DVec3]) -> Vec<DVec3> {
        (0..x.len())
            .into_par_iter()
            .map(|row| {
                let own = self.diagonal[row] * x[row];
                self.couplings[row].iter().fold(own, |sum, &(other, weight)| sum - x[other] * weight)
            })
            .collect()
    }

    fn precondition(&self, residual: &[DVec3]) -> Vec<DVec3> {
        residual.iter().zip(&self.preconditioner).map(|(r, inverse)| *inverse * *r).collect()
    }

    fn solve(&self, start: Vec<DVec3>, steps: usize) -> Vec<DVec3> {
        let mut x = start;
        let mut residual: Vec<DVec3> = self.right.iter().zip(self.times(&x)).map(|(b, ax)| *b - ax).collect();
        let mut direction = self.precondition(&residual);
        let mut power = dot(&residual, &direction);
        let enough = RELATIVE_RESIDUAL * power;
        for _ in 0..steps {
            if power.is_nan() || power <= enough {
                break;
            }
            let image = self.times(&direction);
            let curvature = dot(&direction, &image);
            if curvature.is_nan() || curvature <= 0.0 {
                break;
            }
            let length = power / curvature;
            for row in 0..x.len() {
                x[row] += direction[row] * length;
                residual[row] -= image[row] * length;
            }
            let preconditioned = self.precondition(&residual);
            let next = dot(&residual, &preconditioned);
            let keep = next / power;
            for (direction, fresh) in direction.iter_mut().zip(preconditioned) {
                *direction = fresh + *direction * keep;
            }
            power = next;
        }
        x
    }
}

fn row(
    states: &[State],
    context: &Context<'_>,
    index: usize,
    edges: &[Edge],
) -> (DMat3, Vec<(usize, f64)>, DVec3) {
    let state = &states[index];
    let (mut diagonal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    if let Some(own) = &state.own {
        let departure = state.translation - own.translation;
        let limit = context.settings.outlier_significance.powi(2).max(f64::MIN_POSITIVE);
        let misfit = departure.dot(own.information * departure).max(0.0) / limit;
        let information = own.information * (1.0 + misfit).powi(-2);
        diagonal += information;
        right += information * own.translation;
    }
    let mut couplings = Vec::with_capacity(edges.len());
    for edge in edges {
        let other = states[edge.to].translation;
        let strain = state.translation - other - edge.offset;
        let misfit = strain.length_squared() / edge.tolerance.powi(2).max(f64::MIN_POSITIVE);
        let weight = edge.precision * (1.0 + misfit).powi(-2);
        diagonal += DMat3::from_diagonal(DVec3::splat(weight));
        right += edge.offset * weight;
        if let Some(unknown) = edge.unknown {
            couplings.push((unknown, weight));
        }
    }
    (diagonal, couplings, right)
}

fn dot(a: &[DVec3], b: &[DVec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum()
}
