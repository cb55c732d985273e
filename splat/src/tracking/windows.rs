//! Sums and means over square windows.

use crate::simd::{Instructions, Simd, simd_kernel};

/// Sum over windows of `2 * radius + 1` columns and rows, cut at the image's edge.
pub(super) fn box_sum(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let mut sums = vec![0.0; width * height];
    sum_windows(Instructions::detect(), values, width, height, radius, &mut sums);
    sums
}

/// Number of pixels of each window of [`box_sum`].
pub(super) fn box_counts(width: usize, height: usize, radius: usize) -> Vec<f32> {
    let columns: Vec<usize> = (0..width).map(|x| extent(x, width, radius)).collect();
    let counts = (0..height).flat_map(|y| {
        let rows = extent(y, height, radius);
        columns.iter().map(move |columns| (rows * columns) as f32)
    });
    counts.collect()
}

/// Mean over windows of `2 * radius + 1` columns and rows, cut at the image's edge.
pub(super) fn box_mean(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let mut means = vec![0.0; width * height];
    average_windows(Instructions::detect(), values, width, height, radius, &mut means);
    means
}

/// How many of the `2 * radius + 1` rows or columns around `at` exist.
fn extent(at: usize, size: usize, radius: usize) -> usize {
    (at + radius + 1).min(size) - at.saturating_sub(radius)
}

simd_kernel! {
    /// [`box_sum`] into given memory.
    fn sum_windows(values: &[f32], width: usize, height: usize, radius: usize, to: &mut [f32]) = sum_kernel
}

simd_kernel! {
    /// [`box_mean`] into given memory.
    pub(super) fn average_windows(
        values: &[f32], width: usize, height: usize, radius: usize, to: &mut [f32],
    ) = average_kernel
}

#[inline(always)]
fn sum_kernel<S: Simd>(values: &[f32], width: usize, height: usize, radius: usize, to: &mut [f32]) {
    // Loops of these lengths unroll.
    match radius {
        1 => sum_windows_of::<3>(values, width, height, to),
        2 => sum_windows_of::<5>(values, width, height, to),
        3 => sum_windows_of::<7>(values, width, height, to),
        4 => sum_windows_of::<9>(values, width, height, to),
        _ => sum_wide_windows(values, width, height, radius, to),
    }
}

#[inline(always)]
fn average_kernel<S: Simd>(values: &[f32], width: usize, height: usize, radius: usize, to: &mut [f32]) {
    sum_kernel::<S>(values, width, height, radius, to);
    let columns: Vec<f32> = (0..width).map(|x| extent(x, width, radius) as f32).collect();
    for (y, line) in to.chunks_exact_mut(width).enumerate() {
        let rows = extent(y, height, radius) as f32;
        for (sum, columns) in line.iter_mut().zip(&columns) {
            *sum /= rows * columns;
        }
    }
}

/// Direct sums: a running sum would carry its rounding along and break exact symmetry.
#[inline(always)]
fn sum_windows_of<const SIDE: usize>(values: &[f32], width: usize, height: usize, to: &mut [f32]) {
    let radius = SIDE / 2;
    let nothing = vec![0.0f32; width];
    let mut padded = vec![0.0f32; width + 2 * radius];
    for y in 0..height {
        let mut rows: [&[f32]; SIDE] = [&nothing; SIDE];
        for (k, row) in rows.iter_mut().enumerate() {
            if y + k >= radius && y + k - radius < height {
                let source = y + k - radius;
                *row = &values[source * width..(source + 1) * width];
            }
        }
        let line = &mut padded[radius..radius + width];
        for i in 0..width {
            let mut sum = rows[0][i];
            for k in 1..SIDE {
                sum += rows[k][i];
            }
            line[i] = sum;
        }
        let mut shifted: [&[f32]; SIDE] = [&[]; SIDE];
        for (k, shifted) in shifted.iter_mut().enumerate() {
            *shifted = &padded[k..k + width];
        }
        let out = &mut to[y * width..(y + 1) * width];
        for i in 0..width {
            let mut sum = shifted[0][i];
            for k in 1..SIDE {
                sum += shifted[k][i];
            }
            out[i] = sum;
        }
    }
}

#[inline(always)]
fn sum_wide_windows(values: &[f32], width: usize, height: usize, radius: usize, to: &mut [f32]) {
    let mut line = vec![0.0f32; width];
    for y in 0..height {
        line.fill(0.0);
        for source in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            let row = &values[source * width..(source + 1) * width];
            for i in 0..width {
                line[i] += row[i];
            }
        }
        let out = &mut to[y * width..(y + 1) * width];
        out.fill(0.0);
        for shift in 0..=radius.min(width - 1) {
            let rest = width - shift;
            for i in 0..rest {
                out[i] += line[i + shift];
            }
            if shift > 0 {
                for i in 0..rest {
                    out[i + shift] += line[i];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn box_means_agree_with_direct_sums() {
        let (width, height) = (7, 5);
        let values: Vec<f32> = (0..width * height).map(|i| ((i * 13) % 17) as f32 - 8.0).collect();
        for radius in [0, 1, 2, 3, 4, 6, 100] {
            let means = box_mean(&values, width, height, radius);
            for (i, &mean) in means.iter().enumerate() {
                let inside = |j: &usize| {
                    (j % width).abs_diff(i % width) <= radius && (j / width).abs_diff(i / width) <= radius
                };
                let members: Vec<f64> =
                    (0..values.len()).filter(inside).map(|j| f64::from(values[j])).collect();
                let exact = members.iter().sum::<f64>() / members.len() as f64;
                assert!((f64::from(mean) - exact).abs() < 1e-5);
            }
        }
    }
}
