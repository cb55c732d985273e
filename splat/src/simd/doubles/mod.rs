//! Eight double-precision numbers at a time, with an exponential and a logarithm that need no library.

use std::ops::{Add, Div, Mul, Neg, Sub};

mod plain;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod x86;

pub(super) use self::plain::PlainDoubles;
#[cfg(target_arch = "x86_64")]
pub(super) use self::x86::{Avx2Doubles, Avx512Doubles};

/// Numbers per group.
pub(crate) const OCTET: usize = 8;

/// `2⁵² + 2⁵¹`: added to a number below 2⁵¹ it leaves the nearest integer in the low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// The 41 leading bits of ln 2, so that products with exponents are exact, and what is left.
const LN2_HIGH: f64 = 0.693_147_180_559_663;
const LN2_LOW: f64 = 2.823_529_056_303_157_7e-13;

/// A group of [`OCTET`] double-precision numbers. Operators round once each; only [`Doubles::mul_add`] is fused where
/// the instruction set can, so AVX-512 and AVX2 give the same bytes.
///
/// # Contract
/// That of [`Simd`](super::Simd), which names the implementation for each instruction set.
pub(crate) trait Doubles:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// One flag per lane.
    type Mask: Copy;
    fn splat(value: f64) -> Self;
    fn load(from: &[f64; OCTET]) -> Self;
    fn store(self, to: &mut [f64; OCTET]);
    fn load_singles(from: &[f32; OCTET]) -> Self;
    /// Rounded to single precision.
    fn store_singles(self, to: &mut [f32; OCTET]);
    fn sqrt(self) -> Self;
    fn abs(self) -> Self;
    /// `self * factor + term`, rounded once where the instruction set can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// The larger; `other` where one is NaN.
    fn max(self, other: Self) -> Self;
    /// The smaller; `other` where one is NaN.
    fn min(self, other: Self) -> Self;
    fn ge(self, other: Self) -> Self::Mask;
    fn gt(self, other: Self) -> Self::Mask;
    fn lt(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Bit `n` is the flag of lane `n`.
    fn bits(mask: Self::Mask) -> u8;
    /// `yes` where the flag is set, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Adds the low bits of `rounded` to the exponent of `self`.
    fn add_to_exponent(self, rounded: Self) -> Self;
    /// The fraction in `[1, 2)` and the exponent of positive normal numbers.
    fn split(self) -> (Self, Self);

    /// `self * factor - term`, rounded once where the instruction set can.
    #[inline(always)]
    fn mul_sub(self, factor: Self, term: Self) -> Self {
        self.mul_add(factor, -term)
    }

    /// Whether the number is one.
    #[inline(always)]
    fn is_finite(self) -> Self::Mask {
        self.abs().lt(Self::splat(f64::INFINITY))
    }

    /// Whether it stays finite when it is rounded to single precision.
    #[inline(always)]
    fn fits_single(self) -> Self::Mask {
        // Halfway between the largest finite number and the next power of two, which rounds up.
        self.abs().lt(Self::splat(340_282_356_779_733_661_637_539_395_458_142_568_448.0))
    }

    /// `e^x`, error below 2 units in the last place, or 2 of the smallest subnormals; infinite from 709.79 on, zero below
    /// -745.14, NaN for NaN.
    ///
    /// Splits off the nearest multiple of ln 2 and evaluates the Taylor polynomial of degree 13 on `[-ln 2 / 2, ln 2 / 2]`,
    /// whose remainder is `(ln 2 / 2)^14 / 14!`, 4e-18.
    #[inline(always)]
    fn exp(self) -> Self {
        const INVERSE_FACTORIALS: [f64; 13] = [
            1.0 / 479_001_600.0,
            1.0 / 39_916_800.0,
            1.0 / 3_628_800.0,
            1.0 / 362_880.0,
            1.0 / 40_320.0,
            1.0 / 5_040.0,
            1.0 / 720.0,
            1.0 / 120.0,
            1.0 / 24.0,
            1.0 / 6.0,
            0.5,
            1.0,
            1.0,
        ];
        let round = Self::splat(ROUND);
        // Beyond these the result is zero or infinite; NaN passes as the second operand.
        let x = Self::splat(710.0).min(Self::splat(-750.0).max(self));
        let exponent = x.mul_add(Self::splat(std::f64::consts::LOG2_E), round) - round;
        let rest = exponent.mul_add(Self::splat(-LN2_HIGH), x);
        let rest = exponent.mul_add(Self::splat(-LN2_LOW), rest);
        let mut power = Self::splat(1.0 / 6_227_020_800.0);
        for coefficient in INVERSE_FACTORIALS {
            power = power.mul_add(rest, Self::splat(coefficient));
        }
        // In two factors, neither of which leaves the range that the result may leave.
        let half = exponent.mul_add(Self::splat(0.5), round);
        let other = exponent - (half - round) + round;
        let one = Self::splat(1.0);
        power * one.add_to_exponent(half) * one.add_to_exponent(other)
    }

    /// Natural logarithm, error below 2 units in the last place; negative infinity for zeros, NaN for negative numbers and
    /// NaN.
    ///
    /// With the fraction `m` in `[1/√2, √2]` and `s = (m - 1) / (m + 1)`, `ln m = 2 artanh s`: the Taylor polynomial of degree
    /// 21, whose remainder is `s^22 / 23`, 7e-19 relative.
    #[inline(always)]
    fn ln(self) -> Self {
        const INVERSE_ODD: [f64; 9] = [
            2.0 / 19.0,
            2.0 / 17.0,
            2.0 / 15.0,
            2.0 / 13.0,
            2.0 / 11.0,
            2.0 / 9.0,
            2.0 / 7.0,
            2.0 / 5.0,
            2.0 / 3.0,
        ];
        let (zero, one, infinity) = (Self::splat(0.0), Self::splat(1.0), Self::splat(f64::INFINITY));
        let is_subnormal = self.lt(Self::splat(f64::MIN_POSITIVE));
        let normal = Self::select(is_subnormal, self * Self::splat((1_u64 << 54) as f64), self);
        let (fraction, exponent) = normal.split();
        let exponent = exponent - Self::select(is_subnormal, Self::splat(54.0), zero);
        let is_large = fraction.ge(Self::splat(std::f64::consts::SQRT_2));
        let fraction = Self::select(is_large, fraction * Self::splat(0.5), fraction);
        let exponent = exponent + Self::select(is_large, one, zero);
        let beyond_one = fraction - one;
        let s = beyond_one / (fraction + one);
        let square = s * s;
        let mut series = Self::splat(2.0 / 21.0);
        for coefficient in INVERSE_ODD {
            series = series.mul_add(square, Self::splat(coefficient));
        }
        // ln m = 2 s + s · series · s², and 2 s = beyond_one - s · beyond_one: the error of s counts little.
        let less = s * (beyond_one - series * square) - exponent * Self::splat(LN2_LOW);
        let result = exponent.mul_add(Self::splat(LN2_HIGH), beyond_one - less);
        let result = Self::select(self.lt(infinity), result, self);
        let result = Self::select(self.gt(zero), result, Self::splat(f64::NAN));
        Self::select(zero.ge(self.abs()), -infinity, result)
    }
}
