//! The exact reach of a footprint, row by row.

use super::project::Footprint;

/// One footprint on one row: alpha at column `x` is `2^(peak - curvature · (x + 0.5 - centre)²)`.
#[derive(Clone, Copy)]
pub(super) struct Span {
    /// First column.
    pub first: usize,
    /// One past the last column.
    pub end: usize,
    /// Offset of the first column's centre from the row centre, pixels.
    pub offset: f32,
    /// Logarithm to base 2 of alpha at the row centre.
    pub peak: f32,
    /// Half the inverse variance along the row, in units of base-2 exponents.
    pub curvature: f32,
}

/// The columns of image row `row` on which the footprint's alpha can reach [`super::ALPHA_MIN`].
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
