//! AVX-512 and AVX2 + FMA.

use std::arch::x86_64::*;

use super::{
    LANES, Plain, ROWS, Simd,
    doubles::{Avx2Doubles, Avx512Doubles},
    shorts::Avx2Shorts,
};

/// One 512-bit register.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(__m512);

/// Two 256-bit registers.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(__m256, __m256);

/// Wraps intrinsics whose only demand is the instruction set.
macro_rules! intrinsic {
    ($call:expr) => {
        // SAFETY: by the contract of `Simd` this runs on a machine with the instruction set; memory operands are
        // unaligned accesses to whole arrays of numbers.
        unsafe { $call }
    };
}

impl Simd for Avx512 {
    type Mask = __mmask16;
    type Doubles = Avx512Doubles;
    // Unaligned loads of 512 bits always touch two lines of the cache.
    type Shorts = Avx2Shorts;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self(intrinsic!(_mm512_set1_ps(value)))
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        Self(intrinsic!(_mm512_loadu_ps(from.as_ptr())))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        intrinsic!(_mm512_storeu_ps(to.as_mut_ptr(), self.0));
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_add_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_sub_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_mul_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(intrinsic!(_mm512_sqrt_ps(self.0)))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(intrinsic!(_mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(self.0)))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        Self(intrinsic!(_mm512_roundscale_ps::<{ _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC }>(self.0)))
    }
    #[inline(always)]
    fn store_integers(self, to: &mut [i32; LANES]) {
        intrinsic!(_mm512_storeu_epi32(to.as_mut_ptr(), _mm512_cvttps_epi32(self.0)));
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(intrinsic!(_mm512_fmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_max_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(intrinsic!(_mm512_min_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn negated_mul_add(self, factor: Self, term: Self) -> Self {
        Self(intrinsic!(_mm512_fnmadd_ps(self.0, factor.0, term.0)))
    }
    #[inline(always)]
    fn load_halves([low, high]: [&[f32; LANES / 2]; 2]) -> Self {
        intrinsic!({
            let low = _mm512_castps256_ps512(_mm256_loadu_ps(low.as_ptr()));
            Self(_mm512_insertf32x8::<1>(low, _mm256_loadu_ps(high.as_ptr())))
        })
    }
    #[inline(always)]
    fn store_halves(self, [low, high]: [&mut [f32; LANES / 2]; 2]) {
        intrinsic!({
            _mm256_storeu_ps(low.as_mut_ptr(), _mm512_castps512_ps256(self.0));
            _mm256_storeu_ps(high.as_mut_ptr(), _mm512_extractf32x8_ps::<1>(self.0));
        });
    }
    #[inline(always)]
    fn straddle(self, next: Self) -> Self {
        Self(intrinsic!(_mm512_shuffle_f32x4::<0x4E>(self.0, next.0)))
    }
    #[inline(always)]
    fn load_rows([a, b, c, d]: [&[f32; ROWS]; ROWS]) -> Self {
        intrinsic!({
            let upper = _mm512_castps128_ps512(_mm_loadu_ps(a.as_ptr()));
            let upper = _mm512_insertf32x4::<1>(upper, _mm_loadu_ps(b.as_ptr()));
            let three = _mm512_insertf32x4::<2>(upper, _mm_loadu_ps(c.as_ptr()));
            Self(_mm512_insertf32x4::<3>(three, _mm_loadu_ps(d.as_ptr())))
        })
    }
    #[inline(always)]
    fn spread_in_rows<const COLUMN: usize>(self) -> Self {
        Self(match COLUMN {
            0 => intrinsic!(_mm512_permute_ps::<0x00>(self.0)),
            1 => intrinsic!(_mm512_permute_ps::<0x55>(self.0)),
            2 => intrinsic!(_mm512_permute_ps::<0xAA>(self.0)),
            _ => intrinsic!(_mm512_permute_ps::<0xFF>(self.0)),
        })
    }
    #[inline(always)]
    fn positions(words: &[u32; LANES], mask: u32, first: u32, to: &mut [u32; LANES]) -> usize {
        intrinsic!({
            let words = _mm512_loadu_epi32(words.as_ptr().cast());
            let flags = _mm512_test_epi32_mask(words, _mm512_set1_epi32(mask.cast_signed()));
            let places = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            let numbers = _mm512_add_epi32(places, _mm512_set1_epi32(first.cast_signed()));
            // Compressed in a register: into memory the instruction is many times slower.
            _mm512_storeu_epi32(to.as_mut_ptr().cast(), _mm512_maskz_compress_epi32(flags, numbers));
            flags.count_ones() as usize
        })
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        intrinsic!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        intrinsic!(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0))
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        a & b
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u16 {
        mask
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        mask != 0
    }
    #[inline(always)]
    fn transpose([a, b, c, d]: [Self; ROWS]) -> [Self; ROWS] {
        intrinsic!({
            let (ab_upper, ab_lower) =
                (_mm512_shuffle_f32x4::<0x44>(a.0, b.0), _mm512_shuffle_f32x4::<0xEE>(a.0, b.0));
            let (cd_upper, cd_lower) =
                (_mm512_shuffle_f32x4::<0x44>(c.0, d.0), _mm512_shuffle_f32x4::<0xEE>(c.0, d.0));
            [
                Self(_mm512_shuffle_f32x4::<0x88>(ab_upper, cd_upper)),
                Self(_mm512_shuffle_f32x4::<0xDD>(ab_upper, cd_upper)),
                Self(_mm512_shuffle_f32x4::<0x88>(ab_lower, cd_lower)),
                Self(_mm512_shuffle_f32x4::<0xDD>(ab_lower, cd_lower)),
            ]
        })
    }
    #[inline(always)]
    fn transpose_rows([a, b, c, d]: [Self; ROWS]) -> [Self; ROWS] {
        intrinsic!({
            let (ab_low, ab_high) = (_mm512_unpacklo_ps(a.0, b.0), _mm512_unpackhi_ps(a.0, b.0));
            let (cd_low, cd_high) = (_mm512_unpacklo_ps(c.0, d.0), _mm512_unpackhi_ps(c.0, d.0));
            [
                Self(_mm512_shuffle_ps::<0x44>(ab_low, cd_low)),
                Self(_mm512_shuffle_ps::<0xEE>(ab_low, cd_low)),
                Self(_mm512_shuffle_ps::<0x44>(ab_high, cd_high)),
                Self(_mm512_shuffle_ps::<0xEE>(ab_high, cd_high)),
            ]
        })
    }
    #[inline(always)]
    fn row_sums([a, b, c, d]: [Self; ROWS]) -> Self {
        intrinsic!({
            // Within each row: a0 + a2, b0 + b2, a1 + a3, b1 + b3.
            let ab = _mm512_add_ps(_mm512_unpacklo_ps(a.0, b.0), _mm512_unpackhi_ps(a.0, b.0));
            let cd = _mm512_add_ps(_mm512_unpacklo_ps(c.0, d.0), _mm512_unpackhi_ps(c.0, d.0));
            let even = _mm512_shuffle_ps::<0x44>(ab, cd);
            Self(_mm512_add_ps(even, _mm512_shuffle_ps::<0xEE>(ab, cd)))
        })
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(intrinsic!(_mm512_mask_blend_ps(mask, no.0, yes.0)))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        Self(intrinsic!(_mm512_castsi512_ps(_mm512_add_epi32(
            _mm512_castps_si512(self.0),
            _mm512_slli_epi32::<23>(_mm512_castps_si512(rounded.0))
        ))))
    }
}

impl Avx2 {
    #[inline(always)]
    fn each(self, operation: impl Fn(__m256) -> __m256) -> Self {
        Self(operation(self.0), operation(self.1))
    }

    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(__m256, __m256) -> __m256) -> Self {
        Self(operation(self.0, other.0), operation(self.1, other.1))
    }
}

impl Simd for Avx2 {
    type Mask = (__m256, __m256);
    type Doubles = Avx2Doubles;
    type Shorts = Avx2Shorts;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        let half = intrinsic!(_mm256_set1_ps(value));
        Self(half, half)
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        let (low, high) = from.split_at(LANES / 2);
        Self(intrinsic!(_mm256_loadu_ps(low.as_ptr())), intrinsic!(_mm256_loadu_ps(high.as_ptr())))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        let (low, high) = to.split_at_mut(LANES / 2);
        intrinsic!(_mm256_storeu_ps(low.as_mut_ptr(), self.0));
        intrinsic!(_mm256_storeu_ps(high.as_mut_ptr(), self.1));
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_add_ps(a, b)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_sub_ps(a, b)))
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_mul_ps(a, b)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(|a| intrinsic!(_mm256_sqrt_ps(a)))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        self.each(|a| intrinsic!(_mm256_floor_ps(a)))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        self.each(|a| intrinsic!(_mm256_ceil_ps(a)))
    }
    #[inline(always)]
    fn store_integers(self, to: &mut [i32; LANES]) {
        let (low, high) = to.split_at_mut(LANES / 2);
        intrinsic!({
            _mm256_storeu_si256(low.as_mut_ptr().cast(), _mm256_cvttps_epi32(self.0));
            _mm256_storeu_si256(high.as_mut_ptr().cast(), _mm256_cvttps_epi32(self.1));
        });
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(
            intrinsic!(_mm256_fmadd_ps(self.0, factor.0, term.0)),
            intrinsic!(_mm256_fmadd_ps(self.1, factor.1, term.1)),
        )
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_max_ps(a, b)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| intrinsic!(_mm256_min_ps(a, b)))
    }
    #[inline(always)]
    fn negated_mul_add(self, factor: Self, term: Self) -> Self {
        Self(
            intrinsic!(_mm256_fnmadd_ps(self.0, factor.0, term.0)),
            intrinsic!(_mm256_fnmadd_ps(self.1, factor.1, term.1)),
        )
    }
    #[inline(always)]
    fn load_halves([low, high]: [&[f32; LANES / 2]; 2]) -> Self {
        intrinsic!(Self(_mm256_loadu_ps(low.as_ptr()), _mm256_loadu_ps(high.as_ptr())))
    }
    #[inline(always)]
    fn store_halves(self, [low, high]: [&mut [f32; LANES / 2]; 2]) {
        intrinsic!(_mm256_storeu_ps(low.as_mut_ptr(), self.0));
        intrinsic!(_mm256_storeu_ps(high.as_mut_ptr(), self.1));
    }
    #[inline(always)]
    fn straddle(self, next: Self) -> Self {
        Self(self.1, next.0)
    }
    #[inline(always)]
    fn load_rows([a, b, c, d]: [&[f32; ROWS]; ROWS]) -> Self {
        intrinsic!(Self(
            _mm256_loadu2_m128(b.as_ptr(), a.as_ptr()),
            _mm256_loadu2_m128(d.as_ptr(), c.as_ptr())
        ))
    }
    #[inline(always)]
    fn spread_in_rows<const COLUMN: usize>(self) -> Self {
        match COLUMN {
            0 => self.each(|a| intrinsic!(_mm256_permute_ps::<0x00>(a))),
            1 => self.each(|a| intrinsic!(_mm256_permute_ps::<0x55>(a))),
            2 => self.each(|a| intrinsic!(_mm256_permute_ps::<0xAA>(a))),
            _ => self.each(|a| intrinsic!(_mm256_permute_ps::<0xFF>(a))),
        }
    }
    #[inline(always)]
    fn positions(words: &[u32; LANES], mask: u32, first: u32, to: &mut [u32; LANES]) -> usize {
        Plain::positions(words, mask, first, to)
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        let flags = self.zip(other, |a, b| intrinsic!(_mm256_cmp_ps::<_CMP_GE_OQ>(a, b)));
        (flags.0, flags.1)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        let flags = self.zip(other, |a, b| intrinsic!(_mm256_cmp_ps::<_CMP_LT_OQ>(a, b)));
        (flags.0, flags.1)
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        (intrinsic!(_mm256_and_ps(a.0, b.0)), intrinsic!(_mm256_and_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn transpose([a, b, c, d]: [Self; ROWS]) -> [Self; ROWS] {
        intrinsic!({
            [
                Self(_mm256_permute2f128_ps::<0x20>(a.0, b.0), _mm256_permute2f128_ps::<0x20>(c.0, d.0)),
                Self(_mm256_permute2f128_ps::<0x31>(a.0, b.0), _mm256_permute2f128_ps::<0x31>(c.0, d.0)),
                Self(_mm256_permute2f128_ps::<0x20>(a.1, b.1), _mm256_permute2f128_ps::<0x20>(c.1, d.1)),
                Self(_mm256_permute2f128_ps::<0x31>(a.1, b.1), _mm256_permute2f128_ps::<0x31>(c.1, d.1)),
            ]
        })
    }
    #[inline(always)]
    fn transpose_rows([a, b, c, d]: [Self; ROWS]) -> [Self; ROWS] {
        let half = |a, b, c, d| {
            intrinsic!({
                let (ab_low, ab_high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
                let (cd_low, cd_high) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
                [
                    _mm256_shuffle_ps::<0x44>(ab_low, cd_low),
                    _mm256_shuffle_ps::<0xEE>(ab_low, cd_low),
                    _mm256_shuffle_ps::<0x44>(ab_high, cd_high),
                    _mm256_shuffle_ps::<0xEE>(ab_high, cd_high),
                ]
            })
        };
        let (low, high) = (half(a.0, b.0, c.0, d.0), half(a.1, b.1, c.1, d.1));
        [Self(low[0], high[0]), Self(low[1], high[1]), Self(low[2], high[2]), Self(low[3], high[3])]
    }
    #[inline(always)]
    fn row_sums([a, b, c, d]: [Self; ROWS]) -> Self {
        let half = |a, b, c, d| {
            intrinsic!({
                let ab = _mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
                let cd = _mm256_add_ps(_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
                _mm256_add_ps(_mm256_shuffle_ps::<0x44>(ab, cd), _mm256_shuffle_ps::<0xEE>(ab, cd))
            })
        };
        Self(half(a.0, b.0, c.0, d.0), half(a.1, b.1, c.1, d.1))
    }
    #[inline(always)]
    fn bits(mask: Self::Mask) -> u16 {
        (intrinsic!(_mm256_movemask_ps(mask.0)) | intrinsic!(_mm256_movemask_ps(mask.1)) << 8) as u16
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        intrinsic!(_mm256_movemask_ps(_mm256_or_ps(mask.0, mask.1))) != 0
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(
            intrinsic!(_mm256_blendv_ps(no.0, yes.0, mask.0)),
            intrinsic!(_mm256_blendv_ps(no.1, yes.1, mask.1)),
        )
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| {
            intrinsic!(_mm256_castsi256_ps(_mm256_add_epi32(
                _mm256_castps_si256(a),
                _mm256_slli_epi32::<23>(_mm256_castps_si256(b))
            )))
        })
    }
}
