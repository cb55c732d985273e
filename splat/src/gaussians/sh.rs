//! Real spherical harmonics up to degree 3, with the basis and signs of the original 3D Gaussian Splatting.

/// Highest supported degree.
pub const MAX_DEGREE: u32 = 3;

/// Basis value of degree 0, `1 / (2 √π)`.
pub const C0: f64 = 0.28209479177387814;

/// Coefficients per channel of degree `degree`, `(degree + 1)²`.
pub const fn coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}
