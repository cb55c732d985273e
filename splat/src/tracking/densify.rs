//! One displacement per pixel from overlapping patches.

use super::{
    flow::Flow,
    patches::{PATCH_PIXELS, PatchField, Window, totals},
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

#[inline(always)]
fn paint_kernel<S: Simd, const C: usize>(
    reference: &Planes<C>,
    target: &Planes<C>,
    field: &PatchField,
    canvas: &mut Canvas,
) {
    let mut weights = vec![[0.0f32; PATCH_PIXELS]; field.displacement.len()];
    let width = canvas.width;
    for (j, &y) in field.ys.iter().enumerate() {
        for (i, &x) in field.xs.iter().enumerate() {
            let at = j * field.columns + i;
            let [u, v] = field.displacement[at];
            pixel_weights::<S, C>(reference, target, [x, y], [u, v], field.cost[at], &mut weights[at]);
            for (row, weights) in weights[at].as_chunks::<PATCH>().0.iter().enumerate() {
                let first = (y + row) * width + x;
                let best_weight = &mut canvas.best_weight[first..first + PATCH];
                let [best_u, best_v] = &mut canvas.best;
                let best_u = &mut best_u[first..first + PATCH];
                let best_v = &mut best_v[first..first + PATCH];
                for k in 0..PATCH {
                    let better = weights[k] > best_weight[k];
                    best_u[k] = if better { u } else { best_u[k] };
                    best_v[k] = if better { v } else { best_v[k] };
                    best_weight[k] = if better { weights[k] } else { best_weight[k] };
                }
            }
        }
    }
    for (j, &y) in field.ys.iter().enumerate() {
        for (i, &x) in field.xs.iter().enumerate() {
            let at = j * field.columns + i;
            let [u, v] = field.displacement[at];
            for (row, weights) in weights[at].as_chunks::<PATCH>().0.iter().enumerate() {
                let first = (y + row) * width + x;
                let best_u = &canvas.best[0][first..first + PATCH];
                let best_v = &canvas.best[1][first..first + PATCH];
                let [sum_u, sum_v] = &mut canvas.sum;
                let sum_u = &mut sum_u[first..first + PATCH];
                let sum_v = &mut sum_v[first..first + PATCH];
                let total = &mut canvas.total[first..first + PATCH];
                for k in 0..PATCH {
                    let apart = (u - best_u[k]).abs().max((v - best_v[k]).abs());
                    let weight = if apart > SAME_MOTION { 0.0 } else { weights[k] };
                    sum_u[k] += weight * u;
                    sum_v[k] += weight * v;
                    total[k] += weight;
                }
            }
        }
    }
    // Every pixel is covered, and weights are positive.
    for axis in &mut canvas.sum {
        for (value, total) in axis.iter_mut().zip(&canvas.total) {
            *value /= total;
        }
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
    let here = Window::<S>::new(reference, x as f32, y as f32);
    let there = Window::<S>::new(target, x as f32 + u, y as f32 + v);
    let channels = C as f32;
    let scale = RESIDUAL_SCALE * RESIDUAL_SCALE;
    let patch = 1.0 / (scale + cost / (channels * PATCH_PIXELS as f32));
    let mut squares = [[0.0f32; LANES]; PATCH_PIXELS / LANES];
    for (a, b) in reference.channels.iter().zip(&target.channels) {
        let mut off = there.fetch(b, target.stride);
        let template = here.fetch(a, reference.stride);
        for pair in 0..off.len() {
            off[pair] = off[pair].sub(template[pair]);
        }
        let none = S::splat(0.0);
        let sum = off[0].add(off[1]).add(off[2].add(off[3]));
        let mean = S::splat(totals([sum, none, none, none])[0] / PATCH_PIXELS as f32);
        for (squares, off) in squares.iter_mut().zip(off) {
            let off = off.sub(mean);
            off.mul_add(off, S::load(squares)).store(squares);
        }
    }
    let squares = squares.as_flattened();
    for k in 0..PATCH_PIXELS {
        weights[k] = patch / (scale + squares[k] / channels);
    }
}
