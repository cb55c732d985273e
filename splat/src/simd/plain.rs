//! Plain arrays.

use super::{LANES, ROWS, Simd, doubles::PlainDoubles, shorts::PlainShorts};

/// Plain arrays, for machines without the instruction sets below and for reference.
#[derive(Clone, Copy)]
pub(crate) struct Plain([f32; LANES]);

impl Plain {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }
}

impl Simd for Plain {
    type Mask = [bool; LANES];
    type Doubles = PlainDoubles;
    type Shorts = PlainShorts;
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
    fn sqrt(self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane].sqrt()))
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane].floor()))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane].ceil()))
    }
    #[inline(always)]
    fn store_integers(self, to: &mut [i32; LANES]) {
        *to = std::array::from_fn(|lane| self.0[lane] as i32);
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| multiply_add(self.0[lane], factor.0[lane], term.0[lane])))
    }
    #[inline(always)]
    fn negated_mul_add(self, factor: Self, term: Self) -> Self {
        Self(std::array::from_fn(|lane| multiply_add(-self.0[lane], factor.0[lane], term.0[lane])))
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
    fn bits(mask: Self::Mask) -> u16 {
        (0..LANES).fold(0, |bits, lane| bits | u16::from(mask[lane]) << lane)
    }
    #[inline(always)]
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask[lane] { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    fn add_to_exponent(self, rounded: Self) -> Self {
        self.zip(rounded, |a, b| f32::from_bits(a.to_bits().wrapping_add(b.to_bits() << 23)))
    }

    #[inline(always)]
    fn transpose(arguments: [Self; ROWS]) -> [Self; ROWS] {
        std::array::from_fn(|row| {
            Self(std::array::from_fn(|lane| arguments[lane / ROWS].0[ROWS * row + lane % ROWS]))
        })
    }

    #[inline(always)]
    fn load_halves(halves: [&[f32; LANES / 2]; 2]) -> Self {
        Self(std::array::from_fn(|lane| halves[lane / (LANES / 2)][lane % (LANES / 2)]))
    }

    #[inline(always)]
    fn store_halves(self, [low, high]: [&mut [f32; LANES / 2]; 2]) {
        low.copy_from_slice(&self.0[..LANES / 2]);
        high.copy_from_slice(&self.0[LANES / 2..]);
    }

    #[inline(always)]
    fn straddle(self, next: Self) -> Self {
        let half = LANES / 2;
        Self(std::array::from_fn(|lane| if lane < half { self.0[lane + half] } else { next.0[lane - half] }))
    }

    #[inline(always)]
    fn load_rows(rows: [&[f32; ROWS]; ROWS]) -> Self {
        Self(std::array::from_fn(|lane| rows[lane / ROWS][lane % ROWS]))
    }

    #[inline(always)]
    fn spread_in_rows<const COLUMN: usize>(self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane - lane % ROWS + COLUMN]))
    }

    #[inline(always)]
    fn positions(words: &[u32; LANES], mask: u32, first: u32, to: &mut [u32; LANES]) -> usize {
        // Written whether it counts or not: which bits are set follows no pattern that a branch could learn.
        let mut count = 0;
        for (place, word) in words.iter().enumerate() {
            to[count % LANES] = first + place as u32;
            count += usize::from(word & mask != 0);
        }
        count
    }

    #[inline(always)]
    fn transpose_rows(arguments: [Self; ROWS]) -> [Self; ROWS] {
        std::array::from_fn(|result| {
            Self(std::array::from_fn(|lane| arguments[lane % ROWS].0[lane - lane % ROWS + result]))
        })
    }

    #[inline(always)]
    fn row_sums(arguments: [Self; ROWS]) -> Self {
        Self(std::array::from_fn(|lane| {
            let (row, of) = (ROWS * (lane / ROWS), arguments[lane % ROWS].0);
            (of[row] + of[row + 2]) + (of[row + 1] + of[row + 3])
        }))
    }
}

/// On AArch64 the fused instruction is part of the baseline; elsewhere it would be a library call.
#[inline(always)]
fn multiply_add(value: f32, factor: f32, term: f32) -> f32 {
    if cfg!(target_arch = "aarch64") { value.mul_add(factor, term) } else { value * factor + term }
}
