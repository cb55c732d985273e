//! One Gaussian in one view, from its parameters: 3D Gaussian Splatting (Kerbl et al. 2023) over EWA splatting (Zwicker
//! et al. 2001), with the constants that `splat::raster` documents.

use splat::{
    cameras::Camera,
    gaussians::Gaussians,
    raster::{FRUSTUM_MARGIN, LOW_PASS, NEAR_PLANE},
};

use super::real::{Dual, Real, dot};

/// Mean, quaternion, log scales, logit of the opacity, and something added to each channel of the colour.
pub(crate) const PARAMETERS: usize = 3 + 4 + 3 + 1 + 3;

/// Parameters of one Gaussian.
#[derive(Clone, Copy)]
pub(crate) struct Parameters<R> {
    mean: [R; 3],
    rotation: [R; 4],
    log_scale: [R; 3],
    logit_opacity: R,
    colour_offset: [R; 3],
}

impl<R: Real> Parameters<R> {
    /// `number` turns value and position among the [`PARAMETERS`] into a number.
    fn new(gaussians: &Gaussians, index: usize, number: impl Fn(f64, usize) -> R) -> Self {
        let of = |value: f32, position: usize| number(value.into(), position);
        Self {
            mean: std::array::from_fn(|i| of(gaussians.means[index][i], i)),
            rotation: std::array::from_fn(|i| of(gaussians.rotations[index][i], 3 + i)),
            log_scale: std::array::from_fn(|i| of(gaussians.log_scales[index][i], 7 + i)),
            logit_opacity: of(gaussians.logit_opacities[index], 10),
            colour_offset: std::array::from_fn(|i| number(0.0, 11 + i)),
        }
    }
}

/// Parameters without derivatives.
pub(crate) fn plain(gaussians: &Gaussians, index: usize) -> Parameters<f64> {
    Parameters::new(gaussians, index, |value, _| value)
}

/// Parameters with derivatives by each of them.
pub(crate) fn differentiable(gaussians: &Gaussians, index: usize) -> Parameters<Dual<PARAMETERS>> {
    Parameters::new(gaussians, index, Dual::parameter)
}

/// One Gaussian in one view: `alpha = opacity · exp(-½ (ex - slope ey)² / conditional - ½ ey² / variance_y)`.
#[derive(Clone, Copy)]
pub(crate) struct Shape<R> {
    pub depth: f64,
    pub mean: [R; 2],
    pub slope: R,
    pub conditional: R,
    pub variance_y: R,
    pub opacity: R,
    pub colour: [R; 3],
    /// Values of the spherical harmonics in the direction of view.
    pub basis: [f64; 16],
    /// What single precision may do to a channel of the colour, in unit roundoffs.
    pub colour_roundoff: [f64; 3],
    /// Longest by shortest extent, nearly: how many times double precision's roundoff a covariance loses.
    pub elongation: f64,
}

/// None where it is not in front of the near plane.
pub(crate) fn project<R: Real>(
    parameters: &Parameters<R>,
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
) -> Option<Shape<R>> {
    let world_row = |row: usize| camera.rotation.row(row).to_array().map(R::of);
    let rows: [[R; 3]; 3] = std::array::from_fn(world_row);
    let shift = camera.translation.to_array();
    let [x, y, z]: [R; 3] = std::array::from_fn(|row| dot(rows[row], parameters.mean) + R::of(shift[row]));
    if z.value() <= NEAR_PLANE {
        return None;
    }
    let axis = |position: R, focal: f64, principal: f64, size: u32, row: usize| {
        let slope = position / z;
        let margin = FRUSTUM_MARGIN * 0.5 * f64::from(size) / focal;
        let low = -principal / focal - margin;
        let high = (f64::from(size) - principal) / focal + margin;
        let held = if slope.value() < low {
            R::of(low)
        } else if slope.value() > high {
            R::of(high)
        } else {
            slope
        };
        // Derivative of the pixel position by the world position.
        let scale = R::of(focal) / z;
        let jacobian: [R; 3] = std::array::from_fn(|i| scale * (rows[row][i] - held * rows[2][i]));
        (R::of(focal) * slope + R::of(principal), jacobian)
    };
    let (mean_x, jacobian_x) = axis(x, camera.fx, camera.cx, camera.width, 0);
    let (mean_y, jacobian_y) = axis(y, camera.fy, camera.cy, camera.height, 1);
    let axes = axes(parameters);
    let spread = |jacobian: [R; 3]| -> [R; 3] { std::array::from_fn(|k| dot(jacobian, axes[k])) };
    let (spread_x, spread_y) = (spread(jacobian_x), spread(jacobian_y));
    // The covariance is AᵀA of this 5×2 matrix; its QR factors lose as many digits as A has, not as AᵀA.
    let (blur, zero) = (R::of(LOW_PASS.sqrt()), R::of(0.0));
    let column_x = [spread_x[0], spread_x[1], spread_x[2], blur, zero];
    let column_y = [spread_y[0], spread_y[1], spread_y[2], zero, blur];
    let deviation_y = dot(column_y, column_y).sqrt();
    let unit = column_y.map(|value| value / deviation_y);
    let shared = dot(unit, column_x);
    let rest: [R; 5] = std::array::from_fn(|i| column_x[i] - shared * unit[i]);
    let conditional = dot(rest, rest);
    let variances = (dot(column_x, column_x) + dot(column_y, column_y)).value();
    let (colour, basis, colour_roundoff) = colour(parameters, gaussians, index, camera);
    Some(Shape {
        depth: z.value(),
        mean: [mean_x, mean_y],
        slope: shared / deviation_y,
        conditional,
        variance_y: deviation_y * deviation_y,
        opacity: sigmoid(parameters.logit_opacity),
        colour,
        basis,
        colour_roundoff,
        elongation: variances / (conditional * dot(column_y, column_y)).value().sqrt(),
    })
}

/// Columns of `R diag(exp(s))`; a quaternion without direction does not rotate.
fn axes<R: Real>(parameters: &Parameters<R>) -> [[R; 3]; 3] {
    let norm = dot(parameters.rotation, parameters.rotation);
    let one = R::of(1.0);
    let [w, x, y, z] = if norm.value() > 0.0 && norm.value().is_finite() {
        let norm = norm.sqrt();
        parameters.rotation.map(|value| value / norm)
    } else {
        [one, R::of(0.0), R::of(0.0), R::of(0.0)]
    };
    let two = R::of(2.0);
    let columns = [
        [one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)],
        [two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)],
        [two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)],
    ];
    std::array::from_fn(|k| columns[k].map(|value| value * parameters.log_scale[k].exp()))
}

fn sigmoid<R: Real>(x: R) -> R {
    let one = R::of(1.0);
    if x.value() >= 0.0 {
        return one / (one + (-x).exp());
    }
    let power = x.exp();
    power / (one + power)
}

fn colour<R: Real>(
    parameters: &Parameters<R>,
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
) -> ([R; 3], [f64; 16], [f64; 3]) {
    let centre = (-(camera.rotation.transpose() * camera.translation)).to_array();
    let offset: [R; 3] = std::array::from_fn(|i| parameters.mean[i] - R::of(centre[i]));
    let distance = dot(offset, offset).sqrt();
    let direction =
        if distance.value() > 0.0 { offset.map(|value| value / distance) } else { [R::of(0.0); 3] };
    let basis = harmonics(direction);
    let count = gaussians.sh_coefficients();
    let coefficients = gaussians.sh_of(index);
    let mut roundoff = [0.0; 3];
    let colour = std::array::from_fn(|channel| {
        let mut sum = R::of(0.5) + parameters.colour_offset[channel];
        let mut sizes = 0.5;
        for k in 0..count {
            let coefficient = f64::from(coefficients[3 * k + channel]);
            sum = sum + basis[k] * R::of(coefficient);
            // No harmonic up to degree 3 exceeds 1.
            sizes += coefficient.abs();
        }
        // Direction, powers of it, product and sum: about eight roundings of each term, then one per sum.
        roundoff[channel] = (8.0 + count as f64) * sizes;
        if sum.value() < 0.0 { R::of(0.0) } else { sum }
    });
    (colour, basis.map(Real::value), roundoff)
}

/// The real spherical harmonics to degree 3 with the signs of 3D Gaussian Splatting, from their normalisations.
pub(crate) fn harmonics<R: Real>([x, y, z]: [R; 3]) -> [R; 16] {
    let root = |value: f64| R::of((value / std::f64::consts::PI).sqrt());
    let (three, five) = (R::of(3.0), R::of(5.0));
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let square = xx + yy + zz;
    [
        root(0.25),
        -root(0.75) * y,
        root(0.75) * z,
        -root(0.75) * x,
        root(3.75) * x * y,
        -root(3.75) * y * z,
        root(5.0 / 16.0) * (three * zz - square),
        -root(3.75) * x * z,
        root(15.0 / 16.0) * (xx - yy),
        -root(35.0 / 32.0) * y * (three * xx - yy),
        root(105.0 / 4.0) * x * y * z,
        -root(21.0 / 32.0) * y * (five * zz - square),
        root(7.0 / 16.0) * z * (five * zz - three * square),
        -root(21.0 / 32.0) * x * (five * zz - square),
        root(105.0 / 16.0) * z * (xx - yy),
        -root(35.0 / 32.0) * x * (xx - three * yy),
    ]
}
