//! The neighbours' field: one sparse least-squares problem over all moving Gaussians.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{
    MotionOrigin,
    neighbours::{Incoming, Neighbour},
    propagate::{Context, State},
};

/// Strain beyond which an edge crosses a motion boundary and lets go.
const BOUNDARY_STRAIN: f64 = 0.25;
/// Tie between a moving and a resting Gaussian, relative to one between two moving ones: most such edges
/// cross a boundary, but the foot of a bending pole does not.
const REST_AFFINITY: f64 = 0.1;
/// Squared residual norm, relative to the first, at which conjugate gradients stop: what is left of the
/// correction by the neighbours is far below its own error.
const RELATIVE_RESIDUAL: f64 = 1e-10;
/// Rows that are summed at a time, whatever the number of threads.
const CHUNK: usize = 4096;

/// Replaces the translations of moving Gaussians by the minimum of
/// `Σ (d−d̂)ᵀ H (d−d̂) + Σ λ_ij |d_i − d_j − r_ij|²`, where `r_ij` is what the rotations of both ends say about
/// their difference.
///
/// `λ_ij` is the precision of a neighbour's prediction, `1 / (neighbour_strain · distance)²`, times the
/// colour affinity and a redescending weight that stops the field at motion boundaries. Gaussians at rest
/// stay at rest and anchor their neighbours. Each round is solved by block-Jacobi conjugate gradients with a
/// bounded number of steps; all sums are in the order of the Gaussians.
pub(super) fn regularize(states: &mut [State], context: &Context<'_>) {
    let moving: Vec<usize> = (0..states.len())
        .filter(|&i| matches!(states[i].origin, MotionOrigin::Solved | MotionOrigin::Propagated))
        .collect();
    if moving.is_empty() || context.settings.field_steps == 0 || context.settings.field_rounds == 0 {
        return;
    }
    let graph = Graph::new(states, context, &moving);
    for _ in 0..context.settings.field_rounds {
        let system = System::new(states, context, &moving, &graph);
        let start: Vec<DVec3> = moving.iter().map(|&index| states[index].translation).collect();
        let solution = system.solve(start, context.settings.field_steps);
        for (&index, translation) in moving.iter().zip(solution) {
            if translation.is_finite() {
                states[index].translation = translation;
            }
        }
    }
}

/// Which unknown is tied to which. Unknowns are the moving Gaussians, in their order.
struct Graph {
    incoming: Incoming,
    /// Where the unknowns that each unknown is tied to begin in `columns`, and one past the last of all.
    starts: Vec<usize>,
    columns: Vec<u32>,
}

/// What `Graph::columns` has for a Gaussian that does not move.
const FIXED: u32 = u32::MAX;

impl Graph {
    fn new(states: &[State], context: &Context<'_>, moving: &[usize]) -> Self {
        let incoming = context.neighbourhood.incoming();
        let mut unknown_of = vec![FIXED; states.len()];
        for (unknown, &index) in moving.iter().enumerate() {
            unknown_of[index] = unknown as u32;
        }
        let mut starts = vec![0; moving.len() + 1];
        for (unknown, &index) in moving.iter().enumerate() {
            starts[unknown + 1] = starts[unknown] + ties(index, states, context, &incoming).count();
        }
        let columns = moving
            .par_iter()
            .flat_map_iter(|&index| ties(index, states, context, &incoming).map(|tie| unknown_of[tie.index]))
            .collect();
        Self { incoming, starts, columns }
    }
}

/// The ties of a Gaussian in both directions, to those whose motion is known.
fn ties<'a>(
    index: usize,
    states: &'a [State],
    context: &Context<'a>,
    incoming: &'a Incoming,
) -> impl Iterator<Item = &'a Neighbour> {
    let ties = context.neighbourhood.nearest[index].iter().chain(incoming.to(index));
    ties.filter(|tie| states[tie.index].origin != MotionOrigin::Unsolved)
}

/// A symmetric positive definite block system, one 3×3 block row per moving Gaussian.
struct System<'a> {
    graph: &'a Graph,
    rows: Vec<Row>,
    /// Inverse of the diagonal blocks.
    preconditioner: Vec<DMat3>,
    /// Of every entry of the graph's columns.
    weights: Vec<f64>,
}

struct Row {
    diagonal: DMat3,
    right: DVec3,
}

impl<'a> System<'a> {
    fn new(states: &[State], context: &Context<'_>, moving: &[usize], graph: &'a Graph) -> Self {
        let chunk = |indices: &[usize]| {
            let mut weights = Vec::new();
            let rows = indices.iter().map(|&index| row(states, context, index, graph, &mut weights));
            (rows.collect::<Vec<Row>>(), weights)
        };
        let chunks: Vec<_> = moving.par_chunks(CHUNK).map(chunk).collect();
        let (mut rows, mut weights) = (Vec::with_capacity(moving.len()), Vec::new());
        for (chunk_rows, chunk_weights) in chunks {
            rows.extend(chunk_rows);
            weights.extend(chunk_weights);
        }
        let invert = |row: &Row| {
            let inverse = row.diagonal.inverse();
            // A row that nothing determines keeps its start: its residual is zero.
            if inverse.is_finite() { inverse } else { DMat3::IDENTITY }
        };
        let preconditioner = rows.par_iter().map(invert).collect();
        Self { graph, rows, preconditioner, weights }
    }

    fn times(&self, x: &[DVec3]) -> Vec<DVec3> {
        let starts = &self.graph.starts;
        (0..x.len())
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|row| {
                let entries = starts[row]..starts[row + 1];
                let mut sum = self.rows[row].diagonal * x[row];
                for (&column, &weight) in
                    self.graph.columns[entries.clone()].iter().zip(&self.weights[entries])
                {
                    if column != FIXED {
                        sum -= x[column as usize] * weight;
                    }
                }
                sum
            })
            .collect()
    }

    fn precondition(&self, residual: &[DVec3]) -> Vec<DVec3> {
        residual.par_iter().zip(&self.preconditioner).map(|(r, inverse)| *inverse * *r).collect()
    }

    fn solve(&self, start: Vec<DVec3>, steps: usize) -> Vec<DVec3> {
        let mut x = start;
        let mut residual: Vec<DVec3> =
            self.rows.iter().zip(self.times(&x)).map(|(row, ax)| row.right - ax).collect();
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
            add(&mut x, &direction, power / curvature);
            add(&mut residual, &image, -power / curvature);
            let preconditioned = self.precondition(&residual);
            let next = dot(&residual, &preconditioned);
            let keep = next / power;
            direction.par_iter_mut().zip(preconditioned).for_each(|(direction, fresh)| {
                *direction = fresh + *direction * keep;
            });
            power = next;
        }
        x
    }
}

/// The row of a moving Gaussian; appends the weights of its ties.
fn row(states: &[State], context: &Context<'_>, index: usize, graph: &Graph, weights: &mut Vec<f64>) -> Row {
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
    for tie in ties(index, states, context, &graph.incoming) {
        let offset = offset(states, context, index, tie);
        let weight = weight(states, context, index, tie, offset);
        diagonal += DMat3::from_diagonal(DVec3::splat(weight));
        right += offset * weight;
        weights.push(weight);
    }
    Row { diagonal, right }
}

/// Expected difference of the translations of both ends of a tie, from their rotations.
fn offset(states: &[State], context: &Context<'_>, from: usize, tie: &Neighbour) -> DVec3 {
    let lever = context.gaussians.mean(from) - context.gaussians.mean(tie.index);
    let turns = [states[from].rotation, states[tie.index].rotation];
    turns.iter().map(|turn| *turn * lever - lever).sum::<DVec3>() * 0.5
}

/// The weight of a tie under the present translations.
fn weight(states: &[State], context: &Context<'_>, from: usize, tie: &Neighbour, offset: DVec3) -> f64 {
    let other = &states[tie.index];
    let distance = tie.distance + 0.1 * context.neighbourhood.spacing;
    let label = if other.origin == MotionOrigin::Static { REST_AFFINITY } else { 1.0 };
    let precision = label * tie.affinity / (context.settings.neighbour_strain * distance).powi(2);
    let strain = states[from].translation - other.translation - offset;
    let tolerance = (BOUNDARY_STRAIN * distance).powi(2).max(f64::MIN_POSITIVE);
    let weight = precision * (1.0 + strain.length_squared() / tolerance).powi(-2);
    if weight.is_finite() { weight } else { 0.0 }
}

fn add(x: &mut [DVec3], direction: &[DVec3], length: f64) {
    x.par_iter_mut().zip(direction).for_each(|(x, direction)| *x += *direction * length);
}

fn dot(a: &[DVec3], b: &[DVec3]) -> f64 {
    let chunk = |(a, b): (&[DVec3], &[DVec3])| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum();
    let sums: Vec<f64> = a.par_chunks(CHUNK).zip(b.par_chunks(CHUNK)).map(chunk).collect();
    sums.iter().sum()
}
