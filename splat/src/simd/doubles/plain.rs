//! Plain arrays.

use std::ops::{Add, Div, Mul, Neg, Sub};

use super::{Doubles, OCTET};

/// Plain arrays, for machines without the instruction sets below and for reference.
#[derive(Clone, Copy)]
pub(crate) struct PlainDoubles([f64; OCTET]);

impl PlainDoubles {
    #[inline(always)]
    fn each(self, operation: impl Fn(f64) -> f64) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane])))
    }

    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f64, f64) -> f64) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    fn compare(self, other: Self, operation: impl Fn(f64, f64) -> bool) -> [bool; OCTET] {
        std::array::from_fn(|lane| operation(self.0[lane], other.0[lane]))
    }
}

impl Add for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
}

impl Sub for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
}

impl Mul for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
}

impl Div for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
}

impl Neg for PlainDoubles {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.each(|a| -a)
    }
}

impl Doubles for PlainDoubles {
    type Mask = [bool; OCTET];
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; OCTET])
    }
    #[inline(always)]
    fn load(from: &[f64; OCTET]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; OCTET]) {
        *to = self.0;
    }
    #[inline(always)]
    fn load_singles(from: &[f32; OCTET]) -> Self {
        Self(std::array::from_fn(|lane| f64::from(from[lane])))
    }
    #[inline(always)]
    fn store_singles(self, to: &mut [f32; OCTET]) {
        *to = std::array::from_fn(|lane| self.0[lane] as f32);
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(f64::sqrt)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.each(f64::abs)
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| multiply_add(self.0[lane], factor.0[lane], term.0[lane])))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        self.compare(other, |a, b| a >= b)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> Self::Mask {
        self.compare(other, |a, b| a > b)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        self.compare(other, |a, b| a < b)
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|lane| a[lane] & b[lane])
    }
    #[inline(always)]
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|lane| a[lane] | b[lane])
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u8 {
        (0..OCTET).fold(0, |bits, lane| bits | u8::from(mask[lane]) << lane)
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| f64::from_bits(a.to_bits().wrapping_add(b.to_bits() << 52)))
    }
    #[inline(always)]
    fn split(self) -> (Self, Self) {
        let fraction = |a: f64| f64::from_bits(a.to_bits() & 0x000F_FFFF_FFFF_FFFF | 0x3FF0_0000_0000_0000);
        let exponent = |a: f64| (a.to_bits() >> 52) as f64 - 1023.0;
        (self.each(fraction), self.each(exponent))
    }
}

/// On AArch64 the fused instruction is part of the baseline; elsewhere it would be a library call.
#[inline(always)]
fn multiply_add(value: f64, factor: f64, term: f64) -> f64 {
    if cfg!(target_arch = "aarch64") { value.mul_add(factor, term) } else { value * factor + term }
}
