//! Front-to-back blending of one pixel, and what rounding does to it at first order.
//!
//! Errors of one footprint's alpha are the same wherever it is evaluated the same way, so they are added up with one sign;
//! roundings of products and sums are independent, so their squares are.

use splat::raster::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};

use super::{ROUNDOFF_32, ROUNDOFF_64, project::Shape, real::Real};

/// Error of the shipped `2^x`, stated there as 2.5e-7, in unit roundoffs.
const EXP2: f64 = 4.2;

/// Which way a decision goes that lies nearer to its threshold than its own rounding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Close {
    /// As the double-precision value says.
    AsComputed,
    /// At or above the threshold.
    Above,
    /// Below it.
    Below,
}

impl Close {
    pub(crate) const ALL: [Self; 3] = [Self::AsComputed, Self::Above, Self::Below];

    /// Whether a value of relative error `error` reaches the threshold.
    fn reaches(self, value: f64, threshold: f64, error: f64) -> bool {
        let share = match self {
            Self::AsComputed => 0.0,
            Self::Above => error,
            Self::Below => -error,
        };
        value * (1.0 + share) >= threshold
    }
}

/// What the opacity threshold may be off by when single precision decides: a few roundings at least.
const DECISION: f64 = 4.0;

/// A footprint on a pixel.
#[derive(Clone, Copy)]
pub(crate) struct Sample<R> {
    pub alpha: R,
    /// Relative error of alpha.
    pub error: f64,
    /// Whether alpha is clamped.
    pub clamped: bool,
    /// Offset from the row centre, and across rows, pixels.
    pub offset: [f64; 2],
    /// Largest numbers that those are computed from.
    pub offset_terms: [f64; 2],
}

/// Alpha of a shape at a pixel centre.
pub(crate) fn sample<R: Real>(shape: &Shape<R>, x: f64, y: f64) -> Sample<R> {
    let across = R::of(y) - shape.mean[1];
    let along = R::of(x) - shape.mean[0] - shape.slope * across;
    let (row, column) =
        (R::of(0.5) * along * along / shape.conditional, R::of(0.5) * across * across / shape.variance_y);
    let alpha = shape.opacity * (-(row + column)).exp();
    let clamped = alpha.value() > f64::from(ALPHA_MAX);
    let (d, dy, slope) = (along.value(), across.value(), shape.slope.value());
    // A kernel starts from the first pixel of a block, at most three columns and rows away.
    let offset_terms = [d.abs() + 3.0 + 3.0 * slope.abs(), dy.abs() + 3.0];
    let by_offset = d.abs() / shape.conditional.value() * 2.0 * offset_terms[0]
        + dy.abs() / shape.variance_y.value() * 2.0 * offset_terms[1];
    let opacity = shape.opacity.value();
    let terms = opacity.ln().abs() + 3.0 * (row.value() + column.value()) + by_offset + EXP2;
    let error =
        if clamped { 0.0 } else { ROUNDOFF_32 * terms + 16.0 * ROUNDOFF_64 * shape.elongation * row.value() };
    let alpha = if clamped { R::of(ALPHA_MAX.into()) } else { alpha };
    Sample { alpha, error, clamped, offset: [d, dy], offset_terms }
}

/// Running state of a pixel.
#[derive(Clone, Copy)]
pub(crate) struct Transmittance<R> {
    pub value: R,
    /// Relative error that errors of alpha make.
    pub systematic: f64,
    /// Square of the relative error that independent roundings make.
    pub random: f64,
}

impl<R: Real> Transmittance<R> {
    pub(crate) fn full() -> Self {
        Self { value: R::of(1.0), systematic: 0.0, random: 0.0 }
    }

    pub(crate) fn error(&self) -> f64 {
        self.systematic + self.random.sqrt()
    }

    fn behind(&self, sample: &Sample<R>) -> Self {
        let alpha = sample.alpha.value();
        let shown = alpha / (1.0 - alpha);
        Self {
            value: self.value - self.value * sample.alpha,
            systematic: self.systematic + sample.error * shown,
            random: self.random + (ROUNDOFF_32 * (1.0 + shown)).powi(2),
        }
    }
}

/// Goes through the footprints of a pixel in order of depth: calls `blended` with the place in `shapes`, the footprint's
/// sample and the transmittance in front of it, and returns the transmittance behind all.
pub(crate) fn traverse<R: Real>(
    shapes: &[Shape<R>],
    x: f64,
    y: f64,
    close: Close,
    mut blended: impl FnMut(usize, &Sample<R>, &Transmittance<R>),
) -> Transmittance<R> {
    let mut transmittance = Transmittance::full();
    for (place, shape) in shapes.iter().enumerate() {
        let sample = sample(shape, x, y);
        let error = 2.0 * sample.error + DECISION * ROUNDOFF_32;
        if !close.reaches(sample.alpha.value(), ALPHA_MIN.into(), error) {
            continue;
        }
        let behind = transmittance.behind(&sample);
        let error = 2.0 * behind.error() + DECISION * ROUNDOFF_32;
        if !close.reaches(behind.value.value(), TRANSMITTANCE_MIN.into(), error) {
            break;
        }
        blended(place, &sample, &transmittance);
        transmittance = behind;
    }
    transmittance
}

/// Colour and accumulated opacity of a pixel with the errors that rounding makes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pixel {
    pub colour: [f64; 3],
    pub alpha: f64,
    pub colour_error: [f64; 3],
    pub alpha_error: f64,
}

/// Renders one pixel.
pub(crate) fn pixel(shapes: &[Shape<f64>], background: [f64; 3], x: f64, y: f64, close: Close) -> Pixel {
    let mut colour = [0.0; 3];
    let (mut systematic, mut random) = ([0.0; 3], [0.0; 3]);
    let behind = traverse(shapes, x, y, close, |place, sample, front| {
        let weight = sample.alpha * front.value;
        for channel in 0..3 {
            let light = weight * shapes[place].colour[channel];
            colour[channel] += light;
            systematic[channel] += light * (sample.error + front.systematic)
                + weight * ROUNDOFF_32 * shapes[place].colour_roundoff[channel];
            random[channel] += (light * (ROUNDOFF_32 + front.random.sqrt())).powi(2)
                + (ROUNDOFF_32 * colour[channel]).powi(2);
        }
    });
    let left = behind.value;
    let mut pixel = Pixel { alpha: 1.0 - left, ..Pixel::default() };
    for channel in 0..3 {
        let through = left * background[channel];
        pixel.colour[channel] = colour[channel] + through;
        pixel.colour_error[channel] = systematic[channel]
            + random[channel].sqrt()
            + through.abs() * (behind.error() + ROUNDOFF_32)
            + ROUNDOFF_32 * pixel.colour[channel].abs();
    }
    pixel.alpha_error = left * behind.error() + ROUNDOFF_32;
    pixel
}
