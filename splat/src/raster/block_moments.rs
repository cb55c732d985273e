//! The sums behind footprint moments, block by block.
//!
//! What a pixel says does not depend on the footprint that sees it: its position and its track, both relative to the
//! block, make one row of sixteen features. The sums of a footprint over a block are then the product of its sixteen
//! weights with that matrix, one multiplication and addition of a whole group per pixel. Features are relative to the
//! block's centre and to a displacement that occurs in it, so that single precision suffices; sums over blocks are taken
//! in double precision.

use super::{
    ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN,
    blend::{BATCH, Band, COLUMNS, Local},
    blocks::{BLOCK, Entry, corner},
};
use crate::{
    motion::reweighting::ExpectedMotion,
    simd::{Group, LANES, Simd, prefetch, simd_kernel},
    tracking::TrackField,
};

/// Standard deviations, px, outside of which a claim is taken for this one: squares of its inverse stay within single
/// precision.
const SIGMA: [f32; 2] = [1e-6, 1e6];
/// Displacement, px, beyond which a track is no track.
const FARTHEST: f64 = 65_536.0;

/// Sums of one footprint in image coordinates, pixels, `a, b` being the displacement of a pixel `u, v`.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    /// `Σ w` of the blending weights `w = alpha · T` over all pixels.
    pub blend_weight: f64,
    /// `Σ w` over the pixels with a usable track.
    pub visible: f64,
    /// `Σ ω` with `ω = w / σ²`, over these pixels as all that follows.
    pub weight: f64,
    pub weight_squared: f64,
    pub pixels: f64,
    /// `Σ ω (u, v)`.
    pub position: [f64; 2],
    /// `Σ ω (a, b)`.
    pub displacement: [f64; 2],
    /// `Σ ω (uu, uv, vv)`.
    pub source: [f64; 3],
    /// `Σ ω (au, av, bu, bv)`.
    pub cross: [f64; 4],
    /// `Σ ω (aa + bb)`.
    pub power: f64,
}

impl Sums {
    pub(super) fn add(&mut self, other: &Self) {
        self.blend_weight += other.blend_weight;
        self.visible += other.visible;
        self.weight += other.weight;
        self.weight_squared += other.weight_squared;
        self.pixels += other.pixels;
        self.power += other.power;
        add(&mut self.position, other.position);
        add(&mut self.displacement, other.displacement);
        add(&mut self.source, other.source);
        add(&mut self.cross, other.cross);
    }

    /// Adds a block's sums `m`, see [`BlockTracks::features`], by the parallel-axis theorem.
    #[inline(always)]
    fn add_block(&mut self, sums: &[f32; LANES], tracks: &BlockTracks) {
        let mut m = [0.0; LANES];
        for (wide, &sum) in m.iter_mut().zip(sums) {
            *wide = f64::from(sum);
        }
        let ([u, v], [a, b]) = (tracks.centre, tracks.reference);
        let (su, sv) = (m[1] + u * m[0], m[2] + v * m[0]);
        let (sa, sb) = (m[3] + a * m[0], m[4] + b * m[0]);
        self.weight += m[0];
        self.position[0] += su;
        self.position[1] += sv;
        self.displacement[0] += sa;
        self.displacement[1] += sb;
        self.source[0] += m[5] + u * (m[1] + su);
        self.source[1] += m[6] + u * m[2] + v * su;
        self.source[2] += m[7] + v * (m[2] + sv);
        self.cross[0] += m[8] + u * m[3] + a * su;
        self.cross[1] += m[9] + v * m[3] + a * sv;
        self.cross[2] += m[10] + u * m[4] + b * su;
        self.cross[3] += m[11] + v * m[4] + b * sv;
        self.power += m[12] + a * (m[3] + sa) + b * (m[4] + sb);
        self.visible += m[13];
        self.blend_weight += m[14];
    }
}

fn add<const N: usize>(sums: &mut [f64; N], values: [f64; N]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value;
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
    /// Per pixel: what its weight is multiplied with in each sum. With `r` the precision, `u, v` the pixel from the
    /// block's centre and `a, b` the displacement from the reference:
    /// `r, ru, rv, ra, rb, ruu, ruv, rvv, rau, rav, rbu, rbv, r(aa + bb), rσ², 1` and nothing.
    features: [[f32; LANES]; LANES],
}

/// Offsets of a block's pixels from its centre.
fn offset(lane: usize) -> [f32; 2] {
    let middle = (BLOCK as f32 - 1.0) / 2.0;
    [(lane % BLOCK) as f32 - middle, (lane / BLOCK) as f32 - middle]
}

impl BlockTracks {
    fn new(band: &Band, block: usize, tracks: &TrackField) -> Self {
        let (column, row) = corner(block);
        let half = BLOCK as f64 / 2.0;
        let mut of_block = Self {
            centre: [column as f64 + half, (band.first_row + row) as f64 + half],
            ..Self::default()
        };
        let first = band.first_row * band.width;
        let mut usable = [(0, [0.0; 2]); LANES];
        let mut count = 0;
        for (lane, place) in band.pixels(block) {
            of_block.features[lane][14] = 1.0;
            let pixel = first + place;
            let [x, y] = tracks.positions[pixel].map(f64::from);
            let [u, v] = offset(lane).map(f64::from);
            let displacement = [x - (of_block.centre[0] + u), y - (of_block.centre[1] + v)];
            let sigma = tracks.sigma[pixel];
            let is_near = displacement[0].abs().max(displacement[1].abs()) <= FARTHEST;
            // Comparisons with NaN are false.
            if tracks.visible[pixel] && sigma > 0.0 && sigma < f32::INFINITY && is_near && x + y == x + y {
                of_block.precision[lane] = sigma.clamp(SIGMA[0], SIGMA[1]).powi(2).recip();
                usable[count] = (lane, displacement);
                count += 1;
            }
        }
        of_block.set(&usable[..count]);
        of_block
    }

    fn set(&mut self, usable: &[(usize, [f64; 2])]) {
        if usable.is_empty() {
            return;
        }
        // The median, so that most of a block that straddles two motions is close to the reference.
        for axis in 0..2 {
            let mut values = [0.0; LANES];
            let values = &mut values[..usable.len()];
            for (value, (_, displacement)) in values.iter_mut().zip(usable) {
                *value = displacement[axis];
            }
            let (_, median, _) = values.select_nth_unstable_by(usable.len() / 2, f64::total_cmp);
            self.reference[axis] = *median;
        }
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
                ra * a + rb * b,
                1.0,
                1.0,
                0.0,
            ];
        }
    }
}

/// An expected motion as a block's pixels need it.
struct LocalMotion {
    /// Expected displacement at the block's centre, relative to the reference.
    displacement: [f32; 2],
    /// Its change per column and row.
    gradient: [[f32; 2]; 2],
    /// Exponent to base 2 per squared residual.
    fall: f32,
}

impl LocalMotion {
    #[inline(always)]
    fn new(motion: &ExpectedMotion, tracks: &BlockTracks) -> Self {
        let [[xu, xv], [yu, yv]] = motion.gradient;
        let (u, v) = (tracks.centre[0] - motion.centre[0], tracks.centre[1] - motion.centre[1]);
        let x = motion.displacement[0] + xu * u + xv * v - tracks.reference[0];
        let y = motion.displacement[1] + yu * u + yv * v - tracks.reference[1];
        Self {
            displacement: [x as f32, y as f32],
            gradient: [[xu as f32, xv as f32], [yu as f32, yv as f32]],
            fall: (motion.inverse_scale_squared * std::f64::consts::LOG2_E) as f32,
        }
    }

    /// The share of each pixel's weight that its residual leaves.
    #[inline(always)]
    fn share<S: Simd>(&self, tracks: &BlockTracks, [u, v]: [S; 2]) -> S {
        let mut squared = S::splat(0.0);
        for axis in 0..2 {
            let [by_u, by_v] = self.gradient[axis];
            let expected = u.mul_add(S::splat(by_u), S::splat(self.displacement[axis]));
            let expected = v.mul_add(S::splat(by_v), expected);
            let residual = S::load(&tracks.displacement[axis]).sub(expected);
            squared = residual.mul_add(residual, squared);
        }
        squared.mul(S::splat(-self.fall)).exp2()
    }
}

simd_kernel! {
    /// Adds the band's shares to the sums of its entries. `expected` is empty, or per entry the motion by which its pixels
    /// are reweighted; entries without one are left out.
    pub(super) fn add_moments(
        band: &Band,
        tracks: &TrackField,
        expected: &[Option<ExpectedMotion>],
        sums: &mut [Sums],
    ) = moments_kernel
}

#[inline(always)]
fn moments_kernel<S: Simd>(
    band: &Band,
    tracks: &TrackField,
    expected: &[Option<ExpectedMotion>],
    sums: &mut [Sums],
) {
    for block in 0..band.lists.blocks() {
        let list = band.lists.of(block);
        let end = if expected.is_empty() {
            list.len()
        } else {
            list.iter().rposition(|&entry| expected[entry as usize].is_some()).map_or(0, |last| last + 1)
        };
        if end > 0 {
            let tracks = BlockTracks::new(band, block, tracks);
            block_moments::<S>(band, block, &list[..end], &tracks, expected, sums);
        }
    }
}

#[inline(always)]
fn block_moments<S: Simd>(
    band: &Band,
    block: usize,
    list: &[u32],
    tracks: &BlockTracks,
    expected: &[Option<ExpectedMotion>],
    sums: &mut [Sums],
) {
    let entries: &[Entry] = &band.lists.entries;
    let (column, row) = corner(block);
    let (x, y) = (column as f64 + 0.5, (band.first_row + row) as f64 + 0.5);
    let (zero, one) = (S::splat(0.0), S::splat(1.0));
    let least = S::splat(TRANSMITTANCE_MIN);
    let precision = S::load(&tracks.precision);
    let middle = S::splat((BLOCK as f32 - 1.0) / 2.0);
    let mut rows = [0.0; LANES];
    for (lane, row) in rows.iter_mut().enumerate() {
        *row = (lane / BLOCK) as f32;
    }
    let offsets = [S::load(&COLUMNS).sub(middle), S::load(&rows).sub(middle)];
    let mut features = [zero; LANES];
    for (feature, values) in features.iter_mut().zip(&tracks.features) {
        *feature = S::load(values);
    }
    let mut inside = [0.0; LANES];
    for (inside, values) in inside.iter_mut().zip(&tracks.features) {
        *inside = values[14];
    }
    let mut running = S::load(&inside);
    let mut alphas = [zero; BATCH];
    let mut weights = Group::default();
    for (number, batch) in list.chunks(BATCH).enumerate() {
        for &later in list.iter().skip((number + 1) * BATCH).take(BATCH) {
            prefetch(&entries[later as usize]);
            prefetch(&sums[later as usize]);
        }
        for (alpha, &entry) in alphas.iter_mut().zip(batch) {
            let entry = &entries[entry as usize];
            let value = Local::new(entry, x, y).alpha::<S>(entry).min(S::splat(ALPHA_MAX));
            *alpha = S::select(value.ge(S::splat(ALPHA_MIN)), value, zero);
        }
        for (&alpha, &entry) in alphas.iter().zip(batch) {
            // As in `blend`: falls on where blending has stopped.
            let weight = running.mul(alpha);
            running = running.sub(weight);
            let mut weight = S::select(running.ge(least), weight, zero);
            if !S::any(zero.lt(weight)) {
                continue;
            }
            if let Some(motion) = expected.get(entry as usize) {
                let Some(motion) = motion else { continue };
                weight = weight.mul(LocalMotion::new(motion, tracks).share(tracks, offsets));
            }
            weight.store(&mut weights.0);
            let mut parts = [zero; 4];
            for lane in 0..LANES {
                parts[lane % 4] = S::splat(weights.0[lane]).mul_add(features[lane], parts[lane % 4]);
            }
            let mut values = [0.0; LANES];
            parts[0].add(parts[1]).add(parts[2].add(parts[3])).store(&mut values);
            let reliable = weight.mul(precision);
            let counted = S::select(zero.lt(reliable), one, zero);
            let mut by_row = [0.0; LANES];
            S::row_sums([reliable.mul(reliable), counted, zero, zero]).store(&mut by_row);
            let sums = &mut sums[entry as usize];
            sums.add_block(&values, tracks);
            sums.weight_squared += f64::from((by_row[0] + by_row[4]) + (by_row[8] + by_row[12]));
            sums.pixels += f64::from((by_row[1] + by_row[5]) + (by_row[9] + by_row[13]));
        }
        if !S::any(running.ge(least)) {
            break;
        }
    }
}
