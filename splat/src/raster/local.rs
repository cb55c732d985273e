//! The local affine projection of eight Gaussians, shared by [`project`](super::project) and its gradient.

use super::{
    FRUSTUM_MARGIN, LOW_PASS,
    colour::Triple,
    lanes::{Geometry, Rotation, Vector, dots},
};
use crate::{cameras::Camera, gaussians::Gaussians, simd::Doubles};

/// A view as the stages of a Gaussian need it.
pub(super) struct View<'a> {
    pub camera: &'a Camera,
    /// Of the spherical harmonics that are used; the set's own at most.
    pub sh_degree: u32,
}

impl<'a> View<'a> {
    /// What `camera` sees of the set, spherical harmonics up to `sh_degree`.
    pub(super) fn new(camera: &'a Camera, gaussians: &Gaussians, sh_degree: u32) -> Self {
        Self { camera, sh_degree: sh_degree.min(gaussians.sh_degree) }
    }
}

/// A [`View`] with every number in every lane.
#[derive(Clone, Copy)]
pub(super) struct Lens<D> {
    /// Camera axes in the world.
    pub axes: [Vector<D>; 3],
    /// World origin in camera axes.
    translation: Vector<D>,
    /// Of the camera, world units.
    pub centre: Vector<D>,
    /// Pixels, per axis, as all that follows.
    pub focal: [D; 2],
    pub principal: [D; 2],
    pub size: [D; 2],
    /// Bounds of the slopes `x / z` and `y / z`.
    slopes: [(D, D); 2],
}

impl<D: Doubles> Lens<D> {
    #[inline(always)]
    pub(super) fn new(camera: &Camera) -> Self {
        let axis = |number: usize| Vector::splat(camera.rotation.row(number));
        let bounds = |focal: f64, principal: f64, size: f64| {
            let margin = FRUSTUM_MARGIN * 0.5 * size / focal;
            (D::splat(-(principal / focal + margin)), D::splat((size - principal) / focal + margin))
        };
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        Self {
            axes: [axis(0), axis(1), axis(2)],
            translation: Vector::splat(camera.translation),
            centre: Vector::splat(camera.centre()),
            focal: [D::splat(camera.fx), D::splat(camera.fy)],
            principal: [D::splat(camera.cx), D::splat(camera.cy)],
            size: [D::splat(width), D::splat(height)],
            slopes: [bounds(camera.fx, camera.cx, width), bounds(camera.fy, camera.cy, height)],
        }
    }

    /// World points in camera axes.
    #[inline(always)]
    pub(super) fn camera_point(&self, world: Vector<D>) -> Vector<D> {
        dots(&self.axes, world) + self.translation
    }
}

/// The local affine projection of eight Gaussians; meaningless behind the camera.
#[derive(Clone, Copy)]
pub(super) struct LocalProjection<D: Doubles> {
    pub inverse_z: D,
    /// `x / z` and `y / z`.
    pub direction: [D; 2],
    /// The same, clamped to the widened frustum.
    pub slope: [D; 2],
    /// 0 where the clamp is active, 1 elsewhere, per axis.
    pub unclamped: [D; 2],
    /// Rows of `J W`: derivative of the pixel position by the world position.
    pub rows: [Vector<D>; 2],
    pub rotation: Rotation<D>,
    pub scale: [D; 3],
    /// Columns of `R diag(exp(s))`: world axes of the Gaussian.
    pub axes: [Vector<D>; 3],
    /// The two rows of `J W R diag(exp(s))`.
    pub spread: [Vector<D>; 2],
}

impl<D: Doubles> LocalProjection<D> {
    /// Of Gaussians whose means in camera axes are `point`.
    #[inline(always)]
    pub(super) fn new(gaussians: &Geometry<D>, point: Vector<D>, lens: &Lens<D>) -> Self {
        let inverse_z = D::splat(1.0) / point.z;
        let direction = [point.x * inverse_z, point.y * inverse_z];
        let (slope_x, unclamped_x) = clamp(direction[0], lens.slopes[0]);
        let (slope_y, unclamped_y) = clamp(direction[1], lens.slopes[1]);
        let [right, down, forward] = lens.axes;
        let rows = [
            forward.scaled_plus(-slope_x, right) * (lens.focal[0] * inverse_z),
            forward.scaled_plus(-slope_y, down) * (lens.focal[1] * inverse_z),
        ];
        let [a, b, c] = gaussians.log_scale;
        let scale = [a.exp(), b.exp(), c.exp()];
        let rotation = Rotation::new(gaussians.rotation);
        let [x, y, z] = rotation.columns();
        let axes = [x * scale[0], y * scale[1], z * scale[2]];
        let spread = [dots(&axes, rows[0]), dots(&axes, rows[1])];
        Self {
            inverse_z,
            direction,
            slope: [slope_x, slope_y],
            unclamped: [unclamped_x, unclamped_y],
            rows,
            rotation,
            scale,
            axes,
            spread,
        }
    }

    /// Projected means, pixels.
    #[inline(always)]
    pub(super) fn mean(&self, lens: &Lens<D>) -> [D; 2] {
        [
            lens.focal[0].mul_add(self.direction[0], lens.principal[0]),
            lens.focal[1].mul_add(self.direction[1], lens.principal[1]),
        ]
    }
}

/// And whether that changed nothing; NaN stays.
#[inline(always)]
fn clamp<D: Doubles>(slope: D, (low, high): (D, D)) -> (D, D) {
    let (zero, one) = (D::splat(0.0), D::splat(1.0));
    let (is_low, is_high) = (slope.lt(low), slope.gt(high));
    let clamped = D::select(is_low, low, D::select(is_high, high, slope));
    (clamped, D::select(D::either(is_low, is_high), zero, one))
}

/// Covariance of a footprint, pixels², and what follows from it.
#[derive(Clone, Copy)]
pub(super) struct Covariance<D> {
    pub xx: D,
    pub xy: D,
    pub yy: D,
    pub inverse_yy: D,
    /// Row centre shift per row, `cov_xy / cov_yy`.
    pub slope: D,
    /// Variance along a row, `cov_xx - cov_xy² / cov_yy`.
    pub conditional: D,
    pub inverse_conditional: D,
}

impl<D: Doubles> Covariance<D> {
    /// From the rows of `J W R diag(exp(s))`. The conditional variance is a sum of non-negative terms (Lagrange's identity),
    /// exact for needles.
    #[inline(always)]
    pub(super) fn new([across, along]: [Vector<D>; 2]) -> Self {
        let (one, low_pass) = (D::splat(1.0), D::splat(LOW_PASS));
        let squared = across.length_squared();
        let (xx, xy, yy) = (squared + low_pass, across.dot(along), along.length_squared() + low_pass);
        let inverse_yy = one / yy;
        let unblurred = across.cross(along).length_squared() + low_pass * squared;
        let conditional = low_pass + unblurred / yy;
        Self {
            xx,
            xy,
            yy,
            inverse_yy,
            slope: xy * inverse_yy,
            conditional,
            inverse_conditional: one / conditional,
        }
    }
}

/// Unit vectors from the camera to the means, and the inverses of the distances; zero and one where they coincide.
#[inline(always)]
pub(super) fn sight<D: Doubles>(mean: Vector<D>, lens: &Lens<D>) -> (Vector<D>, D) {
    let one = D::splat(1.0);
    let offset = mean - lens.centre;
    let distance = offset.length_squared().sqrt();
    let inverse = one / D::select(distance.gt(D::splat(0.0)), distance, one);
    (offset * inverse, inverse)
}

/// Rounds unit vectors to single precision, into the lower or the upper `half` of sixteen lanes.
#[inline(always)]
pub(super) fn store_direction<D: Doubles>(direction: Vector<D>, to: &mut Triple, half: usize) {
    direction.x.store_singles(&mut to[0].as_chunks_mut().0[half]);
    direction.y.store_singles(&mut to[1].as_chunks_mut().0[half]);
    direction.z.store_singles(&mut to[2].as_chunks_mut().0[half]);
}

/// The lower or the upper `half` of sixteen lanes.
#[inline(always)]
pub(super) fn load_direction<D: Doubles>([x, y, z]: &Triple, half: usize) -> Vector<D> {
    Vector {
        x: D::load_singles(&x.as_chunks().0[half]),
        y: D::load_singles(&y.as_chunks().0[half]),
        z: D::load_singles(&z.as_chunks().0[half]),
    }
}
