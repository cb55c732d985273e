//! Stage 3: front-to-back blending of a band's footprints, row by row.

use super::{
    ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN,
    bin::{BAND_ROWS, Bins},
    lanes::{LANES, Simd, group_mut, simd_kernel},
    project::Footprint,
};

/// Pixel planes of one band; rows are padded by one group of lanes, padding never blends.
#[derive(Clone, Debug, Default)]
pub struct Band {
    /// First image row.
    pub first_row: usize,
    /// Rows of the image in the band.
    pub rows: usize,
    /// Columns of the image.
    pub width: usize,
    /// Floats per row of every plane.
    pub stride: usize,
    /// Transmittance left per pixel; negative once blending has stopped there.
    pub transmittance: Vec<f32>,
    /// Red, green and blue blended so far.
    pub colour: [Vec<f32>; 3],
    /// 1 + position in the band's entries of the last footprint that the pixel blended; 0: none. Single precision
    /// counts exactly to 2²⁴, more entries than a band can hold in memory.
    pub last: Vec<f32>,
}

impl Band {
    /// Prepares the planes of band `band` of a `width × height` image.
    pub fn reset(&mut self, band: usize, width: usize, height: usize) {
        self.first_row = band * BAND_ROWS;
        self.rows = BAND_ROWS.min(height - self.first_row);
        self.width = width;
        self.stride = width + LANES;
        let size = self.stride * self.rows;
        // Padding starts stopped, so that no lane beyond the border ever blends.
        self.transmittance.clear();
        self.transmittance.resize(size, -1.0);
        for row in 0..self.rows {
            self.transmittance[row * self.stride..row * self.stride + width].fill(1.0);
        }
        for plane in &mut self.colour {
            plane.clear();
            plane.resize(size, 0.0);
        }
        self.last.clear();
        self.last.resize(size, 0.0);
    }
}

/// One footprint on one row: alpha at column `x` is `2^(peak - curvature · (x + 0.5 - centre)²)`.
#[derive(Clone, Copy)]
pub(super) struct Span {
    /// First column.
    pub first: usize,
    /// One past the last column.
    pub end: usize,
    /// Offset of the first column's centre from the row centre, pixels.
    pub offset: f32,
    /// Row minus mean, pixels.
    pub dy: f32,
    /// Logarithm to base 2 of alpha at the row centre.
    pub peak: f32,
    /// Half the inverse variance along the row, in units of base-2 exponents.
    pub curvature: f32,
}

impl Span {
    /// Alpha before the clamp of the group whose first column lies `offset` from the row centre.
    #[inline(always)]
    pub(super) fn alpha<S: Simd>(&self, offset: f32) -> S {
        let d = S::ramp().add(S::splat(offset));
        d.mul(d).mul_add(S::splat(-self.curvature), S::splat(self.peak)).exp2()
    }
}

/// The columns of image row `row` on which the footprint's alpha can reach [`ALPHA_MIN`].
#[inline(always)]
pub(super) fn span(footprint: &Footprint, row: usize, width: usize) -> Option<Span> {
    let dy = row as f64 + 0.5 - footprint.mean[1];
    let fall = 0.5 * dy * dy * footprint.inverse_yy;
    let left = footprint.reach - fall;
    if !(left >= 0.0) {
        return None;
    }
    let centre = footprint.mean[0] + footprint.slope * dy;
    // The margin covers the rounding of the kernel's alpha; the kernel itself decides at the threshold.
    let half = (2.0 * left / footprint.inverse_conditional).sqrt() * (1.0 + 1e-6) + 1e-3;
    let low = (centre - half - 0.5).ceil().max(0.0);
    let high = (centre + half - 0.5).floor().min(width as f64 - 1.0);
    if !(low <= high) {
        return None;
    }
    Some(Span {
        first: low as usize,
        end: high as usize + 1,
        offset: (low + 0.5 - centre) as f32,
        dy: dy as f32,
        peak: ((footprint.log_opacity - fall) * std::f64::consts::LOG2_E) as f32,
        curvature: (0.5 * footprint.inverse_conditional * std::f64::consts::LOG2_E) as f32,
    })
}

/// The image rows of the band that the footprint can reach.
#[inline(always)]
pub(super) fn rows(footprint: &Footprint, band_first: usize, band_rows: usize) -> std::ops::Range<usize> {
    let half = (2.0 * footprint.reach / footprint.inverse_yy).sqrt();
    let low = (footprint.mean[1] - half - 0.5).ceil().max(band_first as f64) as usize;
    let high =
        (footprint.mean[1] + half + 0.5).floor().min((band_first + band_rows) as f64).max(0.0) as usize;
    low..high
}

simd_kernel! {
    /// Blends all footprints of `band` front to back.
    pub fn blend(bins: &Bins, number: usize, band: &mut Band) = blend_kernel
}

#[inline(always)]
fn blend_kernel<S: Simd>(bins: &Bins, number: usize, band: &mut Band) {
    for (place, &position) in bins.band(number).iter().enumerate() {
        let footprint = &bins.footprints[position as usize];
        for row in rows(footprint, band.first_row, band.rows) {
            let Some(span) = span(footprint, row, band.width) else { continue };
            let row_start = (row - band.first_row) * band.stride;
            let mut offset = span.offset;
            let mut first = span.first;
            while first < span.end {
                blend_group::<S>(
                    band,
                    row_start + first,
                    offset,
                    &span,
                    footprint.colour,
                    (place + 1) as f32,
                );
                first += LANES;
                offset += LANES as f32;
            }
        }
    }
}

#[inline(always)]
fn blend_group<S: Simd>(
    band: &mut Band,
    first: usize,
    offset: f32,
    span: &Span,
    colour: [f32; 3],
    mark: f32,
) {
    let transmittance = group_mut(&mut band.transmittance, first);
    let before = S::load(transmittance);
    let alpha = span.alpha::<S>(offset).min(S::splat(ALPHA_MAX));
    let zero = S::splat(0.0);
    let hit = S::both(alpha.ge(S::splat(ALPHA_MIN)), zero.lt(before));
    if !S::any(hit) {
        return;
    }
    let weight = before.mul(alpha);
    let after = before.sub(weight);
    let blends = S::both(hit, after.ge(S::splat(TRANSMITTANCE_MIN)));
    let stopped = S::select(hit, zero.sub(before), before);
    S::select(blends, after, stopped).store(transmittance);
    let weight = S::select(blends, weight, zero);
    for (plane, value) in band.colour.iter_mut().zip(colour) {
        let plane = group_mut(plane, first);
        weight.mul_add(S::splat(value), S::load(plane)).store(plane);
    }
    let last = group_mut(&mut band.last, first);
    S::select(blends, S::splat(mark), S::load(last)).store(last);
}
