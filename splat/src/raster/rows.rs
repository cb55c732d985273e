//! The exact reach of a footprint, row by row.

use super::project::Footprint;

/// One footprint on one row.
#[derive(Clone, Copy)]
pub(super) struct Span {
    /// First column.
    pub first: usize,
    /// One past the last column.
    pub end: usize,
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
    Some(Span { first: low as usize, end: high as usize + 1 })
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
