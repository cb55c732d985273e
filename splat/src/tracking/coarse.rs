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

/// Red, green and blue.
const CHANNELS: usize = 3;
/// Half side of the compared windows.
const RADIUS: usize = 2;
/// Their side.
const SIDE: usize = 2 * RADIUS + 1;
/// Half side of the windows whose mean is removed first. Wide, so that a patch keeps its colour.
const HIGH_PASS_RADIUS: usize = 6;
/// Steps per grey level: squared differences over 32 768 are a third of those of grey levels, so 1.2 of them count.
const UNIT: f32 = 104.5;
/// Largest distance from that mean that is told apart, 0 to 255 scale: differences stay below 32 768 steps.
const CONTRAST: f32 = 156.0;
/// Cost up to which every window rests: a third of a squared grey level per channel. Noise of up to 0.6 grey levels in
/// the searched image, which averages many pixels, stays below it in every window.
const AT_REST: u16 = (CHANNELS * SIDE * SIDE) as u16 / 9;
/// Share of its own contrast by which a window that rests may differ besides, as sampling noise does.
const RESTLESS: u16 = 16;
/// What a pixel counts at most: sums over a window are below 65 535.
const MOST: u16 = u16::MAX / (SIDE * SIDE) as u16;

/// Largest distance along either axis between a pixel and where it comes back to, pixels.
const ROUND_TRIP: f32 = 1.0;

/// The best match of every pixel so far. Longer than the image by a group, as rows are not whole groups.
struct Best {
    /// Cost and number of the displacement, which decides among equal costs.
    best: Vec<u64>,
    /// What a cost must be below to be taken into account.
    limit: Vec<u16>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        Self { best: vec![u64::MAX; pixels + SHORTS], limit: vec![u16::MAX; pixels + SHORTS] }
    }

    /// The pixels whose windows differ at the only displacement that was compared so far, and what lies between them;
    /// `contrasts` are the costs of windows without any.
    fn not_at_rest(&self, contrasts: &Self, width: usize) -> Region {
        let restless = |(&cost, &contrast): (&u16, &u16)| cost > AT_REST + contrast / RESTLESS;
        let mut region = Region { first_column: width, first_row: 0, columns: 0, rows: 0 };
        let mut end = 0;
        let pixels = self.limit.len() - SHORTS;
        let rows = self.limit[..pixels].chunks_exact(width).zip(contrasts.limit.chunks_exact(width));
        for (y, (costs, contrasts)) in rows.enumerate() {
            let mut row = costs.iter().zip(contrasts);
            let Some(from) = row.clone().position(restless) else { continue };
            let to = row.rposition(restless).map_or(from, |last| last + 1);
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
pub(super) fn search(
    instructions: Instructions,
    first: &Planes,
    second: &Planes,
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
struct Prepared {
    width: usize,
    height: usize,
    stride: usize,
    channels: [Vec<u16>; CHANNELS],
}

impl Prepared {
    /// What an image of the same size without contrast becomes.
    fn flat(image: &Self) -> Self {
        let channels = image.channels.each_ref().map(|channel| vec![in_steps(0.0); channel.len()]);
        Self { channels, ..*image }
    }

    fn of(planes: &Planes) -> Self {
        let (width, height) = (planes.width, planes.height);
        let stride = width + 2 * RADIUS;
        let channels = planes.high_passed(HIGH_PASS_RADIUS).map(|channel| {
            let box3 = box_mean(&channel, width, height, 1);
            let mut shorts = Vec::with_capacity(stride * (height + 2 * RADIUS) + 2 * SHORTS);
            for y in 0..height + 2 * RADIUS {
                let row = y.saturating_sub(RADIUS).min(height - 1) * width;
                let short = |x: usize| {
                    let value = 0.5 * (channel[row + x] + box3[row + x]);
                    in_steps(value)
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

/// A distance from the mean in steps.
fn in_steps(value: f32) -> u16 {
    (UNIT * (value.clamp(-CONTRAST, CONTRAST) + CONTRAST)).round() as u16
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
    fn compare_all(
        images: &[Prepared; 2], displacements: &[[i32; 2]], matches: &mut [Best; 2],
    ) = compare_kernel
}

#[inline(always)]
fn compare_kernel<S: Simd>(images: &[Prepared; 2], displacements: &[[i32; 2]], matches: &mut [Best; 2]) {
    let mut sums = WindowSums::new(images[0].width);
    let mut region = Region::all(&images[0]);
    let mut shorter = 0;
    for equally_long in displacements.chunk_by(|a, b| length_first(a).0 == length_first(b).0) {
        let last = equally_long.len() - 1;
        for (n, &displacement) in equally_long.iter().enumerate() {
            // Where one displacement is the nth of its length, its opposite is the nth from the end.
            let labels = [shorter + n as u32, shorter + (last - n) as u32];
            let [first, second] = images;
            sums.compare::<S::Shorts>([first, second], region.overlap(displacement), labels, matches);
        }
        if shorter == 0 {
            // The lesser contrast of both images: what appears on something flat does not rest.
            let flat = Prepared::flat(&images[0]);
            let mut contrasts = [(); 2].map(|()| Best::new(flat.width * flat.height));
            for image in images {
                sums.compare::<S::Shorts>([image, &flat], region.overlap([0, 0]), [0, 0], &mut contrasts);
            }
            region = matches[0].not_at_rest(&contrasts[0], flat.width);
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
    fn all(image: &Prepared) -> Self {
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
    fn compare<S: Shorts>(
        &mut self,
        images: [&Prepared; 2],
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
                self.add_row::<S>(images, &overlap, line);
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
    fn add_row<S: Shorts>(&mut self, images: [&Prepared; 2], overlap: &Overlap, line: usize) {
        let [first, second] = images;
        let groups = (self.columns + 2 * RADIUS).div_ceil(SHORTS);
        let [dx, dy] = overlap.displacement.map(i64::from);
        // The border shifts both axes by the radius, and the first row and column lie as far before the overlap.
        let at = (overlap.within.first_row + line) * first.stride + overlap.within.first_column;
        let shifted = (at as i64 + dy * second.stride as i64 + dx) as usize;
        let mut here: [&[[u16; SHORTS]]; CHANNELS] = [&[]; CHANNELS];
        let mut there: [&[[u16; SHORTS]]; CHANNELS] = [&[]; CHANNELS];
        for c in 0..CHANNELS {
            here[c] = in_groups(&first.channels[c], at, groups);
            there[c] = in_groups(&second.channels[c], shifted, groups);
        }
        let row = in_groups_mut(&mut self.squares, line % SIDE * self.stride, groups);
        let (even, odd) = self.sums.split_at_mut(self.stride);
        let (before, after) = if line.is_multiple_of(2) { (odd, even) } else { (even, odd) };
        let (before, after) = (in_groups(before, 0, groups), in_groups_mut(after, 0, groups));
        for group in 0..groups {
            let mut squares = S::splat(0);
            for c in 0..CHANNELS {
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
        // Of equal costs the smaller number wins. Forwards numbers ascend, so what comes later must be better; backwards
        // they descend among equally long displacements.
        let ties = u16::from(labels[1] > 0);
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
            take(best_here, &mut here[group], better_here, &values, labels[0], 0);
            take(best_there, &mut there[group], better_there, &values, labels[1], ties);
        }
    }
}

/// Compares those pixels of a group whose bits are set. Later costs count if they are below these plus `ties`.
#[inline(always)]
fn take(
    best: &mut [u64],
    limit: &mut [u16; SHORTS],
    mut bits: u16,
    costs: &[u16; SHORTS],
    label: u32,
    ties: u16,
) {
    while bits != 0 {
        let lane = bits.trailing_zeros() as usize;
        bits &= bits - 1;
        let offered = u64::from(costs[lane]) << u32::BITS | u64::from(label);
        if offered < best[lane] {
            best[lane] = offered;
            limit[lane] = costs[lane] + ties;
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
mod tests;
