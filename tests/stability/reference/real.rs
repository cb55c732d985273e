//! Numbers that a formula can be evaluated with: doubles, and doubles that carry derivatives.

use std::ops::{Add, Div, Mul, Neg, Sub};

/// What the formulas of a renderer need of a number.
pub(crate) trait Real:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// A constant.
    fn of(value: f64) -> Self;
    /// Without derivatives.
    fn value(self) -> f64;
    fn sqrt(self) -> Self;
    fn exp(self) -> Self;
}

impl Real for f64 {
    fn of(value: f64) -> Self {
        value
    }
    fn value(self) -> f64 {
        self
    }
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    fn exp(self) -> Self {
        self.exp()
    }
}

/// A value and its derivatives by `N` parameters.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dual<const N: usize> {
    pub value: f64,
    pub by: [f64; N],
    /// The derivatives if no terms cancelled in them: what rounding of double precision is relative to.
    pub size: [f64; N],
}

impl<const N: usize> Dual<N> {
    /// Parameter number `index`.
    pub(crate) fn parameter(value: f64, index: usize) -> Self {
        let mut by = [0.0; N];
        by[index] = 1.0;
        Self { value, by, size: by }
    }

    /// A function of this with the given value and slope.
    fn mapped(self, value: f64, slope: f64) -> Self {
        let by = self.by.map(|by| slope * by);
        Self { value, by, size: self.size.map(|size| slope.abs() * size) }
    }

    /// A function of two with the given value and slopes.
    fn joined(self, other: Self, value: f64, slope: f64, other_slope: f64) -> Self {
        let (mut by, mut size) = ([0.0; N], [0.0; N]);
        for index in 0..N {
            by[index] = slope * self.by[index] + other_slope * other.by[index];
            size[index] = slope.abs() * self.size[index] + other_slope.abs() * other.size[index];
        }
        Self { value, by, size }
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        self.joined(other, self.value + other.value, 1.0, 1.0)
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self.joined(other, self.value - other.value, 1.0, -1.0)
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        self.joined(other, self.value * other.value, other.value, self.value)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        let quotient = self.value / other.value;
        self.joined(other, quotient, 1.0 / other.value, -quotient / other.value)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;
    fn neg(self) -> Self {
        self.mapped(-self.value, -1.0)
    }
}

impl<const N: usize> Real for Dual<N> {
    fn of(value: f64) -> Self {
        Self { value, by: [0.0; N], size: [0.0; N] }
    }
    fn value(self) -> f64 {
        self.value
    }
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.mapped(root, 0.5 / root)
    }
    fn exp(self) -> Self {
        let power = self.value.exp();
        self.mapped(power, power)
    }
}

/// `Σ a b`.
pub(crate) fn dot<R: Real, const N: usize>(a: [R; N], b: [R; N]) -> R {
    (0..N).fold(R::of(0.0), |sum, i| sum + a[i] * b[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_every_operation_match_central_differences() {
        fn function<R: Real>(x: R, y: R) -> R {
            (x * y - (x + R::of(2.0)).sqrt() / y).exp() + -(y / x)
        }
        let (x, y, step) = (0.7, 1.3, 1e-6);
        let dual = function(Dual::<2>::parameter(x, 0), Dual::parameter(y, 1));
        let by_x = (function(x + step, y) - function(x - step, y)) / (2.0 * step);
        let by_y = (function(x, y + step) - function(x, y - step)) / (2.0 * step);
        // Central differences at step 1e-6 err by about 1e-10 here.
        assert!(
            (dual.by[0] - by_x).abs() < 1e-8 && (dual.by[1] - by_y).abs() < 1e-8,
            "{dual:?} {by_x} {by_y}"
        );
        assert_eq!(dual.value, function(x, y));
    }
}
