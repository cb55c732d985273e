//! Which footprints each tile of 16 × 16 pixels of a band sees, and in which of its blocks of 4 × 4.
//!
//! A footprint of a few pixels touches few blocks, and sixteen pixels are what one group of lanes holds, so that a block's
//! state stays in registers while its footprints are blended. Lists of blocks would be long, and a block is looked at
//! once; so lists are kept per tile, sixteen bits for its blocks with each footprint, and a block's list is picked out of
//! its tile's when its turn comes ([`super::tile`]).
//!
//! A band's footprints are listed in rounds, nearest first, so that lists stay small whatever the scene.

use super::{
    bin::{BAND_ROWS, Bins},
    project::Footprint,
    spans::{Reach, Spans, spans},
};
use crate::simd::{ROWS, Simd, prefetch, simd_kernel};

/// Columns and rows of a block.
pub(super) const BLOCK: usize = 4;

/// Columns and rows of a tile.
pub(super) const TILE: usize = BAND_ROWS;

/// Blocks of a tile, row by row.
pub(super) const BLOCKS: usize = BLOCK_ROWS * BLOCK_ROWS;

/// Groups of footprints whose memory is asked for ahead.
const AHEAD: usize = 8;

/// Rows and columns of blocks of a tile.
pub(super) const BLOCK_ROWS: usize = TILE / BLOCK;

/// What one round of a band's lists may hold.
#[derive(Clone, Copy, Debug)]
pub(super) struct RoundLimit {
    /// Footprints; at most 2¹⁶, as a place among them has sixteen bits.
    pub footprints: usize,
    /// Listed places, each a footprint and a tile; the last four footprints may exceed it.
    pub places: usize,
}

/// More than any but huge scenes need: most bands take one round. Seven MiB of memory per band at most.
impl Default for RoundLimit {
    fn default() -> Self {
        Self { footprints: 1 << 16, places: 1 << 18 }
    }
}

/// A band of rows of the image and what it is made from.
#[derive(Clone, Copy)]
pub(super) struct BandView<'a> {
    pub bins: &'a Bins,
    pub number: usize,
    /// Of the image, pixels.
    pub width: usize,
    pub height: usize,
    /// Gaussians whose gradients are wanted; empty if all are.
    pub active: &'a [bool],
    pub limit: RoundLimit,
}

impl BandView<'_> {
    /// First image row.
    pub(super) fn first_row(&self) -> usize {
        self.number * BAND_ROWS
    }

    /// Rows of the image in the band.
    pub(super) fn rows(&self) -> usize {
        BAND_ROWS.min(self.height - self.first_row())
    }

    pub(super) fn tiles(&self) -> usize {
        self.width.div_ceil(TILE)
    }

    /// Number of footprints.
    pub(super) fn footprints(&self) -> usize {
        self.bins.band(self.number).len()
    }

    /// Centre of a tile that is not cut by the border, pixels.
    pub(super) fn centre(&self, tile: usize) -> [f64; 2] {
        let half = 0.5 * TILE as f64;
        [(tile * TILE) as f64 + half, self.first_row() as f64 + half]
    }

    /// Lane and place within the band of each of a block's pixels that lie in the image.
    pub(super) fn pixels(&self, tile: usize, block: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (column, row) = corner(block);
        let (width, column) = (self.width, tile * TILE + column);
        let columns = BLOCK.min(width.saturating_sub(column));
        let rows = BLOCK.min(self.rows().saturating_sub(row));
        (0..rows)
            .flat_map(move |y| (0..columns).map(move |x| (y * BLOCK + x, (row + y) * width + column + x)))
    }
}

/// First column and row of a block within its tile.
pub(super) fn corner(block: usize) -> (usize, usize) {
    ((block % BLOCK_ROWS) * BLOCK, (block / BLOCK_ROWS) * BLOCK)
}

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

/// A footprint in a tile's list: its place among the entries, and in the upper half a bit for each block that it reaches.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Listed(pub u32);

impl Listed {
    pub(super) fn place(self) -> usize {
        (self.0 & 0xFFFF) as usize
    }

    /// What a list's words have set if the footprint reaches the block.
    pub(super) fn bit(block: usize) -> u32 {
        1 << (16 + block)
    }
}

/// The lists of one round of a band.
#[derive(Clone, Debug, Default)]
pub(super) struct TileLists {
    /// The round's footprints, nearest first.
    pub entries: Vec<Entry>,
    /// `listed[starts[t]..starts[t + 1]]` belong to tile `t`.
    starts: Vec<u32>,
    /// Places ascend within a tile.
    listed: Vec<Listed>,
    spans: Vec<Spans>,
    next: Vec<u32>,
}

simd_kernel! {
    /// Lists the footprints of a band from number `first` on, as many as a round holds.
    pub(super) fn fill(lists: &mut TileLists, band: &BandView<'_>, first: usize) = fill_kernel
}

#[inline(always)]
fn fill_kernel<S: Simd>(lists: &mut TileLists, band: &BandView<'_>, first: usize) {
    lists.fill::<S>(band, first);
}

impl TileLists {
    /// See [`fill`]. No sum can wrap: a round ends with the four footprints that reach the limit of its places, and four
    /// footprints reach no more than four rows of tiles, 2³⁰ at most.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(&mut self, band: &BandView<'_>, first: usize) {
        self.entries.clear();
        self.spans.clear();
        // Counts: +1 where a span begins and -1 behind its end, summed up along the row of tiles afterwards.
        self.starts.clear();
        self.starts.resize(band.tiles() + 2, 0);
        let indices = &band.bins.band(band.number)[first..];
        let indices = &indices[..indices.len().min(band.limit.footprints)];
        let footprints = &band.bins.projection.footprints;
        let mut places = 0;
        for (group, indices_of_group) in indices.chunks(ROWS).enumerate() {
            if places >= band.limit.places {
                break;
            }
            // Depth order is no order in memory.
            for &index in indices.iter().skip((group + AHEAD) * ROWS).take(ROWS) {
                prefetch(&footprints[index as usize]);
            }
            let mut reaches = [Reach::default(); ROWS];
            for (reach, &index) in reaches.iter_mut().zip(indices_of_group) {
                let footprint = &footprints[index as usize];
                let is_active = band.active.get(index as usize).copied().unwrap_or(true);
                self.entries.push(Entry::new(footprint, is_active));
                *reach = Reach::new(footprint, band.first_row());
            }
            let spans = spans::<S>(&reaches, band.rows(), band.width);
            for spans in &spans[..indices_of_group.len()] {
                let tiles = spans.tiles();
                places += tiles.len();
                self.starts[tiles.start + 1] = self.starts[tiles.start + 1].wrapping_add(1);
                self.starts[tiles.end + 1] = self.starts[tiles.end + 1].wrapping_sub(1);
                self.spans.push(*spans);
            }
        }
        self.accumulate();
        self.distribute();
    }

    /// Turns differences along the row of tiles into where each tile's list starts.
    #[inline(always)]
    fn accumulate(&mut self) {
        let (mut open, mut start) = (0u32, 0u32);
        for slot in &mut self.starts {
            open = open.wrapping_add(*slot);
            start = start.wrapping_add(open);
            *slot = start;
        }
        self.starts.pop();
    }

    #[inline(always)]
    fn distribute(&mut self) {
        let total = self.starts.last().copied().unwrap_or(0);
        self.listed.resize(total as usize, Listed::default());
        self.next.clone_from(&self.starts);
        for (place, spans) in self.spans.iter().enumerate() {
            for tile in spans.tiles() {
                let next = &mut self.next[tile];
                self.listed[*next as usize] = Listed(spans.blocks(tile) << 16 | place as u32);
                *next += 1;
            }
        }
    }

    /// Asks for the memory of the entries, which lie in a row; the tiles' lists pick from all of it.
    #[inline(always)]
    pub(super) fn prefetch(&self) {
        self.entries.iter().for_each(prefetch);
    }

    /// A tile's list, nearest first.
    pub(super) fn of(&self, tile: usize) -> &[Listed] {
        &self.listed[self.starts[tile] as usize..self.starts[tile + 1] as usize]
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
    fn blocks_by_rows(
        footprint: &Footprint,
        number: usize,
        width: usize,
        height: usize,
    ) -> Vec<(usize, usize)> {
        let row_of_blocks = |row: usize| row / BLOCK * BLOCK_ROWS;
        let first = number * BAND_ROWS;
        let count = BAND_ROWS.min(height - first);
        let mut blocks: Vec<(usize, usize)> = rows::rows(footprint, first, count)
            .filter_map(|row| Some((row, rows::span(footprint, row, width)?)))
            .flat_map(|(row, span)| {
                (span.first / BLOCK..span.end.div_ceil(BLOCK)).map(move |column| {
                    (column / BLOCK_ROWS, column % BLOCK_ROWS + row_of_blocks(row - first))
                })
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
        let mut lists = TileLists::default();
        for number in 0..bins.bands() {
            let limit = RoundLimit::default();
            let band = BandView { bins: &bins, number, width, height, active: &[], limit };
            fill(instructions, &mut lists, &band, 0);
            for (place, &index) in bins.band(number).iter().enumerate() {
                let footprint = &bins.projection.footprints[index as usize];
                let expected = blocks_by_rows(footprint, number, width, height);
                let is_listed = |&(tile, block): &(usize, usize)| {
                    lists.of(tile).iter().any(|at| at.place() == place && at.0 & Listed::bit(block) != 0)
                };
                assert!(expected.iter().all(is_listed), "footprint {index} misses a block of band {number}");
                needed += expected.len();
            }
            for tile in 0..band.tiles() {
                let list = lists.of(tile);
                listed += list.iter().map(|at| (at.0 >> 16).count_ones() as usize).sum::<usize>();
                assert!(list.is_sorted_by_key(|at| at.place()), "nearest first");
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

    #[test]
    fn a_round_holds_no_more_than_its_limit_and_a_row_of_four_giants() {
        let camera = &arc(1, 320, 48)[0];
        let mut gaussians = blobs(1000, 7);
        gaussians.log_scales.fill([3.0; 3]);
        gaussians.logit_opacities.fill(0.0);
        let mut bins = Bins::default();
        project(Instructions::detect(), &gaussians, camera, 0, &mut bins.projection);
        bins.sort(camera.height, &mut Vec::new());
        let limit = RoundLimit { footprints: 300, places: 500 };
        let view = BandView { bins: &bins, number: 1, width: 320, height: 48, active: &[], limit };
        assert!(view.footprints() * view.tiles() > 19_000, "all of them reach all tiles");
        let mut lists = TileLists::default();
        let mut first = 0;
        while first < view.footprints() {
            fill(Instructions::detect(), &mut lists, &view, first);
            assert!(!lists.entries.is_empty() && lists.entries.len() <= limit.footprints);
            assert!(lists.listed.len() < limit.places + ROWS * view.tiles(), "{}", lists.listed.len());
            for (place, entry) in lists.entries.iter().enumerate() {
                let index = bins.band(1)[first + place] as usize;
                assert_eq!(entry.mean, bins.projection.footprints[index].mean, "none is left out");
            }
            first += lists.entries.len();
        }
        assert_eq!(first, view.footprints());
    }
}
