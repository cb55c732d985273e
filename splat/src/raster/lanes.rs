//! Groups of pixels that LLVM turns into one vector register, and the choice of instruction set at run time.
//!
//! Kernels are written once, as loops over [`LANES`] pixels without branches. [`simd_kernel!`] compiles such a kernel
//! for AVX-512, for AVX2 + FMA and for the baseline, and picks the best that the machine has.

/// Pixels per group: one AVX-512 register, two AVX2 registers.
pub(super) const LANES: usize = 16;

/// `a * b + c`, fused where the kernel is compiled for a machine that has the instruction.
#[inline(always)]
pub(super) fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

/// `2^x` for `x ≤ 127`, relative error below 2.5e-7 for `x ≥ -126`; smaller and NaN arguments give `2^-126`.
///
/// Splits off the nearest integer by the addition of `1.5 · 2²³` and evaluates the Taylor polynomial of degree 6 on
/// `[-1/2, 1/2]`, whose remainder `(ln 2 / 2)^7 / 7!` is 1.2e-7 relative at the ends.
#[inline(always)]
pub(super) fn exp2<const FUSED: bool>(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    let x = if x > -126.0 { x } else { -126.0 };
    let rounded = x + ROUND;
    let fraction = x - (rounded - ROUND);
    let mut power = 1.540_353e-4;
    power = multiply_add::<FUSED>(power, fraction, 1.333_355_8e-3);
    power = multiply_add::<FUSED>(power, fraction, 9.618_129e-3);
    power = multiply_add::<FUSED>(power, fraction, 5.550_410_9e-2);
    power = multiply_add::<FUSED>(power, fraction, 2.402_265_1e-1);
    power = multiply_add::<FUSED>(power, fraction, 6.931_472e-1);
    power = multiply_add::<FUSED>(power, fraction, 1.0);
    f32::from_bits(power.to_bits().wrapping_add(rounded.to_bits() << 23))
}

/// Sum of a group in a fixed order.
#[inline(always)]
pub(super) fn sum(group: &[f32; LANES]) -> f32 {
    let mut eight = [0.0; 8];
    for lane in 0..8 {
        eight[lane] = group[lane] + group[lane + 8];
    }
    let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// The `LANES` values of `plane` from `first` on.
#[inline(always)]
pub(super) fn group<T>(plane: &[T], first: usize) -> &[T; LANES] {
    plane[first..].first_chunk().unwrap_or_else(|| unreachable!("planes are padded by a group"))
}

/// The `LANES` values of `plane` from `first` on, to change.
#[inline(always)]
pub(super) fn group_mut<T>(plane: &mut [T], first: usize) -> &mut [T; LANES] {
    plane[first..].first_chunk_mut().unwrap_or_else(|| unreachable!("planes are padded by a group"))
}

/// Defines `$name(arguments)` as the best of three compilations of the generic kernel `$kernel::<FUSED>`.
macro_rules! simd_kernel {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) = $kernel:ident) => {
        $(#[$meta])*
        $vis fn $name($($argument: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn avx512($($argument: $type),*) {
                    $kernel::<true>($($argument),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($argument: $type),*) {
                    $kernel::<true>($($argument),*);
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
            // NEON is part of the AArch64 baseline and its fused multiply-add is one instruction.
            $kernel::<{ cfg!(target_arch = "aarch64") }>($($argument),*);
        }
    };
}
pub(super) use simd_kernel;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_stays_within_its_bound_over_the_whole_range() {
        for step in 0..=1_260_000 {
            let x = -126.0 + step as f32 * 1e-4;
            let exact = f64::from(x).exp2();
            for value in [exp2::<true>(x), exp2::<false>(x)] {
                let relative = (f64::from(value) / exact - 1.0).abs();
                assert!(relative < 2.5e-7, "2^{x}: {relative:e}");
            }
        }
    }

    #[test]
    fn exp2_of_what_is_no_small_number_is_tiny() {
        for x in [f32::NAN, f32::NEG_INFINITY, -1e30, -127.0] {
            assert_eq!(exp2::<true>(x), f32::MIN_POSITIVE, "2^{x}");
        }
    }
}
