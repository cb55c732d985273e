//! The three sweeps over the rows of an image: blur the rendering's moments horizontally; finish them vertically,
//! evaluate SSIM and blur its derivatives horizontally; finish those vertically and assemble the gradient.
//!
//! Every sweep writes rows only, from a fixed partition into bands, and every sum is taken per row: the result does
//! not depend on the number of threads. There is no fused multiply-add, so that the instruction set does not
//! change the bytes either. Inner loops run over whole rows of one channel and vectorise.

use super::window::{HalfWindow, RADIUS, blur, horizontal_taps, vertical_taps};
use crate::simd::{Simd, simd_kernel};

/// Stabilisers of SSIM for values in `[0, 1]` (Wang et al. 2004): `(0.01)²` and `(0.03)²`.
pub(crate) const C1: f64 = 0.01 * 0.01;
/// See [`C1`].
pub(crate) const C2: f64 = 0.03 * 0.03;

/// Rows of one band, the unit of parallel work.
pub(super) const BAND_ROWS: usize = 8;

/// Planes of a row of the target: per channel value, blurred value, blurred variance; then the pixel weight.
pub(super) const TARGET_PLANES: usize = 10;
/// Planes of a row after the first sweep: per channel value, and the blurred value, square and product with the target.
const MOMENT_PLANES: usize = 12;
/// Planes of a row after the second sweep: per channel the blurred derivatives by mean, square and product.
const DERIVATIVE_PLANES: usize = 9;

/// What the sweeps read.
#[derive(Clone, Copy)]
pub(super) struct Inputs<'a> {
    pub(super) window: &'a HalfWindow,
    /// Records of [`TARGET_PLANES`] rows, one record per image row.
    pub(super) target: &'a [f32],
    /// One row of zeros; its length is the image's width.
    pub(super) zeros: &'a [f32],
}

impl<'a> Inputs<'a> {
    #[inline(always)]
    fn target_plane(&self, row: usize, plane: usize) -> &'a [f32] {
        let width = self.zeros.len();
        &self.target[(row * TARGET_PLANES + plane) * width..][..width]
    }
}

/// Values of one record after the first sweep. Odd, so that neighbouring records do not share cache sets.
pub(super) fn moment_stride(width: usize) -> usize {
    odd_cache_lines(MOMENT_PLANES * width)
}

/// Values of one record after the second sweep.
pub(super) fn derivative_stride(width: usize) -> usize {
    odd_cache_lines(DERIVATIVE_PLANES * width)
}

/// Rounds up to an odd number of cache lines: at widths of many powers of two the eleven rows of a vertical window
/// would otherwise compete for the same cache sets.
fn odd_cache_lines(values: usize) -> usize {
    const LINE: usize = 16;
    (values.div_ceil(LINE) | 1) * LINE
}

/// Scratch of one band: three rows with room for the window on either side, whose margins stay zero.
pub(super) fn scratch_size(width: usize) -> usize {
    3 * (width + 2 * RADIUS)
}

#[inline(always)]
fn padded_rows(scratch: &mut [f32]) -> [&mut [f32]; 3] {
    let (first, rest) = scratch.split_at_mut(scratch.len() / 3);
    let (second, third) = rest.split_at_mut(rest.len() / 2);
    [first, second, third]
}

#[inline(always)]
fn interior(padded: &mut [f32]) -> &mut [f32] {
    let width = padded.len() - 2 * RADIUS;
    &mut padded[RADIUS..][..width]
}

/// Blurs the padded rows horizontally into consecutive planes.
#[inline(always)]
fn blur_horizontally(padded: &[f32], planes: &mut [f32], window: &HalfWindow) {
    let sources = padded.chunks_exact(padded.len() / 3);
    for (source, plane) in sources.zip(planes.chunks_exact_mut(planes.len() / 3)) {
        blur(plane, horizontal_taps(source), window);
    }
}

/// Sum of a row in double precision, from eight interleaved sums in single precision.
#[inline(always)]
fn row_sum(row: &[f32]) -> f64 {
    let (groups, rest) = row.as_chunks::<8>();
    let mut sums = [0.0_f32; 8];
    for group in groups {
        for lane in 0..8 {
            sums[lane] += group[lane];
        }
    }
    sums.iter().chain(rest).map(|&value| f64::from(value)).sum()
}

simd_kernel! {
    /// First sweep over the band of rows from `first_row`; `pixels` are the band's rendered values.
    pub(super) fn moments(
        inputs: Inputs<'_>,
        first_row: usize,
        pixels: &[f32],
        records: &mut [f32],
        scratch: &mut [f32],
    ) = moments_rows
}

simd_kernel! {
    /// Second sweep: per row the weighted sum of `1 - SSIM`, and the horizontally blurred derivatives of SSIM by the
    /// windowed mean, square and product.
    pub(super) fn derivatives(
        inputs: Inputs<'_>,
        first_row: usize,
        moments: &[f32],
        records: &mut [f32],
        dissimilarity: &mut [f64],
        scratch: &mut [f32],
    ) = derivatives_rows
}

simd_kernel! {
    /// Third sweep: per row the weighted sum of `|x - y|`, and the gradient, channel fastest.
    pub(super) fn gradient(
        inputs: Inputs<'_>,
        terms: TermWeights,
        first_row: usize,
        moments: &[f32],
        derivatives: &[f32],
        gradient: &mut [f32],
        difference: &mut [f64],
        scratch: &mut [f32],
    ) = gradient_rows
}

#[inline(always)]
fn moments_rows<S: Simd>(
    inputs: Inputs<'_>,
    first_row: usize,
    pixels: &[f32],
    records: &mut [f32],
    scratch: &mut [f32],
) {
    let width = inputs.zeros.len();
    let rows = records.chunks_exact_mut(moment_stride(width)).zip(pixels.chunks_exact(3 * width));
    for (row, (record, pixels)) in rows.enumerate() {
        for (channel, planes) in record[..MOMENT_PLANES * width].chunks_exact_mut(4 * width).enumerate() {
            let (values, blurred) = planes.split_at_mut(width);
            for (value, pixel) in values.iter_mut().zip(pixels.as_chunks::<3>().0) {
                *value = pixel[channel];
            }
            let [copies, squares, products] = padded_rows(scratch).map(interior);
            copies.copy_from_slice(values);
            multiply(squares, values, values);
            multiply(products, values, inputs.target_plane(first_row + row, 3 * channel));
            blur_horizontally(scratch, blurred, inputs.window);
        }
    }
}

#[inline(always)]
fn multiply(out: &mut [f32], left: &[f32], right: &[f32]) {
    for ((out, left), right) in out.iter_mut().zip(left).zip(right) {
        *out = left * right;
    }
}

#[inline(always)]
fn derivatives_rows<S: Simd>(
    inputs: Inputs<'_>,
    first_row: usize,
    moments: &[f32],
    records: &mut [f32],
    dissimilarity: &mut [f64],
    scratch: &mut [f32],
) {
    let width = inputs.zeros.len();
    let rows = records.chunks_exact_mut(derivative_stride(width)).zip(dissimilarity);
    for (row, (record, dissimilarity)) in rows.enumerate() {
        let row = first_row + row;
        *dissimilarity = 0.0;
        for (channel, planes) in record[..DERIVATIVE_PLANES * width].chunks_exact_mut(3 * width).enumerate() {
            let [means, squares, products] = padded_rows(scratch).map(interior);
            for (plane, out) in [&mut *means, squares, products].into_iter().enumerate() {
                let offset = (4 * channel + 1 + plane) * width;
                let taps = vertical_taps(moments, moment_stride(width), row, offset, inputs.zeros);
                blur(out, taps, inputs.window);
            }
            // The record's first plane is free until the derivatives are blurred into it.
            let losses = &mut planes[..width];
            differentiate(
                means,
                squares,
                products,
                inputs.target_plane(row, 3 * channel + 1),
                inputs.target_plane(row, 3 * channel + 2),
                inputs.target_plane(row, 9),
                losses,
            );
            *dissimilarity += row_sum(losses);
            blur_horizontally(scratch, planes, inputs.window);
        }
    }
}

/// Turns windowed `E[x]`, `E[x²]`, `E[xy]` of a row into the weighted derivatives of SSIM by each of them, and
/// writes the weighted `1 - SSIM`.
#[inline(always)]
fn differentiate(
    means: &mut [f32],
    squares: &mut [f32],
    products: &mut [f32],
    target_means: &[f32],
    target_variances: &[f32],
    weights: &[f32],
    losses: &mut [f32],
) {
    const C1_F32: f32 = C1 as f32;
    const C2_F32: f32 = C2 as f32;
    let width = losses.len();
    let (means, squares, products) = (&mut means[..width], &mut squares[..width], &mut products[..width]);
    let (target_means, target_variances) = (&target_means[..width], &target_variances[..width]);
    let weights = &weights[..width];
    for at in 0..width {
        let (mean, target_mean, weight) = (means[at], target_means[at], weights[at]);
        // |2 cov| ≤ var + var holds exactly, but not after rounding; without these bounds the quotient of values
        // far above 1 could have a zero or negative denominator. Comparisons, not min and max: they are one
        // instruction each. NaN reaches the value through the mean.
        let variances = (squares[at] - mean * mean) + target_variances[at];
        let variances = if variances > 0.0 { variances } else { 0.0 };
        let covariance = 2.0 * (products[at] - mean * target_mean);
        let covariance = if covariance < variances { covariance } else { variances };
        let covariance = if covariance > -variances { covariance } else { -variances };

        let luminance = 2.0 * mean * target_mean + C1_F32;
        let structure = covariance + C2_F32;
        let luminance_norm = mean * mean + target_mean * target_mean + C1_F32;
        let structure_norm = variances + C2_F32;
        let norm = luminance_norm * structure_norm;
        let similarity = luminance * structure / norm;
        let weight_by_norm = weight / norm;

        losses[at] = weight * (1.0 - similarity);
        // Written as differences that vanish exactly for equal images.
        means[at] = 2.0
            * (target_mean * (structure - luminance) + mean * similarity * (luminance_norm - structure_norm))
            * weight_by_norm;
        squares[at] = -similarity * luminance_norm * weight_by_norm;
        products[at] = 2.0 * luminance * weight_by_norm;
    }
}

/// Weights of the two terms per pixel and channel that counts.
#[derive(Clone, Copy)]
pub(super) struct TermWeights {
    pub(super) absolute: f32,
    pub(super) structural: f32,
}

#[inline(always)]
fn gradient_rows<S: Simd>(
    inputs: Inputs<'_>,
    terms: TermWeights,
    first_row: usize,
    moments: &[f32],
    derivatives: &[f32],
    gradient: &mut [f32],
    difference: &mut [f64],
    scratch: &mut [f32],
) {
    let width = inputs.zeros.len();
    let rows = gradient.chunks_exact_mut(3 * width).zip(difference);
    for (row, (gradient, difference)) in rows.enumerate() {
        let row = first_row + row;
        *difference = 0.0;
        for channel in 0..3 {
            let [means, squares, products] = padded_rows(scratch).map(interior);
            for (plane, out) in [&mut *means, squares, products].into_iter().enumerate() {
                let offset = (3 * channel + plane) * width;
                let taps = vertical_taps(derivatives, derivative_stride(width), row, offset, inputs.zeros);
                blur(out, taps, inputs.window);
            }
            let values = &moments[row * moment_stride(width) + 4 * channel * width..][..width];
            let targets = inputs.target_plane(row, 3 * channel);
            assemble(means, squares, products, values, targets, inputs.target_plane(row, 9), terms);
            *difference += row_sum(squares);
            for (pixel, value) in gradient.as_chunks_mut::<3>().0.iter_mut().zip(means) {
                pixel[channel] = *value;
            }
        }
    }
}

/// Turns the blurred derivatives of a row into the gradient, in place of `means`, and the weighted absolute
/// differences, in place of `squares`.
#[inline(always)]
fn assemble(
    means: &mut [f32],
    squares: &mut [f32],
    products: &[f32],
    values: &[f32],
    targets: &[f32],
    weights: &[f32],
    terms: TermWeights,
) {
    let width = means.len();
    let (squares, products) = (&mut squares[..width], &products[..width]);
    let (values, targets, weights) = (&values[..width], &targets[..width], &weights[..width]);
    for at in 0..width {
        let (x, y, weight) = (values[at], targets[at], weights[at]);
        let above = if x > y { 1.0_f32 } else { 0.0 };
        let below = if x < y { 1.0_f32 } else { 0.0 };
        let structural = means[at] + 2.0 * x * squares[at] + y * products[at];
        means[at] = terms.absolute * weight * (above - below) - terms.structural * structural;
        squares[at] = weight * (x - y).abs();
    }
}
