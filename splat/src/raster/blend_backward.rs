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
    ALPHA_MAX,
    blend::{Band, Open, Sums},
    blocks::{BLOCKS, BandView},
    tile::{COLUMNS, Offsets, Seen, first_offset},
};
use crate::simd::{Group, LANES, ROWS, Simd, simd_kernel};

simd_kernel! {
    /// Fills the band's sums. `gradient` is that of the image's values in the band's rows, `rows × width × 3`,
    /// `alpha_gradient` `rows × width` or empty. Sums of entries that are not active stay zero, but their light is taken
    /// out all the same.
    pub(super) fn blend_backward(
        band: &mut Band,
        view: &BandView<'_>,
        background: [f32; 3],
        gradient: &[f32],
        alpha_gradient: &[f32],
    ) = backward_kernel
}

#[inline(always)]
fn backward_kernel<S: Simd>(
    band: &mut Band,
    view: &BandView<'_>,
    background: [f32; 3],
    gradient: &[f32],
    alpha_gradient: &[f32],
) {
    band.sums.clear();
    band.sums.resize(view.footprints(), [0.0; 12]);
    let mut replayed = std::mem::take(&mut band.replayed);
    replayed.behind.clear();
    replayed.behind.resize(view.tiles() * BLOCKS, [0.0; LANES]);
    let rounds = band.rounds.len();
    for round in (0..rounds).rev() {
        let first = band.rounds[round];
        if round + 1 < rounds {
            band.lists.fill::<S>(view, first);
        } else {
            band.lists.prefetch();
        }
        for tile in 0..view.tiles() {
            band.tile.gather(&band.lists, tile, view.centre(tile));
            replayed.sums.clear();
            replayed.sums.resize(band.tile.seen.len(), [0.0; 12]);
            for block in 0..BLOCKS {
                let mut seeds = Seeds::default();
                for (lane, place) in view.pixels(tile, block) {
                    let mut from_background = -alpha_gradient.get(place).copied().unwrap_or(0.0);
                    for channel in 0..3 {
                        let gradient = gradient[3 * place + channel];
                        seeds.colour_gradient[channel][lane] = gradient;
                        from_background += gradient * background[channel];
                    }
                    seeds.behind[lane] = from_background;
                }
                let number = tile * BLOCKS + block;
                if round + 1 < rounds {
                    seeds.behind = replayed.behind[number];
                }
                let start = band.start(view, round, tile, block);
                let count = band.tile.list::<S>(block);
                let (seen, list) = (&band.tile.seen[..], band.tile.listed(count));
                replayed.behind[number] = replayed.block::<S>(seen, list, block, &start, &seeds);
            }
            let sums = &mut band.sums[first..];
            for (listed, of_tile) in band.lists.of(tile).iter().zip(&replayed.sums) {
                add(&mut sums[listed.place()], of_tile);
            }
        }
    }
    band.replayed = replayed;
}

#[inline(always)]
fn add(sums: &mut Sums, values: &Sums) {
    let mut total = *sums;
    for place in 0..total.len() {
        total[place] += values[place];
    }
    *sums = total;
}

/// What a block's replay starts from.
#[derive(Default)]
struct Seeds {
    colour_gradient: [[f32; LANES]; 3],
    behind: [f32; LANES],
}

/// Buffers of the replay.
#[derive(Clone, Debug, Default)]
pub(super) struct Replayed {
    /// Per footprint of the tile at hand.
    sums: Vec<Sums>,
    /// Of the block at hand, see [`Blended`].
    blended: Vec<Blended>,
    /// Which footprints of the tile `blended` are.
    places: Vec<u32>,
    /// Per block and pixel, the light behind the footprints that were replayed.
    behind: Vec<[f32; LANES]>,
}

/// What one footprint did to a block's pixels; zero where it was not blended.
#[derive(Clone, Debug, Default)]
struct Blended {
    /// On the way back `alpha · ∂loss/∂alpha` takes its place.
    alpha: Group,
    weight: Group,
}

impl Replayed {
    /// Replays a block and adds to the tile's sums; returns the light behind its first footprint.
    #[inline(always)]
    fn block<S: Simd>(
        &mut self,
        seen: &[Seen],
        list: &[u32],
        block: usize,
        start: &[f32; LANES],
        seeds: &Seeds,
    ) -> [f32; LANES] {
        let count = self.forwards::<S>(seen, list, block, start);
        let [red, green, blue] = &seeds.colour_gradient;
        let g = [S::load(red), S::load(green), S::load(blue)];
        let mut behind = S::load(&seeds.behind);
        let first = self.backwards(seen, &list[..count], &g, &mut behind);
        let [red, green, blue] = g;
        let rows = [S::transpose([red; ROWS]), S::transpose([green; ROWS]), S::transpose([blue; ROWS])];
        for place in (first..count).step_by(ROWS) {
            self.accumulate(seen, place, block, &rows);
        }
        let mut left = [0.0; LANES];
        behind.store(&mut left);
        left
    }

    /// Repeats the blending of a block's list; returns how many of it come before all pixels have stopped.
    #[inline(always)]
    fn forwards<S: Simd>(
        &mut self,
        seen: &[Seen],
        list: &[u32],
        block: usize,
        start: &[f32; LANES],
    ) -> usize {
        /// Footprints between two looks at whether any pixel is open.
        const LOOK: usize = 8;
        // Whole rows of four are summed up; those behind the last stay as they are and are cleared on the way back.
        if self.blended.len() < list.len() + ROWS {
            self.blended.resize(list.len() + ROWS, Blended::default());
            self.places.resize(list.len() + ROWS, 0);
        }
        let offsets = Offsets::new(block);
        let mut open = Open::<S>::load(start);
        let mut count = 0;
        for (blended, places) in self.blended.chunks_mut(LOOK).zip(list.chunks(LOOK)) {
            if !open.is_any() {
                break;
            }
            for (blended, &place) in blended.iter_mut().zip(places) {
                let alpha = seen[place as usize].alpha(&offsets);
                let (weight, blends) = open.pass(alpha);
                S::select(blends, alpha, S::splat(0.0)).store(&mut blended.alpha.0);
                weight.store(&mut blended.weight.0);
            }
            count += places.len();
        }
        count
    }

    /// Goes through what was blended back to front, and leaves what active footprints get at the end of the buffers;
    /// returns where it begins.
    #[inline(always)]
    fn backwards<S: Simd>(&mut self, seen: &[Seen], list: &[u32], g: &[S; 3], behind: &mut S) -> usize {
        let (zero, one) = (S::splat(0.0), S::splat(1.0));
        let mut first = list.len();
        for (place, &number) in list.iter().enumerate().rev() {
            let blended = &self.blended[place];
            let (alpha, weight) = (S::load(&blended.alpha.0), S::load(&blended.weight.0));
            let seen = &seen[number as usize];
            let [red, green, blue] = seen.colour;
            let light = S::splat(blue).mul(g[2]);
            let light = S::splat(red).mul_add(g[0], S::splat(green).mul_add(g[1], light));
            let excess = light.sub(*behind);
            // The one operation that waits for the footprint behind.
            *behind = one.sub(alpha).mul_add(*behind, alpha.mul(light));
            if !seen.is_active {
                continue;
            }
            // Where alpha was clamped it follows nothing.
            let v = S::select(alpha.lt(S::splat(ALPHA_MAX)), weight.mul(excess), zero);
            first -= 1;
            let share = &mut self.blended[first];
            v.store(&mut share.alpha.0);
            if first != place {
                weight.store(&mut share.weight.0);
            }
            self.places[first] = number;
        }
        for place in list.len()..list.len() + ROWS {
            self.blended[place] = Blended::default();
            self.places[place] = 0;
        }
        first
    }

    /// Adds a block's shares to the sums of four footprints, a row of lanes for each: first over the rows of the block, whose
    /// offsets are known, then over its columns.
    #[inline(always)]
    fn accumulate<S: Simd>(&mut self, seen: &[Seen], first: usize, block: usize, g: &[[S; ROWS]; 3]) {
        let (Some([a, b, c, d]), Some(&places)) =
            (self.blended[first..].first_chunk(), self.places[first..].first_chunk::<ROWS>())
        else {
            return;
        };
        let [i, j, k, l] = places;
        let frame = |place: u32| &seen[place as usize].frame;
        let frames = S::load_rows([frame(i), frame(j), frame(k), frame(l)]);
        let [x, y] = first_offset(block);
        // Per footprint, the same in its four lanes, but for the column.
        let against = frames.spread_in_rows::<2>();
        let dy = frames.spread_in_rows::<1>().add(S::splat(y));
        let across = frames.spread_in_rows::<0>().add(S::load(&COLUMNS).add(S::splat(x)));
        let across = against.mul_add(S::splat(y), across);
        // Moments of v by the row within the block, per column.
        let v = [S::load(&a.alpha.0), S::load(&b.alpha.0), S::load(&c.alpha.0), S::load(&d.alpha.0)];
        let [v0, v1, v2, v3] = S::transpose(v);
        let m0 = v0.add(v2).add(v1.add(v3));
        let m1 = v3.mul_add(S::splat(3.0), v2.mul_add(S::splat(2.0), v1));
        let m2 = v3.mul_add(S::splat(9.0), v2.mul_add(S::splat(4.0), v1));
        // Of v by d and dy, with d = across - slope · row and dy that of the first row plus row.
        let v_d = m0.mul_add(across, m1.mul(against));
        let v_d_row = m1.mul_add(across, m2.mul(against));
        let v_dd = v_d.mul_add(across, v_d_row.mul(against));
        let v_y = m0.mul_add(dy, m1);
        let v_dy = v_d.mul_add(dy, v_d_row);
        let v_y_row = m1.mul_add(dy, m2);
        let v_yy = v_y.mul_add(dy, v_y_row);
        let weights =
            [S::load(&a.weight.0), S::load(&b.weight.0), S::load(&c.weight.0), S::load(&d.weight.0)];
        let [w0, w1, w2, w3] = S::transpose(weights);
        let zero = S::splat(0.0);
        let mut colour = [zero; 3];
        for (sum, [g0, g1, g2, g3]) in colour.iter_mut().zip(g) {
            *sum = w3.mul_add(*g3, w2.mul_add(*g2, w1.mul_add(*g1, w0.mul(*g0))));
        }
        let [red, green, blue] = colour;
        let parts = [[m0, v_d, v_dd, v_y], [v_dy, v_yy, red, green], [blue, zero, zero, zero]];
        for (part, of_footprints) in parts.into_iter().enumerate() {
            let mut values = [0.0; LANES];
            S::row_sums(of_footprints).store(&mut values);
            for (&place, values) in places.iter().zip(values.as_chunks::<ROWS>().0) {
                let sums = &mut self.sums[place as usize].as_chunks_mut::<ROWS>().0[part];
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum += value;
                }
            }
        }
    }
}
