//! Which flow vectors to believe, and how far: forward-backward error, photometric agreement, local texture.

use super::{
    TrackingSettings,
    flow::Flow,
    matcher::Noise,
    pair::Frame,
    planes::{PATCH, Planes},
    refine::{SHADING_RADIUS, rest},
    windows::{box_counts, box_sum},
};

/// A flow with the doubts about it, per pixel.
#[derive(Clone)]
pub(super) struct Judged {
    pub(super) flow: Flow,
    pub(super) visible: Vec<bool>,
    /// Standard deviation per axis as far as the matches tell, pixels.
    pub(super) sigma: Vec<f32>,
    /// Matches in a row that led here; interpolated, so not whole.
    pub(super) links: Vec<f32>,
    /// Variance per axis that the alignment with the key frame adds, square pixels. It is not carried along chains:
    /// every frame is aligned anew.
    pub(super) alignment: Vec<f32>,
}

impl Judged {
    /// The flow of a single match.
    pub(super) fn of(flow: Flow, visible: Vec<bool>, sigma: Vec<f32>) -> Self {
        let pixels = sigma.len();
        Self { flow, visible, sigma, links: vec![1.0; pixels], alignment: vec![0.0; pixels] }
    }

    /// The standard deviation of each pixel's track per axis, pixels; without the floor.
    pub(super) fn deviations(&self) -> Vec<f32> {
        let deviation = |(i, contrast): (usize, f32)| {
            let squared = self.flow.u[i] * self.flow.u[i] + self.flow.v[i] * self.flow.v[i];
            let interpolation = INTERPOLATION * squared / (squared + INTERPOLATED * INTERPOLATED);
            let beyond_noise = contrast / (contrast + NOISY_CONTRAST);
            let boundary = BOUNDARY * contrast.min(WIDEST_CONTRAST) * beyond_noise;
            (interpolation + boundary + self.sigma[i] * self.sigma[i] + self.alignment[i]).sqrt()
        };
        self.flow.contrast().into_iter().enumerate().map(deviation).collect()
    }
}

/// Half side of the windows that are correlated.
const WINDOW: usize = 2;
/// Root mean square difference that image noise alone explains, 0 to 255 scale.
const NOISE: f32 = 6.0;
/// Difference of mean colour, after the best change of brightness, that the same surface may show, 0 to 255 scale.
const COLOUR_TOLERANCE: f32 = 24.0;

// The variance of a track per axis is modelled as
//     floor² + m INTERPOLATION + BOUNDARY c' + Σ r (TRIP e² + NOISE_SHARE n/λ) + DOUBT² d² + r ALIGNMENT L a²,
// with sums over the matches of its chain: e is the forward-backward error, n the mean squared residual of the window,
// λ the smaller eigenvalue of the structure tensor; d is the distance to a candidate that disagrees (`chain`), a how far
// the alignment with the key frame moves the track, L the number of matches; c' is how much neighbouring displacements
// differ, less where noise explains it; r < 1 where the flow is smooth as it rests, m from 0 at rest to 1.
// Fitted by the shares of errors within one and two standard deviations, by decile, and the pinball loss of both, on three
// clips; docs/tracking.md has the procedure and the result.

/// Share of a match's squared forward-backward error.
const TRIP: f32 = 0.0354;
/// Share of the variance by image noise: neighbouring residuals are not independent, yet most noise averages out.
const NOISE_SHARE: f32 = 0.0067;
/// How much more of both where the noise is unknown: the shares are fitted beside the term of boundaries, which says less
/// of flow that errs elsewhere.
const CAUTION: f32 = 5.0;
/// Least eigenvalue that counts as texture.
const LEAST_TEXTURE: f32 = 1e-4;
/// Power of the smoothness by which the variance of what rests is divided: neighbours share their noise.
const REST_POWER: f32 = 0.65;
/// Variance of what moves, as it is found between pixels, square pixels.
const INTERPOLATION: f32 = 0.012 * 0.012;
/// Displacement of which half counts as such, pixels: far more than noise makes of what rests.
const INTERPOLATED: f32 = 0.5;
/// Variance per pixel by which neighbouring displacements differ: some of them belong to the other side of the boundary, of
/// a wide one a smaller part.
const BOUNDARY: f32 = 0.029;
/// Difference from which on it says no more, pixels.
const WIDEST_CONTRAST: f32 = 10.0;
/// Difference of which half counts: what noise makes of neighbours that rest.
const NOISY_CONTRAST: f32 = 0.0055;
/// Share of the squared distance that the alignment moves a track.
const ALIGNMENT: f32 = 1.0;

/// Agreement of the surroundings of each pixel with where a flow puts them.
pub(super) struct Agreement {
    /// Mean squared difference per channel, means removed.
    residual: Vec<f32>,
    /// Normalised correlation over all channels.
    correlation: Vec<f32>,
    /// Distance of mean colours that no change of brightness explains.
    colour: Vec<f32>,
}

/// Compares windows around each pixel of `first` with `second` fetched along `flow`.
pub(super) fn agreement<P>(first: &Frame<P>, second: &Frame<P>, flow: &Flow) -> Agreement {
    let (width, height) = (flow.width, flow.height);
    let counts = box_counts(width, height, WINDOW);
    let here = first.colours.interiors();
    let there = fetched(&second.colours, flow);
    let sum = |values: &[f32]| box_sum(values, width, height, WINDOW);
    let products = |a: &[Vec<f32>; 3], b: &[Vec<f32>; 3]| -> Vec<f32> {
        sum(&(0..width * height)
            .map(|i| a[0][i] * b[0][i] + a[1][i] * b[1][i] + a[2][i] * b[2][i])
            .collect::<Vec<_>>())
    };
    let (aa, ab, bb) = (products(&here, &here), products(&here, &there), products(&there, &there));
    let means = |planes: &[Vec<f32>; 3]| -> [Vec<f32>; 3] {
        std::array::from_fn(|c| sum(&planes[c]).iter().zip(&counts).map(|(sum, count)| sum / count).collect())
    };
    let (mean_here, mean_there) = (means(&here), means(&there));
    let mut out = Agreement { residual: Vec::new(), correlation: Vec::new(), colour: Vec::new() };
    for i in 0..width * height {
        let a = [mean_here[0][i], mean_here[1][i], mean_here[2][i]];
        let b = [mean_there[0][i], mean_there[1][i], mean_there[2][i]];
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let variance_here = (aa[i] / counts[i] - dot(a, a)).max(0.0);
        let variance_there = (bb[i] / counts[i] - dot(b, b)).max(0.0);
        let covariance = ab[i] / counts[i] - dot(a, b);
        out.residual.push((variance_here + variance_there - 2.0 * covariance).max(0.0) / 3.0);
        out.correlation.push(covariance / (variance_here * variance_there + 1.0).sqrt());
        let gain = (dot(a, b) / (dot(a, a) + 1.0)).clamp(0.4, 2.5);
        let off = [b[0] - gain * a[0], b[1] - gain * a[1], b[2] - gain * a[2]];
        out.colour.push(dot(off, off).sqrt());
    }
    out
}

impl Agreement {
    fn holds(&self, i: usize, least_correlation: f32) -> bool {
        let textured_alike = self.correlation[i] >= least_correlation || self.residual[i] < NOISE * NOISE;
        textured_alike && self.colour[i] < COLOUR_TOLERANCE
    }
}

/// What an image shows along a flow.
fn fetched(image: &Planes, flow: &Flow) -> [Vec<f32>; 3] {
    let mut channels = [(); 3].map(|()| Vec::with_capacity(flow.u.len()));
    for y in 0..flow.height {
        for x in 0..flow.width {
            let [u, v] = flow.at(x, y);
            let colour = image.colour_at(x as f32 + u, y as f32 + v);
            channels.iter_mut().zip(colour).for_each(|(channel, value)| channel.push(value));
        }
    }
    channels
}

/// Smaller eigenvalue of the structure tensor around each pixel, summed over channels and a window of about a patch. Of the
/// gradients without their mean, as matching counts no others: a ramp tells no displacement that shading would not explain.
pub(super) fn texture(colours: &Planes) -> Vec<f32> {
    let (width, height) = (colours.width, colours.height);
    let unshaded = Planes::from_interiors(width, height, colours.high_passed(SHADING_RADIUS));
    let [gx, gy] = unshaded.gradients().map(|planes| planes.interiors());
    let tensor = |a: &[Vec<f32>; 3], b: &[Vec<f32>; 3]| {
        let products: Vec<f32> =
            (0..width * height).map(|i| a[0][i] * b[0][i] + a[1][i] * b[1][i] + a[2][i] * b[2][i]).collect();
        box_sum(&products, width, height, PATCH / 2 - 1)
    };
    let (xx, xy, yy) = (tensor(&gx, &gx), tensor(&gx, &gy), tensor(&gy, &gy));
    let smaller = |i: usize| {
        let (mean, half) = (0.5 * (xx[i] + yy[i]), 0.5 * (xx[i] - yy[i]));
        (mean - (half * half + xy[i] * xy[i]).sqrt()).max(0.0)
    };
    (0..width * height).map(smaller).collect()
}

/// Distance between each pixel and where it comes back to.
fn round_trip(flow: &Flow, back: &Flow) -> Vec<f32> {
    let mut error = Vec::with_capacity(flow.u.len());
    for y in 0..flow.height {
        for x in 0..flow.width {
            let [u, v] = flow.at(x, y);
            let [bu, bv] = back.sample(x as f32 + u, y as f32 + v);
            error.push(((u + bu).powi(2) + (v + bv).powi(2)).sqrt());
        }
    }
    error
}

/// Judges the flow from `first` to `second` by the flow back and by what both frames show.
pub(super) fn judge<P>(
    first: &Frame<P>,
    second: &Frame<P>,
    flow: Flow,
    back: &Flow,
    noise: Noise,
    settings: &TrackingSettings,
) -> Judged {
    let error = round_trip(&flow, back);
    let agreement = agreement(first, second, &flow);
    let mut visible = Vec::with_capacity(error.len());
    let mut sigma = Vec::with_capacity(error.len());
    for y in 0..flow.height {
        for x in 0..flow.width {
            let i = y * flow.width + x;
            let [u, v] = flow.at(x, y);
            let inside = is_inside(x as f32 + u, y as f32 + v, flow.width, flow.height);
            visible
                .push(inside && error[i] < settings.consistency && agreement.holds(i, settings.correlation));
            let residual = agreement.residual[i].max(4.0);
            let squared_error = error[i] * error[i];
            let variance = TRIP * squared_error + NOISE_SHARE * residual / (first.texture[i] + LEAST_TEXTURE);
            // What nothing is known of rests for no reason.
            let rests = (u * u + v * v).max(squared_error).max(variance);
            let variance = match noise {
                Noise::SharedAtRest => variance * share_at_rest(rests),
                Noise::Unknown(least) => least * least + CAUTION * variance,
            };
            sigma.push(variance.sqrt().min(flow.width.max(flow.height) as f32));
        }
    }
    Judged::of(flow, visible, sigma)
}

/// Whether a fractional pixel index lies within the image.
pub(super) fn is_inside(x: f32, y: f32, width: usize, height: usize) -> bool {
    x >= -0.5 && y >= -0.5 && x <= width as f32 - 0.5 && y <= height as f32 - 0.5
}

/// Withdraws visibility where the frames disagree along the flow: a chain of good steps can still end elsewhere.
pub(super) fn recheck<P>(
    first: &Frame<P>,
    second: &Frame<P>,
    judged: &mut Judged,
    settings: &TrackingSettings,
) {
    let agreement = agreement(first, second, &judged.flow);
    for (i, visible) in judged.visible.iter_mut().enumerate() {
        *visible = *visible && agreement.holds(i, settings.correlation);
    }
}

/// Share of the variance that is left where the square of a displacement, or of the doubt about it, is this.
fn share_at_rest(squared: f32) -> f32 {
    rest(squared).powf(-REST_POWER)
}

/// Accounts for the alignment of tracks with the key frame: where it moves them far, one of both is wrong, and a long
/// chain has more to put right.
pub(super) fn account_for_alignment(aligned: &mut Judged, before: &Flow) {
    for i in 0..aligned.alignment.len() {
        let moved = [aligned.flow.u[i] - before.u[i], aligned.flow.v[i] - before.v[i]];
        let squared = moved[0] * moved[0] + moved[1] * moved[1];
        let displaced = aligned.flow.u[i] * aligned.flow.u[i] + aligned.flow.v[i] * aligned.flow.v[i];
        aligned.alignment[i] = ALIGNMENT * aligned.links[i] * squared * share_at_rest(displaced.max(squared));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The middle pixel of 3x3 that all move by `u`, their upper row by `step` more.
    fn middle(u: f32, step: f32, sigma: f32, alignment: f32) -> f32 {
        let mut flow = Flow::zeros(3, 3);
        flow.u.fill(u);
        flow.u[..3].fill(u + step);
        let mut judged = Judged::of(flow, vec![true; 9], vec![sigma; 9]);
        judged.alignment.fill(alignment);
        judged.deviations()[4]
    }

    #[test]
    fn deviations_are_the_sum_of_their_terms() {
        // Against the formula in double precision; f32 rounds a sum of squares by some 1e-7 of it.
        let exact = |u: f64, contrast: f64, sigma: f64, alignment: f64| {
            let moves = 0.012f64.powi(2) * u * u / (u * u + 0.25);
            let boundary = 0.029 * contrast.min(10.0) * contrast / (contrast + 0.0055);
            (moves + boundary + sigma * sigma + alignment).sqrt()
        };
        for (u, step, sigma, alignment) in [
            (0.0f32, 0.0f32, 0.01f32, 0.0f32),
            (20.0, 0.0, 0.0, 0.0),
            (0.5, 0.0, 0.02, 1e-4),
            (0.0, 0.002, 0.0, 0.0),
            (3.0, 1.5, 0.3, 0.04),
            (0.0, -250.0, 0.0, 0.0),
        ] {
            let (found, exact) = (
                f64::from(middle(u, step, sigma, alignment)),
                exact(u.into(), f64::from(step.abs()), sigma.into(), alignment.into()),
            );
            assert!((found - exact).abs() < 1e-5 * exact, "{u} {step} {sigma} {alignment}: {found} {exact}");
        }
        assert_eq!(middle(0.0, 0.0, 0.0, 0.0), 0.0);
    }

    #[test]
    fn a_ramp_of_brightness_is_no_texture() {
        let channel =
            |x: f32, y: f32| (0..40 * 30).map(|i| x * (i % 40) as f32 + y * (i / 40) as f32).collect();
        let ramps = Planes::from_interiors(40, 30, [channel(2.5, 0.0), channel(0.0, 2.5), channel(1.0, 1.0)]);
        let texture = texture(&ramps);
        // Away from the edge, where windows see less than the whole.
        let inner = (0..40 * 30).filter(|i| (9..31).contains(&(i % 40)) && (9..21).contains(&(i / 40)));
        // Sums of 81 values up to 172 round by 1e-3 of a level, which counts squared.
        assert!(inner.map(|i| texture[i]).fold(0.0, f32::max) < 1e-3);
    }
}
