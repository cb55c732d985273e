//! AVX-512 and AVX2 + FMA.

use std::{
    arch::x86_64::*,
    ops::{Add, Div, Mul, Neg, Sub},
};

use super::{Doubles, OCTET};

/// One 512-bit register.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Doubles(__m512d);

/// Two 256-bit registers.
#[derive(Clone, Copy)]
pub(crate) struct Avx2Doubles(__m256d, __m256d);

/// Wraps intrinsics whose only demand is the instruction set.
macro_rules! intrinsic {
    ($call:expr) => {
        // SAFETY: by the contract of `Simd` this runs on a machine with the instruction set; memory operands are
        // unaligned accesses to whole arrays of numbers.
        unsafe { $call }
    };
}

/// An operator of both types.
macro_rules! operator {
    ($operator:ident, $method:ident, $wide:ident, $half:ident) => {
        impl $operator for Avx512Doubles {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(intrinsic!($wide(self.0, other.0)))
            }
        }
        impl $operator for Avx2Doubles {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(intrinsic!($half(self.0, other.0)), intrinsic!($half(self.1, other.1)))
            }
        }
    };
}

operator!(Add, add, _mm512_add_pd, _mm256_add_pd);
operator!(Sub, sub, _mm512_sub_pd, _mm256_sub_pd);
operator!(Mul, mul, _mm512_mul_pd, _mm256_mul_pd);
operator!(Div, div, _mm512_div_pd, _mm256_div_pd);

impl Neg for Avx512Doubles {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(intrinsic!(_mm512_xor_pd(self.0, _mm512_set1_pd(-0.0))))
    }
}

impl Neg for Avx2Doubles {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.zip(Self::splat(-0.0), |a, b| intrinsic!(_mm256_xor_pd(a, b)))
    }
}

/// Of the biased exponent: or-ed into the low bits of 2⁵², it makes 2⁵² plus itself.
const EXPONENT: i64 = 0x4330_0000_0000_0000;
/// What must be taken off then.
const EXPONENT_BIAS: f64 = 4_503_599_627_370_496.0 + 1023.0;
const FRACTION_BITS: i64 = 0x000F_FFFF_FFFF_FFFF;
const ONE_BITS: i64 = 0x3FF0_0000_0000_0000;

impl Doubles for Avx512Doubles {
    type Mask = __mmask8;
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self(intrinsic!(_mm512_set1_pd(value)))
    }
    #[inline(always)]
    fn load(from: &[f64; OCTET]) -> Self {
        Self(intrinsic!(_mm512_loadu_pd(from.as_ptr())))
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; OCTET]) {
        intrinsic!(_mm512_storeu_pd(to.as_mut_ptr(), self.0));
    }
    #[inline(always)]
    fn load_singles(from: &[f32; OCTET]) -> Self {
        Self(intrinsic!(_mm512_cvtps_pd(_mm256_loadu_ps(from.as_ptr()))))
    }
    #[inline(always)]
    fn store_singles(self, to: &mut [f32; OCTET]) {
        intrinsic!(_mm256_storeu_ps(to.as_mut_ptr(), _mm512_cvtpd_ps(self.0)));
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(intrinsic!(_mm512_sqrt_pd(self.0)))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(intrinsic!(_mm512_abs_pd(self.0)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(intrinsic!(_mm512_fmadd_pd(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_max_pd(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_min_pd(self.0, other.0)))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        intrinsic!(_mm512_cmp_pd_mask::<_CMP_GE_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn gt(self, other: Self) -> Self::Mask {
        intrinsic!(_mm512_cmp_pd_mask::<_CMP_GT_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        intrinsic!(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        a & b
    }
    #[inline(always)]
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        a | b
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u8 {
        mask
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(intrinsic!(_mm512_mask_blend_pd(mask, no.0, yes.0)))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        Self(intrinsic!(_mm512_castsi512_pd(_mm512_add_epi64(
            _mm512_castpd_si512(self.0),
            _mm512_slli_epi64::<52>(_mm512_castpd_si512(rounded.0))
        ))))
    }
    #[inline(always)]
    fn split(self) -> (Self, Self) {
        intrinsic!({
            let bits = _mm512_castpd_si512(self.0);
            let fraction = _mm512_and_si512(bits, _mm512_set1_epi64(FRACTION_BITS));
            let fraction = _mm512_or_si512(fraction, _mm512_set1_epi64(ONE_BITS));
            let exponent = _mm512_or_si512(_mm512_srli_epi64::<52>(bits), _mm512_set1_epi64(EXPONENT));
            let exponent = _mm512_sub_pd(_mm512_castsi512_pd(exponent), _mm512_set1_pd(EXPONENT_BIAS));
            (Self(_mm512_castsi512_pd(fraction)), Self(exponent))
        })
    }
}

impl Avx2Doubles {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(__m256d, __m256d) -> __m256d) -> Self {
        Self(operation(self.0, other.0), operation(self.1, other.1))
    }
}

impl Doubles for Avx2Doubles {
    type Mask = (__m256d, __m256d);
    #[inline(always)]
    fn splat(value: f64) -> Self {
        let half = intrinsic!(_mm256_set1_pd(value));
        Self(half, half)
    }
    #[inline(always)]
    fn load(from: &[f64; OCTET]) -> Self {
        let (low, high) = from.split_at(OCTET / 2);
        Self(intrinsic!(_mm256_loadu_pd(low.as_ptr())), intrinsic!(_mm256_loadu_pd(high.as_ptr())))
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; OCTET]) {
        let (low, high) = to.split_at_mut(OCTET / 2);
        intrinsic!(_mm256_storeu_pd(low.as_mut_ptr(), self.0));
        intrinsic!(_mm256_storeu_pd(high.as_mut_ptr(), self.1));
    }
    #[inline(always)]
    fn load_singles(from: &[f32; OCTET]) -> Self {
        let (low, high) = from.split_at(OCTET / 2);
        intrinsic!(Self(
            _mm256_cvtps_pd(_mm_loadu_ps(low.as_ptr())),
            _mm256_cvtps_pd(_mm_loadu_ps(high.as_ptr()))
        ))
    }
    #[inline(always)]
    fn store_singles(self, to: &mut [f32; OCTET]) {
        let (low, high) = to.split_at_mut(OCTET / 2);
        intrinsic!(_mm_storeu_ps(low.as_mut_ptr(), _mm256_cvtpd_ps(self.0)));
        intrinsic!(_mm_storeu_ps(high.as_mut_ptr(), _mm256_cvtpd_ps(self.1)));
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(intrinsic!(_mm256_sqrt_pd(self.0)), intrinsic!(_mm256_sqrt_pd(self.1)))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::splat(-0.0).zip(self, |a, b| intrinsic!(_mm256_andnot_pd(a, b)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(
            intrinsic!(_mm256_fmadd_pd(self.0, factor.0, term.0)),
            intrinsic!(_mm256_fmadd_pd(self.1, factor.1, term.1)),
        )
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_max_pd(a, b)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_min_pd(a, b)))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        let flags = self.zip(other, |a, b| intrinsic!(_mm256_cmp_pd::<_CMP_GE_OQ>(a, b)));
        (flags.0, flags.1)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> Self::Mask {
        let flags = self.zip(other, |a, b| intrinsic!(_mm256_cmp_pd::<_CMP_GT_OQ>(a, b)));
        (flags.0, flags.1)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        let flags = self.zip(other, |a, b| intrinsic!(_mm256_cmp_pd::<_CMP_LT_OQ>(a, b)));
        (flags.0, flags.1)
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        (intrinsic!(_mm256_and_pd(a.0, b.0)), intrinsic!(_mm256_and_pd(a.1, b.1)))
    }
    #[inline(always)]
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        (intrinsic!(_mm256_or_pd(a.0, b.0)), intrinsic!(_mm256_or_pd(a.1, b.1)))
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u8 {
        (intrinsic!(_mm256_movemask_pd(mask.0)) | intrinsic!(_mm256_movemask_pd(mask.1)) << 4) as u8
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(
            intrinsic!(_mm256_blendv_pd(no.0, yes.0, mask.0)),
            intrinsic!(_mm256_blendv_pd(no.1, yes.1, mask.1)),
        )
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| {
            intrinsic!(_mm256_castsi256_pd(_mm256_add_epi64(
                _mm256_castpd_si256(a),
                _mm256_slli_epi64::<52>(_mm256_castpd_si256(b))
            )))
        })
    }
    #[inline(always)]
    fn split(self) -> (Self, Self) {
        let half = |value: __m256d| {
            intrinsic!({
                let bits = _mm256_castpd_si256(value);
                let fraction = _mm256_and_si256(bits, _mm256_set1_epi64x(FRACTION_BITS));
                let fraction = _mm256_or_si256(fraction, _mm256_set1_epi64x(ONE_BITS));
                let exponent = _mm256_or_si256(_mm256_srli_epi64::<52>(bits), _mm256_set1_epi64x(EXPONENT));
                let exponent = _mm256_sub_pd(_mm256_castsi256_pd(exponent), _mm256_set1_pd(EXPONENT_BIAS));
                (_mm256_castsi256_pd(fraction), exponent)
            })
        };
        let (low, high) = (half(self.0), half(self.1));
        (Self(low.0, high.0), Self(low.1, high.1))
    }
}
