//! Sixteen single-precision or eight double-precision numbers at a time, and the choice of instruction set at run time.
//!
//! Kernels are written once, generic over [`Simd`]. [`simd_kernel!`] compiles such a kernel for AVX-512, for AVX2 + FMA
//! and for plain arrays, which the compiler turns into the baseline's instructions (SSE2, NEON). AVX-512 and AVX2 give
//! the same bytes; the baseline of x86 rounds after every multiplication where they round once after a fused
//! multiplication and addition.

mod doubles;
mod instructions;
mod plain;
mod shorts;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod x86;

pub(crate) use self::doubles::{Doubles, OCTET};
pub use self::instructions::{InstructionSet, Instructions, Unavailable};
pub(crate) use self::plain::Plain;
pub(crate) use self::shorts::{SHORTS, Shorts};
#[cfg(target_arch = "x86_64")]
pub(crate) use self::x86::{Avx2, Avx512};

/// Numbers per group: the pixels of a block, row by row.
pub(crate) const LANES: usize = 16;

/// Rows of a group, of as many lanes each.
pub(crate) const ROWS: usize = 4;

/// A group in memory, on one cache line.
#[derive(Clone, Debug, Default)]
#[repr(C, align(64))]
pub(crate) struct Group(pub [f32; LANES]);

/// A group of [`LANES`] single-precision numbers.
///
/// # Contract
/// No function is unsafe, as every one would be: the methods of an implementation may only run inside a function compiled with its instruction set, on a machine
/// that has it; [`simd_kernel!`] is the only place that chooses one.
pub(crate) trait Simd: Copy {
    /// One flag per lane.
    type Mask: Copy;
    /// Double precision with the same instructions.
    type Doubles: Doubles;
    /// 16-bit whole numbers with the same instructions.
    type Shorts: Shorts;
    fn splat(value: f32) -> Self;
    fn load(from: &[f32; LANES]) -> Self;
    fn store(self, to: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn sqrt(self) -> Self;
    fn floor(self) -> Self;
    fn ceil(self) -> Self;
    /// Whole numbers from -2³¹ to below 2³¹.
    fn store_integers(self, to: &mut [i32; LANES]);
    /// `self * factor + term`, rounded once where the instruction set can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// `term - self * factor`, rounded once where the instruction set can.
    fn negated_mul_add(self, factor: Self, term: Self) -> Self;
    /// The larger; `other` where `self` is NaN.
    fn max(self, other: Self) -> Self;
    /// The smaller; `other` where `self` is NaN.
    fn min(self, other: Self) -> Self;
    fn ge(self, other: Self) -> Self::Mask;
    fn lt(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    /// Bit `n` is the flag of lane `n`.
    fn bits(mask: Self::Mask) -> u16;
    /// `yes` where the flag is set, else `no`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Adds the low bits of `rounded` to the exponent of `self`.
    fn add_to_exponent(self, rounded: Self) -> Self;

    /// Row `r` of the result holds row `r` of each argument, a row being lanes 0 to 3, 4 to 7, 8 to 11 or 12 to 15.
    fn transpose(arguments: [Self; ROWS]) -> [Self; ROWS];
    /// Lane `l` of a row of result `r` is lane `r` of that row of argument `l`.
    fn transpose_rows(arguments: [Self; ROWS]) -> [Self; ROWS];
    /// In each row, the sum of that row of each argument, taken as `(0 + 2) + (1 + 3)`.
    fn row_sums(arguments: [Self; ROWS]) -> Self;

    /// Each argument half of the lanes.
    fn load_halves(halves: [&[f32; LANES / 2]; 2]) -> Self;
    fn store_halves(self, to: [&mut [f32; LANES / 2]; 2]);
    /// The upper half of `self`, then the lower half of `next`.
    fn straddle(self, next: Self) -> Self;

    /// Each argument a row.
    fn load_rows(rows: [&[f32; ROWS]; ROWS]) -> Self;
    /// Lane `COLUMN` of each row in all lanes of the row.
    fn spread_in_rows<const COLUMN: usize>(self) -> Self;

    /// Writes the numbers from `first` on of those `words` that have one of the bits of `mask`, ascending, and returns
    /// how many. The rest of `to` is overwritten with anything.
    fn positions(words: &[u32; LANES], mask: u32, first: u32, to: &mut [u32; LANES]) -> usize;

    /// Lane `l` of result `r` is lane `r` of argument `l`.
    #[inline(always)]
    fn transpose_lanes(arguments: [Self; LANES]) -> [Self; LANES] {
        let mut results = arguments;
        for four in results.as_chunks_mut::<ROWS>().0 {
            *four = Self::transpose_rows(*four);
        }
        let halfway = results;
        for at in 0..ROWS {
            let four = [halfway[at], halfway[at + 4], halfway[at + 8], halfway[at + 12]];
            let [a, b, c, d] = Self::transpose(four);
            (results[at], results[at + 4], results[at + 8], results[at + 12]) = (a, b, c, d);
        }
        results
    }

    /// `2^x` for `-126 ≤ x ≤ 127`, relative error below 2.5e-7; anything for other arguments.
    ///
    /// Splits off the nearest integer by the addition of `1.5 · 2²³` and evaluates the polynomial of degree 5 whose largest
    /// relative error on `[-1/2, 1/2]` is least, 0.8e-7 before rounding.
    #[inline(always)]
    fn exp2(self) -> Self {
        let round = Self::splat(12_582_912.0);
        let rounded = self.add(round);
        let fraction = self.sub(rounded.sub(round));
        let mut power = Self::splat(1.327_647_2e-3);
        power = power.mul_add(fraction, Self::splat(9.675_542e-3));
        power = power.mul_add(fraction, Self::splat(5.550_713e-2));
        power = power.mul_add(fraction, Self::splat(2.402_212e-1));
        power = power.mul_add(fraction, Self::splat(6.931_470_04e-1));
        power = power.mul_add(fraction, Self::splat(1.000_000_1));
        power.add_to_exponent(rounded)
    }
}

/// Asks for the memory of a value that will be read soon.
#[inline(always)]
pub(crate) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let address = std::ptr::from_ref(value).cast::<i8>();
        // Asking for one more line, in which a value may end that does not begin one, costs more than it gives.
        for line in 0..size_of::<T>().div_ceil(64) {
            // SAFETY: SSE is part of x86-64; a prefetch reads nothing, and the address lies within the value.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(address.add(64 * line)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// Defines `$name(instructions, arguments)` as the compilation of the generic kernel `$kernel::<impl Simd>` for an
/// instruction set. Constants that the function is generic over are passed on.
macro_rules! simd_kernel {
    (
        $(#[$meta:meta])* $vis:vis fn $name:ident $(<$(const $constant:ident: usize),+>)?
        ($($argument:ident: $type:ty),* $(,)?) = $kernel:ident
    ) => {
        $(#[$meta])*
        $vis fn $name$(<$(const $constant: usize),+>)?(
            instructions: $crate::simd::Instructions, $($argument: $type),*
        ) {
            #[cfg(target_arch = "x86_64")]
            {
                use $crate::simd::{Avx2, Avx512, InstructionSet};
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma,popcnt")]
                fn avx512$(<$(const $constant: usize),+>)?($($argument: $type),*) {
                    $kernel::<Avx512 $($(, $constant)+)?>($($argument),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2$(<$(const $constant: usize),+>)?($($argument: $type),*) {
                    $kernel::<Avx2 $($(, $constant)+)?>($($argument),*);
                }
                match instructions.set() {
                    // SAFETY: `Instructions` exist only for sets that the machine was seen to have.
                    InstructionSet::Avx512 => return unsafe { avx512$(::<$($constant),+>)?($($argument),*) },
                    // SAFETY: as above.
                    InstructionSet::Avx2 => return unsafe { avx2$(::<$($constant),+>)?($($argument),*) },
                    InstructionSet::Baseline => {}
                }
            }
            #[cfg(not(target_arch = "x86_64"))]
            let _ = instructions;
            $kernel::<$crate::simd::Plain $($(, $constant)+)?>($($argument),*);
        }
    };
}
pub(crate) use simd_kernel;
