//! Image quality: PSNR and SSIM, in double precision, of images clamped to `[0, 1]`; and how good tracks are.

#[cfg(test)]
mod tests;
pub mod tracks;

use crate::{
    image::{Image, Mask},
    loss::{
        C1, C2,
        window::{RADIUS, TAPS, gaussian_taps},
    },
};

/// PSNR of equal images, dB: finite, so that reports stay valid JSON. No value is reported above it.
pub const PSNR_CAP: f64 = 100.0;

/// Peak signal-to-noise ratio over all pixels and channels, dB, at most [`PSNR_CAP`].
///
/// NaN if the images differ in size, are empty, or hold a NaN.
pub fn psnr(a: &Image, b: &Image) -> f64 {
    if !comparable(a, b) {
        return f64::NAN;
    }
    from_squared_error(squared_error(&a.pixels, &b.pixels), a.pixels.len())
}

/// [`psnr`] over the pixels inside the mask; `None` if there is none, or if sizes differ.
pub fn masked_psnr(a: &Image, b: &Image, mask: &Mask) -> Option<f64> {
    let fits = (mask.width, mask.height) == (a.width, a.height) && mask.inside.len() == a.pixel_count();
    if !comparable(a, b) || !fits {
        return None;
    }
    let mut sum = 0.0;
    let mut count = 0;
    let pixels = a.pixels.chunks_exact(3).zip(b.pixels.chunks_exact(3));
    for ((a, b), _) in pixels.zip(&mask.inside).filter(|(_, inside)| **inside) {
        sum += squared_error(a, b);
        count += 3;
    }
    (count > 0).then(|| from_squared_error(sum, count))
}

/// Mean structural similarity over pixels and channels (Wang et al. 2004): 11×11 Gaussian window of standard deviation
/// 1.5, images continued with zeros, as in [`crate::loss`].
///
/// NaN if the images differ in size, are empty, or hold a NaN.
pub fn ssim(a: &Image, b: &Image) -> f64 {
    if !comparable(a, b) {
        return f64::NAN;
    }
    mean_over(a, b, |_| true).unwrap_or(f64::NAN)
}

/// [`ssim`] over the windows centred on pixels inside the mask; `None` if there is none, or if sizes differ.
pub fn masked_ssim(a: &Image, b: &Image, mask: &Mask) -> Option<f64> {
    let fits = (mask.width, mask.height) == (a.width, a.height) && mask.inside.len() == a.pixel_count();
    if !comparable(a, b) || !fits {
        return None;
    }
    mean_over(a, b, |pixel| mask.inside[pixel])
}

fn comparable(a: &Image, b: &Image) -> bool {
    let size = 3 * a.pixel_count();
    (a.width, a.height) == (b.width, b.height) && size > 0 && a.pixels.len() == size && b.pixels.len() == size
}

/// `NaN.clamp` stays NaN, so a broken image cannot score.
fn clamped(value: f32) -> f64 {
    f64::from(value.clamp(0.0, 1.0))
}

fn squared_error(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| (clamped(a) - clamped(b)).powi(2)).sum()
}

fn from_squared_error(sum: f64, count: usize) -> f64 {
    let decibels = -10.0 * (sum / count as f64).log10();
    if decibels > PSNR_CAP { PSNR_CAP } else { decibels }
}

/// Mean of the SSIM map over channels and the pixels that count; `None` if none does.
fn mean_over(a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0_usize);
    for channel in 0..3 {
        let plane = |image: &Image| -> Vec<f64> {
            image.pixels.iter().skip(channel).step_by(3).map(|&value| clamped(value)).collect()
        };
        let (a_plane, b_plane) = (plane(a), plane(b));
        let product = |left: &[f64], right: &[f64]| -> Vec<f64> {
            left.iter().zip(right).map(|(left, right)| left * right).collect()
        };
        let blur = |plane: &[f64]| windowed(plane, a.width as usize, a.height as usize);
        let (a_mean, b_mean) = (blur(&a_plane), blur(&b_plane));
        let (a_square, b_square) = (blur(&product(&a_plane, &a_plane)), blur(&product(&b_plane, &b_plane)));
        let cross = blur(&product(&a_plane, &b_plane));
        for pixel in (0..a.pixel_count()).filter(|&pixel| counts(pixel)) {
            let (mean_a, mean_b) = (a_mean[pixel], b_mean[pixel]);
            let variances = (a_square[pixel] - mean_a * mean_a) + (b_square[pixel] - mean_b * mean_b);
            let covariance = cross[pixel] - mean_a * mean_b;
            sum += (2.0 * mean_a * mean_b + C1) * (2.0 * covariance + C2)
                / ((mean_a * mean_a + mean_b * mean_b + C1) * (variances + C2));
            count += 1;
        }
    }
    (count > 0).then(|| sum / count as f64)
}

/// Windowed sum around every pixel of a plane, zeros outside.
fn windowed(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let taps = gaussian_taps();
    let mut padded = vec![0.0; width + 2 * RADIUS];
    let mut rows = vec![0.0; (height + 2 * RADIUS) * width];
    for (values, out) in plane.chunks_exact(width).zip(rows[RADIUS * width..].chunks_exact_mut(width)) {
        padded[RADIUS..][..width].copy_from_slice(values);
        for (column, out) in out.iter_mut().enumerate() {
            *out = (0..TAPS).map(|tap| taps[tap] * padded[column + tap]).sum();
        }
    }
    let mut out = vec![0.0; plane.len()];
    for (row, out) in out.chunks_exact_mut(width).enumerate() {
        for tap in 0..TAPS {
            let source = &rows[(row + tap) * width..][..width];
            for (out, value) in out.iter_mut().zip(source) {
                *out += taps[tap] * value;
            }
        }
    }
    out
}
