//! Which footprints each block of 4 × 4 pixels of a band sees.
//!
//! Lists per block instead of per tile of 16 × 16: a footprint of a few pixels touches few blocks, and sixteen pixels
//! are what one group of lanes holds, so that a block's state stays in registers while its list is blended.

use super::{
    bin::{BAND_ROWS, Bins},
    project::Footprint,
};
use crate::simd::{LANES, ROWS, Simd, prefetch, simd_kernel};

/// Columns and rows of a block.
pub(super) const BLOCK: usize = 4;

/// Groups of footprints whose memory is asked for ahead.
const AHEAD: usize = 4;

const BLOCK_ROWS: usize = BAND_ROWS / BLOCK;

/// A footprint as the kernels read it, on one cache line.
///
/// Alpha at offset `(ex, ey)` from the mean is `2^(peak - curvature · (ex - slope · ey)² - fall · ey²)`.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(super) struct Entry {
    /// Projected mean, pixels.
    pub mean: [f64; 2],
    /// Row centre shift per row.
    pub slope: f64,
    pub curvature: f32,
    pub fall: f32,
    /// Logarithm to base 2 of the opacity.
    pub peak: f32,
    pub colour: [f32; 3],
    /// Whether its gradient is wanted.
    pub is_active: bool,
}

impl Entry {
    #[inline(always)]
    fn new(footprint: &Footprint, is_active: bool) -> Self {
        use std::f64::consts::LOG2_E;
        Self {
            mean: footprint.mean,
            slope: footprint.slope,
            curvature: (0.5 * footprint.inverse_conditional * LOG2_E) as f32,
            fall: (0.5 * footprint.inverse_yy * LOG2_E) as f32,
            peak: (footprint.log_opacity * LOG2_E) as f32,
            colour: footprint.colour,
            is_active,
        }
    }
}

/// The lists of one band's blocks; blocks are counted down each column of blocks, then to the right, so that
/// neighbours in the list are neighbours in the image.
#[derive(Clone, Debug, Default)]
pub(super) struct BlockLists {
    /// The band's footprints, nearest first.
    pub entries: Vec<Entry>,
    /// `listed[starts[b]..starts[b + 1]]` belong to block `b`.
    starts: Vec<u32>,
    /// Places in `entries`, ascending within a block.
    listed: Vec<u32>,
    spans: Vec<Spans>,
    next: Vec<u32>,
}

/// Columns of blocks that a footprint reaches, per row of blocks: from `first` to before `end`.
#[derive(Clone, Copy, Debug)]
struct Spans {
    first: [u32; BLOCK_ROWS],
    end: [u32; BLOCK_ROWS],
}

simd_kernel! {
    /// Lists the footprints of band `number` of a `width × height` image; `active` is empty if all are.
    pub(super) fn fill(
        lists: &mut BlockLists,
        bins: &Bins,
        number: usize,
        width: usize,
        height: usize,
        active: &[bool],
    ) = fill_kernel
}

#[inline(always)]
fn fill_kernel<S: Simd>(
    lists: &mut BlockLists,
    bins: &Bins,
    number: usize,
    width: usize,
    height: usize,
    active: &[bool],
) {
    lists.fill::<S>(bins, number, width, height, active);
}

impl BlockLists {
    #[inline(always)]
    fn fill<S: Simd>(&mut self, bins: &Bins, number: usize, width: usize, height: usize, active: &[bool]) {
        let first_row = number * BAND_ROWS;
        let rows = BAND_ROWS.min(height - first_row);
        let columns = width.div_ceil(BLOCK);
        self.entries.clear();
        self.spans.clear();
        // Counts: +1 where a span begins and -1 behind its end, summed up along the row of blocks afterwards.
        self.starts.clear();
        self.starts.resize((columns + 1) * BLOCK_ROWS + 1, 0);
        let indices = bins.band(number);
        for (group, indices_of_group) in indices.chunks(ROWS).enumerate() {
            // Depth order is no order in memory.
            for &index in indices.iter().skip((group + AHEAD) * ROWS).take(ROWS) {
                prefetch(&bins.projection.footprints[index as usize]);
            }
            let mut reaches = Reaches::default();
            for (slot, &index) in indices_of_group.iter().enumerate() {
                let footprint = &bins.projection.footprints[index as usize];
                let is_active = active.get(index as usize).copied().unwrap_or(true);
                self.entries.push(Entry::new(footprint, is_active));
                reaches.set(slot, footprint, first_row);
            }
            let spans = reaches.spans::<S>(rows, width);
            for spans in &spans[..indices_of_group.len()] {
                for row in 0..BLOCK_ROWS {
                    let start = |column: u32| column as usize * BLOCK_ROWS + row + 1;
                    let (first, end) = (start(spans.first[row]), start(spans.end[row]));
                    self.starts[first] = self.starts[first].wrapping_add(1);
                    self.starts[end] = self.starts[end].wrapping_sub(1);
                }
                self.spans.push(*spans);
            }
        }
        self.accumulate(columns);
        self.distribute();
    }

    /// Turns differences along each row of blocks into where each block's list starts.
    #[inline(always)]
    fn accumulate(&mut self, columns: usize) {
        let mut open = [0u32; BLOCK_ROWS];
        let mut start = 0u32;
        for column in 0..columns {
            for row in 0..BLOCK_ROWS {
                let slot = &mut self.starts[column * BLOCK_ROWS + row + 1];
                open[row] = open[row].wrapping_add(*slot);
                start += open[row];
                *slot = start;
            }
        }
        self.starts.truncate(columns * BLOCK_ROWS + 1);
    }

    #[inline(always)]
    fn distribute(&mut self) {
        let total = self.starts.last().copied().unwrap_or(0);
        self.listed.resize(total as usize, 0);
        self.next.clone_from(&self.starts);
        for (place, spans) in self.spans.iter().enumerate() {
            for row in 0..BLOCK_ROWS {
                for column in spans.first[row]..spans.end[row] {
                    let next = &mut self.next[column as usize * BLOCK_ROWS + row];
                    self.listed[*next as usize] = place as u32;
                    *next += 1;
                }
            }
        }
    }

    /// Number of blocks, those below the image included.
    pub(super) fn blocks(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Places in `entries` of a block's footprints, nearest first.
    pub(super) fn of(&self, block: usize) -> &[u32] {
        &self.listed[self.starts[block] as usize..self.starts[block + 1] as usize]
    }
}

/// First column of a block, and its first row within the band.
pub(super) fn corner(block: usize) -> (usize, usize) {
    ((block / BLOCK_ROWS) * BLOCK, (block % BLOCK_ROWS) * BLOCK)
}

/// The ellipses inside which the alphas of four footprints can reach the threshold. Each row of lanes is a footprint, each
/// lane in it a row of blocks of the band.
#[derive(Default)]
struct Reaches {
    /// Mean, pixels; `y` from the band's first row.
    x: [f32; LANES],
    y: [f32; LANES],
    slope: [f32; LANES],
    /// `2 · variance along a row`, and what the exponent may still fall there.
    double_conditional: [f32; LANES],
    reach: [f32; LANES],
    /// Root of half the inverse variance across rows: squared with the offset, so that neither overflows alone.
    fall: [f32; LANES],
    half_height: [f32; LANES],
    row_of_rightmost: [f32; LANES],
}

impl Reaches {
    #[inline(always)]
    fn set(&mut self, slot: usize, footprint: &Footprint, first_row: usize) {
        let [x, y] = footprint.mean;
        let fields = [
            (&mut self.x, x),
            (&mut self.y, y - first_row as f64),
            (&mut self.slope, footprint.slope),
            (&mut self.double_conditional, 2.0 * footprint.conditional),
            (&mut self.reach, footprint.reach),
            (&mut self.fall, (0.5 * footprint.inverse_yy).sqrt()),
            (&mut self.half_height, footprint.half_height),
            (&mut self.row_of_rightmost, footprint.row_of_rightmost),
        ];
        for (lanes, value) in fields {
            lanes[slot * BLOCK_ROWS..][..BLOCK_ROWS].fill(value as f32);
        }
    }

    /// Columns of blocks per footprint. In a row of blocks the rightmost point is the ellipse's rightmost point of all, or
    /// lies on that row's edge towards it; the leftmost likewise. Margins cover the rounding of single precision, here
    /// and in the kernel's alpha: the kernel itself decides at the threshold.
    #[inline(always)]
    fn spans<S: Simd>(&self, rows: usize, width: usize) -> [Spans; ROWS] {
        let mut edges = [[0.0; LANES]; 2];
        for lane in 0..LANES {
            let row = lane % BLOCK_ROWS;
            edges[0][lane] = (row * BLOCK) as f32 + 0.5;
            edges[1][lane] = ((row + 1) * BLOCK).min(rows) as f32 - 0.5;
        }
        let (zero, small) = (S::splat(0.0), S::splat(4e-6));
        let half_height = S::load(&self.half_height);
        let height = half_height.mul_add(small, half_height).add(S::splat(1e-3));
        let y = S::load(&self.y);
        let above = S::load(&edges[0]).sub(y).max(zero.sub(height));
        let below = S::load(&edges[1]).sub(y).min(height);
        let (x, slope, rightmost) = (S::load(&self.x), S::load(&self.slope), S::load(&self.row_of_rightmost));
        let half = |dy: S| {
            let root = dy.mul(S::load(&self.fall));
            S::load(&self.reach).sub(root.mul(root)).max(zero).mul(S::load(&self.double_conditional)).sqrt()
        };
        let (left_row, right_row) =
            (zero.sub(rightmost).max(above).min(below), rightmost.max(above).min(below));
        let (left_shift, right_shift) = (slope.mul(left_row), slope.mul(right_row));
        let (left_half, right_half) = (half(left_row), half(right_row));
        let magnitude = x.mul(x).add(left_shift.mul(left_shift)).add(right_shift.mul(right_shift));
        let magnitude = magnitude.add(left_half.mul(left_half)).add(right_half.mul(right_half)).sqrt();
        let margin = magnitude.mul_add(small, S::splat(1e-3 + 0.5));
        let low = x.add(left_shift).sub(left_half).sub(margin);
        let high = x.add(right_shift).add(right_half).add(margin).sub(S::splat(1.0));
        let low = low.ceil().max(zero);
        let high = high.floor().min(S::splat(width as f32 - 1.0));
        let is_reached = S::both(below.ge(above), high.ge(low));
        let quarter = S::splat(1.0 / BLOCK as f32);
        let (mut first, mut last) = ([0; LANES], [0; LANES]);
        S::select(is_reached, low.mul(quarter).floor(), zero).store_integers(&mut first);
        S::select(is_reached, high.mul(quarter).floor(), S::splat(-1.0)).store_integers(&mut last);
        let mut spans = [Spans { first: [0; BLOCK_ROWS], end: [0; BLOCK_ROWS] }; ROWS];
        for lane in 0..LANES {
            let spans = &mut spans[lane / BLOCK_ROWS];
            spans.first[lane % BLOCK_ROWS] = first[lane] as u32;
            spans.end[lane % BLOCK_ROWS] = (last[lane] + 1) as u32;
        }
        spans
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        cameras::Camera,
        gaussians::Gaussians,
        raster::{project::project, rows},
        simd::Instructions,
        testing::{arc, blobs},
    };

    /// Blocks that hold a pixel on which the footprint reaches the threshold, by the span of every row.
    fn blocks_by_rows(footprint: &Footprint, number: usize, width: usize, height: usize) -> Vec<usize> {
        let first = number * BAND_ROWS;
        let count = BAND_ROWS.min(height - first);
        let mut blocks: Vec<usize> = rows::rows(footprint, first, count)
            .filter_map(|row| Some((row, rows::span(footprint, row, width)?)))
            .flat_map(|(row, span)| {
                (span.first / BLOCK..span.end.div_ceil(BLOCK))
                    .map(move |column| column * BLOCK_ROWS + (row - first) / BLOCK)
            })
            .collect();
        blocks.sort_unstable();
        blocks.dedup();
        blocks
    }

    /// Listed and needed blocks of all bands; fails if a needed one is not listed.
    fn listed_and_needed(gaussians: &Gaussians, camera: &Camera, instructions: Instructions) -> [usize; 2] {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut bins = Bins::default();
        project(instructions, gaussians, camera, 0, &mut bins.projection);
        bins.sort(camera.height, &mut Vec::new());
        let (mut listed, mut needed) = (0, 0);
        let mut lists = BlockLists::default();
        for number in 0..bins.bands() {
            fill(instructions, &mut lists, &bins, number, width, height, &[]);
            for (place, &index) in bins.band(number).iter().enumerate() {
                let footprint = &bins.projection.footprints[index as usize];
                let expected = blocks_by_rows(footprint, number, width, height);
                let is_listed = |block: &usize| lists.of(*block).contains(&(place as u32));
                assert!(expected.iter().all(is_listed), "footprint {index} misses a block of band {number}");
                needed += expected.len();
            }
            for block in 0..lists.blocks() {
                listed += lists.of(block).len();
                assert!(lists.of(block).is_sorted(), "nearest first");
            }
        }
        [listed, needed]
    }

    #[test]
    fn every_block_with_a_pixel_in_reach_is_listed_and_few_others() {
        for instructions in Instructions::available() {
            let [listed, needed] = listed_and_needed(&blobs(400, 5), &arc(3, 70, 45)[1], instructions);
            // Rows between two pixel centres may reach a little farther than either.
            assert!(listed < needed + needed / 20, "{listed} listed, {needed} needed");
            assert!(needed > 1000, "the test would show nothing with {needed}");
        }
    }

    #[test]
    fn needles_giants_and_footprints_from_outside_miss_no_block() {
        let mut gaussians = blobs(300, 6);
        for index in 0..gaussians.len() {
            // Standard deviations from 1e-4 to 1e4 of the scene, up to 1e8 apart in one Gaussian.
            let stretch = [index % 5, index / 5 % 5, index / 25 % 5].map(|place| 4.6 * (place as f32 - 2.0));
            gaussians.log_scales[index] = stretch;
            gaussians.means[index] = gaussians.means[index].map(|at| at * [1.0, 3.0, 30.0][index % 3]);
        }
        for (width, height) in [(1, 1), (17, 13), (64, 48), (70, 45)] {
            for instructions in Instructions::available() {
                let [_, needed] = listed_and_needed(&gaussians, &arc(3, width, height)[1], instructions);
                assert!(needed > 50, "{needed} blocks at {width}x{height} are no test");
            }
        }
    }
}
