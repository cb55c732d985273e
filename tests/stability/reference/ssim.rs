//! Structural similarity (Wang et al. 2004) by its definition, a double sum over the window of every pixel, with its
//! derivative and what rounding does to both at first order.

use splat::image::{Image, Mask};

const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
const RADIUS: i64 = 5;
const DEVIATION: f64 = 1.5;

/// Weights of the 11 × 11 window, which sum to 1.
fn window() -> Vec<(i64, i64, f64)> {
    let tap = |offset: i64| (-((offset * offset) as f64) / (2.0 * DEVIATION * DEVIATION)).exp();
    let sum: f64 = (-RADIUS..=RADIUS).map(tap).sum();
    let offsets = || -RADIUS..=RADIUS;
    offsets().flat_map(|y| offsets().map(move |x| (x, y, tap(x) * tap(y) / (sum * sum)))).collect()
}

/// Windowed sums around one pixel of one channel: `x`, `y`, `x²`, `y²`, `x y`; zeros outside of the images.
type Moments = [f64; 5];

/// SSIM, `1 - SSIM` where that is smaller than rounding of SSIM, and derivatives by the moments.
struct Similarity {
    value: f64,
    by_moment: Moments,
}

fn similarity([x, y, xx, yy, xy]: Moments) -> Similarity {
    let (luminance, contrast) = (2.0 * x * y + C1, 2.0 * (xy - x * y) + C2);
    let (energy, variance) = (x * x + y * y + C1, (xx - x * x) + (yy - y * y) + C2);
    let value = luminance * contrast / (energy * variance);
    let by_x = (2.0 * y * contrast - 2.0 * y * luminance) / (energy * variance)
        + value * (2.0 * x / variance - 2.0 * x / energy);
    let by_y = (2.0 * x * contrast - 2.0 * x * luminance) / (energy * variance)
        + value * (2.0 * y / variance - 2.0 * y / energy);
    let by_square = -value / variance;
    Similarity { value, by_moment: [by_x, by_y, by_square, by_square, 2.0 * luminance / (energy * variance)] }
}

/// A mean over values, and what one rounding of its parts does to it, in unit roundoffs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Mean {
    pub value: f64,
    /// One rounding of every moment.
    pub by_moments: f64,
    /// One rounding per term of the sum, all to the same side: number of terms × mean of their sizes.
    pub by_sum: f64,
}

/// Two images of one size, as doubles.
pub(crate) struct Pair {
    width: i64,
    height: i64,
    a: Vec<f64>,
    b: Vec<f64>,
    counts: Vec<bool>,
    window: Vec<(i64, i64, f64)>,
}

impl Pair {
    /// All pixels count unless there is a mask.
    pub(crate) fn new(a: &Image, b: &Image, mask: Option<&Mask>) -> Self {
        let wide = |image: &Image| image.pixels.iter().map(|&value| f64::from(value)).collect();
        Self {
            width: a.width.into(),
            height: a.height.into(),
            a: wide(a),
            b: wide(b),
            counts: mask.map_or(vec![true; a.pixel_count()], |mask| mask.inside.clone()),
            window: window(),
        }
    }

    /// Replaces one value of the first image.
    pub(crate) fn set(&mut self, value: usize, to: f64) {
        self.a[value] = to;
    }

    fn counted(&self) -> f64 {
        3.0 * self.counts.iter().filter(|&&counts| counts).count() as f64
    }

    /// Places of the pixels under the window around a pixel, with their weights.
    fn around(&self, pixel: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let (x, y) = (pixel as i64 % self.width, pixel as i64 / self.width);
        self.window.iter().filter_map(move |&(dx, dy, weight)| {
            let (x, y) = (x + dx, y + dy);
            let is_inside = (0..self.width).contains(&x) && (0..self.height).contains(&y);
            is_inside.then_some(((y * self.width + x) as usize, weight))
        })
    }

    fn moments(&self, pixel: usize, channel: usize) -> Moments {
        let mut moments = [0.0; 5];
        for (place, weight) in self.around(pixel) {
            let (a, b) = (self.a[3 * place + channel], self.b[3 * place + channel]);
            for (moment, term) in moments.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                *moment += weight * term;
            }
        }
        moments
    }

    fn values(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        (0..self.counts.len())
            .filter(|&pixel| self.counts[pixel])
            .flat_map(|pixel| (0..3).map(move |c| (pixel, c)))
    }

    /// Mean SSIM over the channels of the pixels that count.
    pub(crate) fn ssim(&self) -> Mean {
        let mut mean = Mean::default();
        for (pixel, channel) in self.values() {
            let moments = self.moments(pixel, channel);
            let Similarity { value, by_moment } = similarity(moments);
            mean.value += value / self.counted();
            mean.by_sum += value.abs();
            let terms: f64 = moments.iter().zip(by_moment).map(|(moment, by)| (moment * by).abs()).sum();
            mean.by_moments += terms / self.counted();
        }
        mean
    }

    /// Mean absolute difference over the channels of the pixels that count.
    pub(crate) fn absolute(&self) -> f64 {
        let difference = |(pixel, channel): (usize, usize)| {
            (self.a[3 * pixel + channel] - self.b[3 * pixel + channel]).abs()
        };
        self.values().map(difference).sum::<f64>() / self.counted()
    }

    /// Mean squared difference over the channels of the pixels that count.
    pub(crate) fn squared(&self) -> f64 {
        let square = |(pixel, channel): (usize, usize)| {
            (self.a[3 * pixel + channel] - self.b[3 * pixel + channel]).powi(2)
        };
        self.values().map(square).sum::<f64>() / self.counted()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_by_moments_match_central_differences() {
        let at = [0.4, 0.5, 0.21, 0.3, 0.22];
        for moment in 0..5 {
            let step = 1e-6;
            let moved = |by: f64| {
                let mut moments = at;
                moments[moment] += by;
                similarity(moments).value
            };
            let numeric = (moved(step) - moved(-step)) / (2.0 * step);
            let analytic = similarity(at).by_moment[moment];
            // Central differences at step 1e-6 of a function of scale 1 err by about 1e-10.
            assert!((numeric - analytic).abs() < 1e-7, "{moment}: {numeric} {analytic}");
        }
    }
}
