//! Stage 1: each Gaussian's footprint, colour and depth in one view.
//!
//! Works on eight Gaussians at a time in f64: the cost is per Gaussian, not per pixel, and needles of aspect ratio 1e4 lose all of f32's digits
//! in the determinant of their projected covariance.

use rayon::prelude::*;

use super::{
    ALPHA_MIN, NEAR_PLANE,
    bin::BAND_ROWS,
    colour::{Coefficients, Triple},
    lanes::{Geometry, sigmoid},
    local::{Covariance, Lens, LocalProjection, View, sight, store_direction},
};
use crate::{
    cameras::Camera,
    gaussians::{Gaussians, part::Part},
    simd::{Doubles, Instructions, LANES, OCTET, Simd, simd_kernel},
};

/// Gaussians per parallel task.
pub(super) const CHUNK: usize = 512;

/// All Gaussians in one view, in their order.
#[derive(Clone, Debug, Default)]
pub(super) struct Projection {
    /// Meaningless for those that reach no pixel.
    pub footprints: Vec<Footprint>,
    /// Camera z, world units; NaN for those that reach no pixel.
    pub depths: Vec<f64>,
    /// Bands of rows that they touch; none for those that reach no pixel.
    pub bands: Vec<BandRange>,
}

impl Projection {
    /// Whether the bounding box of a Gaussian's footprint reaches a pixel.
    pub(super) fn is_visible(&self, index: usize) -> bool {
        !self.depths[index].is_nan()
    }
}

/// Consecutive bands.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BandRange {
    /// The first.
    pub first: u32,
    /// One past the last.
    pub end: u32,
}

/// One Gaussian in one view.
///
/// The exponent at pixel offset `(ex, ey)` from the mean is written row by row,
/// `½ (ex - slope · ey)² · inverse_conditional + ½ ey² · inverse_yy`, which has no cancellation however thin and
/// slanted the footprint is: `slope = cov_xy / cov_yy` is the regression line through the row centres and
/// `1 / inverse_conditional = cov_xx - cov_xy² / cov_yy` the variance along a row.
#[derive(Clone, Copy, Debug, Default)]
#[repr(align(64))]
pub(super) struct Footprint {
    /// Projected mean, pixels.
    pub mean: [f64; 2],
    /// Row centre shift per row, `cov_xy / cov_yy`.
    pub slope: f64,
    /// Variance along a row, pixels².
    pub conditional: f64,
    /// Its inverse, 1 / pixels².
    pub inverse_conditional: f64,
    /// Inverse of the variance across rows, 1 / pixels².
    pub inverse_yy: f64,
    /// Natural logarithm of the opacity.
    pub log_opacity: f64,
    /// Exponent at which alpha falls to [`ALPHA_MIN`], `ln(opacity / ALPHA_MIN)`.
    pub reach: f64,
    /// Rows between the mean and the end of the reach, pixels.
    pub half_height: f64,
    /// Rows between the mean and the rightmost point in reach, pixels.
    pub row_of_rightmost: f64,
    /// Colour seen from the camera, not below 0.
    pub colour: [f32; 3],
}

/// Projects every Gaussian; spherical harmonics up to `sh_degree`.
pub(super) fn project(
    instructions: Instructions,
    gaussians: &Gaussians,
    camera: &Camera,
    sh_degree: u32,
    projection: &mut Projection,
) {
    let count = gaussians.len();
    projection.footprints.resize(count, Footprint::default());
    projection.depths.resize(count, f64::NAN);
    projection.bands.resize(count, BandRange::default());
    let view = View::new(camera, gaussians, sh_degree);
    let arrays = (
        projection.footprints.par_chunks_mut(CHUNK),
        projection.depths.par_chunks_mut(CHUNK),
        projection.bands.par_chunks_mut(CHUNK),
    );
    arrays.into_par_iter().enumerate().for_each(|(chunk, (footprints, depths, bands))| {
        let first = chunk * CHUNK;
        let part = gaussians.part().slice(first..first + depths.len());
        project_chunk(instructions, part, &view, footprints, depths, bands);
    });
}

simd_kernel! {
    /// The Gaussians of a part, which is not empty.
    fn project_chunk(
        part: Part<'_>,
        view: &View<'_>,
        footprints: &mut [Footprint],
        depths: &mut [f64],
        bands: &mut [BandRange],
    ) = project_kernel
}

#[inline(always)]
fn project_kernel<S: Simd>(
    part: Part<'_>,
    view: &View<'_>,
    footprints: &mut [Footprint],
    depths: &mut [f64],
    bands: &mut [BandRange],
) {
    let lens = Lens::<S::Doubles>::new(view.camera);
    let groups = footprints.chunks_mut(LANES).zip(depths.chunks_mut(LANES)).zip(bands.chunks_mut(LANES));
    for (number, ((footprints, depths), bands)) in groups.enumerate() {
        let first = number * LANES;
        let mut directions = [[0.0; LANES]; 3];
        let mut visible = 0;
        let octets = footprints.chunks_mut(OCTET).zip(depths.chunks_mut(OCTET)).zip(bands.chunks_mut(OCTET));
        for (half, ((footprints, depths), bands)) in octets.enumerate() {
            let octet = Octet::project(&part, first + half * OCTET, &lens, &mut directions, half);
            octet.store(footprints, depths, bands);
            visible |= u16::from(octet.visible) << (half * OCTET);
        }
        if visible == 0 {
            continue;
        }
        let coefficients = Coefficients::<S>::load(&part, first, view.sh_degree);
        let (colours, are_finite) = coefficients.seen_along(&directions);
        for (lane, footprint) in footprints.iter_mut().enumerate() {
            footprint.colour = [colours[0][lane], colours[1][lane], colours[2][lane]];
            if visible & !are_finite & 1 << lane != 0 {
                (depths[lane], bands[lane]) = (f64::NAN, BandRange::default());
            }
        }
    }
}

/// Eight footprints but for their colours, value by lane.
struct Octet {
    /// Bit `n` is set if lane `n` reaches a pixel; all else is meaningless where it is not.
    visible: u8,
    depth: [f64; OCTET],
    mean: [[f64; OCTET]; 2],
    slope: [f64; OCTET],
    conditional: [f64; OCTET],
    inverse_conditional: [f64; OCTET],
    inverse_yy: [f64; OCTET],
    log_opacity: [f64; OCTET],
    reach: [f64; OCTET],
    half_height: [f64; OCTET],
    row_of_rightmost: [f64; OCTET],
    /// Where the first and the last row lie, counted in bands.
    ends: [[f64; OCTET]; 2],
}

impl Octet {
    /// None of which reaches a pixel.
    const EMPTY: Self = Self {
        visible: 0,
        depth: [f64::NAN; OCTET],
        mean: [[0.0; OCTET]; 2],
        slope: [0.0; OCTET],
        conditional: [0.0; OCTET],
        inverse_conditional: [0.0; OCTET],
        inverse_yy: [0.0; OCTET],
        log_opacity: [0.0; OCTET],
        reach: [0.0; OCTET],
        half_height: [0.0; OCTET],
        row_of_rightmost: [0.0; OCTET],
        ends: [[0.0; OCTET]; 2],
    };

    /// The Gaussians from `first` on; the last of the part stands in for those beyond. Writes the directions that they are
    /// seen in to lanes of `directions`, the lower or the upper `half`.
    #[inline(always)]
    fn project<D: Doubles>(
        part: &Part<'_>,
        first: usize,
        lens: &Lens<D>,
        directions: &mut Triple,
        half: usize,
    ) -> Self {
        let (zero, one, two) = (D::splat(0.0), D::splat(1.0), D::splat(2.0));
        let centre = D::splat(0.5);
        let mut octet = Self::EMPTY;
        let gaussians = Geometry::<D>::load(part, first);
        let point = lens.camera_point(gaussians.mean);
        let log_opacity = sigmoid(gaussians.logit_opacity).ln();
        let reach = log_opacity - D::splat(ALPHA_MIN.into()).ln();
        // Comparisons with NaN are false: what is no number is not drawn.
        let mut visible = D::both(point.z.gt(D::splat(NEAR_PLANE)), reach.ge(zero));
        if D::bits(visible) == 0 {
            return octet;
        }
        let local = LocalProjection::new(&gaussians, point, lens);
        let covariance = Covariance::new(local.spread);
        let mean = local.mean(lens);
        let (half_width, half_height) =
            ((two * reach * covariance.xx).sqrt(), (two * reach * covariance.yy).sqrt());
        for number in [mean[0], mean[1], covariance.xx, covariance.yy] {
            visible = D::both(visible, number.is_finite());
        }
        visible = D::both(visible, covariance.conditional.gt(zero));
        for (mean, reach, size) in [(mean[0], half_width, lens.size[0]), (mean[1], half_height, lens.size[1])]
        {
            visible = D::both(visible, (mean + reach).ge(centre));
            visible = D::both(visible, (size - centre).ge(mean - reach));
        }
        octet.visible = D::bits(visible);
        D::select(visible, point.z, D::splat(f64::NAN)).store(&mut octet.depth);
        mean[0].store(&mut octet.mean[0]);
        mean[1].store(&mut octet.mean[1]);
        covariance.slope.store(&mut octet.slope);
        covariance.conditional.store(&mut octet.conditional);
        covariance.inverse_conditional.store(&mut octet.inverse_conditional);
        covariance.inverse_yy.store(&mut octet.inverse_yy);
        log_opacity.store(&mut octet.log_opacity);
        reach.store(&mut octet.reach);
        half_height.store(&mut octet.half_height);
        (half_width * covariance.xy / covariance.xx).store(&mut octet.row_of_rightmost);
        let bands = D::splat(1.0 / BAND_ROWS as f64);
        ((mean[1] - half_height - centre).max(zero) * bands).store(&mut octet.ends[0]);
        ((mean[1] + half_height - centre).min(lens.size[1] - one) * bands).store(&mut octet.ends[1]);
        store_direction(sight(gaussians.mean, lens).0, directions, half);
        octet
    }

    /// Writes the Gaussians that there are, up to eight.
    #[inline(always)]
    fn store(&self, footprints: &mut [Footprint], depths: &mut [f64], bands: &mut [BandRange]) {
        depths.copy_from_slice(&self.depth[..depths.len()]);
        for (lane, (footprint, bands)) in footprints.iter_mut().zip(bands).enumerate() {
            if self.visible >> lane & 1 == 0 {
                *bands = BandRange::default();
                continue;
            }
            let [first, last] = [self.ends[0][lane] as u32, self.ends[1][lane] as u32];
            *bands = BandRange { first, end: last + 1 };
            *footprint = Footprint {
                mean: [self.mean[0][lane], self.mean[1][lane]],
                slope: self.slope[lane],
                conditional: self.conditional[lane],
                inverse_conditional: self.inverse_conditional[lane],
                inverse_yy: self.inverse_yy[lane],
                log_opacity: self.log_opacity[lane],
                reach: self.reach[lane],
                half_height: self.half_height[lane],
                row_of_rightmost: self.row_of_rightmost[lane],
                colour: [0.0; 3],
            };
        }
    }
}
