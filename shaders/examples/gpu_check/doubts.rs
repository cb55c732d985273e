//! Pixels on which single precision cannot decide: where, in double precision, some decision of blending is nearer to its
//! threshold than an error of projection carries it. On all others both engines blend the same pairs of pixel and footprint.

use std::fmt;

use glam::{DMat2, DVec2};
use splat::{
    cameras::Camera,
    gaussians::Gaussians,
    raster::{ALPHA_MAX, ALPHA_MIN, LOW_PASS, NEAR_PLANE, TRANSMITTANCE_MIN},
};

/// Error of a projected position, of the image's size: a unit in the last place. Pixels that were found to differ are within a
/// tenth of what it comes to.
const PLACE: f64 = 1.2e-7;

/// Error of the logarithm of alpha on its own, and of a depth of itself.
const EXPONENT: f64 = 5e-6;
const DEPTH: f64 = 4e-7;

/// What decides whether a pair is blended, or how.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Decision {
    /// Alpha reaches 1/255.
    #[default]
    LeastAlpha,
    /// Alpha is clamped: matters to gradients only.
    LargestAlpha,
    /// The transmittance behind falls below the least.
    Transmittance,
    /// Which of two footprints is nearer.
    Order,
}

/// The decision of a pixel that is nearest to its threshold.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Nearest {
    pub decision: Decision,
    /// Relative to the threshold.
    pub distance: f64,
    /// Distance in units of the error that single precision may make; below 1 the pixel is in doubt.
    pub margin: f64,
}

impl fmt::Display for Nearest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:?} {:.1e} from its threshold, {:.2} of the error",
            self.decision, self.distance, self.margin
        )
    }
}

/// Of a view.
pub(crate) struct Doubts {
    /// Per pixel, row by row.
    pub nearest: Vec<Nearest>,
    /// Pairs of pixel and footprint that are blended.
    pub pairs: u64,
}

impl Doubts {
    /// Whether an engine may decide either way on a pixel.
    pub(crate) fn is_open(&self, pixel: usize) -> bool {
        self.nearest[pixel].margin < 1.0
    }

    /// Share of pixels that are in doubt.
    pub(crate) fn share(&self) -> f64 {
        let open = (0..self.nearest.len()).filter(|&pixel| self.is_open(pixel)).count();
        open as f64 / self.nearest.len() as f64
    }

    /// Blends a view in double precision. Every Gaussian must be within the slopes at which the projection's
    /// linearisation is clamped.
    pub(crate) fn new(gaussians: &Gaussians, camera: &Camera) -> Self {
        let place = PLACE * f64::from(camera.width.max(camera.height));
        let mut footprints: Vec<_> =
            (0..gaussians.len()).filter_map(|index| Footprint::new(gaussians, camera, index)).collect();
        // Equal depths keep their order.
        footprints.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        let mut pixels = vec![Pixel::default(); camera.width as usize * camera.height as usize];
        let mut pairs = 0;
        for footprint in &footprints {
            let [columns, rows] = footprint.reached(camera);
            for (row, column) in rows.flat_map(|row| columns.clone().map(move |column| (row, column))) {
                let offset = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5) - footprint.mean;
                let pixel = &mut pixels[row as usize * camera.width as usize + column as usize];
                pairs += u64::from(pixel.blends(footprint, offset, place));
            }
        }
        Self { nearest: pixels.into_iter().map(|pixel| pixel.nearest).collect(), pairs }
    }
}

struct Footprint {
    mean: DVec2,
    inverse: DMat2,
    /// Pixels between the mean and the end of the reach, right and down.
    half_size: DVec2,
    log_opacity: f64,
    depth: f64,
}

impl Footprint {
    fn new(gaussians: &Gaussians, camera: &Camera, index: usize) -> Option<Self> {
        let in_camera = camera.to_camera(gaussians.mean(index));
        let log_opacity = gaussians.opacity(index).ln();
        // A margin, so that those at the threshold are there.
        let reach = log_opacity - f64::from(ALPHA_MIN).ln() + 0.01;
        if in_camera.z <= NEAR_PLANE || reach <= 0.0 {
            return None;
        }
        let axes = camera.world_jacobian(in_camera);
        let spread = axes.map(|axis| gaussians.covariance(index) * axis);
        let xy = axes[0].dot(spread[1]);
        let covariance = DMat2::from_cols(
            DVec2::new(axes[0].dot(spread[0]) + LOW_PASS, xy),
            DVec2::new(xy, axes[1].dot(spread[1]) + LOW_PASS),
        );
        let variances = DVec2::new(covariance.x_axis.x, covariance.y_axis.y);
        Some(Self {
            mean: camera.project(in_camera)?,
            inverse: covariance.inverse(),
            half_size: DVec2::new((2.0 * reach * variances.x).sqrt(), (2.0 * reach * variances.y).sqrt()),
            log_opacity,
            depth: in_camera.z,
        })
    }

    /// Columns and rows of the bounding box.
    fn reached(&self, camera: &Camera) -> [std::ops::Range<u32>; 2] {
        let (low, high) = (self.mean - self.half_size, self.mean + self.half_size);
        let within = |low: f64, high: f64, size: u32| {
            let bounded = |value: f64| value.clamp(0.0, f64::from(size)) as u32;
            bounded(low.floor())..bounded(high.ceil() + 1.0)
        };
        [within(low.x, high.x, camera.width), within(low.y, high.y, camera.height)]
    }
}

#[derive(Clone, Copy, Debug)]
struct Pixel {
    transmittance: f64,
    /// Of the logarithm of the transmittance.
    error: f64,
    last_depth: f64,
    is_closed: bool,
    nearest: Nearest,
}

impl Default for Pixel {
    fn default() -> Self {
        let nearest =
            Nearest { decision: Decision::default(), distance: f64::INFINITY, margin: f64::INFINITY };
        Self { transmittance: 1.0, error: 0.0, last_depth: 0.0, is_closed: false, nearest }
    }
}

impl Pixel {
    /// Whether the footprint is blended on this pixel at `offset` from its mean.
    fn blends(&mut self, footprint: &Footprint, offset: DVec2, place: f64) -> bool {
        if self.is_closed {
            return false;
        }
        let slope = footprint.inverse * offset;
        let log_alpha = footprint.log_opacity - 0.5 * offset.dot(slope);
        let error = slope.length() * place + EXPONENT;
        let above = log_alpha - f64::from(ALPHA_MIN).ln();
        self.decide(Decision::LeastAlpha, above, error);
        if above < 0.0 {
            return false;
        }
        self.decide(Decision::LargestAlpha, log_alpha - f64::from(ALPHA_MAX).ln(), error);
        self.decide(Decision::Order, footprint.depth / self.last_depth - 1.0, DEPTH);
        self.last_depth = footprint.depth;
        let alpha = log_alpha.exp().min(f64::from(ALPHA_MAX));
        let left = self.transmittance * (1.0 - alpha);
        self.error += error * alpha / (1.0 - alpha);
        self.decide(Decision::Transmittance, (left / f64::from(TRANSMITTANCE_MIN)).ln(), self.error);
        self.is_closed = left < f64::from(TRANSMITTANCE_MIN);
        if !self.is_closed {
            self.transmittance = left;
        }
        !self.is_closed
    }

    fn decide(&mut self, decision: Decision, from_threshold: f64, error: f64) {
        let (distance, margin) = (from_threshold.abs(), from_threshold.abs() / error);
        if margin < self.nearest.margin {
            self.nearest = Nearest { decision, distance, margin };
        }
    }
}
