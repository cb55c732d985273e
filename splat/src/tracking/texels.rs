//! Values and gradients side by side, for sampling along a flow.

use super::planes::Planes;

/// Replicated pixels on every side: one to interpolate with, one more for positions a pixel outside.
const BORDER: usize = 2;

/// Per pixel and channel the value and its central differences along x and y, padded to four numbers: the corners of
/// an interpolation are four loads.
pub(super) struct Texels<const CHANNELS: usize> {
    width: usize,
    height: usize,
    stride: usize,
    texels: Vec<[[f32; 4]; CHANNELS]>,
}

impl<const CHANNELS: usize> Texels<CHANNELS> {
    pub(super) fn new(planes: &Planes<CHANNELS>) -> Self {
        let (width, height) = (planes.width, planes.height);
        let stride = width + 2 * BORDER;
        let mut texels = Vec::with_capacity(stride * (height + 2 * BORDER));
        for y in 0..height + 2 * BORDER {
            let y = y.saturating_sub(BORDER).min(height - 1);
            let first = texels.len() + BORDER;
            texels.resize(first, [[0.0; 4]; CHANNELS]);
            for x in 0..width {
                let mut texel = [[0.0; 4]; CHANNELS];
                for (texel, channel) in texel.iter_mut().zip(&planes.channels) {
                    let at = planes.index(x, y);
                    let along_x = 0.5 * (channel[at + 1] - channel[at - 1]);
                    let along_y = 0.5 * (channel[at + planes.stride] - channel[at - planes.stride]);
                    *texel = [channel[at], along_x, along_y, 0.0];
                }
                texels.push(texel);
            }
            let (left, right) = (texels[first], texels[first + width - 1]);
            texels[first - BORDER..first].fill(left);
            texels.extend([right; BORDER]);
        }
        Self { width, height, stride, texels }
    }

    /// Value and gradient of each channel at fractional pixel index `(x, y)`, bilinear; outside is the border.
    #[inline(always)]
    pub(super) fn sample(&self, x: f32, y: f32) -> [[f32; 4]; CHANNELS] {
        // Shifting by the border makes the coordinates positive, so truncation is the floor.
        let x = x.clamp(-1.0, self.width as f32) + BORDER as f32;
        let y = y.clamp(-1.0, self.height as f32) + BORDER as f32;
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let first = row * self.stride + column;
        let upper = &self.texels[first..first + 2];
        let lower = &self.texels[first + self.stride..first + self.stride + 2];
        let mut sample = [[0.0; 4]; CHANNELS];
        for c in 0..CHANNELS {
            for k in 0..4 {
                let above = upper[0][c][k] + fx * (upper[1][c][k] - upper[0][c][k]);
                let below = lower[0][c][k] + fx * (lower[1][c][k] - lower[0][c][k]);
                sample[c][k] = above + fy * (below - above);
            }
        }
        sample
    }
}
