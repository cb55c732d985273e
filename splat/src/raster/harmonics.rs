//! Real spherical harmonics of sixteen directions at a time, with the signs of the original 3D Gaussian Splatting.

use std::ops::{Add, Mul, Sub};

use crate::{
    gaussians::sh::{C0, C1, C2, C3},
    simd::Simd,
};

/// Basis functions up to the highest degree.
pub(super) const MOST: usize = 16;

/// A group of numbers with the operators of formulas.
#[derive(Clone, Copy)]
struct Number<S>(S);

impl<S: Simd> Add for Number<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(self.0.add(other.0))
    }
}

impl<S: Simd> Sub for Number<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(self.0.sub(other.0))
    }
}

impl<S: Simd> Mul for Number<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(self.0.mul(other.0))
    }
}

#[inline(always)]
fn constant<S: Simd>(value: f64) -> Number<S> {
    Number(S::splat(value as f32))
}

/// Values at unit vectors; zero beyond the degree.
#[inline(always)]
pub(super) fn basis<S: Simd>([x, y, z]: [S; 3], degree: u32) -> [S; MOST] {
    let (x, y, z) = (Number(x), Number(y), Number(z));
    let mut basis = [S::splat(0.0); MOST];
    basis[0] = S::splat(C0 as f32);
    if degree > 0 {
        basis[1] = (constant(-C1) * y).0;
        basis[2] = (constant(C1) * z).0;
        basis[3] = (constant(-C1) * x).0;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, difference) = (x * y, xx - yy);
    if degree > 1 {
        basis[4] = (constant(C2[0]) * xy).0;
        basis[5] = (constant(C2[1]) * y * z).0;
        basis[6] = (constant(C2[2]) * (zz + zz - xx - yy)).0;
        basis[7] = (constant(C2[3]) * x * z).0;
        basis[8] = (constant(C2[4]) * difference).0;
    }
    if degree > 2 {
        let (three, four) = (constant(3.0), constant(4.0));
        let slope = four * zz - xx - yy;
        basis[9] = (constant(C3[0]) * y * (three * xx - yy)).0;
        basis[10] = (constant(C3[1]) * xy * z).0;
        basis[11] = (constant(C3[2]) * y * slope).0;
        basis[12] = (constant(C3[3]) * z * (zz + zz - three * (xx + yy))).0;
        basis[13] = (constant(C3[4]) * x * slope).0;
        basis[14] = (constant(C3[5]) * z * difference).0;
        basis[15] = (constant(C3[6]) * x * (xx - three * yy)).0;
    }
    basis
}

/// `Σ_k weights[k] ∇ basis_k`.
#[inline(always)]
pub(super) fn direction_gradient<S: Simd>([x, y, z]: [S; 3], degree: u32, weights: &[S; MOST]) -> [S; 3] {
    if degree == 0 {
        return [S::splat(0.0); 3];
    }
    let (x, y, z) = (Number(x), Number(y), Number(z));
    let weighted = |factor: f64, place: usize| constant(factor) * Number(weights[place]);
    let (mut dx, mut dy, mut dz) = (weighted(-C1, 3), weighted(-C1, 1), weighted(C1, 2));
    if degree > 1 {
        let (xy, yz, zz) = (weighted(C2[0], 4), weighted(C2[1], 5), weighted(2.0 * C2[2], 6));
        let (xz, difference) = (weighted(C2[3], 7), weighted(2.0 * C2[4], 8));
        dx = dx + y * xy + z * xz + x * (difference - zz);
        dy = dy + x * xy + z * yz - y * (difference + zz);
        dz = dz + y * yz + x * xz + z * (zz + zz);
    }
    if degree > 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, yz, xz, difference) = (x * y, y * z, x * z, xx - yy);
        let (three, four) = (constant(3.0), constant(4.0));
        let (g9, g10, g11) = (weighted(3.0 * C3[0], 9), weighted(C3[1], 10), weighted(C3[2], 11));
        let (g12, g13) = (weighted(3.0 * C3[3], 12), weighted(C3[4], 13));
        let (g14, g15) = (weighted(C3[5], 14), weighted(3.0 * C3[6], 15));
        let (xy2, yz2, xz2) = (xy + xy, yz + yz, xz + xz);
        dx = dx + xy2 * (g9 - g11) + yz * g10 + xz2 * (g14 - g12);
        dx = dx + (four * zz - three * xx - yy) * g13 + difference * g15;
        dy = dy + difference * g9 + xz * g10 + (four * zz - xx - three * yy) * g11;
        dy = dy - yz2 * (g12 + g14) - xy2 * (g13 + g15);
        dz = dz + xy * g10 + four * (yz2 * g11 + xz2 * g13);
        dz = dz + (zz + zz - xx - yy) * g12 + difference * g14;
    }
    [dx.0, dy.0, dz.0]
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::{
        gaussians::sh,
        simd::{Instructions, LANES, simd_kernel},
    };

    type Lanes = [f32; LANES];

    simd_kernel! {
        fn evaluate(
            directions: &[Lanes; 3],
            degree: u32,
            weights: &[Lanes; MOST],
            basis_to: &mut [Lanes; MOST],
            gradient_to: &mut [Lanes; 3],
        ) = evaluate_kernel
    }

    #[inline(always)]
    fn evaluate_kernel<S: Simd>(
        [x, y, z]: &[Lanes; 3],
        degree: u32,
        weights: &[Lanes; MOST],
        basis_to: &mut [Lanes; MOST],
        gradient_to: &mut [Lanes; 3],
    ) {
        let directions = [S::load(x), S::load(y), S::load(z)];
        let mut loaded = [S::splat(0.0); MOST];
        for (loaded, weights) in loaded.iter_mut().zip(weights) {
            *loaded = S::load(weights);
        }
        for (values, to) in basis(directions, degree).into_iter().zip(basis_to) {
            values.store(to);
        }
        for (values, to) in direction_gradient(directions, degree, &loaded).into_iter().zip(gradient_to) {
            values.store(to);
        }
    }

    #[test]
    fn basis_and_gradient_are_those_of_double_precision() {
        let direction = |lane: usize| {
            let angle = 0.7 * lane as f64;
            DVec3::new(angle.sin(), (1.3 * angle).cos(), 0.2 + (2.1 * angle).sin()).normalize()
        };
        let weight = |place: usize, lane: usize| ((3 * place + 5 * lane) as f64).sin();
        let directions: [Lanes; 3] =
            std::array::from_fn(|axis| std::array::from_fn(|lane| direction(lane)[axis] as f32));
        let weights: [Lanes; MOST] =
            std::array::from_fn(|place| std::array::from_fn(|lane| weight(place, lane) as f32));
        for instructions in Instructions::available() {
            for degree in 0..=sh::MAX_DEGREE {
                let (mut values, mut gradient) = ([[0.0; LANES]; MOST], [[0.0; LANES]; 3]);
                evaluate(instructions, &directions, degree, &weights, &mut values, &mut gradient);
                for lane in 0..LANES {
                    let expected = sh::basis(direction(lane), degree);
                    for (found, expected) in values.iter().zip(expected) {
                        // A dozen roundings of numbers up to 3, directions rounded among them.
                        assert!((f64::from(found[lane]) - expected).abs() < 2e-6, "degree {degree}");
                    }
                    let weighted = |at: DVec3| -> f64 {
                        sh::basis(at, degree).iter().enumerate().map(|(k, b)| b * weight(k, lane)).sum()
                    };
                    for axis in 0..3 {
                        let step = DVec3::AXES[axis] * 1e-5;
                        let difference = weighted(direction(lane) + step) - weighted(direction(lane) - step);
                        let (found, expected) = (f64::from(gradient[axis][lane]), difference / 2e-5);
                        // Sums of up to 16 products of that kind, ten times as large.
                        assert!((found - expected).abs() < 3e-5, "degree {degree}: {found} {expected}");
                    }
                }
            }
        }
    }
}
