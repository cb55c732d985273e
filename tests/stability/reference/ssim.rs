//! Structural similarity (Wang et al. 2004) by its definition, a double sum over the window of every pixel, with its
//! derivative and what rounding does to both at first order.

use splat::image::{Image, Mask};

const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
const RADIUS: i64 = 5;
const DEVIATION: f64 = 1.5;

/// Weights of the window along one axis, which sum to 1.
fn taps() -> [f64; 11] {
    let tap = |offset: i64| (-((offset * offset) as f64) / (2.0 * DEVIATION * DEVIATION)).exp();
    let sum: f64 = (-RADIUS..=RADIUS).map(tap).sum();
    std::array::from_fn(|place| tap(place as i64 - RADIUS) / sum)
}

/// Windowed sums around one pixel of one channel: `x`, `y`, `x²`, `y²`, `x y`; zeros outside of the images.
type Moments = [f64; 5];

/// SSIM around one pixel.
struct Similarity {
    value: f64,
    by_moment: Moments,
    /// Sum of the sizes of the terms that a rounding of every intermediate result changes the value by, in roundoffs.
    sensitivity: f64,
    /// How many times its own roundoff a derivative has, as variances are small differences of squares.
    amplification: f64,
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
    let by_moment = [by_x, by_y, by_square, by_square, 2.0 * luminance / (energy * variance)];
    let squares = xx + yy + x * x + y * y;
    let sensitivity = (by_x * x).abs()
        + (by_y * y).abs()
        + by_square.abs() * squares
        + by_moment[4].abs() * (xy.abs() + (x * y).abs())
        + 4.0 * value.abs();
    Similarity { value, by_moment, sensitivity, amplification: 4.0 + squares / variance }
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
    /// Values in the means.
    counted: f64,
    taps: [f64; 11],
}

impl Pair {
    /// All pixels count unless there is a mask.
    pub(crate) fn new(a: &Image, b: &Image, mask: Option<&Mask>) -> Self {
        let counts = mask.map_or(vec![true; a.pixel_count()], |mask| mask.inside.clone());
        let wide = |image: &Image| image.pixels.iter().map(|&value| f64::from(value)).collect();
        Self {
            width: a.width.into(),
            height: a.height.into(),
            a: wide(a),
            b: wide(b),
            counted: 3.0 * counts.iter().filter(|&&counts| counts).count() as f64,
            counts,
            taps: taps(),
        }
    }

    /// Places of the pixels under the window around a pixel, with their weights.
    fn around(&self, pixel: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let (x, y) = (pixel as i64 % self.width, pixel as i64 / self.width);
        let reach = |centre: i64, size: i64| (centre - RADIUS).max(0)..(centre + RADIUS + 1).min(size);
        let tap = |place: i64, centre: i64| self.taps[(place - centre + RADIUS) as usize];
        reach(y, self.height).flat_map(move |row| {
            reach(x, self.width)
                .map(move |column| ((row * self.width + column) as usize, tap(row, y) * tap(column, x)))
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
            let Similarity { value, sensitivity, .. } = similarity(moments);
            mean.value += value / self.counted;
            mean.by_sum += value.abs();
            mean.by_moments += sensitivity / self.counted;
        }
        mean
    }

    /// Mean absolute difference over the channels of the pixels that count.
    pub(crate) fn absolute(&self) -> f64 {
        let difference = |(pixel, channel): (usize, usize)| {
            (self.a[3 * pixel + channel] - self.b[3 * pixel + channel]).abs()
        };
        self.values().map(difference).sum::<f64>() / self.counted
    }

    /// Gradient of `mean SSIM` by every value of the first image, each with the sum of the sizes of its terms times what
    /// their roundoff is amplified by.
    pub(crate) fn ssim_gradient(&self) -> Vec<[f64; 2]> {
        let mut gradient = vec![[0.0; 2]; self.a.len()];
        for (pixel, channel) in self.values() {
            let Similarity { by_moment: [by_x, _, by_xx, _, by_xy], amplification, .. } =
                similarity(self.moments(pixel, channel));
            for (place, weight) in self.around(pixel) {
                let value = 3 * place + channel;
                let (a, b) = (self.a[value], self.b[value]);
                let terms = [by_x, 2.0 * a * by_xx, b * by_xy].map(|term| term * weight / self.counted);
                gradient[value][0] += terms.iter().sum::<f64>();
                gradient[value][1] += terms.iter().map(|term| term.abs()).sum::<f64>() * amplification;
            }
        }
        gradient
    }

    /// Gradient of the mean absolute difference by every value of the first image; zero where both are equal.
    pub(crate) fn absolute_gradient(&self) -> Vec<f64> {
        let mut gradient = vec![0.0; self.a.len()];
        for (pixel, channel) in self.values() {
            let value = 3 * pixel + channel;
            let difference = self.a[value] - self.b[value];
            gradient[value] = if difference == 0.0 { 0.0 } else { difference.signum() / self.counted };
        }
        gradient
    }

    /// Mean squared difference over the channels of the pixels that count.
    pub(crate) fn squared(&self) -> f64 {
        let square = |(pixel, channel): (usize, usize)| {
            (self.a[3 * pixel + channel] - self.b[3 * pixel + channel]).powi(2)
        };
        self.values().map(square).sum::<f64>() / self.counted
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

    #[test]
    fn gradient_matches_central_differences() {
        let image = |phase: f32| Image {
            width: 7,
            height: 4,
            pixels: (0..84).map(|index| 0.5 + 0.4 * (index as f32 * 0.37 + phase).sin()).collect(),
        };
        let mut pair = Pair::new(&image(0.0), &image(0.4), None);
        let gradient = pair.ssim_gradient();
        for value in [0, 5, 40, 83] {
            let step = 1e-6;
            let at = pair.a[value];
            let mut moved = |by: f64| {
                pair.a[value] = at + by;
                pair.ssim().value
            };
            let numeric = (moved(step) - moved(-step)) / (2.0 * step);
            pair.a[value] = at;
            // Central differences of a mean of 84 values of scale 1 err by 1e-10.
            assert!((numeric - gradient[value][0]).abs() < 1e-8, "{value}: {numeric} {:?}", gradient[value]);
        }
    }
}
