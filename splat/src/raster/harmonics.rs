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
