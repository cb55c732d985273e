//! Colour planes with a replicated border, their pyramid, and the sampling that everything else is made of.

use crate::image::Image;

/// Side of a patch, pixels. A constant, so that the loops over a patch have a known length and vectorise.
pub(super) const PATCH: usize = 8;
/// Values of a patch: three channels, row by row.
pub(super) const PATCH_VALUES: usize = 3 * PATCH * PATCH;
/// Replicated pixels on every side: a whole patch fits outside the image, with one more pixel to interpolate.
pub(super) const BORDER: usize = PATCH + 2;

/// The values of one patch, channel by channel.
pub(super) type Patch = [f32; PATCH_VALUES];

/// Three `f32` channels on the 0 to 255 scale, each with `BORDER` replicated pixels on every side.
#[derive(Clone, Debug)]
pub(super) struct Planes {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    pub(super) channels: [Vec<f32>; 3],
}

impl Planes {
    /// Planes of an image; values that are not finite become 0.
    pub(super) fn from_image(image: &Image) -> Self {
        let (width, height) = (image.width as usize, image.height as usize);
        let interior = |channel: usize| -> Vec<f32> {
            let values = image.pixels.iter().skip(channel).step_by(3);
            values
                .map(|&value| if value.is_finite() { 255.0 * value.clamp(-4.0, 4.0) } else { 0.0 })
                .collect()
        };
        Self::from_interiors(width, height, [interior(0), interior(1), interior(2)])
    }

    /// Adds the border to three channels of `height * width` values.
    pub(super) fn from_interiors(width: usize, height: usize, interiors: [Vec<f32>; 3]) -> Self {
        let stride = width + 2 * BORDER;
        let channels = interiors.map(|interior| with_border(&interior, width, height));
        Self { width, height, stride, channels }
    }

    /// The values of one row of one channel, without the border.
    pub(super) fn row(&self, channel: usize, y: usize) -> &[f32] {
        let first = (y + BORDER) * self.stride + BORDER;
        &self.channels[channel][first..first + self.width]
    }

    /// The channels without the border.
    pub(super) fn interiors(&self) -> [Vec<f32>; 3] {
        [0, 1, 2].map(|channel| (0..self.height).flat_map(|y| self.row(channel, y)).copied().collect())
    }

    /// Half the size, each pixel the mean of four; an odd last row or column is replicated.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let halve = |channel: &Vec<f32>| {
            let mut half = Vec::with_capacity(width * height);
            for y in 0..height {
                let first = (2 * y + BORDER) * self.stride + BORDER;
                let upper = &channel[first..first + 2 * width];
                let lower = &channel[first + self.stride..first + self.stride + 2 * width];
                let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
                half.extend(pairs.map(|(a, b)| 0.25 * (a[0] + a[1] + b[0] + b[1])));
            }
            half
        };
        Self::from_interiors(width, height, [0, 1, 2].map(|channel| halve(&self.channels[channel])))
    }

    /// Central differences along x and along y.
    pub(super) fn gradients(&self) -> [Self; 2] {
        [1, self.stride].map(|step| {
            let interiors = [0, 1, 2].map(|channel| {
                let values = &self.channels[channel];
                let mut differences = Vec::with_capacity(self.width * self.height);
                for y in 0..self.height {
                    let first = (y + BORDER) * self.stride + BORDER;
                    let ahead = &values[first + step..first + step + self.width];
                    let behind = &values[first - step..first - step + self.width];
                    differences.extend(ahead.iter().zip(behind).map(|(a, b)| 0.5 * (a - b)));
                }
                differences
            });
            Self::from_interiors(self.width, self.height, interiors)
        })
    }

    /// The image minus its mean over windows of `2 * radius + 1` pixels: what is left of shading and exposure
    /// changes is small.
    pub(super) fn high_passed(&self, radius: usize) -> Self {
        let interiors = self.interiors().map(|interior| {
            let mean = box_mean(&interior, self.width, self.height, radius);
            interior.iter().zip(&mean).map(|(value, mean)| value - mean).collect()
        });
        Self::from_interiors(self.width, self.height, interiors)
    }

    /// The patch whose top-left pixel has index `(x, y)`.
    pub(super) fn patch(&self, x: usize, y: usize) -> Patch {
        let mut patch = [0.0; PATCH_VALUES];
        for (channel, rows) in self.channels.iter().zip(patch.as_chunks_mut::<{ PATCH * PATCH }>().0) {
            let mut first = (y + BORDER) * self.stride + x + BORDER;
            for row in rows.as_chunks_mut::<PATCH>().0 {
                row.copy_from_slice(&channel[first..first + PATCH]);
                first += self.stride;
            }
        }
        patch
    }

    /// The patch whose top-left pixel has the fractional index `(x, y)`, bilinear; far outside is the border.
    pub(super) fn patch_at(&self, x: f32, y: f32) -> Patch {
        let least = -(PATCH as f32 + 1.0);
        // Shifting by the border makes the coordinates positive, so truncation is the floor.
        let x = x.clamp(least, self.width as f32) + BORDER as f32;
        let y = y.clamp(least, self.height as f32) + BORDER as f32;
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let mut patch = [0.0; PATCH_VALUES];
        for (channel, rows) in self.channels.iter().zip(patch.as_chunks_mut::<{ PATCH * PATCH }>().0) {
            let mut first = row * self.stride + column;
            for out in rows.as_chunks_mut::<PATCH>().0 {
                let upper = &channel[first..first + PATCH + 1];
                let lower = &channel[first + self.stride..first + self.stride + PATCH + 1];
                for i in 0..PATCH {
                    out[i] = weights[0] * upper[i]
                        + weights[1] * upper[i + 1]
                        + weights[2] * lower[i]
                        + weights[3] * lower[i + 1];
                }
                first += self.stride;
            }
        }
        patch
    }

    /// The colour at fractional pixel index `(x, y)`, bilinear; outside is the border.
    pub(super) fn colour_at(&self, x: f32, y: f32) -> [f32; 3] {
        let x = x.clamp(-1.0, self.width as f32) + BORDER as f32;
        let y = y.clamp(-1.0, self.height as f32) + BORDER as f32;
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let first = row * self.stride + column;
        [0, 1, 2].map(|channel| {
            let upper = &self.channels[channel][first..first + 2];
            let lower = &self.channels[channel][first + self.stride..first + self.stride + 2];
            let above = upper[0] + fx * (upper[1] - upper[0]);
            let below = lower[0] + fx * (lower[1] - lower[0]);
            above + fy * (below - above)
        })
    }
}

/// The pyramid of one frame: level 0 first, each level half the size of the one before, down to at most
/// `coarsest_side` pixels on the longer side.
pub(super) fn pyramid(finest: Planes, coarsest_side: usize) -> Vec<Planes> {
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

fn with_border(interior: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut padded = Vec::with_capacity((width + 2 * BORDER) * (height + 2 * BORDER));
    for y in 0..height + 2 * BORDER {
        let source = y.saturating_sub(BORDER).min(height - 1);
        let row = &interior[source * width..(source + 1) * width];
        padded.extend(std::iter::repeat_n(row[0], BORDER));
        padded.extend_from_slice(row);
        padded.extend(std::iter::repeat_n(row[width - 1], BORDER));
    }
    padded
}

/// Sum over windows of `2 * radius + 1` columns and rows, cut at the image's edge.
pub(super) fn box_sum(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let mut columns = vec![0.0f32; width * height];
    for y in 0..height {
        let out = &mut columns[y * width..(y + 1) * width];
        // Direct sums: a running sum would carry its rounding along and break exact symmetry.
        for source in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            let row = &values[source * width..(source + 1) * width];
            out.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
        }
    }
    let mut sums = vec![0.0f32; width * height];
    let mut padded = vec![0.0f32; width + 2 * radius];
    for y in 0..height {
        padded[radius..radius + width].copy_from_slice(&columns[y * width..(y + 1) * width]);
        let out = &mut sums[y * width..(y + 1) * width];
        for shift in 0..=2 * radius {
            out.iter_mut().zip(&padded[shift..shift + width]).for_each(|(sum, value)| *sum += value);
        }
    }
    sums
}

/// Number of pixels of each window of [`box_sum`].
pub(super) fn box_counts(width: usize, height: usize, radius: usize) -> Vec<f32> {
    let extent = |at: usize, size: usize| (at + radius + 1).min(size) - at.saturating_sub(radius);
    let counts =
        (0..height).flat_map(|y| (0..width).map(move |x| (extent(x, width) * extent(y, height)) as f32));
    counts.collect()
}

/// Mean over windows of `2 * radius + 1` columns and rows, cut at the image's edge.
pub(super) fn box_mean(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let sums = box_sum(values, width, height, radius);
    sums.iter().zip(&box_counts(width, height, radius)).map(|(sum, count)| sum / count).collect()
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
            let patch = planes.patch_at(x, y);
            for (i, &value) in patch.iter().enumerate() {
                let (channel, row, column) = (i / 64, i / 8 % 8, i % 8);
                let exact =
                    bilinear(&planes, channel, f64::from(x) + column as f64, f64::from(y) + row as f64);
                // Values up to 100 in f32: four roundings of 6e-8 relative, the weights another few.
                assert!((f64::from(value) - exact).abs() < 1e-3, "{x} {y} {i}: {value} {exact}");
            }
            let colour = planes.colour_at(x.clamp(-1.0, 13.0), y.clamp(-1.0, 9.0));
            let exact = bilinear(&planes, 2, f64::from(x.clamp(-1.0, 13.0)), f64::from(y.clamp(-1.0, 9.0)));
            assert!((f64::from(colour[2]) - exact).abs() < 1e-3);
        }
        for far in [f32::MAX, f32::MIN, f32::INFINITY, f32::NEG_INFINITY, 1e-40] {
            assert!(
                planes.patch_at(far, far).iter().chain(&planes.colour_at(far, far)).all(|v| v.is_finite())
            );
        }
    }

    #[test]
    fn box_means_agree_with_direct_sums() {
        let (width, height) = (7, 5);
        let values: Vec<f32> = (0..width * height).map(|i| ((i * 13) % 17) as f32 - 8.0).collect();
        for radius in [0, 1, 2, 6, 100] {
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
