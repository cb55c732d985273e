//! Sixteen 16-bit whole numbers at a time, exact on every instruction set.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Numbers per group.
pub(crate) const SHORTS: usize = 16;

/// A group of [`SHORTS`] whole numbers from 0 to 65 535.
///
/// # Contract
/// That of [`Simd`](super::Simd), which names the implementation for each instruction set.
pub(crate) trait Shorts: Copy {
    fn splat(value: u16) -> Self;
    fn load(from: &[u16; SHORTS]) -> Self;
    fn store(self, to: &mut [u16; SHORTS]);
    /// The sum, or 65 535 where that is less.
    fn add(self, other: Self) -> Self;
    /// The difference, which must not be negative.
    fn sub(self, other: Self) -> Self;
    /// The squared difference over 32 768, rounded to the nearest, halves up; both must be below 32 768.
    fn squared_difference(self, other: Self) -> Self;
    fn min(self, other: Self) -> Self;
    /// Bit `n` says whether lane `n` is below that of the other group.
    fn below(self, other: Self) -> u16;
}

/// Plain arrays.
#[derive(Clone, Copy)]
pub(crate) struct PlainShorts([u16; SHORTS]);

impl Shorts for PlainShorts {
    #[inline(always)]
    fn load(from: &[u16; SHORTS]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    fn store(self, to: &mut [u16; SHORTS]) {
        *to = self.0;
    }
    #[inline(always)]
    fn add(mut self, other: Self) -> Self {
        for lane in 0..SHORTS {
            self.0[lane] = self.0[lane].saturating_add(other.0[lane]);
        }
        self
    }
    #[inline(always)]
    fn sub(mut self, other: Self) -> Self {
        for lane in 0..SHORTS {
            self.0[lane] -= other.0[lane];
        }
        self
    }
    #[inline(always)]
    fn squared_difference(mut self, other: Self) -> Self {
        for lane in 0..SHORTS {
            let difference = i32::from(self.0[lane]) - i32::from(other.0[lane]);
            self.0[lane] = ((difference * difference + (1 << 14)) >> 15) as u16;
        }
        self
    }
    #[inline(always)]
    fn min(mut self, other: Self) -> Self {
        for lane in 0..SHORTS {
            self.0[lane] = self.0[lane].min(other.0[lane]);
        }
        self
    }
    #[inline(always)]
    fn splat(value: u16) -> Self {
        Self([value; SHORTS])
    }
    #[inline(always)]
    fn below(self, other: Self) -> u16 {
        let mut bits = 0;
        for lane in 0..SHORTS {
            bits |= u16::from(self.0[lane] < other.0[lane]) << lane;
        }
        bits
    }
}

/// Wraps intrinsics whose only demand is the instruction set.
#[cfg(target_arch = "x86_64")]
macro_rules! intrinsic {
    ($call:expr) => {
        // SAFETY: by the contract of `Simd` this runs on a machine with the instruction set; memory operands are
        // unaligned accesses to whole arrays of numbers.
        unsafe { $call }
    };
}

/// One 256-bit register.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(crate) struct Avx2Shorts(__m256i);

#[cfg(target_arch = "x86_64")]
impl Shorts for Avx2Shorts {
    #[inline(always)]
    fn splat(value: u16) -> Self {
        Self(intrinsic!(_mm256_set1_epi16(value.cast_signed())))
    }
    #[inline(always)]
    fn load(from: &[u16; SHORTS]) -> Self {
        Self(intrinsic!(_mm256_loadu_si256(from.as_ptr().cast())))
    }
    #[inline(always)]
    fn store(self, to: &mut [u16; SHORTS]) {
        intrinsic!(_mm256_storeu_si256(to.as_mut_ptr().cast(), self.0));
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(intrinsic!(_mm256_adds_epu16(self.0, other.0)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(intrinsic!(_mm256_sub_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(intrinsic!(_mm256_min_epu16(self.0, other.0)))
    }
    #[inline(always)]
    fn squared_difference(self, other: Self) -> Self {
        let difference = intrinsic!(_mm256_sub_epi16(self.0, other.0));
        Self(intrinsic!(_mm256_mulhrs_epi16(difference, difference)))
    }
    #[inline(always)]
    fn below(self, other: Self) -> u16 {
        // Comparisons are signed, maxima are not.
        intrinsic!({
            let reaches = _mm256_cmpeq_epi16(_mm256_max_epu16(self.0, other.0), self.0);
            let bytes =
                _mm_packs_epi16(_mm256_castsi256_si128(reaches), _mm256_extracti128_si256::<1>(reaches));
            !(_mm_movemask_epi8(bytes) as u16)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Instructions, Simd, simd_kernel};

    type Results = [[u16; SHORTS]; 5];

    simd_kernel! {
        /// The last operation takes halves of the numbers.
        fn operate(a: &[u16; SHORTS], b: &[u16; SHORTS], halves: &[[u16; SHORTS]; 2], results: &mut Results)
            = operate_kernel
    }

    #[inline(always)]
    fn operate_kernel<S: Simd>(
        a: &[u16; SHORTS],
        b: &[u16; SHORTS],
        halves: &[[u16; SHORTS]; 2],
        results: &mut Results,
    ) {
        let (x, y) = (S::Shorts::load(a), S::Shorts::load(b));
        x.add(y).store(&mut results[0]);
        x.sub(x.min(y)).store(&mut results[1]);
        x.min(y).store(&mut results[2]);
        S::Shorts::splat(x.below(y)).store(&mut results[3]);
        let (x, y) = (S::Shorts::load(&halves[0]), S::Shorts::load(&halves[1]));
        x.squared_difference(y).store(&mut results[4]);
    }

    #[test]
    fn every_instruction_set_computes_exactly() {
        for n in 0..100u32 {
            let mut a: [u16; SHORTS] = std::array::from_fn(|lane| (n * 5003 + lane as u32 * 13_701) as u16);
            let mut b: [u16; SHORTS] = std::array::from_fn(|lane| (n * 2003 + lane as u32 * 7919) as u16);
            // The largest square, equals, and the last square that vanishes beside the first that does not.
            (a[0], b[0]) = (0, u16::MAX);
            b[1] = a[1];
            (a[2], b[2], a[3], b[3]) = (254, 0, 256, 0);
            let below = (0..SHORTS).map(|lane| u16::from(a[lane] < b[lane]) << lane).sum();
            let each = |of: fn(u16, u16) -> u16| std::array::from_fn(|lane| of(a[lane], b[lane]));
            let rounded_square = |a: u16, b: u16| {
                (f64::from(i32::from(a / 2) - i32::from(b / 2)).powi(2) / 32_768.0).round() as u16
            };
            let expected: Results = [
                each(u16::saturating_add),
                each(u16::saturating_sub),
                each(u16::min),
                [below; SHORTS],
                each(rounded_square),
            ];
            assert_eq!(expected[4][..4], [32_766, 0, 0, 1]);
            for instructions in Instructions::available() {
                let mut results = [[0; SHORTS]; 5];
                operate(instructions, &a, &b, &[a.map(|v| v / 2), b.map(|v| v / 2)], &mut results);
                assert_eq!(results, expected, "{}", instructions.set());
            }
        }
    }
}
