//! Values and gradients side by side, for sampling along a flow.

use super::planes::Planes;
use crate::simd::{LANES, ROWS, Simd};

/// Replicated pixels on every side: one to interpolate with, one more for positions a pixel outside.
const BORDER: usize = 2;

/// A pixel of a channel: value, gradient along x and y, nothing.
type Texel = [f32; ROWS];

/// What a channel shows at [`LANES`] places: values, and gradients along x and y.
pub(super) type Sample<S> = [S; 3];

/// Texels of every channel: the corners of an interpolation are four loads.
pub(super) struct Texels<const CHANNELS: usize> {
    width: usize,
    height: usize,
    stride: usize,
    channels: [Vec<Texel>; CHANNELS],
}

impl<const CHANNELS: usize> Texels<CHANNELS> {
    /// Values of one image with the central differences of another of the same size.
    pub(super) fn new(values: &Planes<CHANNELS>, sloped: &Planes<CHANNELS>) -> Self {
        let (width, height) = (values.width, values.height);
        let stride = width + 2 * BORDER;
        let channels = std::array::from_fn(|c| {
            let mut texels = Vec::with_capacity(stride * (height + 2 * BORDER));
            for y in 0..height + 2 * BORDER {
                let y = y.saturating_sub(BORDER).min(height - 1);
                let (at, first) = (sloped.index(0, y), values.index(0, y));
                let row = |from: usize| &sloped.channels[c][from..from + width];
                let (left, right) = (row(at - 1), row(at + 1));
                let (above, below) = (row(at - sloped.stride), row(at + sloped.stride));
                let centre = &values.channels[c][first..first + width];
                let texel =
                    |x: usize| [centre[x], 0.5 * (right[x] - left[x]), 0.5 * (below[x] - above[x]), 0.0];
                texels.extend([texel(0); BORDER]);
                texels.extend((0..width).map(texel));
                texels.extend([texel(width - 1); BORDER]);
            }
            texels
        });
        Self { width, height, stride, channels }
    }

    /// Every channel at fractional pixel indices `(x, y)`, bilinear; outside is the border.
    #[inline(always)]
    pub(super) fn sample<S: Simd>(&self, x: S, y: S) -> [Sample<S>; CHANNELS] {
        let (column, right) = split(x, self.width);
        let (row, below) = split(y, self.height);
        let first: [usize; LANES] =
            std::array::from_fn(|lane| row[lane] as usize * self.stride + column[lane] as usize);
        let shares = spread(right).into_iter().zip(spread(below));
        let mut samples = [[S::splat(0.0); 3]; CHANNELS];
        let mut groups = [[S::splat(0.0); ROWS]; CHANNELS];
        for (part, (right, below)) in shares.enumerate() {
            // Every fourth place, so that the transposition leaves them in their order.
            let places = [first[part], first[part + 4], first[part + 8], first[part + 12]];
            for (groups, texels) in groups.iter_mut().zip(&self.channels) {
                let corner = |offset: usize| S::load_rows(places.map(|place| &texels[place + offset]));
                let between = |left: S, other: S| other.sub(left).mul_add(right, left);
                let upper = between(corner(0), corner(1));
                let lower = between(corner(self.stride), corner(self.stride + 1));
                groups[part] = lower.sub(upper).mul_add(below, upper);
            }
        }
        for (sample, groups) in samples.iter_mut().zip(groups) {
            let [value, along_x, along_y, _] = S::transpose_rows(groups);
            *sample = [value, along_x, along_y];
        }
        samples
    }
}

/// The texels before fractional pixel indices along an axis, and the fractions of the next.
#[inline(always)]
fn split<S: Simd>(at: S, size: usize) -> ([i32; LANES], S) {
    // Not a number becomes the first pixel.
    let inside = at.max(S::splat(-1.0)).min(S::splat(size as f32));
    let whole = inside.floor();
    let mut texels = [0; LANES];
    whole.add(S::splat(BORDER as f32)).store_integers(&mut texels);
    (texels, inside.sub(whole))
}

/// Of every row one number in all of its lanes: the first of each, the second, and so on.
#[inline(always)]
fn spread<S: Simd>(of: S) -> [S; ROWS] {
    [of.spread_in_rows::<0>(), of.spread_in_rows::<1>(), of.spread_in_rows::<2>(), of.spread_in_rows::<3>()]
}
