//! Sixteen pixels at a time, and the choice of instruction set at run time.
//!
//! Kernels are written once, generic over [`Simd`]. [`simd_kernel!`] compiles such a kernel for AVX-512, for AVX2 + FMA
//! and for plain arrays, and picks the best that the machine has. AVX-512 and AVX2 give the same bytes.

/// Pixels per group.
pub(super) const LANES: usize = 16;

const RAMP: [f32; LANES] = [0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.];

/// A group of [`LANES`] single-precision numbers.
///
/// # Safety
/// The methods of an implementation may only run inside a function compiled with its instruction set, on a machine
/// that has it; [`simd_kernel!`] is the only place that chooses one.
pub(super) trait Simd: Copy {
    /// One flag per lane.
    type Mask: Copy;
    fn splat(value: f32) -> Self;
    fn load(from: &[f32; LANES]) -> Self;
    fn store(self, to: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// `self * factor + term`, rounded once where the instruction set can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// The larger; `other` where `self` is NaN.
    fn max(self, other: Self) -> Self;
    /// The smaller; `other` where `self` is NaN.
    fn min(self, other: Self) -> Self;
    fn ge(self, other: Self) -> Self::Mask;
    fn lt(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    /// `yes` where the flag is set, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Adds the low bits of `rounded` to the exponent of `self`.
    fn add_to_exponent(self, rounded: Self) -> Self;

    /// 0, 1, 2, …
    #[inline(always)]
    fn ramp() -> Self {
        Self::load(&RAMP)
    }

    /// Sum in a fixed order.
    #[inline(always)]
    fn sum(self) -> f32 {
        let mut lanes = [0.0; LANES];
        self.store(&mut lanes);
        let eight: [f32; 8] = std::array::from_fn(|lane| lanes[lane] + lanes[lane + 8]);
        let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
        (four[0] + four[2]) + (four[1] + four[3])
    }

    /// `2^x` for `x ≤ 127`, relative error below 2.5e-7 for `x ≥ -126`; smaller and NaN arguments give `2^-126`.
    ///
    /// Splits off the nearest integer by the addition of `1.5 · 2²³` and evaluates the Taylor polynomial of degree 6 on
    /// `[-1/2, 1/2]`, whose remainder `(ln 2 / 2)^7 / 7!` is 1.2e-7 relative at the ends.
    #[inline(always)]
    fn exp2(self) -> Self {
        let round = Self::splat(12_582_912.0);
        let x = self.max(Self::splat(-126.0));
        let rounded = x.add(round);
        let fraction = x.sub(rounded.sub(round));
        let mut power = Self::splat(1.540_353e-4);
        power = power.mul_add(fraction, Self::splat(1.333_355_8e-3));
        power = power.mul_add(fraction, Self::splat(9.618_129e-3));
        power = power.mul_add(fraction, Self::splat(5.550_410_9e-2));
        power = power.mul_add(fraction, Self::splat(2.402_265_1e-1));
        power = power.mul_add(fraction, Self::splat(6.931_472e-1));
        power = power.mul_add(fraction, Self::splat(1.0));
        power.add_to_exponent(rounded)
    }
}

/// Plain arrays, for machines without the instruction sets below and for reference.
#[derive(Clone, Copy)]
pub(super) struct Plain([f32; LANES]);

impl Plain {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }
}

impl Simd for Plain {
    type Mask = [bool; LANES];
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; LANES])
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        *to = self.0;
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
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| {
            // On AArch64 the fused instruction is part of the baseline; elsewhere it would be a library call.
            if cfg!(target_arch = "aarch64") {
                self.0[lane].mul_add(factor.0[lane], term.0[lane])
            } else {
                self.0[lane] * factor.0[lane] + term.0[lane]
            }
        }))
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
        std::array::from_fn(|lane| self.0[lane] >= other.0[lane])
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Self::Mask {
        std::array::from_fn(|lane| self.0[lane] < other.0[lane])
    }
    #[inline(always)]
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
        std::array::from_fn(|lane| a[lane] & b[lane])
    }
    #[inline(always)]
    fn any(mask: Self::Mask) -> bool {
        mask.contains(&true)
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| f32::from_bits(a.to_bits().wrapping_add(b.to_bits() << 23)))
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{LANES, Simd};

    /// One 512-bit register.
    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx512(__m512);

    /// Two 256-bit registers.
    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx2(__m256, __m256);

    /// Wraps intrinsics whose only demand is the instruction set.
    macro_rules! intrinsic {
        ($call:expr) => {
            // SAFETY: by the contract of `Simd` this runs on a machine with the instruction set; memory operands are
            // unaligned accesses to whole arrays of LANES floats.
            unsafe { $call }
        };
    }

    impl Simd for Avx512 {
        type Mask = __mmask16;
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
        fn div(self, other: Self) -> Self {
            Self(intrinsic!(_mm512_div_ps(self.0, other.0)))
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
        fn any(mask: Self::Mask) -> bool {
            mask != 0
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
        fn zip(self, other: Self, operation: impl Fn(__m256, __m256) -> __m256) -> Self {
            Self(operation(self.0, other.0), operation(self.1, other.1))
        }
    }

    impl Simd for Avx2 {
        type Mask = (__m256, __m256);
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
        fn div(self, other: Self) -> Self {
            self.zip(other, |a, b| intrinsic!(_mm256_div_ps(a, b)))
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
}

/// The `LANES` values of `plane` from `first` on.
#[inline(always)]
pub(super) fn group(plane: &[f32], first: usize) -> &[f32; LANES] {
    plane[first..].first_chunk().unwrap_or_else(|| unreachable!("planes are padded by a group"))
}

/// The `LANES` values of `plane` from `first` on, to change.
#[inline(always)]
pub(super) fn group_mut(plane: &mut [f32], first: usize) -> &mut [f32; LANES] {
    plane[first..].first_chunk_mut().unwrap_or_else(|| unreachable!("planes are padded by a group"))
}

/// Defines `$name(arguments)` as the best compilation of the generic kernel `$kernel::<impl Simd>`.
macro_rules! simd_kernel {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) = $kernel:ident) => {
        $(#[$meta])*
        $vis fn $name($($argument: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn avx512($($argument: $type),*) {
                    $kernel::<$crate::raster::lanes::Avx512>($($argument),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($argument: $type),*) {
                    $kernel::<$crate::raster::lanes::Avx2>($($argument),*);
                }
                if is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("fma")
                {
                    // SAFETY: the features that the function is compiled for were just detected.
                    return unsafe { avx512($($argument),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features that the function is compiled for were just detected.
                    return unsafe { avx2($($argument),*) };
                }
            }
            $kernel::<$crate::raster::lanes::Plain>($($argument),*);
        }
    };
}
pub(super) use simd_kernel;

#[cfg(test)]
mod tests {
    use super::*;

    fn power(x: f32) -> f32 {
        let mut lanes = [0.0; LANES];
        Plain::splat(x).exp2().store(&mut lanes);
        lanes[7]
    }

    #[test]
    fn exp2_stays_within_its_bound_over_the_whole_range() {
        for step in 0..=1_260_000 {
            let x = -126.0 + step as f32 * 1e-4;
            let relative = (f64::from(power(x)) / f64::from(x).exp2() - 1.0).abs();
            assert!(relative < 2.5e-7, "2^{x}: {relative:e}");
        }
    }

    #[test]
    fn exp2_of_what_is_no_small_number_is_tiny() {
        for x in [f32::NAN, f32::NEG_INFINITY, -1e30, -127.0] {
            assert_eq!(power(x), f32::MIN_POSITIVE, "2^{x}");
        }
    }

    /// Runs every operation of an instruction set on the same numbers as [`Plain`].
    #[inline(always)]
    fn same_as_plain<S: Simd>() {
        let a: [f32; LANES] = std::array::from_fn(|lane| (lane as f32 - 7.3) * 1.7);
        let b: [f32; LANES] = std::array::from_fn(|lane| 3.1 - lane as f32 * 0.37);
        let run = |operation: &str, fast: S, plain: Plain| {
            let (mut x, mut y) = ([0.0; LANES], [0.0; LANES]);
            fast.store(&mut x);
            plain.store(&mut y);
            for lane in 0..LANES {
                // A fused multiply-add rounds once instead of twice; exp2 is a chain of six of them.
                let bound = 1e-5 * y[lane].abs().max(1e-6);
                assert!(
                    (x[lane] - y[lane]).abs() <= bound,
                    "{operation} lane {lane}: {} {}",
                    x[lane],
                    y[lane]
                );
            }
        };
        let (s, t, p, q) = (S::load(&a), S::load(&b), Plain::load(&a), Plain::load(&b));
        run("add", s.add(t), p.add(q));
        run("sub", s.sub(t), p.sub(q));
        run("mul", s.mul(t), p.mul(q));
        run("div", s.div(t), p.div(q));
        run("mul_add", s.mul_add(t, s), p.mul_add(q, p));
        run("max", s.max(t), p.max(q));
        run("min", s.min(t), p.min(q));
        run("exp2", s.exp2(), p.exp2());
        run("ge", S::select(s.ge(t), s, t), Plain::select(p.ge(q), p, q));
        run("lt", S::select(s.lt(t), s, t), Plain::select(p.lt(q), p, q));
        run(
            "both",
            S::select(S::both(s.ge(t), s.lt(S::splat(9.0))), s, t),
            Plain::select(Plain::both(p.ge(q), p.lt(Plain::splat(9.0))), p, q),
        );
        assert_eq!(S::any(s.ge(S::splat(100.0))), Plain::any(p.ge(Plain::splat(100.0))), "none");
        assert_eq!(S::any(s.ge(S::splat(12.0))), Plain::any(p.ge(Plain::splat(12.0))), "one lane");
        assert_eq!(s.sum(), p.sum(), "the order of the sum is part of the contract");
    }

    simd_kernel! { fn best() = same_as_plain }

    #[test]
    fn every_instruction_set_of_this_machine_agrees_with_plain_arrays() {
        best();
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            #[target_feature(enable = "avx2,fma")]
            fn avx2() {
                same_as_plain::<Avx2>();
            }
            // SAFETY: the features were just detected.
            unsafe { avx2() };
        }
    }
}
