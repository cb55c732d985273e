//! Images on their way into a network, and its maps on their way back to the image's resolution.

use super::settings::ValueRange;

/// How an image fits into a network's input: reduced to the upper left `content`, replicated to the right and below
/// up to `padded`. All widths first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    pub(super) image: (usize, usize),
    pub(super) content: (usize, usize),
    pub(super) padded: (usize, usize),
}

impl Fit {
    /// For a network that takes every size.
    pub(super) fn within(image: (usize, usize), max_side: usize, multiple: usize) -> Self {
        let longest = image.0.max(image.1).max(1);
        let reduced = |side: usize| match longest > max_side {
            true => ((side * max_side) as f64 / longest as f64).round().max(1.0) as usize,
            false => side,
        };
        let content = (reduced(image.0), reduced(image.1));
        let padded = (content.0.next_multiple_of(multiple), content.1.next_multiple_of(multiple));
        Self { image, content, padded }
    }

    /// For a network that takes one size: the image is stretched to it.
    pub(super) fn stretched(image: (usize, usize), size: (usize, usize)) -> Self {
        Self { image, content: size, padded: size }
    }

    /// Image pixels per pixel of the network, along x and y.
    pub(super) fn scale(&self) -> [f32; 2] {
        [self.image.0 as f32 / self.content.0 as f32, self.image.1 as f32 / self.content.1 as f32]
    }

    /// The input `[1, 3, H, W]` for an image of three channels of `height * width` values, 0 to 255.
    pub(super) fn input(&self, channels: &[Vec<f32>; 3], range: ValueRange) -> Vec<f32> {
        let mut out = Vec::with_capacity(3 * self.padded.0 * self.padded.1);
        for (index, channel) in channels.iter().enumerate() {
            let (offset, factor) = range.scale(index);
            let content = resized(channel, self.image, self.content);
            for y in 0..self.padded.1 {
                let first = y.min(self.content.1 - 1) * self.content.0;
                let row = &content[first..first + self.content.0];
                let replicated = std::iter::repeat_n(row[row.len() - 1], self.padded.0 - row.len());
                out.extend(row.iter().copied().chain(replicated).map(|value| (value + offset) * factor));
            }
        }
        out
    }

    /// A map of the network, `padded`, at the image's resolution.
    pub(super) fn enlarged(&self, map: &[f32]) -> Vec<f32> {
        let rows = map.chunks_exact(self.padded.0).take(self.content.1);
        let content: Vec<f32> = rows.flat_map(|row| &row[..self.content.0]).copied().collect();
        resized(&content, self.content, self.image)
    }
}

/// Resizes `height * width` values: linear interpolation between pixel centres, over a wider window where pixels
/// become fewer, so that none is left out.
fn resized(values: &[f32], from: (usize, usize), to: (usize, usize)) -> Vec<f32> {
    if from == to {
        return values.to_vec();
    }
    let columns = windows(from.0, to.0);
    let rows = windows(from.1, to.1);
    let wide: Vec<f32> = values
        .chunks_exact(from.0)
        .flat_map(|row| {
            columns
                .iter()
                .map(|(first, weights)| row[*first..].iter().zip(weights).map(|(v, w)| v * w).sum::<f32>())
        })
        .collect();
    let mut out = vec![0.0; to.0 * to.1];
    for ((first, weights), out) in rows.iter().zip(out.chunks_exact_mut(to.0)) {
        for (row, weight) in wide[first * to.0..].chunks_exact(to.0).zip(weights) {
            out.iter_mut().zip(row).for_each(|(out, value)| *out += weight * value);
        }
    }
    out
}

/// First source index and weights of every target pixel along one axis.
fn windows(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f64 / to as f64;
    let reach = scale.max(1.0);
    let window = |target: usize| {
        let centre = (target as f64 + 0.5) * scale;
        let first = ((centre - reach).max(0.0) as usize).min(from - 1);
        let last = ((centre + reach).ceil() as usize).clamp(first + 1, from);
        let weights: Vec<f64> =
            (first..last).map(|index| (1.0 - (index as f64 + 0.5 - centre).abs() / reach).max(0.0)).collect();
        let sum: f64 = weights.iter().sum();
        (first, weights.iter().map(|weight| (weight / sum) as f32).collect())
    };
    (0..to).map(window).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_images_are_reduced_and_sides_padded() {
        let fit = Fit::within((1920, 1080), 768, 8);
        assert_eq!((fit.content, fit.padded), ((768, 432), (768, 432)));
        let fit = Fit::within((101, 33), 768, 8);
        assert_eq!((fit.content, fit.padded), ((101, 33), (104, 40)));
        assert_eq!(fit.scale(), [1.0, 1.0]);
        // A line of pixels keeps its one row.
        assert_eq!(Fit::within((10_000, 1), 100, 1).content, (100, 1));
    }

    #[test]
    fn ramps_survive_resizing_away_from_the_edge() {
        // Linear interpolation between pixel centres reproduces linear functions, at every ratio.
        for (from, to) in [(40, 23), (23, 40), (64, 16), (9, 9)] {
            let ramp: Vec<f32> = (0..from).map(|x| x as f32 + 0.5).collect();
            let out = resized(&ramp, (from, 1), (to, 1));
            let scale = from as f32 / to as f32;
            let edge = (to as f32 / from as f32).max(1.0).ceil() as usize;
            for (x, value) in out.iter().enumerate().skip(edge).take(to - 2 * edge) {
                let expected = (x as f32 + 0.5) * scale;
                // Windows that do not lie symmetrically to the source pixels err by a fraction of a pixel.
                let tolerance = if to < from { 0.1 * scale } else { 1e-4 };
                assert!((value - expected).abs() < tolerance, "{from} to {to} at {x}: {value}, {expected}");
            }
            let constant = resized(&vec![3.0; from * 2], (from, 2), (to, 5));
            assert!(constant.iter().all(|value| (value - 3.0).abs() < 1e-5) && constant.len() == to * 5);
        }
    }

    #[test]
    fn the_padding_repeats_the_last_row_and_column() {
        let fit = Fit::within((2, 2), 16, 3);
        let channel = vec![0.0, 255.0, 51.0, 102.0];
        let input = fit.input(&[channel.clone(), channel.clone(), channel], ValueRange::Unit);
        let expected = [0.0, 1.0, 1.0, 0.2, 0.4, 0.4, 0.2, 0.4, 0.4];
        assert!(input[..9].iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{input:?}");
        assert_eq!(input.len(), 27);
        assert_eq!(fit.enlarged(&[1.0, 2.0, 9.0, 3.0, 4.0, 9.0, 9.0, 9.0, 9.0]), [1.0, 2.0, 3.0, 4.0]);
    }

    #[test]
    fn ranges_place_black_and_white() {
        for (range, black, white) in [
            (ValueRange::Bytes, 0.0, 255.0),
            (ValueRange::Unit, 0.0, 1.0),
            (ValueRange::Symmetric, -1.0, 1.0),
            // (0 - 0.485) / 0.229 and (1 - 0.485) / 0.229.
            (ValueRange::ImageNet, -2.117_904, 2.248_908),
        ] {
            let (offset, factor) = range.scale(0);
            let [at_black, at_white] = [0.0, 255.0].map(|value: f32| (value + offset) * factor);
            assert!((at_black - black).abs() < 1e-5 && (at_white - white).abs() < 1e-4, "{range:?}");
        }
    }
}
