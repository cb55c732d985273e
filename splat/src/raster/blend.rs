//! Stage 3: front-to-back blending of a band's footprints, round by round, tile by tile and block by block.

use super::{
    TRANSMITTANCE_MIN,
    blend_backward::Replayed,
    blocks::{BLOCKS, BandView, TileLists},
    tile::{Offsets, Seen, Tile},
};
use crate::simd::{LANES, Simd, simd_kernel};

/// What a band of rows of the image holds while a view is rendered and its gradient is taken.
#[derive(Clone, Debug, Default)]
pub(super) struct Band {
    /// Those of the round at hand.
    pub lists: TileLists,
    /// Where each round begins among the band's footprints.
    pub rounds: Vec<usize>,
    /// Per round but the first, block and pixel, the transmittance it starts with, see [`Open`].
    carried: Vec<[f32; LANES]>,
    pub tile: Tile,
    pub replayed: Replayed,
    /// Per footprint of the band, the gradient's sums.
    pub sums: Vec<Sums>,
}

/// Sums over the pixels of a band that make a footprint's gradient, see `FootprintGradient`; the last three are not
/// used.
pub(super) type Sums = [f32; 12];

impl Band {
    /// The transmittances with which a block starts a round.
    #[inline(always)]
    pub(super) fn start(&self, view: &BandView<'_>, round: usize, tile: usize, block: usize) -> [f32; LANES] {
        if round > 0 {
            return self.carried[((round - 1) * view.tiles() + tile) * BLOCKS + block];
        }
        let mut start = [0.0; LANES];
        view.pixels(tile, block).for_each(|(lane, _)| start[lane] = 1.0);
        start
    }
}

/// Entries whose alphas are computed before the first of them is blended: alphas do not depend on each other, blending
/// does, and a processor overlaps the long chains of the former only if they stand close together.
pub(super) const BATCH: usize = 16;

/// Transmittance of a block's pixels, and which of them still blend. In memory, that of those which do not is negative.
#[derive(Clone, Copy)]
pub(super) struct Open<S> {
    pub transmittance: S,
    /// Goes on falling where blending has stopped, and never rises: blending has stopped wherever it is below the least.
    running: S,
}

impl<S: Simd> Open<S> {
    #[inline(always)]
    pub(super) fn load(from: &[f32; LANES]) -> Self {
        let (zero, stored) = (S::splat(0.0), S::load(from));
        let running = stored.max(zero);
        Self { transmittance: running.max(zero.sub(stored)), running }
    }

    #[inline(always)]
    pub(super) fn store(self, to: &mut [f32; LANES]) {
        let stopped = S::splat(0.0).sub(self.transmittance);
        S::select(self.running.ge(S::splat(TRANSMITTANCE_MIN)), self.transmittance, stopped).store(to);
    }

    /// Lets through a footprint of `alpha`; returns its weight, and where it may have one.
    #[inline(always)]
    pub(super) fn pass(&mut self, alpha: S) -> (S, S::Mask) {
        let before = self.running;
        self.running = before.negated_mul_add(alpha, before);
        let blends = self.running.ge(S::splat(TRANSMITTANCE_MIN));
        self.transmittance = S::select(blends, self.running, self.transmittance);
        (S::select(blends, before.mul(alpha), S::splat(0.0)), blends)
    }

    #[inline(always)]
    pub(super) fn is_any(self) -> bool {
        S::any(self.running.ge(S::splat(TRANSMITTANCE_MIN)))
    }
}

simd_kernel! {
    /// Blends all footprints of a band front to back into `pixels`, the band's rows of the image, `rows × width × 3`,
    /// and `alpha`, `rows × width` or empty.
    pub(super) fn blend(
        band: &mut Band,
        view: &BandView<'_>,
        background: [f32; 3],
        pixels: &mut [f32],
        alpha: &mut [f32],
    ) = blend_kernel
}

#[inline(always)]
fn blend_kernel<S: Simd>(
    band: &mut Band,
    view: &BandView<'_>,
    background: [f32; 3],
    pixels: &mut [f32],
    alpha: &mut [f32],
) {
    band.rounds.clear();
    band.carried.clear();
    let mut first = 0;
    loop {
        band.lists.fill::<S>(view, first);
        band.rounds.push(first);
        let end = first + band.lists.entries.len();
        if end == view.footprints() {
            break;
        }
        // With nothing left open, a last round of no footprints lets the background through.
        let is_open = blend_round::<S>(band, view, pixels);
        first = if is_open { end } else { view.footprints() };
    }
    finish::<S>(band, view, background, pixels, alpha);
}

/// A round that is not the last: colours are left in `pixels`, transmittances in `carried`. Returns whether any pixel is
/// still open.
#[inline(always)]
fn blend_round<S: Simd>(band: &mut Band, view: &BandView<'_>, pixels: &mut [f32]) -> bool {
    let mut is_open = false;
    for tile in 0..view.tiles() {
        band.tile.gather(&band.lists, tile, view.centre(tile));
        for block in 0..BLOCKS {
            let (open, colour) = blend_block::<S>(band, view, tile, block, pixels);
            is_open |= open.is_any();
            let mut carried = [0.0; LANES];
            open.store(&mut carried);
            band.carried.push(carried);
            for (lane, place) in view.pixels(tile, block) {
                for channel in 0..3 {
                    pixels[3 * place + channel] = colour[channel][lane];
                }
            }
        }
    }
    is_open
}

/// The last round.
#[inline(always)]
fn finish<S: Simd>(
    band: &mut Band,
    view: &BandView<'_>,
    background: [f32; 3],
    pixels: &mut [f32],
    alpha: &mut [f32],
) {
    for tile in 0..view.tiles() {
        band.tile.gather(&band.lists, tile, view.centre(tile));
        for block in 0..BLOCKS {
            let (open, colour) = blend_block::<S>(band, view, tile, block, pixels);
            let mut left = [0.0; LANES];
            open.transmittance.store(&mut left);
            for (lane, place) in view.pixels(tile, block) {
                for channel in 0..3 {
                    pixels[3 * place + channel] = colour[channel][lane] + left[lane] * background[channel];
                }
                if let Some(value) = alpha.get_mut(place) {
                    *value = 1.0 - left[lane];
                }
            }
        }
    }
}

/// Blends a block's footprints of the round at hand over what the rounds before left; lanes that are not inside the image
/// blend nothing.
#[inline(always)]
fn blend_block<S: Simd>(
    band: &mut Band,
    view: &BandView<'_>,
    tile: usize,
    block: usize,
    pixels: &[f32],
) -> (Open<S>, [[f32; LANES]; 3]) {
    let round = band.rounds.len() - 1;
    let mut open = Open::<S>::load(&band.start(view, round, tile, block));
    let mut colour = [[0.0; LANES]; 3];
    if round > 0 {
        for (lane, place) in view.pixels(tile, block) {
            for channel in 0..3 {
                colour[channel][lane] = pixels[3 * place + channel];
            }
        }
    }
    let mut light = [S::load(&colour[0]), S::load(&colour[1]), S::load(&colour[2])];
    let count = band.tile.list::<S>(block);
    blend_list::<S>(&band.tile.seen, band.tile.listed(count), &Offsets::new(block), &mut open, &mut light);
    for channel in 0..3 {
        light[channel].store(&mut colour[channel]);
    }
    (open, colour)
}

#[inline(always)]
fn blend_list<S: Simd>(
    seen: &[Seen],
    list: &[u32],
    offsets: &Offsets<S>,
    open: &mut Open<S>,
    light: &mut [S; 3],
) {
    let mut alphas = [S::splat(0.0); BATCH];
    for batch in list.chunks(BATCH) {
        if !open.is_any() {
            break;
        }
        for (alpha, &place) in alphas.iter_mut().zip(batch) {
            *alpha = seen[place as usize].alpha(offsets);
        }
        for (&alpha, &place) in alphas.iter().zip(batch) {
            let (weight, _) = open.pass(alpha);
            let [red, green, blue] = seen[place as usize].colour;
            light[0] = weight.mul_add(S::splat(red), light[0]);
            light[1] = weight.mul_add(S::splat(green), light[1]);
            light[2] = weight.mul_add(S::splat(blue), light[2]);
        }
    }
}
