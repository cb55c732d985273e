//! Real spherical harmonics up to degree 3, with the basis and signs of the original 3D Gaussian Splatting.

use glam::{DMat3, DQuat, DVec3};

/// Highest supported degree.
pub const MAX_DEGREE: u32 = 3;

/// Basis value of degree 0, `1 / (2 √π)`.
pub const C0: f64 = 0.28209479177387814;
pub(crate) const C1: f64 = 0.4886025119029199;
pub(crate) const C2: [f64; 5] =
    [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396];
pub(crate) const C3: [f64; 7] = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
];

/// Coefficients per channel of degree `degree`, `(degree + 1)²`.
pub const fn coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// One definition of the basis for both precisions.
macro_rules! evaluate_basis {
    ($real:ty, $direction:expr, $degree:expr) => {{
        let [x, y, z]: [$real; 3] = $direction;
        let mut basis = [0.0 as $real; 16];
        basis[0] = C0 as $real;
        if $degree > 0 {
            basis[1] = -C1 as $real * y;
            basis[2] = C1 as $real * z;
            basis[3] = -C1 as $real * x;
        }
        if $degree > 1 {
            basis[4] = C2[0] as $real * x * y;
            basis[5] = C2[1] as $real * y * z;
            basis[6] = C2[2] as $real * (2.0 * z * z - x * x - y * y);
            basis[7] = C2[3] as $real * x * z;
            basis[8] = C2[4] as $real * (x * x - y * y);
        }
        if $degree > 2 {
            basis[9] = C3[0] as $real * y * (3.0 * x * x - y * y);
            basis[10] = C3[1] as $real * x * y * z;
            basis[11] = C3[2] as $real * y * (4.0 * z * z - x * x - y * y);
            basis[12] = C3[3] as $real * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
            basis[13] = C3[4] as $real * x * (4.0 * z * z - x * x - y * y);
            basis[14] = C3[5] as $real * z * (x * x - y * y);
            basis[15] = C3[6] as $real * x * (x * x - 3.0 * y * y);
        }
        basis
    }};
}

/// The `(degree + 1)²` basis functions at a unit direction; the rest of the array is zero.
pub fn basis(direction: DVec3, degree: u32) -> [f64; 16] {
    evaluate_basis!(f64, direction.to_array(), degree)
}

/// [`basis`] in single precision.
pub fn basis_f32(direction: [f32; 3], degree: u32) -> [f32; 16] {
    evaluate_basis!(f32, direction, degree)
}

/// Rotates a function on the sphere: afterwards it has at `rotation * direction` the value that it had at
/// `direction`.
///
/// `coefficients` is `K × 3`, coefficient by channel, with `K` = 1, 4, 9 or 16. The rotation must be a unit
/// quaternion. A slice of another length than `K × 3` keeps what lies beyond the last complete band.
pub fn rotate(coefficients: &mut [f32], rotation: DQuat) {
    let bands = BandRotation::new(rotation, degree_of(coefficients.len() / 3));
    bands.apply(coefficients);
}

/// Largest degree whose bands are complete in `count` coefficients per channel.
fn degree_of(count: usize) -> u32 {
    (0..=MAX_DEGREE).rev().find(|&degree| coefficients(degree) <= count).unwrap_or(0)
}

/// The matrices by which a rotation acts on the coefficients of bands 1 to `degree`.
#[derive(Clone, Debug)]
struct BandRotation {
    degree: u32,
    /// Element `[row][column]` couples coefficients of the same band; all others are zero.
    matrix: [[f64; 16]; 16],
}

/// Half of the 26 points of the Lebedev rule that integrates polynomials to degree 7 exactly, one of each
/// antipodal pair: axes, edges and corners of the cube.
const DIRECTIONS: [[f64; 3]; 13] = [
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.0, 1.0, 1.0],
    [0.0, 1.0, -1.0],
    [1.0, 0.0, 1.0],
    [1.0, 0.0, -1.0],
    [1.0, 1.0, 0.0],
    [1.0, -1.0, 0.0],
    [1.0, 1.0, 1.0],
    [1.0, 1.0, -1.0],
    [1.0, -1.0, 1.0],
    [1.0, -1.0, -1.0],
];

/// Weight of an antipodal pair with 1, 2 or 3 nonzero coordinates (V. I. Lebedev, 1976); they sum to one over
/// the rule.
const PAIR_WEIGHTS: [f64; 3] = [2.0 / 21.0, 8.0 / 105.0, 18.0 / 280.0];

impl BandRotation {
    /// Projects the rotated basis functions on the basis by quadrature.
    ///
    /// The products are polynomials of degree at most 6 and even under inversion, for which the rule is
    /// exact.
    fn new(rotation: DQuat, degree: u32) -> Self {
        let mut matrix = [[0.0; 16]; 16];
        matrix[0][0] = 1.0;
        let inverse = DMat3::from_quat(rotation).transpose();
        for point in DIRECTIONS.map(DVec3::from_array) {
            let nonzero = point.length_squared() as usize;
            let weight = 4.0 * std::f64::consts::PI * PAIR_WEIGHTS[nonzero - 1];
            let direction = point.normalize();
            let here = basis(direction, degree);
            let before = basis(inverse * direction, degree);
            for band in 1..=degree as usize {
                for row in band * band..(band + 1) * (band + 1) {
                    for column in band * band..(band + 1) * (band + 1) {
                        matrix[row][column] += weight * here[row] * before[column];
                    }
                }
            }
        }
        Self { degree, matrix }
    }

    fn apply(&self, coefficients: &mut [f32]) {
        for band in 1..=self.degree as usize {
            let range = band * band..(band + 1) * (band + 1);
            for channel in 0..3 {
                let mut rotated = [0.0; 7];
                for (row, value) in range.clone().zip(&mut rotated) {
                    *value = range
                        .clone()
                        .map(|column| {
                            self.matrix[row][column] * f64::from(coefficients[column * 3 + channel])
                        })
                        .sum();
                }
                for (row, value) in range.clone().zip(rotated) {
                    coefficients[row * 3 + channel] = value as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn direction(rng: &mut ChaCha8Rng) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0))).normalize()
    }

    fn rotation(rng: &mut ChaCha8Rng) -> DQuat {
        DQuat::from_scaled_axis(direction(rng) * rng.random_range(0.0..3.1))
    }

    fn value(coefficients: &[f64; 16], direction: DVec3, degree: u32) -> f64 {
        basis(direction, degree).iter().zip(coefficients).map(|(b, c)| b * c).sum()
    }

    fn rotated(coefficients: &[f64; 16], rotation: DQuat, degree: u32) -> [f64; 16] {
        let bands = BandRotation::new(rotation, degree);
        std::array::from_fn(|row| {
            (0..16).map(|column| bands.matrix[row][column] * coefficients[column]).sum()
        })
    }

    #[test]
    fn basis_is_orthonormal_under_the_quadrature() {
        for degree in 0..=MAX_DEGREE {
            let identity = BandRotation::new(DQuat::IDENTITY, degree).matrix;
            for row in 0..coefficients(degree) {
                for column in 0..coefficients(degree) {
                    let expected = f64::from(u8::from(row == column));
                    assert!((identity[row][column] - expected).abs() < 1e-14, "{degree} {row} {column}");
                }
            }
        }
    }

    #[test]
    fn rotated_function_at_rotated_direction_keeps_its_value() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for degree in 0..=MAX_DEGREE {
            for _ in 0..50 {
                let count = coefficients(degree);
                let original: [f64; 16] =
                    std::array::from_fn(|k| if k < count { rng.random_range(-1.0..1.0) } else { 0.0 });
                let turn = rotation(&mut rng);
                let turned = rotated(&original, turn, degree);
                let d = direction(&mut rng);
                let difference = value(&turned, turn * d, degree) - value(&original, d, degree);
                assert!(difference.abs() < 1e-10, "degree {degree}: {difference}");
            }
        }
    }

    #[test]
    fn rotations_compose_and_invert() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let original: [f64; 16] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let (a, b) = (rotation(&mut rng), rotation(&mut rng));
        let twice = rotated(&rotated(&original, a, 3), b, 3);
        let once = rotated(&original, b * a, 3);
        let back = rotated(&rotated(&original, a, 3), a.conjugate(), 3);
        for k in 0..16 {
            assert!((twice[k] - once[k]).abs() < 1e-10);
            assert!((back[k] - original[k]).abs() < 1e-10);
        }
    }

    #[test]
    fn stored_coefficients_turn_per_channel_and_degree_zero_stays() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let turn = rotation(&mut rng);
        for degree in 0..=MAX_DEGREE {
            let original: Vec<f32> =
                (0..coefficients(degree) * 3).map(|_| rng.random_range(-1.0..1.0)).collect();
            let mut stored = original.clone();
            rotate(&mut stored, turn);
            assert_eq!(stored[..3], original[..3]);
            for channel in 0..3 {
                let of_channel: [f64; 16] = std::array::from_fn(|k| {
                    original.get(k * 3 + channel).copied().unwrap_or_default().into()
                });
                let expected = rotated(&of_channel, turn, degree);
                for k in 0..coefficients(degree) {
                    assert_eq!(stored[k * 3 + channel], expected[k] as f32);
                }
            }
        }
    }

    #[test]
    fn single_precision_basis_follows_the_double() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for _ in 0..100 {
            let d = direction(&mut rng);
            let single = basis_f32(d.as_vec3().to_array(), 3);
            for (s, exact) in single.iter().zip(basis(d, 3)) {
                // A dozen roundings of values below 3.
                assert!((f64::from(*s) - exact).abs() < 2e-6);
            }
        }
    }

    #[test]
    fn first_band_is_the_rotated_gradient() {
        // A function c·d in band 1 has coefficients (-y, z, -x) of c over C1.
        let mut stored = vec![0.0f32; 12];
        stored[3] = -2.0; // c = +y in channel 0
        rotate(&mut stored, DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2));
        assert!((stored[9] - 2.0).abs() < 1e-6, "c = -x afterwards: {stored:?}");
        assert!(stored[3].abs() < 1e-6 && stored[6].abs() < 1e-6);
    }
}
