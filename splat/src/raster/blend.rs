//! Stage 3: front-to-back blending of a band's footprints, block by block.

use super::{
    ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN,
    bin::{BAND_ROWS, Bins},
    blend_backward::Blended,
    blocks::{BLOCK, BlockLists, Entry, corner, fill},
};
use crate::simd::{Instructions, LANES, Simd, prefetch, simd_kernel};

/// What a band of rows of the image holds while a view is rendered and its gradient is taken.
#[derive(Clone, Debug, Default)]
pub(super) struct Band {
    pub lists: BlockLists,
    /// First image row.
    pub first_row: usize,
    /// Rows of the image in the band.
    pub rows: usize,
    /// Columns of the image.
    pub width: usize,
    /// Per block and pixel, how many footprints of the block's list came before blending stopped.
    /// Single precision counts exactly to 2²⁴.
    pub last: Vec<[f32; LANES]>,
    /// What the list of the block at hand did, while it is replayed.
    pub blended: Vec<Blended>,
    /// Per entry of the lists, the gradient's sums.
    pub sums: Vec<Sums>,
}

/// Sums over the pixels of a band that make a footprint's gradient, see `FootprintGradient`; the last three are not
/// used.
pub(super) type Sums = [f32; 12];

impl Band {
    /// Prepares band `number` of a `width × height` image: lists its footprints per block.
    pub(super) fn reset(
        &mut self,
        instructions: Instructions,
        bins: &Bins,
        number: usize,
        width: usize,
        height: usize,
        active: &[bool],
    ) {
        self.first_row = number * BAND_ROWS;
        self.rows = BAND_ROWS.min(height - self.first_row);
        self.width = width;
        fill(instructions, &mut self.lists, bins, number, width, height, active);
        // Every block writes all of its values.
        self.last.resize(self.lists.blocks(), [0.0; LANES]);
    }

    /// Lane and place within the band of each of a block's pixels that lie in the image.
    pub(super) fn pixels(&self, block: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (column, row) = corner(block);
        let (width, columns) = (self.width, BLOCK.min(self.width.saturating_sub(column)));
        let rows = BLOCK.min(self.rows.saturating_sub(row));
        (0..rows)
            .flat_map(move |y| (0..columns).map(move |x| (y * BLOCK + x, (row + y) * width + column + x)))
    }
}

/// Entries whose alphas are computed before the first of them is blended: alphas do not depend on each other, blending
/// does, and a processor overlaps the long chains of the former only if they stand close together.
pub(super) const BATCH: usize = 16;

/// Entries whose memory is asked for ahead: a block's list leaves out most of its band, so that no pattern shows.
pub(super) const AHEAD: usize = 8;

/// Column and row of each lane within a block.
pub(super) const COLUMNS: [f32; LANES] = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
const ROWS: [f32; LANES] = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];

/// A footprint seen from a block.
#[derive(Clone, Copy)]
pub(super) struct Local {
    /// Offset of the block's first pixel from the row centre of its row.
    pub d: f32,
    /// Offset of the block's first row from the mean.
    pub dy: f32,
    /// Row centre shift per row.
    pub slope: f32,
}

impl Local {
    /// `x, y`: centre of the block's first pixel. In double precision, as a needle's row centre is a small difference
    /// of large numbers.
    #[inline(always)]
    pub(super) fn new(entry: &Entry, x: f64, y: f64) -> Self {
        let dy = y - entry.mean[1];
        let d = (x - entry.mean[0]) - entry.slope * dy;
        Self { d: d as f32, dy: dy as f32, slope: entry.slope as f32 }
    }

    /// Alpha of the block's pixels before the clamp.
    #[inline(always)]
    pub(super) fn alpha<S: Simd>(&self, entry: &Entry) -> S {
        let d = S::load(&ROWS).mul_add(S::splat(-self.slope), S::load(&COLUMNS).add(S::splat(self.d)));
        let dy = S::load(&ROWS).add(S::splat(self.dy));
        let across = dy.mul(S::splat(-entry.fall)).mul_add(dy, S::splat(entry.peak));
        d.mul(S::splat(-entry.curvature)).mul_add(d, across).exp2()
    }
}

simd_kernel! {
    /// Blends all footprints of a band front to back into `pixels`, the band's rows of the image, `rows × width × 3`,
    /// and `alpha`, `rows × width` or empty.
    pub(super) fn blend(band: &mut Band, background: [f32; 3], pixels: &mut [f32], alpha: &mut [f32]) = blend_kernel
}

#[inline(always)]
fn blend_kernel<S: Simd>(band: &mut Band, background: [f32; 3], pixels: &mut [f32], alpha: &mut [f32]) {
    for block in 0..band.lists.blocks() {
        let mut is_inside = [0.0; LANES];
        band.pixels(block).for_each(|(lane, _)| is_inside[lane] = 1.0);
        let (column, row) = corner(block);
        let (x, y) = (column as f64 + 0.5, (band.first_row + row) as f64 + 0.5);
        let blended = blend_block::<S>(&band.lists.entries, band.lists.of(block), x, y, &is_inside);
        band.last[block] = blended.last;
        for (lane, place) in band.pixels(block) {
            let transmittance = blended.transmittance[lane];
            for channel in 0..3 {
                pixels[3 * place + channel] =
                    blended.colour[channel][lane] + transmittance * background[channel];
            }
            if let Some(value) = alpha.get_mut(place) {
                *value = 1.0 - transmittance;
            }
        }
    }
}

struct BlockResult {
    colour: [[f32; LANES]; 3],
    transmittance: [f32; LANES],
    last: [f32; LANES],
}

/// Blends the listed entries over one block; lanes that are not inside the image blend nothing.
#[inline(always)]
fn blend_block<S: Simd>(
    entries: &[Entry],
    list: &[u32],
    x: f64,
    y: f64,
    is_inside: &[f32; LANES],
) -> BlockResult {
    let (zero, one, least) = (S::splat(0.0), S::splat(1.0), S::splat(TRANSMITTANCE_MIN));
    // Goes on falling where blending has stopped, and never rises: blending has stopped wherever it is below the least.
    let mut running = S::load(is_inside);
    let mut transmittance = one;
    let mut colour = [zero; 3];
    let (mut place, mut last) = (zero, zero);
    let mut alphas = [zero; BATCH];
    for (number, batch) in list.chunks(BATCH).enumerate() {
        for &later in list.iter().skip((number + 1) * BATCH).take(BATCH) {
            prefetch(&entries[later as usize]);
        }
        for (alpha, &entry) in alphas.iter_mut().zip(batch) {
            let entry = &entries[entry as usize];
            let value = Local::new(entry, x, y).alpha::<S>(entry).min(S::splat(ALPHA_MAX));
            *alpha = S::select(value.ge(S::splat(ALPHA_MIN)), value, zero);
        }
        for (&alpha, &entry) in alphas.iter().zip(batch) {
            let entry = &entries[entry as usize];
            let weight = running.mul(alpha);
            running = running.sub(weight);
            let blends = running.ge(least);
            transmittance = S::select(blends, running, transmittance);
            place = place.add(one);
            last = S::select(blends, place, last);
            let weight = S::select(blends, weight, zero);
            for channel in 0..3 {
                colour[channel] = weight.mul_add(S::splat(entry.colour[channel]), colour[channel]);
            }
        }
        if !S::any(running.ge(least)) {
            break;
        }
    }
    let mut blended =
        BlockResult { colour: [[0.0; LANES]; 3], transmittance: [0.0; LANES], last: [0.0; LANES] };
    for (values, to) in colour.into_iter().zip(&mut blended.colour) {
        values.store(to);
    }
    transmittance.store(&mut blended.transmittance);
    last.store(&mut blended.last);
    blended
}
