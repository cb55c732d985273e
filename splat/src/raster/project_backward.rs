//! Stage 5: from the gradient of a footprint to the gradient of the Gaussian's parameters, eight Gaussians at a time in f64.

use super::{
    bin::Bins,
    blend::Band,
    colour::{Coefficients, Triple},
    lanes::{Geometry, Vector, combine, load_means, sigmoid, store_rows},
    local::{Covariance, Lens, LocalProjection, View, load_direction, sight, store_direction},
};
use crate::{
    gaussians::part::{Part, PartMut},
    simd::{Doubles, LANES, OCTET, Simd, prefetch, simd_kernel},
};

/// Values of [`Sums`](super::blend_backward::Sums) that are of use.
pub(super) const SUMS: usize = 9;

/// Of sixteen Gaussians, value by lane.
pub(super) type GroupSums = [[f64; LANES]; SUMS];

/// Gaussians between one part of the work and the next: what is handed over fits a near cache.
pub(super) const GRANULE: usize = 128;

/// Gaussians whose sums are asked for ahead.
const AHEAD: usize = 16;

/// What the gradients of the Gaussians of a view start from.
pub(super) struct Backward<'a> {
    pub view: View<'a>,
    pub bins: &'a Bins,
    pub bands: &'a [Band],
    /// Empty: all are.
    pub active: &'a [bool],
}

impl Backward<'_> {
    /// Of up to sixteen Gaussians from `first` on, those that the view shows: bit `n` is that of Gaussian `first + n`.
    #[inline(always)]
    pub(super) fn visible(&self, first: usize, count: usize) -> u16 {
        let mut visible = 0;
        for lane in 0..count {
            visible |= u16::from(self.bins.projection.is_visible(first + lane)) << lane;
        }
        visible
    }

    /// And that are active.
    #[inline(always)]
    fn wanted(&self, first: usize, count: usize) -> u16 {
        let mut wanted = self.visible(first, count);
        if let Some(active) = self.active.get(first..first + count) {
            for (lane, &is_active) in active.iter().enumerate() {
                wanted &= !(u16::from(!is_active) << lane);
            }
        }
        wanted
    }

    /// Sums over the bands, of Gaussians from `first` on, a group after the other; zero for those that need no gradient.
    ///
    /// Bands keep their sums in depth order, which is no order in memory: a loop that does nothing else has the most
    /// lines of memory under way.
    #[inline(always)]
    pub(super) fn gather(&self, first: usize, count: usize, groups: &mut [GroupSums]) {
        for index in first..first + count.min(AHEAD) {
            self.prefetch_sums(index);
        }
        for (number, group) in groups.iter_mut().enumerate().take(count.div_ceil(LANES)) {
            *group = [[0.0; LANES]; SUMS];
            let start = number * LANES;
            for place in start..count.min(start + LANES) {
                self.prefetch_sums(first + (place + AHEAD).min(count - 1));
                self.sum(first + place, place - start, group);
            }
        }
    }

    #[inline(always)]
    fn prefetch_sums(&self, index: usize) {
        let (first_band, places) = self.bins.places_of(index);
        for (band, &place) in self.bands[first_band..].iter().zip(places) {
            // They may lie across two lines.
            let sums = &band.sums[place as usize];
            prefetch(&sums[0]);
            prefetch(&sums[11]);
        }
    }

    #[inline(always)]
    fn sum(&self, index: usize, lane: usize, group: &mut GroupSums) {
        let (first_band, places) = self.bins.places_of(index);
        let mut total = [0.0; 12];
        for (band, &place) in self.bands[first_band..].iter().zip(places) {
            let sums = &band.sums[place as usize];
            for value in 0..12 {
                total[value] += f64::from(sums[value]);
            }
        }
        for (values, total) in group.iter_mut().zip(total) {
            values[lane] = total;
        }
    }
}

simd_kernel! {
    /// Writes the gradients of the Gaussians of a part, the first of which is number `first` of the view; zero for those
    /// that the view does not show or that are not active.
    pub(super) fn project_backward(
        part: Part<'_>,
        backward: &Backward<'_>,
        first: usize,
        gradients: PartMut<'_>,
    ) = project_backward_kernel
}

#[inline(always)]
fn project_backward_kernel<S: Simd>(
    part: Part<'_>,
    backward: &Backward<'_>,
    first: usize,
    mut gradients: PartMut<'_>,
) {
    let lens = Lens::<S::Doubles>::new(backward.view.camera);
    let count = part.len();
    let mut projected_means = [[0.0; 2]; LANES];
    let mut sums = [[[0.0; LANES]; SUMS]; GRANULE / LANES];
    for granule in (0..count).step_by(GRANULE) {
        let end = count.min(granule + GRANULE);
        backward.gather(first + granule, end - granule, &mut sums);
        for (place, sums) in (granule..end).step_by(LANES).zip(&sums) {
            let end = end.min(place + LANES);
            let gradients = gradients.slice(place..end);
            let projected_means = &mut projected_means[..end - place];
            group_backward::<S>(
                &part,
                place,
                backward,
                first + place,
                sums,
                &lens,
                gradients,
                projected_means,
            );
        }
    }
}

/// Gradients of up to sixteen Gaussians, from `place` on in the part and from `index` on in the view, and those by their
/// projected means, per pixel.
#[inline(always)]
pub(super) fn group_backward<S: Simd>(
    part: &Part<'_>,
    place: usize,
    backward: &Backward<'_>,
    index: usize,
    sums: &GroupSums,
    lens: &Lens<S::Doubles>,
    mut gradients: PartMut<'_>,
    projected_means: &mut [[f32; 2]],
) {
    let wanted = backward.wanted(index, projected_means.len());
    let mut directions = [[0.0; LANES]; 3];
    for half in 0..LANES / OCTET {
        let mean = load_means::<S::Doubles>(part, place + half * OCTET);
        store_direction(sight(mean, lens).0, &mut directions, half);
    }
    let coefficients = Coefficients::<S>::load(part, place, backward.view.sh_degree);
    let mut by_colour = [[0.0; LANES]; 3];
    for (to, sums) in by_colour.iter_mut().zip(&sums[6..]) {
        for lane in 0..LANES {
            to[lane] = sums[lane] as f32;
        }
    }
    let (by_coefficients, by_direction) = coefficients.backward(&directions, &by_colour);
    let mut kept = 0;
    for (half, projected_means) in projected_means.chunks_mut(OCTET).enumerate() {
        let first = half * OCTET;
        let sums = FootprintGradient::<S::Doubles>::new(sums, half);
        let gaussians = Geometry::load(part, place + first);
        let gradient = Gradient::new(&gaussians, &sums, &by_direction, half, lens);
        let finite = gradient.fits_single() & (wanted >> first) as u8;
        gradient.store(finite, gradients.slice(first..first + projected_means.len()), projected_means);
        kept |= u16::from(finite) << first;
    }
    by_coefficients.store(gradients.sh, part.sh_stride(), kept);
}

/// Gradient of the loss by eight footprints.
///
/// With `v = alpha · ∂loss/∂alpha`, `d` the offset from the row centre and `dy` that from the mean's row, the moments of
/// `v` suffice for the footprint's position and shape.
struct FootprintGradient<D> {
    /// `Σ v`: by the logarithm of the opacity.
    v: D,
    /// `Σ v d`.
    v_d: D,
    /// `Σ v d²`.
    v_dd: D,
    /// `Σ v dy`.
    v_y: D,
    /// `Σ v d dy`.
    v_dy: D,
    /// `Σ v dy²`.
    v_yy: D,
    /// By the colour.
    colour: [D; 3],
}

impl<D: Doubles> FootprintGradient<D> {
    /// Of the lower or the upper `half` of sixteen lanes.
    #[inline(always)]
    fn new(sums: &[[f64; LANES]; SUMS], half: usize) -> Self {
        let load = |value: usize| D::load(&sums[value].as_chunks().0[half]);
        Self {
            v: load(0),
            v_d: load(1),
            v_dd: load(2),
            v_y: load(3),
            v_dy: load(4),
            v_yy: load(5),
            colour: [load(6), load(7), load(8)],
        }
    }
}

/// Gradients of the loss by the parameters of eight Gaussians, but for their coefficients.
struct Gradient<D> {
    /// By the world mean.
    mean: Vector<D>,
    /// By the stored quaternion `w, x, y, z`.
    rotation: [D; 4],
    /// By the logarithm of the scales.
    log_scale: [D; 3],
    /// By the logit of the opacity.
    logit_opacity: D,
    /// By the projected mean, per pixel.
    projected_mean: [D; 2],
    /// By the colour; every gradient by a coefficient is a share of it.
    colour: [D; 3],
}

impl<D: Doubles> Gradient<D> {
    /// From the gradient by the footprint, and through the colour that by the direction, of which the lower or the upper
    /// `half` of the lanes.
    #[inline(always)]
    fn new(
        gaussians: &Geometry<D>,
        gradient: &FootprintGradient<D>,
        by_direction: &Triple,
        half: usize,
        lens: &Lens<D>,
    ) -> Self {
        let point = lens.camera_point(gaussians.mean);
        let local = LocalProjection::new(gaussians, point, lens);
        let covariance = Covariance::new(local.spread);
        let projected_mean = mean_gradient(&covariance, gradient);
        let spread = spread_gradient(&covariance, gradient, &local);
        let rows = [combine(&local.axes, spread[0]), combine(&local.axes, spread[1])];
        let in_camera = camera_gradient(&local, lens, projected_mean, rows);
        let (log_scale, rotation) = axes_gradient(&local, spread);
        let (direction, inverse_distance) = sight(gaussians.mean, lens);
        let by_direction = load_direction(by_direction, half);
        let across = direction.scaled_plus(-direction.dot(by_direction), by_direction);
        Self {
            mean: across.scaled_plus(inverse_distance, combine(&lens.axes, in_camera)),
            rotation,
            log_scale,
            logit_opacity: gradient.v * sigmoid(-gaussians.logit_opacity),
            projected_mean,
            colour: gradient.colour,
        }
    }

    /// The lanes in which all is finite in single precision. Beyond that there is no direction to follow; a step of
    /// infinity would spread.
    #[inline(always)]
    fn fits_single(&self) -> u8 {
        let [w, x, y, z] = self.rotation;
        let [a, b, c] = self.log_scale;
        let [u, v] = self.projected_mean;
        let [red, green, blue] = self.colour;
        let Vector { x: p, y: q, z: r } = self.mean;
        let mut fits = self.logit_opacity.fits_single();
        for value in [w, x, y, z, a, b, c, u, v, red, green, blue, p, q, r] {
            fits = D::both(fits, value.fits_single());
        }
        D::bits(fits)
    }

    /// Writes up to eight rows; zeros where bits of `kept` are.
    #[inline(always)]
    fn store(&self, kept: u8, to: PartMut<'_>, projected_means: &mut [[f32; 2]]) {
        store_rows([self.mean.x, self.mean.y, self.mean.z], kept, to.means);
        store_rows(self.rotation, kept, to.rotations);
        store_rows(self.log_scale, kept, to.log_scales);
        store_rows([self.logit_opacity], kept, to.logit_opacities.as_chunks_mut().0);
        store_rows(self.projected_mean, kept, projected_means);
    }
}

/// By the projected mean: alpha's exponent falls with `d` along the row and with `dy` across.
#[inline(always)]
fn mean_gradient<D: Doubles>(covariance: &Covariance<D>, gradient: &FootprintGradient<D>) -> [D; 2] {
    let x = covariance.inverse_conditional * gradient.v_d;
    [x, covariance.inverse_yy.mul_sub(gradient.v_y, covariance.slope * x)]
}

/// By the two rows of `J W R diag(exp(s))`, through `inverse_conditional`, `slope` and `inverse_yy`.
#[inline(always)]
fn spread_gradient<D: Doubles>(
    covariance: &Covariance<D>,
    gradient: &FootprintGradient<D>,
    local: &LocalProjection<D>,
) -> [Vector<D>; 2] {
    let (half, two) = (D::splat(0.5), D::splat(2.0));
    let (k, s, inverse_yy) = (covariance.inverse_conditional, covariance.slope, covariance.inverse_yy);
    let by_variance = half * k * k * gradient.v_dd;
    let by_slope = inverse_yy * (k * gradient.v_dy);
    let by_yy = half * gradient.v_yy * (inverse_yy * inverse_yy);
    // The variance along a row is the square of what is left of `across` besides its share along `along`: written so, no
    // product of a needle's length with itself has to cancel.
    let [across, along] = local.spread;
    let rest = along.scaled_plus(-s, across);
    [
        rest.scaled_plus(two * by_variance, along * by_slope),
        rest.scaled_plus(by_slope - two * s * by_variance, along * (two * by_yy - s * by_slope)),
    ]
}

/// By the mean in camera axes, through the projected mean and through the Jacobian's entries; `rows` is the gradient by
/// the rows of `J W`.
#[inline(always)]
fn camera_gradient<D: Doubles>(
    local: &LocalProjection<D>,
    lens: &Lens<D>,
    mean: [D; 2],
    rows: [Vector<D>; 2],
) -> Vector<D> {
    let [right, down, forward] = lens.axes;
    let mut along = [D::splat(0.0); 2];
    let mut towards = D::splat(0.0);
    for (axis, of_camera) in [right, down].into_iter().enumerate() {
        let scale = lens.focal[axis] * local.inverse_z;
        // J[axis][axis] = f / z and J[axis][z] = -f · slope / z.
        let by_diagonal = rows[axis].dot(of_camera) * local.inverse_z;
        let by_slope = rows[axis].dot(forward) * local.inverse_z;
        let through_slope = by_slope * local.unclamped[axis];
        along[axis] = scale * (mean[axis] - through_slope);
        let by_depth = local.slope[axis] * (by_slope + through_slope);
        towards = towards + scale * (by_depth - mean[axis] * local.direction[axis] - by_diagonal);
    }
    let [x, y] = along;
    Vector { x, y, z: towards }
}

/// By log scales and quaternion, from the gradient by the rows of `J W R diag(exp(s))`.
#[inline(always)]
fn axes_gradient<D: Doubles>(local: &LocalProjection<D>, spread: [Vector<D>; 2]) -> ([D; 3], [D; 4]) {
    let [across, along] = local.rows;
    let by_axis = |a: D, b: D| across.scaled_plus(a, along * b);
    let axes = [
        by_axis(spread[0].x, spread[1].x),
        by_axis(spread[0].y, spread[1].y),
        by_axis(spread[0].z, spread[1].z),
    ];
    let [x, y, z] = axes;
    let log_scale = [x.dot(local.axes[0]), y.dot(local.axes[1]), z.dot(local.axes[2])];
    let [a, b, c] = local.scale;
    (log_scale, local.rotation.gradient(&[x * a, y * b, z * c]))
}
