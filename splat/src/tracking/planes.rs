//! Channels of an image with a replicated border, and their pyramid.

use super::windows::box_mean;
use crate::{
    image::Image,
    simd::{Instructions, Simd, simd_kernel},
};

/// Side of a patch, pixels. A constant, so that the loops over a patch have a known length and vectorise.
pub(super) const PATCH: usize = 8;
/// Replicated pixels on every side: a whole patch fits outside the image, with one more pixel to interpolate.
pub(super) const BORDER: usize = PATCH + 2;

/// Share of each channel in luma (ITU-R BT.601).
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

/// `f32` channels on the 0 to 255 scale, each with `BORDER` replicated pixels on every side.
#[derive(Clone, Debug)]
pub(super) struct Planes<const CHANNELS: usize = 3> {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    pub(super) channels: [Vec<f32>; CHANNELS],
}

impl Planes {
    /// Planes of an image, halved so many times; values that are not finite become 0.
    pub(super) fn from_image(image: &Image, halvings: u32) -> Self {
        Self::block_means(image, halvings, |colour| colour)
    }
}

impl Planes<1> {
    /// The luma of an image, halved so many times; values that are not finite count as 0.
    pub(super) fn luma_of(image: &Image, halvings: u32) -> Self {
        Self::block_means(image, halvings, |[r, g, b]| [LUMA[0] * r + LUMA[1] * g + LUMA[2] * b])
    }
}

simd_kernel! {
    /// Adds a row to sums, neither what is not finite nor what is beyond any exposure.
    fn add_finite(values: &[f32], sums: &mut [f32]) = add_finite_kernel
}

#[inline(always)]
fn add_finite_kernel<S: Simd>(values: &[f32], sums: &mut [f32]) {
    for (sum, &value) in sums.iter_mut().zip(values) {
        let value = if value.is_finite() { value } else { 0.0 };
        *sum += value.clamp(-4.0, 4.0);
    }
}

impl<const CHANNELS: usize> Planes<CHANNELS> {
    /// Adds the border to channels of `height * width` values.
    pub(super) fn from_interiors(width: usize, height: usize, interiors: [Vec<f32>; CHANNELS]) -> Self {
        Self::from_rows(width, height, |channel, y, row| {
            row.copy_from_slice(&interiors[channel][y * width..(y + 1) * width]);
        })
    }

    /// Planes whose rows `fill(channel, row, values)` writes; all values start as 0.
    pub(super) fn from_rows(
        width: usize,
        height: usize,
        mut fill: impl FnMut(usize, usize, &mut [f32]),
    ) -> Self {
        let stride = width + 2 * BORDER;
        let mut channel = 0;
        let channels = [(); CHANNELS].map(|()| {
            let mut values = vec![0.0f32; stride * (height + 2 * BORDER)];
            for (y, line) in values.chunks_exact_mut(stride).skip(BORDER).take(height).enumerate() {
                fill(channel, y, &mut line[BORDER..BORDER + width]);
                let (left, right) = (line[BORDER], line[BORDER + width - 1]);
                line[..BORDER].fill(left);
                line[BORDER + width..].fill(right);
            }
            let (top, bottom) = (BORDER * stride, (BORDER + height - 1) * stride);
            for y in 0..BORDER {
                values.copy_within(top..top + stride, y * stride);
                values.copy_within(bottom..bottom + stride, (BORDER + height + y) * stride);
            }
            channel += 1;
            values
        });
        Self { width, height, stride, channels }
    }

    /// Means over blocks of `2^halvings` pixels along either axis; blocks that the image does not fill go on with its last
    /// column and row.
    fn block_means(image: &Image, halvings: u32, mix: impl Fn([f32; 3]) -> [f32; CHANNELS]) -> Self {
        let [image_width, image_height] = [image.width as usize, image.height as usize];
        let side = 1 << halvings;
        let (width, height) = (image_width.div_ceil(side), image_height.div_ceil(side));
        let instructions = Instructions::detect();
        let mut line = vec![[0.0f32; 3]; width * side];
        let mut sums = vec![[0.0f32; CHANNELS]; width * height];
        for (y, sums) in sums.chunks_exact_mut(width).enumerate() {
            // Down the columns first: most of the work is adding whole rows.
            line.fill([0.0; 3]);
            for row in y * side..(y + 1) * side {
                let from = 3 * image_width * row.min(image_height - 1);
                let values = &image.pixels[from..from + 3 * image_width];
                add_finite(instructions, values, line[..image_width].as_flattened_mut());
            }
            let last = line[image_width - 1];
            line[image_width..].fill(last);
            for (sum, block) in sums.iter_mut().zip(line.chunks_exact(side)) {
                let mut total = [0.0; 3];
                for colour in block {
                    for c in 0..3 {
                        total[c] += colour[c];
                    }
                }
                *sum = mix(total);
            }
        }
        let share = 255.0 / (side * side) as f32;
        Self::from_rows(width, height, |channel, y, row| {
            for (value, sum) in row.iter_mut().zip(&sums[y * width..]) {
                *value = share * sum[channel];
            }
        })
    }

    /// Columns and rows.
    pub(super) fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Index of a pixel in a channel.
    #[inline(always)]
    pub(super) fn index(&self, x: usize, y: usize) -> usize {
        (y + BORDER) * self.stride + x + BORDER
    }

    /// The values of one row of one channel, without the border.
    pub(super) fn row(&self, channel: usize, y: usize) -> &[f32] {
        let first = (y + BORDER) * self.stride + BORDER;
        &self.channels[channel][first..first + self.width]
    }

    /// The channels without the border.
    pub(super) fn interiors(&self) -> [Vec<f32>; CHANNELS] {
        std::array::from_fn(|channel| {
            let mut values = Vec::with_capacity(self.width * self.height);
            (0..self.height).for_each(|y| values.extend_from_slice(self.row(channel, y)));
            values
        })
    }

    /// Half the size, each pixel the mean of four; an odd last row or column is replicated.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        Self::from_rows(width, height, |channel, y, row| {
            let (first, channel) = (self.index(0, 2 * y), &self.channels[channel]);
            let upper = &channel[first..first + 2 * width];
            let lower = &channel[first + self.stride..first + self.stride + 2 * width];
            let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
            for (value, (a, b)) in row.iter_mut().zip(pairs) {
                *value = 0.25 * (a[0] + a[1] + b[0] + b[1]);
            }
        })
    }

    /// Central differences along x and along y.
    pub(super) fn gradients(&self) -> [Self; 2] {
        [1, self.stride].map(|step| {
            Self::from_rows(self.width, self.height, |channel, y, row| {
                let (first, values) = (self.index(0, y), &self.channels[channel]);
                let ahead = &values[first + step..first + step + self.width];
                let behind = &values[first - step..first - step + self.width];
                for ((value, a), b) in row.iter_mut().zip(ahead).zip(behind) {
                    *value = 0.5 * (a - b);
                }
            })
        })
    }

    /// The image minus its mean over windows of `2 * radius + 1` pixels: what is left of shading and exposure
    /// changes is small. Without the border.
    pub(super) fn high_passed(&self, radius: usize) -> [Vec<f32>; CHANNELS] {
        self.interiors().map(|mut values| {
            let mean = box_mean(&values, self.width, self.height, radius);
            values.iter_mut().zip(&mean).for_each(|(value, mean)| *value -= mean);
            values
        })
    }

    /// The colour at fractional pixel index `(x, y)`, bilinear; outside is the border.
    pub(super) fn colour_at(&self, x: f32, y: f32) -> [f32; CHANNELS] {
        let x = x.clamp(-1.0, self.width as f32) + BORDER as f32;
        let y = y.clamp(-1.0, self.height as f32) + BORDER as f32;
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let first = row * self.stride + column;
        self.channels.each_ref().map(|channel| {
            let upper = &channel[first..first + 2];
            let lower = &channel[first + self.stride..first + self.stride + 2];
            let above = upper[0] + fx * (upper[1] - upper[0]);
            let below = lower[0] + fx * (lower[1] - lower[0]);
            above + fy * (below - above)
        })
    }
}

/// The pyramid of one frame: level 0 first, each level half the size of the one before, down to at most
/// `coarsest_side` pixels on the longer side.
pub(super) fn pyramid<const CHANNELS: usize>(
    finest: Planes<CHANNELS>,
    coarsest_side: usize,
) -> Vec<Planes<CHANNELS>> {
    let mut levels = vec![finest];
    loop {
        let coarsest = &levels[levels.len() - 1];
        if coarsest.width.max(coarsest.height) <= coarsest_side.max(2) {
            return levels;
        }
        let next = coarsest.halved();
        levels.push(next);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramped(width: usize, height: usize) -> Planes {
        let channel = |c: usize| (0..width * height).map(|i| ((i * 37 + c * 11) % 101) as f32).collect();
        Planes::from_interiors(width, height, [channel(0), channel(1), channel(2)])
    }

    /// Bilinear in f64, clamped to the image, as the reference.
    fn bilinear(planes: &Planes, channel: usize, x: f64, y: f64) -> f64 {
        let value = |x: f64, y: f64| {
            let column = x.clamp(0.0, planes.width as f64 - 1.0) as usize;
            f64::from(planes.row(channel, y.clamp(0.0, planes.height as f64 - 1.0) as usize)[column])
        };
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        (1.0 - fy) * ((1.0 - fx) * value(x0, y0) + fx * value(x0 + 1.0, y0))
            + fy * ((1.0 - fx) * value(x0, y0 + 1.0) + fx * value(x0 + 1.0, y0 + 1.0))
    }

    #[test]
    fn sampling_agrees_with_double_precision_and_clamps_outside() {
        let planes = ramped(13, 9);
        for (x, y) in [(0.0f32, 0.0f32), (3.25, 4.75), (-4.5, 2.5), (11.9, 8.0), (-9.0, -9.0), (13.0, 9.0)] {
            let colour = planes.colour_at(x.clamp(-1.0, 13.0), y.clamp(-1.0, 9.0));
            let exact = bilinear(&planes, 2, f64::from(x.clamp(-1.0, 13.0)), f64::from(y.clamp(-1.0, 9.0)));
            assert!((f64::from(colour[2]) - exact).abs() < 1e-3);
        }
        for far in [f32::MAX, f32::MIN, f32::INFINITY, f32::NEG_INFINITY, 1e-40] {
            assert!(planes.colour_at(far, far).iter().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn halving_keeps_the_mean_and_rounds_sizes_up() {
        let half = ramped(6, 4).halved();
        let mean = |planes: &Planes| {
            planes.interiors()[1].iter().sum::<f32>() / (planes.width * planes.height) as f32
        };
        assert!((mean(&half) - mean(&ramped(6, 4))).abs() < 1e-3);
        let odd = ramped(5, 1).halved();
        assert_eq!((odd.width, odd.height), (3, 1));
        assert_eq!(odd.row(0, 0)[2], ramped(5, 1).row(0, 0)[4]);
        assert_eq!(pyramid(ramped(40, 3), 10).len(), 3);
    }
}
