//! One displacement per pixel from overlapping patches.

use std::collections::VecDeque;

use super::{
    flow::Flow,
    patches::{PATCH_PIXELS, PatchField, Window, line, totals},
    planes::{PATCH, Planes},
};
use crate::simd::{Instructions, LANES, Simd, simd_kernel};

/// Residual at which a pixel stops to believe a patch, on the 0 to 255 scale.
const RESIDUAL_SCALE: f32 = 6.0;
/// Displacements closer than this belong to the same motion and are averaged, pixels.
const SAME_MOTION: f32 = 1.0;

/// The patch that explains a pixel best picks its motion, patches that agree with it are averaged. Averaging over
/// different motions would put pixels of an edge between them.
pub(super) fn densify<const C: usize>(
    instructions: Instructions,
    reference: &Planes<C>,
    target: &Planes<C>,
    field: &PatchField,
) -> Flow {
    let mut canvas = Canvas::new(reference.width, reference.height);
    paint(instructions, reference, target, field, &mut canvas);
    canvas.into_flow(reference.width, reference.height)
}

/// Sums per pixel. At least as large as a patch, so that patches lie inside.
struct Canvas {
    width: usize,
    best_weight: Vec<f32>,
    best: [Vec<f32>; 2],
    sum: [Vec<f32>; 2],
    total: Vec<f32>,
}

impl Canvas {
    fn new(width: usize, height: usize) -> Self {
        let (width, height) = (width.max(PATCH), height.max(PATCH));
        let zeros = || vec![0.0f32; width * height];
        Self {
            width,
            best_weight: vec![-1.0; width * height],
            best: [zeros(), zeros()],
            sum: [zeros(), zeros()],
            total: zeros(),
        }
    }

    fn into_flow(self, width: usize, height: usize) -> Flow {
        let [u, v] = self.sum;
        if self.width == width && u.len() == width * height {
            return Flow { width, height, u, v };
        }
        let cut = |axis: Vec<f32>| {
            axis.chunks(self.width).take(height).flat_map(|row| row[..width].to_vec()).collect()
        };
        Flow { width, height, u: cut(u), v: cut(v) }
    }
}

simd_kernel! {
    fn paint<const C: usize>(reference: &Planes<C>, target: &Planes<C>, field: &PatchField, canvas: &mut Canvas) = paint_kernel
}

/// Rows of a patch that a group of lanes holds.
const PAIRS: usize = PATCH / 2;

/// The weights of the pixels of a row of patches.
type RowWeights = Vec<[f32; PATCH_PIXELS]>;

#[inline(always)]
fn paint_kernel<S: Simd, const C: usize>(
    reference: &Planes<C>,
    target: &Planes<C>,
    field: &PatchField,
    canvas: &mut Canvas,
) {
    // Weights are kept only until every patch has been seen that shares a pixel with theirs.
    let mut waiting: VecDeque<(usize, RowWeights)> = VecDeque::new();
    let mut spare: Vec<RowWeights> = Vec::new();
    for row in 0..field.ys.len() {
        let mut weights = spare.pop().unwrap_or_else(|| vec![[0.0; PATCH_PIXELS]; field.columns]);
        choose_best::<S, C>(reference, target, field, row, &mut weights, canvas);
        waiting.push_back((row, weights));
        let next = field.ys.get(row + 1).copied();
        while let Some(&(first, _)) = waiting.front() {
            if next.is_some_and(|next| next < field.ys[first] + PATCH) {
                break;
            }
            let Some((first, weights)) = waiting.pop_front() else { break };
            add_agreeing::<S>(field, first, &weights, canvas);
            spare.push(weights);
        }
    }
    // Every pixel is covered, and weights are positive.
    for axis in &mut canvas.sum {
        for (value, total) in axis.iter_mut().zip(&canvas.total) {
            *value /= total;
        }
    }
}

/// Weighs the pixels of a row of patches, and notes the motion of those that explain a pixel best so far.
#[inline(always)]
fn choose_best<S: Simd, const C: usize>(
    reference: &Planes<C>,
    target: &Planes<C>,
    field: &PatchField,
    row: usize,
    weights: &mut RowWeights,
    canvas: &mut Canvas,
) {
    let (width, y) = (canvas.width, field.ys[row]);
    for (i, &x) in field.xs.iter().enumerate() {
        let at = row * field.columns + i;
        let displacement = field.displacement[at];
        pixel_weights::<S, C>(reference, target, [x, y], displacement, field.cost[at], &mut weights[i]);
        let [u, v] = [S::splat(displacement[0]), S::splat(displacement[1])];
        let [best_u, best_v] = &mut canvas.best;
        for pair in 0..PAIRS {
            let first = (y + 2 * pair) * width + x;
            let weight = group::<S>(&weights[i], LANES * pair, PATCH);
            let best: S = group(&canvas.best_weight, first, width);
            let better = best.lt(weight);
            put(S::select(better, weight, best), &mut canvas.best_weight, first, width);
            put(S::select(better, u, group(best_u, first, width)), best_u, first, width);
            put(S::select(better, v, group(best_v, first, width)), best_v, first, width);
        }
    }
}

/// Adds a row of patches to the pixels whose best motion is theirs.
#[inline(always)]
fn add_agreeing<S: Simd>(field: &PatchField, row: usize, weights: &RowWeights, canvas: &mut Canvas) {
    let (width, y) = (canvas.width, field.ys[row]);
    let (zero, near, far) = (S::splat(0.0), S::splat(SAME_MOTION), S::splat(-SAME_MOTION));
    for (i, &x) in field.xs.iter().enumerate() {
        let [u, v] = field.displacement[row * field.columns + i];
        let [u, v] = [S::splat(u), S::splat(v)];
        let [sum_u, sum_v] = &mut canvas.sum;
        for pair in 0..PAIRS {
            let first = (y + 2 * pair) * width + x;
            let weight = group::<S>(&weights[i], LANES * pair, PATCH);
            let off_u = u.sub(group(&canvas.best[0], first, width));
            let off_v = v.sub(group(&canvas.best[1], first, width));
            let agrees_u = S::both(near.ge(off_u), off_u.ge(far));
            let agrees_v = S::both(near.ge(off_v), off_v.ge(far));
            let weight = S::select(S::both(agrees_u, agrees_v), weight, zero);
            put(weight.mul_add(u, group(sum_u, first, width)), sum_u, first, width);
            put(weight.mul_add(v, group(sum_v, first, width)), sum_v, first, width);
            put(weight.add(group(&canvas.total, first, width)), &mut canvas.total, first, width);
        }
    }
}

/// Eight values from `first` on, and eight a row below.
#[inline(always)]
fn group<S: Simd>(values: &[f32], first: usize, width: usize) -> S {
    S::load_halves([line(values, first), line(values, first + width)])
}

/// Writes what [`group`] reads.
#[inline(always)]
fn put<S: Simd>(group: S, values: &mut [f32], first: usize, width: usize) {
    let (upper, lower) = values[first..].split_at_mut(width);
    if let (Some(upper), Some(lower)) = (upper.first_chunk_mut(), lower.first_chunk_mut()) {
        group.store_halves([upper, lower]);
    }
}

#[inline(always)]
fn pixel_weights<S: Simd, const C: usize>(
    reference: &Planes<C>,
    target: &Planes<C>,
    [x, y]: [usize; 2],
    [u, v]: [f32; 2],
    cost: f32,
    weights: &mut [f32; PATCH_PIXELS],
) {
    let there = Window::<S>::new(target, x as f32 + u, y as f32 + v);
    let here = reference.index(x, y);
    let scale = RESIDUAL_SCALE * RESIDUAL_SCALE;
    let patch = 1.0 / (scale + cost / (C * PATCH_PIXELS) as f32);
    let mut squares = [S::splat(scale); PAIRS];
    let none = S::splat(0.0);
    for (a, b) in reference.channels.iter().zip(&target.channels) {
        let mut off = there.fetch(b, target.stride);
        for pair in 0..PAIRS {
            let first = here + 2 * pair * reference.stride;
            off[pair] = off[pair].sub(group(a, first, reference.stride));
        }
        let sum = off[0].add(off[1]).add(off[2].add(off[3]));
        let mean = S::splat(totals([sum, none, none, none])[0] / PATCH_PIXELS as f32);
        for pair in 0..PAIRS {
            let off = off[pair].sub(mean);
            squares[pair] = off.mul(S::splat(1.0 / C as f32)).mul_add(off, squares[pair]);
        }
    }
    for (pair, weights) in weights.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        let mut lanes = [0.0; LANES];
        squares[pair].store(&mut lanes);
        for (weight, square) in weights.iter_mut().zip(lanes) {
            *weight = patch / square;
        }
    }
}
