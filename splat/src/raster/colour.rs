//! Colour of a Gaussian as seen from a camera centre: `max(0, SH(direction) + 0.5)`.

use glam::DVec3;

use crate::gaussians::{Gaussians, sh};

/// Direction from the camera centre to the mean; zero where they coincide, which leaves the degree-0 colour.
#[inline(always)]
fn direction_to(gaussians: &Gaussians, index: usize, centre: DVec3) -> (DVec3, f64) {
    let offset = gaussians.mean(index) - centre;
    let distance = offset.length();
    if distance > 0.0 { (offset / distance, distance) } else { (DVec3::ZERO, 1.0) }
}

/// Colour before the clamp at 0.
#[inline(always)]
fn unclamped(coefficients: &[f32], basis: &[f32; 16], count: usize) -> [f32; 3] {
    let mut colour = [0.5f32; 3];
    for (value, rgb) in basis[..count].iter().zip(coefficients.chunks_exact(3)) {
        for channel in 0..3 {
            colour[channel] += value * rgb[channel];
        }
    }
    colour
}

/// Colour of Gaussian `index` seen from `centre`, spherical harmonics up to `sh_degree`.
#[inline(always)]
pub(super) fn seen_from(gaussians: &Gaussians, index: usize, centre: DVec3, sh_degree: u32) -> [f32; 3] {
    let (direction, _) = direction_to(gaussians, index, centre);
    let degree = sh_degree.min(gaussians.sh_degree);
    let basis = basis(direction.as_vec3().to_array(), degree);
    let colour = unclamped(gaussians.sh_of(index), &basis, sh::coefficients(degree));
    // Not `max`: a colour that is no number must stay one, so that projection drops the Gaussian.
    colour.map(|value| if value < 0.0 { 0.0 } else { value })
}

/// Writes the gradient by the coefficients to `sh_gradient` (`K × 3`) and returns the gradient by the mean.
#[inline(always)]
pub(super) fn backward(
    gaussians: &Gaussians,
    index: usize,
    centre: DVec3,
    sh_degree: u32,
    colour_gradient: [f32; 3],
    sh_gradient: &mut [f32],
) -> DVec3 {
    let (direction, distance) = direction_to(gaussians, index, centre);
    let degree = sh_degree.min(gaussians.sh_degree);
    let count = sh::coefficients(degree);
    let unit = direction.as_vec3().to_array();
    let basis = basis(unit, degree);
    let coefficients = &gaussians.sh_of(index)[..3 * count];
    let colour = unclamped(coefficients, &basis, count);
    let mut passed = colour_gradient;
    for channel in 0..3 {
        if !(colour[channel] >= 0.0) {
            passed[channel] = 0.0;
        }
    }
    let (used, rest) = sh_gradient.split_at_mut(3 * count);
    rest.fill(0.0);
    let mut basis_gradient = [0.0f32; 16];
    let triples = used.as_chunks_mut::<3>().0.iter_mut().zip(coefficients.as_chunks::<3>().0);
    for (k, (gradient, coefficient)) in triples.enumerate() {
        *gradient = [basis[k] * passed[0], basis[k] * passed[1], basis[k] * passed[2]];
        basis_gradient[k] =
            coefficient[0] * passed[0] + coefficient[1] * passed[1] + coefficient[2] * passed[2];
    }
    if degree == 0 {
        return DVec3::ZERO;
    }
    let along = glam::Vec3::from(direction_gradient(unit, degree, &basis_gradient)).as_dvec3();
    (along - direction * direction.dot(along)) / distance
}

const C0: f32 = 0.282_094_79;
const C1: f32 = 0.488_602_51;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];

/// Values of the real spherical harmonics, with the signs of the original 3D Gaussian Splatting.
#[inline(always)]
fn basis([x, y, z]: [f32; 3], degree: u32) -> [f32; 16] {
    let mut b = [0.0; 16];
    b[0] = C0;
    if degree > 0 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree > 1 {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree > 2 {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    b
}

/// `Σ_k g_k ∇ basis_k`.
#[inline(always)]
fn direction_gradient([x, y, z]: [f32; 3], degree: u32, g: &[f32; 16]) -> [f32; 3] {
    let (mut dx, mut dy, mut dz) = (-C1 * g[3], -C1 * g[1], C1 * g[2]);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree > 1 {
        dx += C2[0] * y * g[4] - 2.0 * C2[2] * x * g[6] + C2[3] * z * g[7] + 2.0 * C2[4] * x * g[8];
        dy += C2[0] * x * g[4] + C2[1] * z * g[5] - 2.0 * C2[2] * y * g[6] - 2.0 * C2[4] * y * g[8];
        dz += C2[1] * y * g[5] + 4.0 * C2[2] * z * g[6] + C2[3] * x * g[7];
    }
    if degree > 2 {
        dx += C3[0] * 6.0 * x * y * g[9] + C3[1] * y * z * g[10]
            - C3[2] * 2.0 * x * y * g[11]
            - C3[3] * 6.0 * x * z * g[12]
            + C3[4] * (4.0 * zz - 3.0 * xx - yy) * g[13]
            + C3[5] * 2.0 * x * z * g[14]
            + C3[6] * 3.0 * (xx - yy) * g[15];
        dy += C3[0] * 3.0 * (xx - yy) * g[9]
            + C3[1] * x * z * g[10]
            + C3[2] * (4.0 * zz - xx - 3.0 * yy) * g[11]
            - C3[3] * 6.0 * y * z * g[12]
            - C3[4] * 2.0 * x * y * g[13]
            - C3[5] * 2.0 * y * z * g[14]
            - C3[6] * 6.0 * x * y * g[15];
        dz += C3[1] * x * y * g[10]
            + C3[2] * 8.0 * y * z * g[11]
            + C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12]
            + C3[4] * 8.0 * x * z * g[13]
            + C3[5] * (xx - yy) * g[14];
    }
    [dx, dy, dz]
}
