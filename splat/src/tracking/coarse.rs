//! Exhaustive search on a small image: finds displacements that no pyramid can follow.
//!
//! One cost volume serves both directions: the best match of `x` in the second image and the best match of `y` in
//! the first are the minima over the same costs.

use super::{
    flow::Flow,
    planes::{BORDER, Planes},
    windows::box_mean,
};
use crate::simd::{Instructions, Simd, simd_kernel};

/// The best match of every pixel of one image in the other, in pixels of the searched level; not a number where it
/// does not lead back.
pub(super) struct CoarseMatches {
    pub(super) forward: Flow,
    pub(super) backward: Flow,
}

/// Half side of the compared windows.
const RADIUS: usize = 2;
/// Half side of the windows whose mean is removed first. Wide, so that a patch keeps its colour.
const HIGH_PASS_RADIUS: usize = 6;

/// Largest distance along either axis between a pixel and where it comes back to, pixels.
const ROUND_TRIP: f32 = 1.0;

struct Best {
    cost: Vec<f32>,
    label: Vec<u32>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        Self { cost: vec![f32::INFINITY; pixels], label: vec![0; pixels] }
    }

    #[inline(always)]
    fn offer(&mut self, first: usize, costs: &[f32], label: u32) {
        let best = &mut self.cost[first..first + costs.len()];
        let labels = &mut self.label[first..first + costs.len()];
        for i in 0..costs.len() {
            labels[i] = if costs[i] < best[i] { label } else { labels[i] };
            best[i] = if costs[i] < best[i] { costs[i] } else { best[i] };
        }
    }

    fn into_flow(self, width: usize, displacements: &[[i32; 2]], sign: f32) -> Flow {
        let height = self.label.len() / width;
        let axis = |axis: usize| -> Vec<f32> {
            self.label.iter().map(|&label| sign * displacements[label as usize][axis] as f32).collect()
        };
        Flow { width, height, u: axis(0), v: axis(1) }
    }
}

/// Compares every pixel's window with all windows at most `radius` pixels away along either axis.
///
/// Of equal costs the smallest displacement wins, so identical images match at zero.
pub(super) fn search<const C: usize>(
    instructions: Instructions,
    first: &Planes<C>,
    second: &Planes<C>,
    radius: usize,
) -> CoarseMatches {
    let (width, height) = (first.width, first.height);
    let images = [first, second].map(|image| smoothed(&image.high_passed(HIGH_PASS_RADIUS)));
    let displacements = displacements_by_length(radius.min(width - 1), radius.min(height - 1));
    let mut matches = [Best::new(width * height), Best::new(width * height)];
    compare_all(instructions, &images, &displacements, &mut matches);
    let [forward, backward] = matches;
    let mut forward = forward.into_flow(width, &displacements, 1.0);
    let mut backward = backward.into_flow(width, &displacements, -1.0);
    let unverified = forward.clone();
    verify(&mut forward, &backward);
    verify(&mut backward, &unverified);
    CoarseMatches { forward, backward }
}

/// Marks matches that do not lead back as not found.
fn verify(flow: &mut Flow, back: &Flow) {
    for y in 0..flow.height {
        for x in 0..flow.width {
            let i = y * flow.width + x;
            let (u, v) = (flow.u[i], flow.v[i]);
            let [bu, bv] = back.at((x as f32 + u) as usize, (y as f32 + v) as usize);
            if !((u + bu).abs() <= ROUND_TRIP && (v + bv).abs() <= ROUND_TRIP) {
                flow.u[i] = f32::NAN;
            }
        }
    }
}

simd_kernel! {
    fn compare_all<const C: usize>(
        images: &[Planes<C>; 2], displacements: &[[i32; 2]], matches: &mut [Best; 2],
    ) = compare_kernel
}

#[inline(always)]
fn compare_kernel<S: Simd, const C: usize>(
    images: &[Planes<C>; 2],
    displacements: &[[i32; 2]],
    matches: &mut [Best; 2],
) {
    let (width, height) = (images[0].width, images[0].height);
    let mut scratch = Scratch::default();
    let mut energies = [vec![0.0f32; width * height], vec![0.0f32; width * height]];
    for (image, energy) in images.iter().zip(&mut energies) {
        let overlap = Overlap::new(image, [0, 0]);
        scratch.sum_rows(image, image, &overlap);
        for y in 0..height {
            scratch.sum_columns(y, width);
            energy[y * width..(y + 1) * width].copy_from_slice(&scratch.row[..width]);
        }
    }
    let [forward, backward] = matches;
    for (label, &[dx, dy]) in displacements.iter().enumerate() {
        let overlap = Overlap::new(&images[0], [dx, dy]);
        let columns = overlap.columns;
        scratch.sum_rows(&images[0], &images[1], &overlap);
        for line in 0..overlap.rows {
            scratch.sum_columns(line, columns);
            let at_first = (overlap.first_row + line) * width + overlap.first_column;
            let at_second = (at_first as i64 + i64::from(dy) * width as i64 + i64::from(dx)) as usize;
            let first_energy = &energies[0][at_first..at_first + columns];
            let second_energy = &energies[1][at_second..at_second + columns];
            let costs = &mut scratch.row[..columns];
            for i in 0..columns {
                costs[i] = (first_energy[i] + second_energy[i]) - 2.0 * costs[i];
            }
            forward.offer(at_first, costs, label as u32);
            backward.offer(at_second, costs, label as u32);
        }
    }
}

/// Binomial smoothing: a displacement of half a coarse pixel must not hide a match.
fn smoothed<const C: usize>(planes: &Planes<C>) -> Planes<C> {
    let interiors = planes.interiors().map(|channel| {
        // Two box filters of different size approximate the binomial well enough.
        let (width, height) = (planes.width, planes.height);
        let box3 = box_mean(&channel, width, height, 1);
        channel.iter().zip(&box3).map(|(value, mean)| 0.5 * (value + mean)).collect()
    });
    Planes::from_interiors(planes.width, planes.height, interiors)
}

fn displacements_by_length(radius_x: usize, radius_y: usize) -> Vec<[i32; 2]> {
    let (rx, ry) = (radius_x as i32, radius_y as i32);
    let mut all: Vec<[i32; 2]> = (-ry..=ry).flat_map(|dy| (-rx..=rx).map(move |dx| [dx, dy])).collect();
    all.sort_by_key(|&[dx, dy]| (dx * dx + dy * dy, dy, dx));
    all
}

/// The pixels of the first image whose counterpart at some displacement lies in the second.
struct Overlap {
    displacement: [i32; 2],
    first_column: usize,
    first_row: usize,
    columns: usize,
    rows: usize,
}

impl Overlap {
    fn new<const C: usize>(image: &Planes<C>, displacement: [i32; 2]) -> Self {
        let [dx, dy] = displacement;
        Self {
            displacement,
            first_column: (-dx).max(0) as usize,
            first_row: (-dy).max(0) as usize,
            columns: image.width - dx.unsigned_abs() as usize,
            rows: image.height - dy.unsigned_abs() as usize,
        }
    }
}

/// Window sums of the products of two images, one shifted, computed without allocating per displacement.
#[derive(Default)]
struct Scratch {
    products: Vec<f32>,
    sums: Vec<f32>,
    row: Vec<f32>,
}

impl Scratch {
    /// Sums along the rows of `first` that `second`, shifted, overlaps, and of `RADIUS` rows before and after.
    #[inline(always)]
    fn sum_rows<const C: usize>(&mut self, first: &Planes<C>, second: &Planes<C>, overlap: &Overlap) {
        let columns = overlap.columns;
        let padded = columns + 2 * RADIUS;
        let [dx, dy] = overlap.displacement.map(i64::from);
        self.products.resize(padded, 0.0);
        self.sums.resize((overlap.rows + 2 * RADIUS) * columns, 0.0);
        self.row.resize(columns, 0.0);
        for (line, sums) in self.sums.chunks_exact_mut(columns).enumerate() {
            let row = overlap.first_row + line + BORDER - RADIUS;
            let at = row * first.stride + overlap.first_column + BORDER - RADIUS;
            let shifted = (at as i64 + dy * second.stride as i64 + dx) as usize;
            let products = &mut self.products[..padded];
            products.fill(0.0);
            for (a, b) in first.channels.iter().zip(&second.channels) {
                let (a, b) = (&a[at..at + padded], &b[shifted..shifted + padded]);
                for i in 0..padded {
                    products[i] += a[i] * b[i];
                }
            }
            let (a, b, c) = (&products[..columns], &products[1..][..columns], &products[2..][..columns]);
            let (d, e) = (&products[3..][..columns], &products[4..][..columns]);
            for i in 0..columns {
                sums[i] = a[i] + b[i] + c[i] + d[i] + e[i];
            }
        }
    }

    /// Sums of the rows of sums around the given one, in `row`.
    #[inline(always)]
    fn sum_columns(&mut self, line: usize, columns: usize) {
        let sums = &self.sums[line * columns..(line + 2 * RADIUS + 1) * columns];
        let (a, b, c) = (&sums[..columns], &sums[columns..][..columns], &sums[2 * columns..][..columns]);
        let (d, e) = (&sums[3 * columns..][..columns], &sums[4 * columns..][..columns]);
        let row = &mut self.row[..columns];
        for i in 0..columns {
            row[i] = a[i] + b[i] + c[i] + d[i] + e[i];
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;

    #[test]
    fn shifts_up_to_the_radius_are_found_both_ways() {
        let (width, height) = (40, 30);
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let wide: Vec<[f32; 3]> =
            (0..100 * 100).map(|_| random.random::<[f32; 3]>().map(|v| 255.0 * v)).collect();
        let crop = |x0: usize, y0: usize| {
            let channel = |c: usize| {
                let at = |i: usize| wide[(y0 + i / width) * 100 + x0 + i % width][c];
                (0..width * height).map(at).collect()
            };
            Planes::from_interiors(width, height, [channel(0), channel(1), channel(2)])
        };
        let matches = search(Instructions::detect(), &crop(30, 30), &crop(19, 36), 12);
        let (mut right, mut all) = (0, 0);
        for y in 10..height - 10 {
            for x in 3..width - 15 {
                all += 2;
                right += usize::from(matches.forward.at(x, y) == [11.0, -6.0]);
                right += usize::from(matches.backward.at(x + 11, y - 6) == [-11.0, 6.0]);
            }
        }
        assert_eq!(right, all);
        let limited = search(Instructions::detect(), &crop(30, 30), &crop(19, 36), 5);
        assert!(
            limited
                .forward
                .u
                .iter()
                .chain(&limited.backward.v)
                .all(|value| value.is_nan() || value.abs() <= 5.0)
        );
        assert_eq!(
            search(Instructions::detect(), &crop(0, 0), &crop(0, 0), 12).forward,
            Flow::zeros(width, height)
        );
    }
}
