//! The sums behind footprint moments, block by block.
//!
//! What a pixel says does not depend on the footprint that sees it: its position and its track, both relative to the
//! block, make one row of sixteen features. The sums of a footprint over a block are then the product of its sixteen
//! weights with that matrix, one multiplication and addition of a whole group per pixel. Features are relative to the
//! block's centre and to a displacement that occurs in it, so that single precision suffices; sums over blocks are taken
//! in double precision.

use super::{
    FARTHEST, SIGMA_MAX, SIGMA_MIN,
    blend::{BATCH, Open},
    blocks::{BLOCK, BLOCKS, BandView, Listed, TILE, TileLists, corner},
    tile::{Offsets, Tile},
};
use crate::{
    motion::reweighting::ExpectedMotion,
    simd::{Group, LANES, ROWS, Simd, prefetch, simd_kernel},
    tracking::TrackField,
};

/// A pixel's features, in the order of the columns of [`BlockTracks::features`] and of [`Sums`]: with `r` the inverse
/// variance of its track, `u, v` its position and `a, b` its displacement.
pub(super) mod feature {
    /// `r`; then `ru`, `rv`, `ra`, `rb`.
    pub(crate) const WEIGHT: usize = 0;
    /// First of `ru`, `rv`.
    pub(crate) const POSITION: usize = 1;
    /// First of `ruu`, `ruv`, `rvv`.
    pub(crate) const SOURCE: usize = 5;
    /// First of `rau`, `rav`, `rbu`, `rbv`.
    pub(crate) const CROSS: usize = 8;
    /// First of `raa`, `rbb`.
    pub(crate) const POWER: usize = 12;
    /// One where the track can be used.
    pub(crate) const VISIBLE: usize = 14;
    /// One.
    pub(crate) const BLEND_WEIGHT: usize = 15;
}

/// Sums of one footprint over its pixels, in image coordinates: blending weight `alpha · T` times each [`feature`], and
/// two more. Plain numbers, so that a list of zeros costs nothing until it is touched.
pub(super) type Sums = [f64; SUMS];
const SUMS: usize = LANES + 2;
/// `(alpha · T · r)²`.
pub(super) const WEIGHT_SQUARED: usize = LANES;
/// Pixels with a usable track.
pub(super) const PIXELS: usize = LANES + 1;

/// Adds a block's sums, which are relative to its centre and reference, by the parallel-axis theorem.
#[inline(always)]
fn add_block(sums: &mut Sums, relative: &[f32; LANES], shift: &Shift) {
    let (mut m, mut linear) = ([0.0; LANES], [0.0; LANES]);
    for k in 0..LANES {
        m[k] = f64::from(relative[k]);
        linear[k] = m[k];
    }
    for k in 0..FACTORS {
        linear[k] += shift.of_weight[k] * m[0];
    }
    for k in 0..LANES {
        let of_products = shift.relative[k] * m[SECOND[k]] + shift.shifted[k] * linear[FIRST[k]];
        sums[k] += linear[k] + of_products;
    }
}

/// The features of at most one factor, rounded up to half a group.
const FACTORS: usize = LANES / 2;
/// Of each feature that is a product of two, the first; any other feature for those that are not.
const FIRST: [usize; LANES] = [0, 0, 0, 0, 0, 1, 1, 2, 1, 2, 1, 2, 3, 4, 0, 0];
/// The second.
const SECOND: [usize; LANES] = [0, 0, 0, 0, 0, 1, 2, 2, 3, 3, 4, 4, 3, 4, 0, 0];

/// Factors of the parallel-axis theorem: with `p, q` relative to `P, Q`, a sum of `(p + P)(q + Q)` is that of `pq`, plus
/// `P` times that of `q`, plus `Q` times that of `p + P`.
#[derive(Clone, Debug, Default)]
struct Shift {
    /// Per feature of one factor: its shift.
    of_weight: [f64; FACTORS],
    /// Per product: the shift of its first factor.
    relative: [f64; LANES],
    /// Per product: the shift of its second factor.
    shifted: [f64; LANES],
}

impl Shift {
    fn new(centre: [f64; 2], reference: [f64; 2]) -> Self {
        let by = [0.0, centre[0], centre[1], reference[0], reference[1]];
        let mut shift = Self::default();
        shift.of_weight[..by.len()].copy_from_slice(&by);
        for k in 0..LANES {
            shift.relative[k] = by[FIRST[k]];
            shift.shifted[k] = by[SECOND[k]];
        }
        shift
    }
}

/// What the tracks say on one block.
#[derive(Default)]
struct BlockTracks {
    /// Block centre, pixels.
    centre: [f64; 2],
    /// Displacement that the block's displacements are relative to.
    reference: [f64; 2],
    /// `1 / σ²` per pixel, zero where the track cannot be used.
    precision: [f32; LANES],
    /// Displacement per axis and pixel, relative to the reference; zero where the track cannot be used.
    displacement: [[f32; LANES]; 2],
    /// Per pixel its features, positions relative to the block's centre and displacements to the reference.
    features: [[f32; LANES]; LANES],
    shift: Shift,
}

/// Offsets of a block's pixels from its centre.
fn offset(lane: usize) -> [f32; 2] {
    let middle = (BLOCK as f32 - 1.0) / 2.0;
    [(lane % BLOCK) as f32 - middle, (lane / BLOCK) as f32 - middle]
}

impl BlockTracks {
    /// Takes the tracks of another block.
    fn reset(&mut self, band: &BandView<'_>, tile: usize, block: usize, tracks: &TrackField) {
        let (column, row) = corner(block);
        let half = BLOCK as f64 / 2.0;
        self.centre = [(tile * TILE + column) as f64 + half, (band.first_row() + row) as f64 + half];
        self.precision = [0.0; LANES];
        self.displacement = [[0.0; LANES]; 2];
        self.features = [[0.0; LANES]; LANES];
        let first = band.first_row() * band.width;
        let mut usable = [(0, [0.0; 2]); LANES];
        let mut count = 0;
        for (lane, place) in band.pixels(tile, block) {
            self.features[lane][feature::BLEND_WEIGHT] = 1.0;
            let pixel = first + place;
            let [x, y] = tracks.positions[pixel].map(f64::from);
            let [u, v] = offset(lane).map(f64::from);
            let displacement = [x - (self.centre[0] + u), y - (self.centre[1] + v)];
            let sigma = tracks.sigma[pixel];
            let is_near = displacement[0].abs() <= FARTHEST && displacement[1].abs() <= FARTHEST;
            // Comparisons with NaN are false.
            if tracks.visible[pixel] && sigma > 0.0 && sigma < f32::INFINITY && is_near {
                self.precision[lane] = sigma.clamp(SIGMA_MIN, SIGMA_MAX).powi(2).recip();
                usable[count] = (lane, displacement);
                count += 1;
            }
        }
        self.set(&usable[..count]);
    }

    fn set(&mut self, usable: &[(usize, [f64; 2])]) {
        if usable.is_empty() {
            return;
        }
        // One that occurs, so that most of a block that straddles two motions, or half of it, is close to it.
        self.reference = usable[usable.len() / 2].1;
        self.shift = Shift::new(self.centre, self.reference);
        for &(lane, displacement) in usable {
            let [u, v] = offset(lane);
            let (a, b) =
                ((displacement[0] - self.reference[0]) as f32, (displacement[1] - self.reference[1]) as f32);
            let r = self.precision[lane];
            self.displacement[0][lane] = a;
            self.displacement[1][lane] = b;
            let (ra, rb) = (r * a, r * b);
            self.features[lane] = [
                r,
                r * u,
                r * v,
                ra,
                rb,
                r * (u * u),
                r * (u * v),
                r * (v * v),
                ra * u,
                ra * v,
                rb * u,
                rb * v,
                ra * a,
                rb * b,
                1.0,
                1.0,
            ];
        }
    }
}

/// An expected motion as a block's pixels need it.
struct LocalMotion {
    /// Relative to the reference.
    displacement: [f32; 2],
    /// Exponent to base 2 per squared residual.
    fall: f32,
}

impl LocalMotion {
    #[inline(always)]
    fn new(motion: &ExpectedMotion, tracks: &BlockTracks) -> Self {
        let [x, y] = motion.displacement;
        Self {
            displacement: [(x - tracks.reference[0]) as f32, (y - tracks.reference[1]) as f32],
            fall: (motion.inverse_scale_squared * std::f64::consts::LOG2_E) as f32,
        }
    }

    /// The share of each pixel's weight that its residual leaves.
    #[inline(always)]
    fn share<S: Simd>(&self, tracks: &BlockTracks) -> S {
        let mut squared = S::splat(0.0);
        for axis in 0..2 {
            let residual = S::load(&tracks.displacement[axis]).sub(S::splat(self.displacement[axis]));
            squared = residual.mul_add(residual, squared);
        }
        // Below, the power may be anything.
        squared.mul(S::splat(-self.fall)).max(S::splat(-126.0)).exp2()
    }
}

/// The slot of an entry that has none.
pub(super) const NONE: u32 = u32::MAX;

/// What a band's sums are made with, kept from band to band.
#[derive(Default)]
pub(super) struct Scratch {
    lists: TileLists,
    tile: Tile,
    /// Per block of the band, what its pixels let through, see [`Open`].
    open: Vec<[f32; LANES]>,
    of_block: BlockTracks,
    live: Live,
}

/// Which sums a footprint adds to.
#[derive(Clone, Copy)]
pub(super) struct Slots<'a> {
    /// Per footprint of the band its number among the expected motions, or [`NONE`]; not used if none is expected.
    pub of_footprint: &'a [u32],
    /// By which the footprints' pixels are reweighted. None: every footprint has sums, unweighted.
    pub expected: &'a [ExpectedMotion],
}

impl Slots<'_> {
    #[inline(always)]
    fn of(&self, footprint: usize) -> u32 {
        if self.expected.is_empty() { footprint as u32 } else { self.of_footprint[footprint] }
    }
}

simd_kernel! {
    /// Adds the band's shares to `sums`: one for each of its footprints or, if motions are expected, one for each of those.
    pub(super) fn add_moments(
        scratch: &mut Scratch,
        band: &BandView<'_>,
        tracks: &TrackField,
        slots: Slots<'_>,
        sums: &mut [Sums],
    ) = moments_kernel
}

#[inline(always)]
fn moments_kernel<S: Simd>(
    scratch: &mut Scratch,
    band: &BandView<'_>,
    tracks: &TrackField,
    slots: Slots<'_>,
    sums: &mut [Sums],
) {
    scratch.open.clear();
    for number in 0..band.tiles() * BLOCKS {
        let mut inside = [0.0; LANES];
        band.pixels(number / BLOCKS, number % BLOCKS).for_each(|(lane, _)| inside[lane] = 1.0);
        scratch.open.push(inside);
    }
    let mut first = 0;
    while first < band.footprints() {
        scratch.lists.fill::<S>(band, first);
        for tile in 0..band.tiles() {
            scratch.tile.gather(&scratch.lists, tile, band.centre(tile));
            for block in 0..BLOCKS {
                scratch.add_block::<S>(band, [tile, block], tracks, first, slots, sums);
            }
        }
        first += scratch.lists.entries.len();
    }
}

impl Scratch {
    /// One block in the round that begins with footprint `first`.
    #[inline(always)]
    fn add_block<S: Simd>(
        &mut self,
        band: &BandView<'_>,
        [tile, block]: [usize; 2],
        tracks: &TrackField,
        first: usize,
        slots: Slots<'_>,
        sums: &mut [Sums],
    ) {
        let Self { lists, tile: seen, open, of_block, live } = self;
        let count = seen.list::<S>(block);
        let listed = lists.of(tile);
        let slot_of = Places { listed, first, slots };
        let stored = &mut open[tile * BLOCKS + block];
        let mut open = Open::<S>::load(stored);
        let list = seen.listed(count);
        // What lies behind the last footprint that has sums matters to a later round only.
        let is_last = first + lists.entries.len() == band.footprints();
        let end = if slots.expected.is_empty() || !is_last {
            list.len()
        } else {
            list.iter().rposition(|&place| slot_of.of(place) != NONE).map_or(0, |last| last + 1)
        };
        if end == 0 || !open.is_any() {
            return;
        }
        of_block.reset(band, tile, block, tracks);
        live.block_moments::<S>(seen, block, &list[..end], of_block, slot_of, &mut open, sums);
        open.store(stored);
    }
}

/// From a place in a tile's list to the sums of its footprint.
#[derive(Clone, Copy)]
struct Places<'a> {
    listed: &'a [Listed],
    first: usize,
    slots: Slots<'a>,
}

impl Places<'_> {
    #[inline(always)]
    fn of(&self, place: u32) -> u32 {
        self.slots.of(self.first + self.listed[place as usize].place())
    }
}

/// The slots of a batch's entries that a block's pixels see, and their weights: kept in memory, from where a weight reaches all
/// lanes in one instruction.
#[derive(Default)]
struct Live {
    count: usize,
    slots: [u32; BATCH],
    weights: [Group; BATCH],
}

impl Live {
    #[inline(always)]
    fn block_moments<S: Simd>(
        &mut self,
        tile: &Tile,
        block: usize,
        list: &[u32],
        tracks: &BlockTracks,
        places: Places<'_>,
        open: &mut Open<S>,
        sums: &mut [Sums],
    ) {
        let zero = S::splat(0.0);
        let at = Offsets::<S>::new(block);
        let mut features = [zero; LANES];
        for (feature, values) in features.iter_mut().zip(&tracks.features) {
            *feature = S::load(values);
        }
        let mut alphas = [zero; BATCH];
        for (number, batch) in list.chunks(BATCH).enumerate() {
            for &later in list.iter().skip((number + 1) * BATCH).take(BATCH) {
                if let Some(sums) = sums.get(places.of(later) as usize) {
                    prefetch(sums);
                }
            }
            for (alpha, &place) in alphas.iter_mut().zip(batch) {
                *alpha = tile.seen[place as usize].alpha(&at);
            }
            self.count = 0;
            for (&alpha, &place) in alphas.iter().zip(batch) {
                let (mut weight, _) = open.pass(alpha);
                if !S::any(zero.lt(weight)) {
                    continue;
                }
                let slot = places.of(place);
                if slot == NONE {
                    continue;
                }
                if let Some(motion) = places.slots.expected.get(slot as usize) {
                    weight = weight.mul(LocalMotion::new(motion, tracks).share(tracks));
                }
                weight.store(&mut self.weights[self.count].0);
                self.slots[self.count] = slot;
                self.count += 1;
            }
            self.add::<S>(tracks, &features, sums);
            if !open.is_any() {
                break;
            }
        }
    }

    #[inline(always)]
    fn add<S: Simd>(&self, tracks: &BlockTracks, features: &[S; LANES], sums: &mut [Sums]) {
        let (zero, one) = (S::splat(0.0), S::splat(1.0));
        let precision = S::load(&tracks.precision);
        for first in (0..self.count).step_by(ROWS) {
            // What lies beyond the count is of earlier batches, and not used.
            let (mut squares, mut counts) = ([zero; ROWS], [zero; ROWS]);
            for slot in 0..ROWS {
                let reliable = S::load(&self.weights[first + slot].0).mul(precision);
                squares[slot] = reliable.mul(reliable);
                counts[slot] = S::select(zero.lt(reliable), one, zero);
            }
            let (mut by_row, mut counted) = ([0.0; LANES], [0.0; LANES]);
            S::row_sums(squares).store(&mut by_row);
            S::row_sums(counts).store(&mut counted);
            for slot in 0..ROWS.min(self.count - first) {
                let weights = &self.weights[first + slot].0;
                let mut parts = [zero; 4];
                for lane in 0..LANES {
                    parts[lane % 4] = S::splat(weights[lane]).mul_add(features[lane], parts[lane % 4]);
                }
                let mut values = [0.0; LANES];
                parts[0].add(parts[1]).add(parts[2].add(parts[3])).store(&mut values);
                let sums = &mut sums[self.slots[first + slot] as usize];
                add_block(sums, &values, &tracks.shift);
                sums[WEIGHT_SQUARED] += f64::from(column_sum(&by_row, slot));
                sums[PIXELS] += f64::from(column_sum(&counted, slot));
            }
        }
    }
}

#[inline(always)]
fn column_sum(rows: &[f32; LANES], column: usize) -> f32 {
    (rows[column] + rows[ROWS + column]) + (rows[2 * ROWS + column] + rows[3 * ROWS + column])
}
