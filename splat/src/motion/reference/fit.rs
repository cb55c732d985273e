//! The affine motion of one footprint.

use glam::{DMat2, DMat3, DVec2, DVec3};

use crate::motion::moments::FootprintMoments;

/// Least determinant of the weight-normalised second moments of `(1, x, y)`, in normalised device coordinates.
const MIN_DETERMINANT: f64 = 1e-12;
/// Least sum of blending weights of a view.
const MIN_WEIGHT: f64 = 1e-3;

/// `x ↦ gradient · x + offset`, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Affine {
    pub gradient: DMat2,
    pub offset: DVec2,
}

impl Affine {
    pub(super) fn of(&self, pixel: DVec2) -> DVec2 {
        self.gradient * pixel + self.offset
    }
}

/// Weighted least squares with the explicit inverse of the 3×3 matrix of second moments; `None` where the
/// footprint is a line, a point, or too faint.
pub(super) fn fit(moments: &FootprintMoments, size: DVec2) -> Option<Affine> {
    if !(moments.weight > MIN_WEIGHT) || moments.pixels <= 1 {
        return None;
    }
    let (second, cross) = device_moments(moments, size);
    if !(second.determinant().abs() > MIN_DETERMINANT) {
        return None;
    }
    let inverse = second.inverse();
    let [x, y] = cross.map(|column| inverse * column);
    let affine = in_pixels(x, y, size);
    (affine.gradient.is_finite() && affine.offset.is_finite()).then_some(affine)
}

/// `Σ w p pᵀ / W` with `p = (1, x, y)`, and `Σ w x' p / W`, `Σ w y' p / W`, in normalised device coordinates.
fn device_moments(moments: &FootprintMoments, size: DVec2) -> (DMat3, [DVec3; 2]) {
    let scale = DVec2::splat(2.0) / size;
    let centre = DVec2::from_array(moments.centroid) * scale - DVec2::ONE;
    let tracked = DVec2::from_array(moments.tracked_centroid) * scale - DVec2::ONE;
    let [uu, uv, vv] = moments.source.map(|sum| sum / moments.weight);
    let [eu_du, eu_dv, ev_du, ev_dv] = moments.cross.map(|sum| sum / moments.weight);
    let xx = uu * scale.x * scale.x + centre.x * centre.x;
    let xy = uv * scale.x * scale.y + centre.x * centre.y;
    let yy = vv * scale.y * scale.y + centre.y * centre.y;
    let second = DMat3::from_cols(
        DVec3::new(1.0, centre.x, centre.y),
        DVec3::new(centre.x, xx, xy),
        DVec3::new(centre.y, xy, yy),
    );
    let row = |tracked: f64, scale_to: f64, du: f64, dv: f64| {
        DVec3::new(
            tracked,
            scale_to * scale.x * du + tracked * centre.x,
            scale_to * scale.y * dv + tracked * centre.y,
        )
    };
    (second, [row(tracked.x, scale.x, eu_du, eu_dv), row(tracked.y, scale.y, ev_du, ev_dv)])
}

/// From coefficients of `(1, x, y)` in normalised device coordinates.
fn in_pixels(x: DVec3, y: DVec3, size: DVec2) -> Affine {
    let aspect = size.x / size.y;
    Affine {
        gradient: DMat2::from_cols(DVec2::new(x.y, y.y / aspect), DVec2::new(x.z * aspect, y.z)),
        offset: DVec2::new(0.5 * size.x * (x.x - x.y - x.z + 1.0), 0.5 * size.y * (y.x - y.y - y.z + 1.0)),
    }
}
