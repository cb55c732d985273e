//! The registers that the microkernels are generic over.

/// One register of single-precision numbers.
///
/// # Safety
/// Methods may only run inside a function compiled for the instruction set, on a machine that has it; the choice in
/// [`super::kernels`] is the only place where a type is named.
pub(super) trait Vector: Copy {
    /// One flag per lane.
    type Mask: Copy;
    /// Numbers per register.
    const LANES: usize;
    fn splat(value: f32) -> Self;
    /// The first numbers of a slice, which has at least as many.
    fn load(from: &[f32]) -> Self;
    fn store(self, to: &mut [f32]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn mul_add(self, factor: Self, term: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    /// `1 / self` to about single precision.
    fn reciprocal(self) -> Self;
    /// Adds the low bits of `rounded` to the exponent.
    fn add_to_exponent(self, rounded: Self) -> Self;
    fn ge(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;

    /// The sum of all lanes.
    #[inline(always)]
    fn sum(self) -> f32 {
        let mut lanes = [0.0; 16];
        self.store(&mut lanes);
        let eight: [f32; 8] = std::array::from_fn(|lane| lanes[lane] + lanes[lane + 8]);
        let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
        (four[0] + four[2]) + (four[1] + four[3])
    }

    /// `2^self`: range reduction by the rounding constant, polynomial of degree 6, as in `splat::raster`.
    #[inline(always)]
    fn exp2(self) -> Self {
        let round = Self::splat(12_582_912.0);
        let x = self.max(Self::splat(-126.0));
        let rounded = x.add(round);
        let fraction = x.sub(rounded.sub(round));
        let coefficients = [1.333_355_8e-3, 9.618_129e-3, 5.550_410_9e-2, 2.402_265_1e-1, 6.931_472e-1, 1.0];
        let mut power = Self::splat(1.540_353e-4);
        for coefficient in coefficients {
            power = power.mul_add(fraction, Self::splat(coefficient));
        }
        power.add_to_exponent(rounded)
    }
}

/// What every machine of the architecture has, left to the compiler.
#[derive(Clone, Copy)]
pub(super) struct Baseline([f32; 4]);

impl Baseline {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }
}

impl Vector for Baseline {
    type Mask = [bool; 4];
    const LANES: usize = 4;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        Self(std::array::from_fn(|lane| from[lane]))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[..4].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
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
    fn mul_add(self, factor: Self, term: Self) -> Self {
        // On AArch64 the fused instruction is part of the baseline; elsewhere it would be a library call.
        if cfg!(target_arch = "aarch64") {
            return Self(std::array::from_fn(|lane| self.0[lane].mul_add(factor.0[lane], term.0[lane])));
        }
        self.mul(factor).add(term)
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn reciprocal(self) -> Self {
        Self(self.0.map(|value| 1.0 / value))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| f32::from_bits(a.to_bits().wrapping_add(b.to_bits() << 23)))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Self::Mask {
        std::array::from_fn(|lane| self.0[lane] >= other.0[lane])
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|lane| a[lane] & b[lane])
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }))
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::Vector;

    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx512(__m512);

    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx2(__m256);

    /// Wraps intrinsics whose only demand is the instruction set.
    macro_rules! intrinsic {
        ($call:expr) => {
            // SAFETY: by the contract of `Vector` this runs on a machine with the instruction set; memory operands are
            // unaligned accesses to slices whose length was checked.
            unsafe { $call }
        };
    }

    /// The methods whose intrinsics differ in their names alone.
    macro_rules! same {
        ($lanes:literal, $set:ident, $load:ident, $store:ident, $fused:ident, $($method:ident = $call:ident),*) => {
            const LANES: usize = $lanes;
            #[inline(always)]
            fn splat(value: f32) -> Self {
                Self(intrinsic!($set(value)))
            }
            #[inline(always)]
            fn load(from: &[f32]) -> Self {
                Self(intrinsic!($load(from[..$lanes].as_ptr())))
            }
            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                intrinsic!($store(to[..$lanes].as_mut_ptr(), self.0));
            }
            #[inline(always)]
            fn mul_add(self, factor: Self, term: Self) -> Self {
                Self(intrinsic!($fused(self.0, factor.0, term.0)))
            }
            $(
                #[inline(always)]
                fn $method(self, other: Self) -> Self {
                    Self(intrinsic!($call(self.0, other.0)))
                }
            )*
        };
    }

    impl Vector for Avx512 {
        type Mask = __mmask16;
        same!(
            16,
            _mm512_set1_ps,
            _mm512_loadu_ps,
            _mm512_storeu_ps,
            _mm512_fmadd_ps,
            add = _mm512_add_ps,
            sub = _mm512_sub_ps,
            mul = _mm512_mul_ps,
            max = _mm512_max_ps,
            min = _mm512_min_ps,
            div = _mm512_div_ps
        );
        #[inline(always)]
        fn sqrt(self) -> Self {
            Self(intrinsic!(_mm512_sqrt_ps(self.0)))
        }
        #[inline(always)]
        fn reciprocal(self) -> Self {
            let estimate = Self(intrinsic!(_mm512_rcp14_ps(self.0)));
            estimate.mul(Self::splat(2.0).sub(self.mul(estimate)))
        }
        #[inline(always)]
        fn add_to_exponent(self, rounded: Self) -> Self {
            Self(intrinsic!(_mm512_castsi512_ps(_mm512_add_epi32(
                _mm512_castps_si512(self.0),
                _mm512_slli_epi32::<23>(_mm512_castps_si512(rounded.0))
            ))))
        }
        #[inline(always)]
        fn ge(self, other: Self) -> Self::Mask {
            intrinsic!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
            a & b
        }
        #[inline(always)]
        fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
            Self(intrinsic!(_mm512_mask_blend_ps(mask, no.0, yes.0)))
        }
    }

    impl Vector for Avx2 {
        type Mask = __m256;
        same!(
            8,
            _mm256_set1_ps,
            _mm256_loadu_ps,
            _mm256_storeu_ps,
            _mm256_fmadd_ps,
            add = _mm256_add_ps,
            sub = _mm256_sub_ps,
            mul = _mm256_mul_ps,
            max = _mm256_max_ps,
            min = _mm256_min_ps,
            div = _mm256_div_ps
        );
        #[inline(always)]
        fn sqrt(self) -> Self {
            Self(intrinsic!(_mm256_sqrt_ps(self.0)))
        }
        #[inline(always)]
        fn reciprocal(self) -> Self {
            let estimate = Self(intrinsic!(_mm256_rcp_ps(self.0)));
            estimate.mul(Self::splat(2.0).sub(self.mul(estimate)))
        }
        #[inline(always)]
        fn add_to_exponent(self, rounded: Self) -> Self {
            Self(intrinsic!(_mm256_castsi256_ps(_mm256_add_epi32(
                _mm256_castps_si256(self.0),
                _mm256_slli_epi32::<23>(_mm256_castps_si256(rounded.0))
            ))))
        }
        #[inline(always)]
        fn ge(self, other: Self) -> Self::Mask {
            intrinsic!(_mm256_cmp_ps::<_CMP_GE_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
            intrinsic!(_mm256_and_ps(a, b))
        }
        #[inline(always)]
        fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
            Self(intrinsic!(_mm256_blendv_ps(no.0, yes.0, mask)))
        }
    }
}
