//! Stage 4: the gradient of blending, replayed block by block.
//!
//! Nothing is stored per pixel and footprint beyond one block at a time. A first loop over the block's list repeats the
//! blending, front to back, and keeps each footprint's alpha and weight; so every transmittance is what it was in the
//! forward pass. A second loop goes back to front with the light behind each footprint, seen through nothing else:
//! with `g` the gradient of the loss by the pixel's colour,
//!
//! ```text
//! behind_last = background · g - g_alpha
//! behind_(i-1) = behind_i + alpha_i (c_i · g - behind_i)
//! ∂loss/∂alpha_i = T_i (c_i · g - behind_i)
//! ```
//!
//! It divides by nothing, so an opaque footprint is as safe as a faint one.

use super::{
    ALPHA_MAX, ALPHA_MIN,
    blend::{AHEAD, Band, COLUMNS, Local, Sums},
    blocks::{Entry, corner},
};
use crate::simd::{Group, LANES, ROWS, Simd, prefetch, simd_kernel};

simd_kernel! {
    /// Fills the band's sums. `gradient` is that of the image's values in the band's rows, `rows × width × 3`,
    /// `alpha_gradient` `rows × width` or empty. Sums of entries that are not active stay zero, but their light is taken
    /// out all the same.
    pub(super) fn blend_backward(
        band: &mut Band,
        background: [f32; 3],
        gradient: &[f32],
        alpha_gradient: &[f32],
    ) = backward_kernel
}

#[inline(always)]
fn backward_kernel<S: Simd>(band: &mut Band, background: [f32; 3], gradient: &[f32], alpha_gradient: &[f32]) {
    band.sums.clear();
    band.sums.resize(band.lists.entries.len(), [0.0; 12]);
    for block in 0..band.lists.blocks() {
        let mut replay = Replay::default();
        for (lane, place) in band.pixels(block) {
            let mut from_background = -alpha_gradient.get(place).copied().unwrap_or(0.0);
            for channel in 0..3 {
                let gradient = gradient[3 * place + channel];
                replay.colour_gradient[channel][lane] = gradient;
                from_background += gradient * background[channel];
            }
            replay.behind[lane] = from_background;
        }
        let (column, row) = corner(block);
        let (x, y) = (column as f64 + 0.5, (band.first_row + row) as f64 + 0.5);
        let last = &band.last[block];
        let deepest = last.iter().fold(0.0, |deepest: f32, &place| deepest.max(place)) as usize;
        let list = &band.lists.of(block)[..deepest];
        blend_again::<S>(&band.lists.entries, list, last, x, y, &mut band.blended);
        replay_block::<S>(&band.lists.entries, list, x, y, &replay, &band.blended, &mut band.sums);
    }
}

/// What a block's replay starts from.
#[derive(Default)]
struct Replay {
    colour_gradient: [[f32; LANES]; 3],
    behind: [f32; LANES],
}

/// What one footprint did to a block's pixels; zero where it was not blended.
#[derive(Clone, Debug, Default)]
pub(super) struct Blended {
    alpha: Group,
    weight: Group,
}

/// Repeats the blending of a block's list.
#[inline(always)]
fn blend_again<S: Simd>(
    entries: &[Entry],
    list: &[u32],
    last: &[f32; LANES],
    x: f64,
    y: f64,
    blended: &mut Vec<Blended>,
) {
    blended.resize(list.len(), Blended::default());
    let (zero, last) = (S::splat(0.0), S::load(last));
    let mut transmittance = S::splat(1.0);
    let mut place = zero;
    for (place_in_list, (blended, &entry)) in blended.iter_mut().zip(list).enumerate() {
        if let Some(&later) = list.get(place_in_list + AHEAD) {
            prefetch(&entries[later as usize]);
        }
        let entry = &entries[entry as usize];
        let alpha = Local::new(entry, x, y).alpha::<S>(entry).min(S::splat(ALPHA_MAX));
        let was_blended = S::both(alpha.ge(S::splat(ALPHA_MIN)), place.lt(last));
        let alpha = S::select(was_blended, alpha, zero);
        let weight = transmittance.mul(alpha);
        transmittance = transmittance.sub(weight);
        place = place.add(S::splat(1.0));
        alpha.store(&mut blended.alpha.0);
        weight.store(&mut blended.weight.0);
    }
}

#[inline(always)]
fn replay_block<S: Simd>(
    entries: &[Entry],
    list: &[u32],
    x: f64,
    y: f64,
    replay: &Replay,
    blended: &[Blended],
    sums: &mut [Sums],
) {
    let zero = S::splat(0.0);
    let [red, green, blue] = &replay.colour_gradient;
    let g = [S::load(red), S::load(green), S::load(blue)];
    let mut behind = S::load(&replay.behind);
    let nothing = Share { entry: 0, weight: zero, v: zero };
    let mut shares = [nothing; ROWS];
    let mut count = 0;
    for (place, (blended, &number)) in blended.iter().zip(list).enumerate().rev() {
        if let Some(&later) = place.checked_sub(AHEAD).and_then(|place| list.get(place)) {
            prefetch(&sums[later as usize]);
        }
        let entry = &entries[number as usize];
        let (alpha, weight) = (S::load(&blended.alpha.0), S::load(&blended.weight.0));
        let [red, green, blue] = entry.colour;
        let light = S::splat(blue).mul(g[2]);
        let light = S::splat(red).mul_add(g[0], S::splat(green).mul_add(g[1], light));
        let excess = light.sub(behind);
        behind = alpha.mul_add(excess, behind);
        if !entry.is_active {
            continue;
        }
        // Where alpha was clamped it follows nothing.
        let v = S::select(alpha.lt(S::splat(ALPHA_MAX)), weight.mul(excess), zero);
        shares[count] = Share { entry: number, weight, v };
        count += 1;
        if count == ROWS {
            accumulate::<S>(sums, entries, &shares, x, y, &g);
            count = 0;
        }
    }
    if count > 0 {
        for share in &mut shares[count..] {
            *share = nothing;
        }
        accumulate::<S>(sums, entries, &shares, x, y, &g);
    }
}

/// What one footprint gets from a block.
#[derive(Clone, Copy)]
struct Share<S> {
    entry: u32,
    weight: S,
    /// `alpha · ∂loss/∂alpha`.
    v: S,
}

/// Adds a block's shares to the sums of four entries, a row of lanes for each: first over the rows of the block, whose
/// offsets are known, then over its columns.
#[inline(always)]
fn accumulate<S: Simd>(
    sums: &mut [Sums],
    entries: &[Entry],
    shares: &[Share<S>; ROWS],
    x: f64,
    y: f64,
    colour_gradient: &[S; 3],
) {
    // Per entry, the same in its four lanes, but for the column.
    let (mut offset, mut dy, mut slope) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
    for (row, share) in shares.iter().enumerate() {
        let local = Local::new(&entries[share.entry as usize], x, y);
        let lanes = ROWS * row..ROWS * (row + 1);
        offset[lanes.clone()].fill(local.d);
        dy[lanes.clone()].fill(local.dy);
        slope[lanes].fill(-local.slope);
    }
    let (dy, against) = (S::load(&dy), S::load(&slope));
    let across = S::load(&COLUMNS).add(S::load(&offset));
    // Moments of v by the row within the block, per column.
    let [a, b, c, d] = shares;
    let [v0, v1, v2, v3] = S::transpose([a.v, b.v, c.v, d.v]);
    let m0 = v0.add(v2).add(v1.add(v3));
    let m1 = v3.mul_add(S::splat(3.0), v2.mul_add(S::splat(2.0), v1));
    let m2 = v3.mul_add(S::splat(9.0), v2.mul_add(S::splat(4.0), v1));
    // Of v by d and dy, with d = across - slope · row and dy = local.dy + row.
    let v_d = m0.mul_add(across, m1.mul(against));
    let v_d_row = m1.mul_add(across, m2.mul(against));
    let v_dd = v_d.mul_add(across, v_d_row.mul(against));
    let v_y = m0.mul_add(dy, m1);
    let v_dy = v_d.mul_add(dy, v_d_row);
    let v_y_row = m1.mul_add(dy, m2);
    let v_yy = v_y.mul_add(dy, v_y_row);
    let zero = S::splat(0.0);
    let mut colour = [zero; 3];
    for (sum, &g) in colour.iter_mut().zip(colour_gradient) {
        let weighted = [a.weight.mul(g), b.weight.mul(g), c.weight.mul(g), d.weight.mul(g)];
        let [w0, w1, w2, w3] = S::transpose(weighted);
        *sum = w0.add(w2).add(w1.add(w3));
    }
    let [red, green, blue] = colour;
    let parts = [[m0, v_d, v_dd, v_y], [v_dy, v_yy, red, green], [blue, zero, zero, zero]];
    for (part, of_entries) in parts.into_iter().enumerate() {
        let mut values = [0.0; LANES];
        S::row_sums(of_entries).store(&mut values);
        for (share, values) in shares.iter().zip(values.as_chunks::<ROWS>().0) {
            let sums = &mut sums[share.entry as usize].as_chunks_mut::<ROWS>().0[part];
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += value;
            }
        }
    }
}
