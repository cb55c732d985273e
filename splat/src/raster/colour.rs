//! Colours of sixteen Gaussians as seen from a camera centre: `max(0, SH(direction) + 0.5)`.

use super::harmonics::{MOST, basis, direction_gradient};
use crate::{
    gaussians::{part::Part, sh},
    simd::{LANES, Simd, prefetch},
};

/// Gaussians whose coefficients are asked for ahead.
const AHEAD: usize = LANES;

/// A value per channel or axis, and lane.
pub(super) type Triple = [[f32; LANES]; 3];

#[inline(always)]
fn load<S: Simd>([a, b, c]: &Triple) -> [S; 3] {
    [S::load(a), S::load(b), S::load(c)]
}

#[inline(always)]
fn store<S: Simd>([a, b, c]: [S; 3]) -> Triple {
    let mut triple = [[0.0; LANES]; 3];
    a.store(&mut triple[0]);
    b.store(&mut triple[1]);
    c.store(&mut triple[2]);
    triple
}

/// The coefficients of sixteen Gaussians up to a degree.
pub(super) struct Coefficients<S> {
    degree: u32,
    values: [[S; 3]; MOST],
}

impl<S: Simd> Coefficients<S> {
    /// Of the Gaussians from `first` on, up to `degree`, which is not above their own; the last of the part stands in for
    /// those beyond.
    #[inline(always)]
    pub(super) fn load(part: &Part<'_>, first: usize, degree: u32) -> Self {
        let stride = part.sh_stride();
        let used = 3 * sh::coefficients(degree);
        let mut values = [[S::splat(0.0); 3]; MOST];
        let blocks = values.as_flattened_mut().as_chunks_mut::<LANES>().0;
        for (number, block) in blocks.iter_mut().enumerate().take(used.div_ceil(LANES)) {
            for (lane, row) in block.iter_mut().enumerate() {
                let start = (first + lane).min(part.len() - 1) * stride;
                let rest = &part.sh[start + number * LANES..start + used];
                // Sixteen rows side by side are no pattern that a processor foresees.
                if let Some(later) = part.sh.get(start + number * LANES + AHEAD * stride) {
                    prefetch(later);
                }
                *row = match rest.first_chunk() {
                    Some(whole) => S::load(whole),
                    None => {
                        let mut short = [0.0; LANES];
                        short[..rest.len()].copy_from_slice(rest);
                        S::load(&short)
                    }
                };
            }
            *block = S::transpose_lanes(*block);
        }
        Self { degree, values }
    }

    /// Those of use.
    #[inline(always)]
    fn used(&self) -> &[[S; 3]] {
        &self.values[..sh::coefficients(self.degree)]
    }

    /// Before the clamp at 0.
    #[inline(always)]
    fn unclamped(&self, basis: &[S; MOST]) -> [S; 3] {
        let mut colour = [S::splat(0.5); 3];
        for (coefficients, basis) in self.used().iter().zip(basis) {
            for channel in 0..3 {
                colour[channel] = basis.mul_add(coefficients[channel], colour[channel]);
            }
        }
        colour
    }

    /// Colours seen along `directions` from the camera, and which of them are numbers.
    #[inline(always)]
    pub(super) fn seen_along(&self, directions: &Triple) -> (Triple, u16) {
        let (zero, infinity) = (S::splat(0.0), S::splat(f32::INFINITY));
        let [red, green, blue] = self.unclamped(&basis(load(directions), self.degree));
        // The second operand is the result where it is NaN.
        let colour = [zero.max(red), zero.max(green), zero.max(blue)];
        let [red, green, blue] = colour;
        let are_finite = S::both(S::both(red.lt(infinity), green.lt(infinity)), blue.lt(infinity));
        (store(colour), S::bits(are_finite))
    }

    /// The gradient by the coefficients, as a product that is yet to be taken, and that by the directions.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        directions: &Triple,
        colour_gradient: &Triple,
    ) -> (CoefficientGradient<S>, Triple) {
        let zero = S::splat(0.0);
        let directions = load(directions);
        let basis = basis(directions, self.degree);
        let colour = self.unclamped(&basis);
        let mut passed = load::<S>(colour_gradient);
        for channel in 0..3 {
            passed[channel] = S::select(colour[channel].ge(zero), passed[channel], zero);
        }
        let [red, green, blue] = passed;
        let mut by_basis = [zero; MOST];
        for (sum, [r, g, b]) in by_basis.iter_mut().zip(self.used()) {
            *sum = red.mul_add(*r, green.mul_add(*g, blue.mul(*b)));
        }
        let along = direction_gradient(directions, self.degree, &by_basis);
        (CoefficientGradient { degree: self.degree, basis, passed }, store(along))
    }
}

/// Gradients of sixteen Gaussians by their coefficients: the outer product of basis and colour gradient.
pub(super) struct CoefficientGradient<S> {
    degree: u32,
    basis: [S; MOST],
    passed: [S; 3],
}

impl<S: Simd> CoefficientGradient<S> {
    /// Writes up to sixteen rows of `stride` values, zero beyond the degree; rows are zero where bits of `kept` are.
    #[inline(always)]
    pub(super) fn store(&self, rows: &mut [f32], stride: usize, kept: u16) {
        let count = sh::coefficients(self.degree);
        let used = 3 * count;
        let mut values = [[S::splat(0.0); 3]; MOST];
        for (values, basis) in values.iter_mut().zip(&self.basis).take(count) {
            for channel in 0..3 {
                values[channel] = basis.mul(self.passed[channel]);
            }
        }
        let blocks = values.as_flattened().as_chunks::<LANES>().0;
        for (number, block) in blocks.iter().enumerate().take(used.div_ceil(LANES)) {
            let block = S::transpose_lanes(*block);
            for (row, values) in rows.chunks_exact_mut(stride).zip(block) {
                let rest = &mut row[number * LANES..used];
                match rest.first_chunk_mut() {
                    Some(whole) => values.store(whole),
                    None => {
                        let mut short = [0.0; LANES];
                        values.store(&mut short);
                        let length = rest.len();
                        rest.copy_from_slice(&short[..length]);
                    }
                }
            }
        }
        for (lane, row) in rows.chunks_exact_mut(stride).enumerate() {
            let is_kept = kept >> lane & 1 != 0;
            row[if is_kept { used } else { 0 }..].fill(0.0);
        }
    }
}
