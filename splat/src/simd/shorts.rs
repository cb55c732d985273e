//! Sixteen 16-bit whole numbers at a time, exact on every instruction set.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Numbers per group.
pub(crate) const SHORTS: usize = 16;

/// A group of [`SHORTS`] whole numbers from 0 to 32 767.
///
/// # Contract
/// That of [`Simd`](super::Simd), which names the implementation for each instruction set.
pub(crate) trait Shorts: Copy {
    fn splat(value: u16) -> Self;
    fn load(from: &[u16; SHORTS]) -> Self;
    fn store(self, to: &mut [u16; SHORTS]);
    /// The sum, which must be below 32 768.
    fn add(self, other: Self) -> Self;
    /// The difference, which must not be negative.
    fn sub(self, other: Self) -> Self;
    /// The squared difference over 65 536, rounded down.
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
            self.0[lane] += other.0[lane];
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
            self.0[lane] = ((difference * difference) >> u16::BITS) as u16;
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
        Self(intrinsic!(_mm256_add_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(intrinsic!(_mm256_sub_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(intrinsic!(_mm256_min_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn squared_difference(self, other: Self) -> Self {
        let difference = intrinsic!(_mm256_sub_epi16(self.0, other.0));
        Self(intrinsic!(_mm256_mulhi_epi16(difference, difference)))
    }
    #[inline(always)]
    fn below(self, other: Self) -> u16 {
        intrinsic!({
            let below = _mm256_cmpgt_epi16(other.0, self.0);
            let bytes = _mm_packs_epi16(_mm256_castsi256_si128(below), _mm256_extracti128_si256::<1>(below));
            _mm_movemask_epi8(bytes) as u16
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Instructions, Simd, simd_kernel};

    type Results = [[u16; SHORTS]; 5];

    simd_kernel! { fn operate(a: &[u16; SHORTS], b: &[u16; SHORTS], results: &mut Results) = operate_kernel }

    #[inline(always)]
    fn operate_kernel<S: Simd>(a: &[u16; SHORTS], b: &[u16; SHORTS], results: &mut Results) {
        let (x, y) = (S::Shorts::load(a), S::Shorts::load(b));
        x.add(y).store(&mut results[0]);
        x.add(y).sub(y).store(&mut results[1]);
        x.min(y).store(&mut results[2]);
        x.squared_difference(y).store(&mut results[3]);
        S::Shorts::splat(x.below(y)).store(&mut results[4]);
    }

    #[test]
    fn every_instruction_set_computes_exactly() {
        for n in 0..100u32 {
            // Sums below 32 768, differences of either sign.
            let a: [u16; SHORTS] =
                std::array::from_fn(|lane| (n * 5003 + lane as u32 * 3701) as u16 % 20_000);
            let b: [u16; SHORTS] =
                std::array::from_fn(|lane| (n * 2003 + lane as u32 * 7919) as u16 % 12_700);
            let below = (0..SHORTS).map(|lane| u16::from(a[lane] < b[lane]) << lane).sum();
            let each = |of: fn(u16, u16) -> u16| std::array::from_fn(|lane| of(a[lane], b[lane]));
            let square = |a: u16, b: u16| (u32::from(a.abs_diff(b)).pow(2) >> 16) as u16;
            let expected: Results = [each(|a, b| a + b), a, each(u16::min), each(square), [below; SHORTS]];
            for instructions in Instructions::available() {
                let mut results = [[0; SHORTS]; 5];
                operate(instructions, &a, &b, &mut results);
                assert_eq!(results, expected, "{}", instructions.set());
            }
        }
    }
}
