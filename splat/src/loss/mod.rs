//! The photometric loss: L1 + D-SSIM, with its gradient by the rendering.
//!
//! `(1 - w) · mean |x - y| + w · (1 - mean SSIM)`, means over pixels and channels, as in 3D Gaussian Splatting (Kerbl
//! et al. 2023): SSIM per channel (Wang et al. 2004) with an 11×11 Gaussian window of standard deviation 1.5, images
//! continued with zeros.

mod passes;
#[cfg(test)]
mod tests;
pub(crate) mod window;

use rayon::prelude::*;

pub(crate) use self::passes::{C1, C2};
use self::{
    passes::{
        BAND_ROWS, Inputs, TARGET_PLANES, TermWeights, derivative_stride, derivatives, gradient,
        moment_stride, moments, scratch_size,
    },
    window::{HalfWindow, RADIUS, blur, half_window, horizontal_taps, vertical_taps},
};
use crate::{
    image::{Image, Mask},
    simd::Instructions,
};

/// The loss against one training image; everything that depends on that image alone is computed once.
#[derive(Clone, Debug)]
pub struct PhotometricLoss {
    width: usize,
    height: usize,
    window: HalfWindow,
    dssim_weight: f32,
    /// Pixels in the means.
    counted_pixels: usize,
    target: Vec<f32>,
    zeros: Vec<f32>,
}

/// Memory that evaluations share, about 90 bytes per pixel.
#[derive(Clone, Debug, Default)]
pub struct LossWorkspace {
    instructions: Instructions,
    size: (usize, usize),
    moments: Vec<f32>,
    derivatives: Vec<f32>,
    scratch: Vec<f32>,
    /// Per row.
    dissimilarity: Vec<f64>,
    /// Per row.
    difference: Vec<f64>,
}

impl LossWorkspace {
    /// Empty memory; evaluations with it use `instructions`, which does not change what they compute.
    pub fn new(instructions: Instructions) -> Self {
        Self { instructions, ..Self::default() }
    }

    /// Resizes for an image. Margins of the scratch rows must be zero, so another size starts from zeros.
    fn fit(&mut self, width: usize, height: usize) {
        if self.size == (width, height) {
            return;
        }
        self.moments.resize(height * moment_stride(width), 0.0);
        self.derivatives.resize(height * derivative_stride(width), 0.0);
        self.scratch.clear();
        self.scratch.resize(height.div_ceil(BAND_ROWS) * scratch_size(width), 0.0);
        self.dissimilarity.resize(height, 0.0);
        self.difference.resize(height, 0.0);
        self.size = (width, height);
    }
}

impl PhotometricLoss {
    /// Prepares the loss against `target`, over the pixels inside `mask` if there is one: the absolute difference
    /// and the SSIM map are averaged over those pixels, each SSIM window still reads its whole neighbourhood.
    ///
    /// # Panics
    /// If target and mask differ in size, or a buffer does not have the size it states.
    pub fn new(target: &Image, mask: Option<&Mask>, dssim_weight: f32) -> Self {
        let (width, height) = (target.width as usize, target.height as usize);
        let pixels = width * height;
        assert_eq!(target.pixels.len(), 3 * pixels, "the target's buffer must have its stated size");
        if let Some(mask) = mask {
            assert_eq!(
                (mask.width, mask.height, mask.inside.len()),
                (target.width, target.height, pixels),
                "the mask must have the target's size"
            );
        }

        let window = half_window();
        let zeros = vec![0.0; width];
        let counted_pixels = mask.map_or(pixels, |mask| mask.inside.iter().filter(|&&inside| inside).count());
        let target = if pixels == 0 { Vec::new() } else { target_planes(target, mask, &window, &zeros) };
        Self { width, height, window, dssim_weight, counted_pixels, target, zeros }
    }

    /// The loss of `rendered`; its gradient by every rendered value is written to `gradient`, `height × width × 3`.
    ///
    /// The derivative of `|x - y|` where both are equal is taken as zero. Zero, with a zero gradient, if no pixel
    /// counts. NaN if a rendered value is NaN. The same bytes for every number of threads.
    ///
    /// # Panics
    /// If `rendered` or `gradient` differs from the target in size.
    pub fn evaluate(&self, rendered: &Image, workspace: &mut LossWorkspace, gradient: &mut [f32]) -> f32 {
        let Self { width, height, .. } = *self;
        assert_eq!(
            (rendered.width as usize, rendered.height as usize, rendered.pixels.len(), gradient.len()),
            (width, height, 3 * width * height, 3 * width * height),
            "rendering and gradient must have the target's size"
        );
        if self.counted_pixels == 0 {
            gradient.fill(0.0);
            return 0.0;
        }

        workspace.fit(width, height);
        self.sweep(rendered, workspace, gradient);
        let count = 3.0 * self.counted_pixels as f64;
        let difference = workspace.difference.iter().sum::<f64>() / count;
        let dissimilarity = workspace.dissimilarity.iter().sum::<f64>() / count;
        let weight = f64::from(self.dssim_weight);
        ((1.0 - weight) * difference + weight * dissimilarity) as f32
    }

    /// The three sweeps, each parallel over bands of rows.
    fn sweep(&self, rendered: &Image, workspace: &mut LossWorkspace, gradient_out: &mut [f32]) {
        let width = self.width;
        let inputs = Inputs { window: &self.window, target: &self.target, zeros: &self.zeros };
        let count = 3.0 * self.counted_pixels as f32;
        let terms = TermWeights {
            absolute: (1.0 - self.dssim_weight) / count,
            structural: self.dssim_weight / count,
        };
        let instructions = workspace.instructions.at_most_avx2();
        let LossWorkspace { moments: moment_records, derivatives: derivative_records, scratch, .. } =
            workspace;
        let band_values = BAND_ROWS * 3 * width;

        moment_records
            .par_chunks_mut(BAND_ROWS * moment_stride(width))
            .zip(rendered.pixels.par_chunks(band_values))
            .zip(scratch.par_chunks_mut(scratch_size(width)))
            .enumerate()
            .for_each(|(band, ((records, pixels), scratch))| {
                moments(instructions, inputs, band * BAND_ROWS, pixels, records, scratch);
            });
        let moment_records = &*moment_records;

        derivative_records
            .par_chunks_mut(BAND_ROWS * derivative_stride(width))
            .zip(workspace.dissimilarity.par_chunks_mut(BAND_ROWS))
            .zip(scratch.par_chunks_mut(scratch_size(width)))
            .enumerate()
            .for_each(|(band, ((records, sums), scratch))| {
                derivatives(instructions, inputs, band * BAND_ROWS, moment_records, records, sums, scratch);
            });
        let derivative_records = &*derivative_records;

        gradient_out
            .par_chunks_mut(band_values)
            .zip(workspace.difference.par_chunks_mut(BAND_ROWS))
            .zip(scratch.par_chunks_mut(scratch_size(width)))
            .enumerate()
            .for_each(|(band, ((out, sums), scratch))| {
                gradient(
                    instructions,
                    inputs,
                    terms,
                    band * BAND_ROWS,
                    moment_records,
                    derivative_records,
                    out,
                    sums,
                    scratch,
                );
            });
    }
}

/// Values, blurred values and blurred variances of the target per channel, and the weight of every pixel, in records
/// of [`TARGET_PLANES`] rows. Runs once per image, so it favours brevity over speed.
fn target_planes(target: &Image, mask: Option<&Mask>, window: &HalfWindow, zeros: &[f32]) -> Vec<f32> {
    let (width, height) = (target.width as usize, target.height as usize);
    let stride = TARGET_PLANES * width;
    let mut records = vec![0.0; height * stride];
    let mut padded = vec![0.0; width + 2 * RADIUS];
    let mut blurred = vec![0.0; 2 * width * height];
    for channel in 0..3 {
        for (row, pixels) in target.pixels.chunks_exact(3 * width).enumerate() {
            for power in [1, 2] {
                for (value, pixel) in padded[RADIUS..].iter_mut().zip(pixels.as_chunks::<3>().0) {
                    *value = pixel[channel].powi(power);
                }
                let first = (2 * row + power as usize - 1) * width;
                blur(&mut blurred[first..][..width], horizontal_taps(&padded), window);
            }
            let values = &mut records[row * stride + 3 * channel * width..][..width];
            for (value, pixel) in values.iter_mut().zip(pixels.as_chunks::<3>().0) {
                *value = pixel[channel];
            }
        }
        for row in 0..height {
            let planes = &mut records[row * stride + (3 * channel + 1) * width..][..2 * width];
            let (means, variances) = planes.split_at_mut(width);
            blur(means, vertical_taps(&blurred, 2 * width, row, 0, zeros), window);
            blur(variances, vertical_taps(&blurred, 2 * width, row, width, zeros), window);
            for (variance, mean) in variances.iter_mut().zip(means) {
                *variance -= *mean * *mean;
            }
        }
    }
    for (pixel, counts) in
        mask.map_or(vec![true; width * height], |mask| mask.inside.clone()).iter().enumerate()
    {
        records[(pixel / width) * stride + (TARGET_PLANES - 1) * width + pixel % width] =
            f32::from(u8::from(*counts));
    }
    records
}
