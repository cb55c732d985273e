//! The footprints of one tile, close together in memory, and which of them each of its blocks sees.

use super::{
    ALPHA_MAX,
    blocks::{Entry, Listed, TILE, TileLists, corner},
};
use crate::simd::{LANES, ROWS, Simd, prefetch};

/// Logarithm to base 2 of [`super::ALPHA_MIN`]: thresholds in the exponent are those of the power.
const LOG2_ALPHA_MIN: f32 = -7.994_353_4;

/// Listed footprints whose memory is asked for ahead.
const AHEAD: usize = 32;

/// Column and row of each lane within a block.
pub(super) const COLUMNS: [f32; LANES] = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
const LANE_ROWS: [f32; LANES] = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];

/// A footprint seen from a tile.
///
/// Alpha at offset `(x, y)` from the tile's centre is `2^(peak - curvature · (x + d - slope · y)² - fall · (y + dy)²)`.
/// Offsets from the centre cost no digits: where alpha is not negligible, and on the rest of the tile, the terms of
/// `x + d - slope · y` are within some thirty times the footprint's extent along a row, as no footprint is smaller than a
/// pixel.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(16))]
pub(super) struct Seen {
    /// Offset of the centre from the row centre of its row; offset of the centre from the mean's row; minus the row centre
    /// shift per row; minus the curvature.
    pub frame: [f32; ROWS],
    /// Minus the fall.
    pub fall: f32,
    pub peak: f32,
    pub colour: [f32; 3],
    /// Whether its gradient is wanted.
    pub is_active: bool,
}

impl Seen {
    /// In double precision, as a needle's row centre is a small difference of large numbers.
    #[inline(always)]
    fn new(entry: &Entry, [x, y]: [f64; 2]) -> Self {
        let dy = y - entry.mean[1];
        let d = (x - entry.mean[0]) - entry.slope * dy;
        Self {
            frame: [d as f32, dy as f32, -entry.slope as f32, -entry.curvature],
            fall: -entry.fall,
            peak: entry.peak,
            colour: entry.colour,
            is_active: entry.is_active,
        }
    }

    /// Alpha of a block's pixels; zero where it is less than the least that is seen.
    #[inline(always)]
    pub(super) fn alpha<S: Simd>(&self, at: &Offsets<S>) -> S {
        let [d, dy, slope, curvature] = self.frame;
        let d = at.y.mul_add(S::splat(slope), at.x.add(S::splat(d)));
        let dy = at.y.add(S::splat(dy));
        let across = dy.mul(S::splat(self.fall)).mul_add(dy, S::splat(self.peak));
        let exponent = d.mul(S::splat(curvature)).mul_add(d, across);
        // The power of what lies far below the threshold may be anything.
        let is_seen = exponent.ge(S::splat(LOG2_ALPHA_MIN));
        S::select(is_seen, exponent.exp2().min(S::splat(ALPHA_MAX)), S::splat(0.0))
    }
}

/// Offsets of a block's pixels from the centre of its tile.
pub(super) struct Offsets<S> {
    x: S,
    y: S,
}

impl<S: Simd> Offsets<S> {
    #[inline(always)]
    pub(super) fn new(block: usize) -> Self {
        let [x, y] = first_offset(block);
        Self { x: S::load(&COLUMNS).add(S::splat(x)), y: S::load(&LANE_ROWS).add(S::splat(y)) }
    }
}

/// Offset of a block's first pixel from the centre of its tile.
#[inline(always)]
pub(super) fn first_offset(block: usize) -> [f32; 2] {
    let (column, row) = corner(block);
    [column, row].map(|first| first as f32 + 0.5 - 0.5 * TILE as f32)
}

/// The tile at hand.
#[derive(Clone, Debug, Default)]
pub(super) struct Tile {
    /// Its footprints, nearest first.
    pub seen: Vec<Seen>,
    /// What the lists say of them, filled up with nothing to whole groups of lanes.
    words: Vec<[u32; LANES]>,
    /// Places in `seen` of the block at hand, nearest first, and some more words that mean nothing.
    places: Vec<u32>,
}

impl Tile {
    /// Takes up a tile of a band whose centre is at `centre`, pixels.
    #[inline(always)]
    pub(super) fn gather(&mut self, lists: &TileLists, tile: usize, centre: [f64; 2]) {
        let list = lists.of(tile);
        self.seen.resize(list.len(), Seen::default());
        for (place, (seen, listed)) in self.seen.iter_mut().zip(list).enumerate() {
            if let Some(later) = list.get(place + AHEAD) {
                prefetch(&lists.entries[later.place()]);
            }
            *seen = Seen::new(&lists.entries[listed.place()], centre);
        }
        self.words.clear();
        for group in list.chunks(LANES) {
            let mut words = [0; LANES];
            for (word, listed) in words.iter_mut().zip(group) {
                *word = listed.0;
            }
            self.words.push(words);
        }
        self.places.resize(LANES * self.words.len() + LANES, 0);
    }

    /// Lists the footprints that reach a block; returns their number.
    #[inline(always)]
    pub(super) fn list<S: Simd>(&mut self, block: usize) -> usize {
        let mut count = 0;
        for (group, words) in self.words.iter().enumerate() {
            // A group of lanes may be written behind the end of what is listed so far, which is no more than the groups
            // before this one.
            let Some(to) = self.places[count..].first_chunk_mut() else { break };
            count += S::positions(words, Listed::bit(block), (LANES * group) as u32, to);
        }
        count
    }

    /// The first `count` places in `seen` that [`Tile::list`] listed.
    pub(super) fn listed(&self, count: usize) -> &[u32] {
        &self.places[..count]
    }
}
