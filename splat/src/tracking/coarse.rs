//! Exhaustive search on a small image: finds displacements that no pyramid can follow.
//!
//! One cost volume serves both directions: the best match of `x` in the second image and the best match of `y` in
//! the first are the minima over the same costs. Costs are whole numbers, so all instruction sets find the same.
//! Cameras stand still: only the rectangle in which the images differ is searched, the rest is matched where it is.

use super::{flow::Flow, planes::Planes, windows::box_mean};
use crate::simd::{Instructions, SHORTS, Shorts, Simd, simd_kernel};

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
/// Largest distance from that mean that is told apart, 0 to 255 scale.
const CONTRAST: f32 = 109.0;
/// Steps per grey level: squared differences over 65 536 are those of grey levels over eight.
const UNIT: f32 = 90.51;
/// Cost below which a window rests: two grey levels, root mean square, are noise.
const AT_REST: u16 = (3 * SIDE * SIDE * 4 / 8) as u16;
/// What a pixel counts at most: sums over a window are below 32 768.
const MOST: u16 = (i16::MAX as usize / (SIDE * SIDE)) as u16;

/// Largest distance along either axis between a pixel and where it comes back to, pixels.
const ROUND_TRIP: f32 = 1.0;

/// The best match of every pixel so far. Longer than the image by a group, as rows are not whole groups.
struct Best {
    /// Cost and number of the displacement, which decides among equal costs.
    best: Vec<u64>,
    /// What a cost must be below to be better or equal; 0 where it is perfect.
    limit: Vec<u16>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        Self { best: vec![u64::MAX; pixels + SHORTS], limit: vec![i16::MAX as u16; pixels + SHORTS] }
    }

    /// The pixels whose windows differ at the only displacement that was compared so far, and what lies between them.
    fn not_at_rest(&self, width: usize) -> Region {
        let mut region = Region { first_column: width, first_row: 0, columns: 0, rows: 0 };
        let mut end = 0;
        let rows = self.limit[..self.limit.len() - SHORTS].chunks_exact(width);
        for (y, row) in rows.enumerate() {
            let Some(from) = row.iter().position(|&limit| limit > AT_REST) else { continue };
            let to = width - row.iter().rev().take_while(|&&limit| limit <= AT_REST).count();
            if region.rows == 0 {
                region.first_row = y;
            }
            region.rows = y + 1 - region.first_row;
            region.first_column = region.first_column.min(from);
            end = end.max(to);
        }
        region.columns = end.saturating_sub(region.first_column);
        region
    }

    fn into_flow(self, width: usize, height: usize, displacements: &[[i32; 2]]) -> Flow {
        let axis = |axis: usize| {
            let displaced = |&best: &u64| displacements[best as u32 as usize][axis] as f32;
            self.best[..width * height].iter().map(displaced).collect()
        };
        Flow { width, height, u: axis(0), v: axis(1) }
    }
}

/// Compares every pixel's window with all windows at most `radius` pixels away along either axis.
///
/// Of equal costs the smallest displacement wins, so identical images match at zero. Outside the rectangle around all
/// windows that differ by more than noise everything rests.
pub(super) fn search<const C: usize>(
    instructions: Instructions,
    first: &Planes<C>,
    second: &Planes<C>,
    radius: usize,
) -> CoarseMatches {
    let (width, height) = (first.width, first.height);
    let images = [first, second].map(Prepared::of);
    let displacements = displacements_by_length(radius.min(width - 1), radius.min(height - 1));
    let mut matches = [(); 2].map(|()| Best::new(width * height));
    compare_all(instructions, &images, &displacements, &mut matches);
    let [mut forward, mut backward] = matches.map(|best| best.into_flow(width, height, &displacements));
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

/// Channels without their local mean, smoothed a little as a displacement of half a coarse pixel must not hide a match,
/// with [`RADIUS`] replicated pixels on every side.
struct Prepared<const C: usize> {
    width: usize,
    height: usize,
    stride: usize,
    channels: [Vec<u16>; C],
}

impl<const C: usize> Prepared<C> {
    fn of(planes: &Planes<C>) -> Self {
        let (width, height) = (planes.width, planes.height);
        let stride = width + 2 * RADIUS;
        let channels = planes.high_passed(HIGH_PASS_RADIUS).map(|channel| {
            let box3 = box_mean(&channel, width, height, 1);
            let mut shorts = Vec::with_capacity(stride * (height + 2 * RADIUS) + 2 * SHORTS);
            for y in 0..height + 2 * RADIUS {
                let row = y.saturating_sub(RADIUS).min(height - 1) * width;
                let short = |x: usize| {
                    let value = 0.5 * (channel[row + x] + box3[row + x]);
                    (UNIT * (value.clamp(-CONTRAST, CONTRAST) + CONTRAST)) as u16
                };
                shorts.extend([short(0); RADIUS]);
                shorts.extend((0..width).map(short));
                shorts.extend([short(width - 1); RADIUS]);
            }
            // Rows are read in whole groups.
            shorts.extend([0; 2 * SHORTS]);
            shorts
        });
        Self { width, height, stride, channels }
    }
}

fn displacements_by_length(radius_x: usize, radius_y: usize) -> Vec<[i32; 2]> {
    let (rx, ry) = (radius_x as i32, radius_y as i32);
    let mut all: Vec<[i32; 2]> = (-ry..=ry).flat_map(|dy| (-rx..=rx).map(move |dx| [dx, dy])).collect();
    all.sort_unstable_by_key(length_first);
    all
}

fn length_first(&[dx, dy]: &[i32; 2]) -> (i32, i32, i32) {
    (dx * dx + dy * dy, dy, dx)
}

simd_kernel! {
    fn compare_all<const C: usize>(
        images: &[Prepared<C>; 2], displacements: &[[i32; 2]], matches: &mut [Best; 2],
    ) = compare_kernel
}

#[inline(always)]
fn compare_kernel<S: Simd, const C: usize>(
    images: &[Prepared<C>; 2],
    displacements: &[[i32; 2]],
    matches: &mut [Best; 2],
) {
    let mut sums = WindowSums::new(images[0].width);
    let mut region = Region::all(&images[0]);
    let mut shorter = 0;
    for equally_long in displacements.chunk_by(|a, b| length_first(a).0 == length_first(b).0) {
        let last = equally_long.len() - 1;
        for (n, &displacement) in equally_long.iter().enumerate() {
            // Where one displacement is the nth of its length, its opposite is the nth from the end.
            let labels = [shorter + n as u32, shorter + (last - n) as u32];
            sums.compare::<S::Shorts, C>(images, region.overlap(displacement), labels, matches);
        }
        if shorter == 0 {
            region = matches[0].not_at_rest(images[0].width);
        }
        shorter += equally_long.len() as u32;
    }
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Region {
    first_column: usize,
    first_row: usize,
    columns: usize,
    rows: usize,
}

impl Region {
    fn all<const C: usize>(image: &Prepared<C>) -> Self {
        Self { first_column: 0, first_row: 0, columns: image.width, rows: image.height }
    }

    /// Those of its pixels that a displacement leaves in it.
    fn overlap(self, displacement: [i32; 2]) -> Overlap {
        let [dx, dy] = displacement;
        let within = Self {
            first_column: self.first_column + (-dx).max(0) as usize,
            first_row: self.first_row + (-dy).max(0) as usize,
            columns: self.columns.saturating_sub(dx.unsigned_abs() as usize),
            rows: self.rows.saturating_sub(dy.unsigned_abs() as usize),
        };
        Overlap { displacement, within }
    }
}

/// Pixels of the first image whose counterparts at some displacement are compared with them.
struct Overlap {
    displacement: [i32; 2],
    within: Region,
}

/// Sums of squared differences over windows, row after row.
struct WindowSums {
    columns: usize,
    /// Numbers per row of both fields below.
    stride: usize,
    /// The squared differences of the last rows, in turn.
    squares: Vec<u16>,
    /// Their sums along columns, as they were after every other row.
    sums: Vec<u16>,
}

impl WindowSums {
    fn new(width: usize) -> Self {
        let stride = (width + 2 * RADIUS).next_multiple_of(SHORTS) + SHORTS;
        Self { columns: 0, stride, squares: vec![0; SIDE * stride], sums: vec![0; 2 * stride] }
    }

    /// Offers the windows of an overlap to the pixels of both images.
    #[inline(always)]
    fn compare<S: Shorts, const C: usize>(
        &mut self,
        images: &[Prepared<C>; 2],
        overlap: Overlap,
        labels: [u32; 2],
        matches: &mut [Best; 2],
    ) {
        let Overlap { displacement: [dx, dy], within } = overlap;
        if within.rows == 0 || within.columns == 0 {
            return;
        }
        self.columns = within.columns;
        self.squares.fill(0);
        self.sums.fill(0);
        let width = images[0].width;
        let lines = within.rows + 2 * RADIUS;
        // Sums are read a row later: what was just written is not yet in the cache.
        for line in 0..=lines {
            if line < lines {
                self.add_row::<S, C>(images, &overlap, line);
            }
            let Some(row) = line.checked_sub(SIDE) else { continue };
            let first = (within.first_row + row) * width + within.first_column;
            let second = (first as i64 + i64::from(dy) * width as i64 + i64::from(dx)) as usize;
            self.offer::<S>(line - 1, [first, second], labels, matches);
        }
    }

    /// Takes in a row of squared differences, the first of which lies [`RADIUS`] rows before the overlap, and forgets that
    /// of [`SIDE`] rows before.
    #[inline(always)]
    fn add_row<S: Shorts, const C: usize>(
        &mut self,
        images: &[Prepared<C>; 2],
        overlap: &Overlap,
        line: usize,
    ) {
        let [first, second] = images;
        let groups = (self.columns + 2 * RADIUS).div_ceil(SHORTS);
        let [dx, dy] = overlap.displacement.map(i64::from);
        // The border shifts both axes by the radius, and the first row and column lie as far before the overlap.
        let at = (overlap.within.first_row + line) * first.stride + overlap.within.first_column;
        let shifted = (at as i64 + dy * second.stride as i64 + dx) as usize;
        let mut here: [&[[u16; SHORTS]]; C] = [&[]; C];
        let mut there: [&[[u16; SHORTS]]; C] = [&[]; C];
        for c in 0..C {
            here[c] = in_groups(&first.channels[c], at, groups);
            there[c] = in_groups(&second.channels[c], shifted, groups);
        }
        let row = in_groups_mut(&mut self.squares, line % SIDE * self.stride, groups);
        let (even, odd) = self.sums.split_at_mut(self.stride);
        let (before, after) = if line.is_multiple_of(2) { (odd, even) } else { (even, odd) };
        let (before, after) = (in_groups(before, 0, groups), in_groups_mut(after, 0, groups));
        for group in 0..groups {
            let mut squares = S::splat(0);
            for c in 0..C {
                let (a, b) = (S::load(&here[c][group]), S::load(&there[c][group]));
                squares = squares.add(a.squared_difference(b));
            }
            let squares = squares.min(S::splat(MOST));
            let sum = S::load(&before[group]).add(squares).sub(S::load(&row[group]));
            sum.store(&mut after[group]);
            squares.store(&mut row[group]);
        }
    }

    /// Offers the windows that end in a row to the pixels from `at[0]` on of one image and those from `at[1]` on of the
    /// other.
    #[inline(always)]
    fn offer<S: Shorts>(&self, line: usize, at: [usize; 2], labels: [u32; 2], matches: &mut [Best; 2]) {
        let groups = self.columns.div_ceil(SHORTS);
        let mut shifted: [&[[u16; SHORTS]]; SIDE] = [&[]; SIDE];
        for k in 0..SIDE {
            shifted[k] = in_groups(&self.sums, line % 2 * self.stride + k, groups);
        }
        let [forward, backward] = matches;
        let here = in_groups_mut(&mut forward.limit, at[0], groups);
        let there = in_groups_mut(&mut backward.limit, at[1], groups);
        for group in 0..groups {
            let mut costs = S::load(&shifted[0][group]);
            for k in 1..SIDE {
                costs = costs.add(S::load(&shifted[k][group]));
            }
            let column = group * SHORTS;
            let inside = u16::MAX >> SHORTS.saturating_sub(self.columns - column);
            let better_here = costs.below(S::load(&here[group])) & inside;
            let better_there = costs.below(S::load(&there[group])) & inside;
            if better_here | better_there == 0 {
                continue;
            }
            let mut values = [0; SHORTS];
            costs.store(&mut values);
            let bests = [&mut forward.best[at[0] + column..], &mut backward.best[at[1] + column..]];
            let [best_here, best_there] = bests;
            take(best_here, &mut here[group], better_here, &values, labels[0]);
            take(best_there, &mut there[group], better_there, &values, labels[1]);
        }
    }
}

/// Compares those pixels of a group whose bits are set.
#[inline(always)]
fn take(best: &mut [u64], limit: &mut [u16; SHORTS], mut bits: u16, costs: &[u16; SHORTS], label: u32) {
    while bits != 0 {
        let lane = bits.trailing_zeros() as usize;
        bits &= bits - 1;
        let offered = u64::from(costs[lane]) << u32::BITS | u64::from(label);
        if offered < best[lane] {
            best[lane] = offered;
            limit[lane] = if costs[lane] == 0 { 0 } else { costs[lane] + 1 };
        }
    }
}

/// The numbers from `first` on, in groups, to be written.
#[inline(always)]
fn in_groups_mut<T>(values: &mut [T], first: usize, groups: usize) -> &mut [[T; SHORTS]] {
    &mut values[first..first + groups * SHORTS].as_chunks_mut().0[..groups]
}

/// The numbers from `first` on, in groups.
#[inline(always)]
fn in_groups<T>(values: &[T], first: usize, groups: usize) -> &[[T; SHORTS]] {
    &values[first..first + groups * SHORTS].as_chunks().0[..groups]
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;

    fn noise(seed: u64, count: usize) -> Vec<[f32; 3]> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        (0..count).map(|_| random.random::<[f32; 3]>().map(|v| 255.0 * v)).collect()
    }

    fn planes(width: usize, height: usize, colour: impl Fn(usize, usize) -> [f32; 3]) -> Planes {
        let channel = |c: usize| (0..width * height).map(|i| colour(i % width, i / width)[c]).collect();
        Planes::from_interiors(width, height, [channel(0), channel(1), channel(2)])
    }

    /// A square of noise in front of a wall of noise.
    fn square_at(x0: usize, y0: usize) -> Planes {
        let (wall, square) = (noise(2, 61 * 43), noise(3, 12 * 12));
        planes(61, 43, |x, y| match (x.checked_sub(x0), y.checked_sub(y0)) {
            (Some(u @ 0..12), Some(v @ 0..12)) => square[v * 12 + u],
            _ => wall[y * 61 + x],
        })
    }

    /// Every window of the first image against every one of the second, one number at a time: the best displacement.
    fn best_matches(first: &Prepared<3>, second: &Prepared<3>, radius: i32) -> Vec<[i32; 2]> {
        let (width, height) = (first.width as i32, first.height as i32);
        let value = |image: &Prepared<3>, c: usize, x: i32, y: i32| {
            let at = (y + RADIUS as i32) * image.stride as i32 + x + RADIUS as i32;
            i32::from(image.channels[c][at as usize])
        };
        let window = -(RADIUS as i32)..=RADIUS as i32;
        let cost = |x: i32, y: i32, [dx, dy]: [i32; 2]| -> u32 {
            let pixel = |x: i32, y: i32| {
                let square =
                    |c| (value(first, c, x, y) - value(second, c, x + dx, y + dy)).pow(2) as u32 >> 16;
                (0..3).map(square).sum::<u32>().min(u32::from(MOST))
            };
            window
                .clone()
                .flat_map(|v| window.clone().map(move |u| (u, v)))
                .map(|(u, v)| pixel(x + u, y + v))
                .sum()
        };
        let best = |x: i32, y: i32| {
            let inside =
                |[dx, dy]: &[i32; 2]| (0..width).contains(&(x + dx)) && (0..height).contains(&(y + dy));
            let all = displacements_by_length(radius as usize, radius as usize).into_iter().filter(inside);
            all.min_by_key(|&displacement| cost(x, y, displacement)).unwrap_or_default()
        };
        (0..width * height).map(|i| best(i % width, i / width)).collect()
    }

    #[test]
    fn the_search_agrees_with_one_number_at_a_time_on_every_instruction_set() {
        // Everything changes, so everything is searched; sizes and windows are no whole groups.
        let (wide, other) = (noise(4, 80 * 60), noise(5, 80 * 60));
        let first = planes(37, 21, |x, y| wide[y * 80 + x + 9]);
        let second = planes(37, 21, |x, y| if x < 20 { wide[(y + 3) * 80 + x] } else { other[y * 80 + x] });
        let (a, b) = (Prepared::of(&first), Prepared::of(&second));
        let (there, back) = (best_matches(&a, &b, 11), best_matches(&b, &a, 11));
        for instructions in Instructions::available() {
            let matches = search(instructions, &first, &second, 11);
            for (found, best, other) in
                [(&matches.forward, &there, &back), (&matches.backward, &back, &there)]
            {
                for (i, &[dx, dy]) in best.iter().enumerate() {
                    let [bx, by] = other[(i as i32 + dy * 37 + dx) as usize];
                    let leads_back = (dx + bx).abs() <= 1 && (dy + by).abs() <= 1;
                    assert_eq!(found.u[i].is_finite(), leads_back, "{} {i}", instructions.set());
                    if leads_back {
                        assert_eq!([found.u[i], found.v[i]], [dx as f32, dy as f32]);
                    }
                }
            }
        }
    }

    #[test]
    fn leaving_out_what_rests_loses_no_match() {
        let (first, second) = (square_at(6, 8), square_at(29, 20));
        let (a, b) = (Prepared::of(&first), Prepared::of(&second));
        let (there, back) = (best_matches(&a, &b, 25), best_matches(&b, &a, 25));
        let found = search(Instructions::detect(), &first, &second, 25).forward;
        let mut jumped = 0;
        for (i, &[dx, dy]) in there.iter().enumerate() {
            let [bx, by] = back[(i as i32 + dy * 61 + dx) as usize];
            if (dx + bx).abs() <= 1 && (dy + by).abs() <= 1 {
                assert_eq!([found.u[i], found.v[i]], [dx as f32, dy as f32], "{i}");
                jumped += usize::from([dx, dy] == [23, 12]);
            }
        }
        // Windows that lie inside the square see nothing else.
        assert!(jumped >= 8 * 8, "{jumped}");
    }

    #[test]
    fn only_the_rectangle_of_what_differs_is_searched() {
        let mut best = Best::new(7 * 5);
        best.limit.fill(AT_REST);
        assert_eq!(best.not_at_rest(7).columns * best.not_at_rest(7).rows, 0);
        best.limit[7 + 4] = AT_REST + 1;
        best.limit[3 * 7 + 2] = AT_REST + 1;
        assert_eq!(best.not_at_rest(7), Region { first_column: 2, first_row: 1, columns: 3, rows: 3 });
        best.limit.fill(i16::MAX as u16);
        assert_eq!(best.not_at_rest(7), Region { first_column: 0, first_row: 0, columns: 7, rows: 5 });
    }

    #[test]
    fn shifts_up_to_the_radius_are_found_both_ways() {
        let (width, height) = (40, 30);
        let wide = noise(1, 100 * 100);
        let crop = |x0: usize, y0: usize| planes(width, height, |x, y| wide[(y0 + y) * 100 + x0 + x]);
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
