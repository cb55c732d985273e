//! Dense inverse search: patches of the reference image, each matched in the target image by inverse-compositional
//! gradient descent on the mean-normalised squared difference, with candidates handed from neighbour to neighbour
//! (Kroeger et al., "Fast optical flow using dense inverse search", 2016).

use super::{
    flow::Flow,
    planes::{BORDER, PATCH, Planes},
};
use crate::simd::{LANES, Simd, simd_kernel};

/// Pixels of a patch.
pub(super) const PATCH_PIXELS: usize = PATCH * PATCH;
/// Groups of lanes that hold a patch, two rows each.
const GROUPS: usize = PATCH_PIXELS / LANES;
/// Variance of image noise on the 0 to 255 scale that damps badly conditioned patches.
const NOISE_VARIANCE: f32 = 9.0;
/// Expected distance of a start from the optimum, pixels: the prior of the damping.
const START_DEVIATION: f32 = 2.0;
const DAMPING: f32 = NOISE_VARIANCE / (START_DEVIATION * START_DEVIATION);
/// How much a difference of mean colour counts against a candidate; 1 would be the plain squared difference.
/// Shadows and exposure change the mean, but between equally textured candidates the colour decides.
const MEAN_WEIGHT: f32 = 0.1;
/// Candidates closer than this to one already tried are not tried again, pixels.
const SAME_CANDIDATE: f32 = 0.1;
/// Steps shorter than this end a descent, pixels.
const SETTLED: f32 = 0.01;
/// A match found without regard to its neighbours must be better than the others by a factor and by what noise of
/// some grey levels makes of a difference: patches without texture match anywhere.
const LEAST_GAIN: f32 = 0.7;
const LEAST_DIFFERENCE: f32 = 4.0 * PATCH_PIXELS as f32;
/// Most candidates of a patch.
const CANDIDATES: usize = 8;

/// Patches on a regular grid and where they went.
pub(super) struct PatchField {
    pub(super) columns: usize,
    /// Top-left pixel of each patch column and of each patch row.
    pub(super) xs: Vec<usize>,
    pub(super) ys: Vec<usize>,
    pub(super) displacement: Vec<[f32; 2]>,
    /// Squared difference of the patch, summed over its values.
    pub(super) cost: Vec<f32>,
}

impl PatchField {
    /// A field of `width * height` pixels whose patches lie every `stride` pixels and flush with the end.
    pub(super) fn new(width: usize, height: usize, stride: usize) -> Self {
        let (xs, ys) = (grid(width, stride), grid(height, stride));
        let patches = xs.len() * ys.len();
        let (displacement, cost) = (vec![[0.0; 2]; patches], vec![f32::INFINITY; patches]);
        Self { columns: xs.len(), xs, ys, displacement, cost }
    }
}

fn grid(size: usize, stride: usize) -> Vec<usize> {
    let last = size.saturating_sub(PATCH);
    let mut at: Vec<usize> = (0..last).step_by(stride.max(1)).collect();
    at.push(last);
    at
}

/// A field that patches may start from.
#[derive(Clone, Copy)]
pub(super) struct Guess<'a> {
    pub(super) flow: &'a Flow,
    /// Resolution of the patches over that of the field.
    pub(super) scale: f32,
}

impl Guess<'_> {
    /// The nearest value: between two motions lies none.
    fn at(&self, x: f32, y: f32) -> [f32; 2] {
        let column = ((x / self.scale) as usize).min(self.flow.width - 1);
        let row = ((y / self.scale) as usize).min(self.flow.height - 1);
        self.flow.at(column, row).map(|value| value * self.scale)
    }
}

/// A patch in registers, two rows per group.
pub(super) type Pixels<S> = [S; GROUPS];

/// The patch whose top-left pixel has the fractional index `(x, y)`, bilinear; far outside is the border.
pub(super) struct Window<S> {
    first: usize,
    fx: S,
    fy: S,
}

impl<S: Simd> Window<S> {
    #[inline(always)]
    pub(super) fn new<const C: usize>(planes: &Planes<C>, x: f32, y: f32) -> Self {
        let least = -(PATCH as f32 + 1.0);
        // Shifting by the border makes the coordinates positive, so truncation is the floor.
        let x = x.clamp(least, planes.width as f32) + BORDER as f32;
        let y = y.clamp(least, planes.height as f32) + BORDER as f32;
        let (column, row) = (x as usize, y as usize);
        Self {
            first: row * planes.stride + column,
            fx: S::splat(x - column as f32),
            fy: S::splat(y - row as f32),
        }
    }

    #[inline(always)]
    pub(super) fn fetch(&self, channel: &[f32], stride: usize) -> Pixels<S> {
        let mut rows = [S::splat(0.0); GROUPS + 1];
        for pair in 0..GROUPS {
            let at = self.first + 2 * pair * stride;
            rows[pair] = self.blend(line(channel, at), line(channel, at + stride));
        }
        let last = line(channel, self.first + PATCH * stride);
        rows[GROUPS] = self.blend(last, last);
        let mut pixels = [S::splat(0.0); GROUPS];
        for pair in 0..GROUPS {
            let below = rows[pair].straddle(rows[pair + 1]);
            pixels[pair] = below.sub(rows[pair]).mul_add(self.fy, rows[pair]);
        }
        pixels
    }

    /// Two rows, interpolated along x.
    #[inline(always)]
    fn blend(&self, upper: &[f32; PATCH + 1], lower: &[f32; PATCH + 1]) -> S {
        let left = S::load_halves([part::<0>(upper), part::<0>(lower)]);
        let right = S::load_halves([part::<1>(upper), part::<1>(lower)]);
        right.sub(left).mul_add(self.fx, left)
    }
}

/// A patch's row and the pixels that interpolation needs beyond it.
#[inline(always)]
pub(super) fn line<const LENGTH: usize>(channel: &[f32], first: usize) -> &[f32; LENGTH] {
    let (line, _) = channel[first..].split_first_chunk().unwrap_or_else(|| beyond_the_border());
    line
}

#[cold]
fn beyond_the_border() -> ! {
    unreachable!("a patch reaches at most one pixel less than the border")
}

/// The row's pixels from `SHIFT` on.
#[inline(always)]
fn part<const SHIFT: usize>(line: &[f32; PATCH + 1]) -> &[f32; PATCH] {
    let (low, high) = (line.first_chunk(), line.last_chunk());
    let part = if SHIFT == 0 { low } else { high };
    part.unwrap_or_else(|| beyond_the_border())
}

#[inline(always)]
fn pair_of_rows<S: Simd>(channel: &[f32], upper: usize, lower: usize) -> S {
    S::load_halves([line(channel, upper), line(channel, lower)])
}

/// The sum over the lanes of each argument.
#[inline(always)]
pub(super) fn totals<S: Simd>(of: [S; 4]) -> [f32; 4] {
    let mut lanes = [0.0; LANES];
    S::row_sums(of).store(&mut lanes);
    let mut totals = [0.0; 4];
    for k in 0..4 {
        totals[k] = (lanes[k] + lanes[4 + k]) + (lanes[8 + k] + lanes[12 + k]);
    }
    totals
}

#[inline(always)]
fn sum<S: Simd>(pixels: &Pixels<S>) -> S {
    pixels[0].add(pixels[1]).add(pixels[2].add(pixels[3]))
}

#[inline(always)]
fn products<S: Simd>(a: &Pixels<S>, b: &Pixels<S>) -> S {
    let upper = a[1].mul_add(b[1], a[0].mul(b[0]));
    let lower = a[3].mul_add(b[3], a[2].mul(b[2]));
    upper.add(lower)
}

/// The sum of squares of a patch whose mean counts little.
#[inline(always)]
fn without_mean(squares: f32, total: f32) -> f32 {
    let share = (1.0 - MEAN_WEIGHT) / PATCH_PIXELS as f32;
    (squares - share * total * total).max(0.0)
}

/// A patch of the reference, its gradients without their mean, and the inverse of the damped Gauss-Newton matrix.
struct Template<S, const C: usize> {
    channels: [[Pixels<S>; 3]; C],
    inverse: [f32; 3],
}

/// What descent needs to know of a patch at some displacement.
#[derive(Clone, Copy)]
struct Comparison {
    cost: f32,
    right: [f32; 2],
}

impl<S: Simd, const C: usize> Template<S, C> {
    #[inline(always)]
    fn new(planes: &Planes<C>, x: usize, y: usize) -> Self {
        let stride = planes.stride;
        let first = planes.index(x, y);
        let half = S::splat(0.5);
        let mut channels = [[[S::splat(0.0); GROUPS]; 3]; C];
        let mut matrix = [DAMPING, 0.0, DAMPING];
        for (template, channel) in channels.iter_mut().zip(&planes.channels) {
            for pair in 0..GROUPS {
                let (upper, lower) = (first + 2 * pair * stride, first + (2 * pair + 1) * stride);
                let right: S = pair_of_rows(channel, upper + 1, lower + 1);
                let left = pair_of_rows(channel, upper - 1, lower - 1);
                let below: S = pair_of_rows(channel, lower, lower + stride);
                let above = pair_of_rows(channel, upper - stride, upper);
                template[0][pair] = pair_of_rows(channel, upper, lower);
                template[1][pair] = right.sub(left).mul(half);
                template[2][pair] = below.sub(above).mul(half);
            }
            let none = S::splat(0.0);
            let means = totals([sum(&template[1]), sum(&template[2]), none, none]);
            for axis in 0..2 {
                let mean = S::splat(means[axis] / PATCH_PIXELS as f32);
                for pair in 0..GROUPS {
                    template[1 + axis][pair] = template[1 + axis][pair].sub(mean);
                }
            }
            let [_, gx, gy] = &*template;
            let [xx, xy, yy, _] = totals([products(gx, gx), products(gx, gy), products(gy, gy), none]);
            matrix = [matrix[0] + xx, matrix[1] + xy, matrix[2] + yy];
        }
        // Positive: the damping is added to a positive semidefinite matrix.
        let determinant = matrix[0] * matrix[2] - matrix[1] * matrix[1];
        let inverse = [matrix[2] / determinant, -matrix[1] / determinant, matrix[0] / determinant];
        Self { channels, inverse }
    }

    #[inline(always)]
    fn compare(&self, target: &Planes<C>, x: f32, y: f32) -> Comparison {
        let window = Window::<S>::new(target, x, y);
        let mut comparison = Comparison { cost: 0.0, right: [0.0; 2] };
        for (template, channel) in self.channels.iter().zip(&target.channels) {
            let mut off = window.fetch(channel, target.stride);
            for pair in 0..GROUPS {
                off[pair] = off[pair].sub(template[0][pair]);
            }
            let [total, squares, along_x, along_y] = totals([
                sum(&off),
                products(&off, &off),
                products(&off, &template[1]),
                products(&off, &template[2]),
            ]);
            comparison.cost += without_mean(squares, total);
            comparison.right[0] += along_x;
            comparison.right[1] += along_y;
        }
        comparison
    }

    /// The step that Gauss-Newton takes, with the prior on the distance to the start.
    #[inline(always)]
    fn step(&self, comparison: &Comparison, from_start: [f32; 2]) -> [f32; 2] {
        let right =
            [comparison.right[0] + DAMPING * from_start[0], comparison.right[1] + DAMPING * from_start[1]];
        let [xx, xy, yy] = self.inverse;
        [xx * right[0] + xy * right[1], xy * right[0] + yy * right[1]]
    }

    /// The cost of [`Self::compare`] if it is below `bound`, else at least that.
    #[inline(always)]
    fn cost_below(&self, bound: f32, target: &Planes<C>, x: f32, y: f32) -> f32 {
        let window = Window::<S>::new(target, x, y);
        let mut cost = 0.0;
        for (template, channel) in self.channels.iter().zip(&target.channels) {
            let mut off = window.fetch(channel, target.stride);
            for pair in 0..GROUPS {
                off[pair] = off[pair].sub(template[0][pair]);
            }
            let none = S::splat(0.0);
            let [total, squares, ..] = totals([sum(&off), products(&off, &off), none, none]);
            cost += without_mean(squares, total);
            if cost >= bound {
                return cost;
            }
        }
        cost
    }

    /// The best of the candidates, improved by descent. Where the cost of the first is `known`, that one was improved
    /// before.
    #[inline(always)]
    fn improve(
        &self,
        target: &Planes<C>,
        [x, y]: [f32; 2],
        candidates: &Candidates,
        known: Option<f32>,
        iterations: u32,
    ) -> ([f32; 2], f32) {
        let first = candidates.list[0];
        let mut start = first;
        let mut cost =
            known.unwrap_or_else(|| self.cost_below(f32::INFINITY, target, x + first[0], y + first[1]));
        for n in 1..candidates.count {
            let candidate = candidates.list[n];
            let bound = if n < candidates.trusted { cost } else { LEAST_GAIN * cost - LEAST_DIFFERENCE };
            let found = self.cost_below(bound, target, x + candidate[0], y + candidate[1]);
            if found < bound {
                (start, cost) = (candidate, found);
            }
        }
        if known.is_some() && start == first {
            return (start, cost);
        }
        let best = self.compare(target, x + start[0], y + start[1]);
        self.descend(target, [x, y], start, best, iterations)
    }

    #[inline(always)]
    fn descend(
        &self,
        target: &Planes<C>,
        [x, y]: [f32; 2],
        start: [f32; 2],
        mut best: Comparison,
        iterations: u32,
    ) -> ([f32; 2], f32) {
        let mut at = start;
        for _ in 0..iterations {
            let from_start = [at[0] - start[0], at[1] - start[1]];
            let step = self.step(&best, from_start);
            let next = [at[0] - step[0], at[1] - step[1]];
            let moved = (next[0] - start[0]).abs().max((next[1] - start[1]).abs());
            // A patch that runs away from its start has left the basin that the start was chosen for.
            if !(moved <= PATCH as f32) {
                break;
            }
            let comparison = self.compare(target, x + next[0], y + next[1]);
            if !(comparison.cost < best.cost) {
                break;
            }
            (at, best) = (next, comparison);
            if step[0].abs().max(step[1].abs()) < SETTLED {
                break;
            }
        }
        (at, best.cost)
    }
}

/// Displacements to try, without repetitions.
#[derive(Default)]
struct Candidates {
    trusted: usize,
    list: [[f32; 2]; CANDIDATES],
    count: usize,
}

impl Candidates {
    #[inline(always)]
    fn offer(&mut self, candidate: [f32; 2]) {
        if self.count == CANDIDATES || !(candidate[0] + candidate[1]).is_finite() {
            return;
        }
        for seen in &self.list[..self.count] {
            if (seen[0] - candidate[0]).abs() + (seen[1] - candidate[1]).abs() < SAME_CANDIDATE {
                return;
            }
        }
        self.list[self.count] = candidate;
        self.count += 1;
    }
}

simd_kernel! {
    /// Matches every patch of `reference` in `target`.
    ///
    /// Candidates of a patch are the fields of `guesses` at its centre, zero, and what its neighbours found: those
    /// left and above in the first pass, those right and below in the second.
    pub(super) fn search<const C: usize>(
        reference: &Planes<C>, target: &Planes<C>, guesses: &[Guess<'_>],
        seeds: Option<Guess<'_>>, iterations: u32, field: &mut PatchField,
    ) = search_kernel
}

#[inline(always)]
fn search_kernel<S: Simd, const C: usize>(
    reference: &Planes<C>,
    target: &Planes<C>,
    guesses: &[Guess<'_>],
    seeds: Option<Guess<'_>>,
    iterations: u32,
    field: &mut PatchField,
) {
    let (columns, rows) = (field.columns, field.ys.len());
    for j in 0..rows {
        for i in 0..columns {
            let at = j * columns + i;
            let (x, y) = (field.xs[i], field.ys[j]);
            let centre = [
                (x + PATCH / 2).min(reference.width - 1) as f32 + 0.5,
                (y + PATCH / 2).min(reference.height - 1) as f32 + 0.5,
            ];
            let mut candidates = Candidates::default();
            for guess in guesses {
                candidates.offer(guess.at(centre[0], centre[1]));
            }
            candidates.offer([0.0; 2]);
            let neighbours = [(i > 0, 1), (j > 0, columns), (i > 0 && j > 0, columns + 1)];
            for (exists, back) in neighbours {
                if exists {
                    candidates.offer(field.displacement[at - back]);
                }
            }
            candidates.trusted = candidates.count;
            if let Some(seeds) = seeds {
                candidates.offer(seeds.at(centre[0], centre[1]));
            }
            let template = Template::<S, C>::new(reference, x, y);
            let corner = [x as f32, y as f32];
            (field.displacement[at], field.cost[at]) =
                template.improve(target, corner, &candidates, None, iterations);
        }
    }
    for j in (0..rows).rev() {
        for i in (0..columns).rev() {
            let at = j * columns + i;
            let mut candidates = Candidates::default();
            candidates.offer(field.displacement[at]);
            let (right, below) = (i + 1 < columns, j + 1 < rows);
            let neighbours = [(right, 1), (below, columns), (right && below, columns + 1)];
            for (exists, ahead) in neighbours {
                if exists {
                    candidates.offer(field.displacement[at + ahead]);
                }
            }
            if candidates.count == 1 {
                continue;
            }
            candidates.trusted = candidates.count;
            let template = Template::<S, C>::new(reference, field.xs[i], field.ys[j]);
            let corner = [field.xs[i] as f32, field.ys[j] as f32];
            (field.displacement[at], field.cost[at]) =
                template.improve(target, corner, &candidates, Some(field.cost[at]), iterations);
        }
    }
}
