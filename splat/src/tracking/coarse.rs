//! Exhaustive search on a small image: finds displacements that no pyramid can follow.
//!
//! One cost volume serves both directions: the best match of `x` in the second image and the best match of `y` in
//! the first are the minima over the same costs.

use super::{
    flow::Flow,
    planes::{BORDER, Planes},
    windows::{box_mean, lanes, lanes_mut},
};
use crate::simd::{Instructions, LANES, Simd, simd_kernel};

/// The best match of every pixel of one image in the other, in pixels of the searched level; not a number where it
/// does not lead back.
pub(super) struct CoarseMatches {
    pub(super) forward: Flow,
    pub(super) backward: Flow,
}

/// Half side of the compared windows.
const RADIUS: usize = 2;
/// Their side.
const SIDE: usize = 2 * RADIUS + 1;
/// Half side of the windows whose mean is removed first. Wide, so that a patch keeps its colour.
const HIGH_PASS_RADIUS: usize = 6;

/// Largest distance along either axis between a pixel and where it comes back to, pixels.
const ROUND_TRIP: f32 = 1.0;

/// The best match of every pixel so far. Longer than the image by a group of lanes, as rows are not whole groups.
struct Best {
    cost: Vec<f32>,
    /// Number of the displacement; a float, so that it is chosen like the cost. At most 513² of them are exact.
    label: Vec<f32>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        Self { cost: vec![f32::INFINITY; pixels + LANES], label: vec![0.0; pixels + LANES] }
    }

    #[inline(always)]
    fn offer<S: Simd>(&mut self, first: usize, cost: S, label: S) {
        let (best, labels) = (lanes_mut(&mut self.cost, first), lanes_mut(&mut self.label, first));
        let known = S::load(best);
        let better = cost.lt(known);
        S::select(better, cost, known).store(best);
        S::select(better, label, S::load(labels)).store(labels);
    }

    fn into_flow(self, width: usize, displacements: &[[i32; 2]], sign: f32) -> Flow {
        let labels = &self.label[..self.label.len() - LANES];
        let axis = |axis: usize| -> Vec<f32> {
            labels.iter().map(|&label| sign * displacements[label as usize][axis] as f32).collect()
        };
        Flow { width, height: labels.len() / width, u: axis(0), v: axis(1) }
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
    let width = images[0].width;
    let mut scratch = Scratch::default();
    let energies = images.each_ref().map(|image| energy::<S, C>(image, &mut scratch));
    let steps: [f32; LANES] = std::array::from_fn(|lane| lane as f32);
    let (steps, nothing) = (S::load(&steps), S::splat(f32::INFINITY));
    let [forward, backward] = matches;
    for (label, &[dx, dy]) in displacements.iter().enumerate() {
        let overlap = Overlap::new(&images[0], [dx, dy]);
        let label = S::splat(label as f32);
        scratch.sum_rows::<S, C>(&images[0], &images[1], &overlap);
        for line in 0..overlap.rows {
            let at_first = (overlap.first_row + line) * width + overlap.first_column;
            let at_second = (at_first as i64 + i64::from(dy) * width as i64 + i64::from(dx)) as usize;
            for column in (0..overlap.columns).step_by(LANES) {
                let (first, second) = (at_first + column, at_second + column);
                let both = S::load(lanes(&energies[0], first)).add(S::load(lanes(&energies[1], second)));
                let product = scratch.window::<S>(line, column);
                // Rounding must not make a difference better than none.
                let cost = both.sub(product.add(product)).max(S::splat(0.0));
                let is_inside = steps.lt(S::splat((overlap.columns - column) as f32));
                let cost = S::select(is_inside, cost, nothing);
                forward.offer(first, cost, label);
                backward.offer(second, cost, label);
            }
        }
    }
}

/// The window sums of the squares of an image, and a group of lanes more.
#[inline(always)]
fn energy<S: Simd, const C: usize>(image: &Planes<C>, scratch: &mut Scratch) -> Vec<f32> {
    let mut energy = vec![0.0f32; image.width * image.height + LANES];
    scratch.sum_rows::<S, C>(image, image, &Overlap::new(image, [0, 0]));
    for y in 0..image.height {
        for x in (0..image.width).step_by(LANES) {
            // What is written beyond the row's end the next row overwrites.
            scratch.window::<S>(y, x).store(lanes_mut(&mut energy, y * image.width + x));
        }
    }
    energy
}

/// Smoothed a little: a displacement of half a coarse pixel must not hide a match.
fn smoothed<const C: usize>(planes: &Planes<C>) -> Planes<C> {
    let interiors = planes.interiors().map(|channel| {
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

/// Window sums of the products of two images, one shifted, computed without allocating per displacement. Rows are
/// filled up to whole groups of lanes with anything.
#[derive(Default)]
struct Scratch {
    products: Vec<f32>,
    /// Sums along rows, from `RADIUS` rows before the overlap to as many after it.
    sums: Vec<f32>,
    columns: usize,
}

impl Scratch {
    /// Sums along the rows of `first` that `second`, shifted, overlaps.
    ///
    /// Reads up to two groups of lanes beyond the end of a row: the border below has them.
    #[inline(always)]
    fn sum_rows<S: Simd, const C: usize>(
        &mut self,
        first: &Planes<C>,
        second: &Planes<C>,
        overlap: &Overlap,
    ) {
        self.columns = overlap.columns.next_multiple_of(LANES);
        let padded = self.columns + LANES;
        let [dx, dy] = overlap.displacement.map(i64::from);
        self.products.resize(padded, 0.0);
        self.sums.resize((overlap.rows + 2 * RADIUS) * self.columns, 0.0);
        for (line, sums) in self.sums.chunks_exact_mut(self.columns).enumerate() {
            let row = overlap.first_row + line + BORDER - RADIUS;
            let at = row * first.stride + overlap.first_column + BORDER - RADIUS;
            let shifted = (at as i64 + dy * second.stride as i64 + dx) as usize;
            for column in (0..padded).step_by(LANES) {
                let mut product = S::splat(0.0);
                for (a, b) in first.channels.iter().zip(&second.channels) {
                    let (a, b) = (S::load(lanes(a, at + column)), S::load(lanes(b, shifted + column)));
                    product = a.mul_add(b, product);
                }
                product.store(lanes_mut(&mut self.products, column));
            }
            for (block, to) in sums.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
                let product = |shift: usize| S::load(lanes(&self.products, block * LANES + shift));
                (1..SIDE).fold(product(0), |sum, shift| sum.add(product(shift))).store(to);
            }
        }
    }

    /// Sums over the windows around [`LANES`] pixels of a line of the overlap.
    #[inline(always)]
    fn window<S: Simd>(&self, line: usize, column: usize) -> S {
        let row = |shift: usize| S::load(lanes(&self.sums, (line + shift) * self.columns + column));
        (1..SIDE).fold(row(0), |sum, shift| sum.add(row(shift)))
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
