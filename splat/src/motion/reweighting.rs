//! Robust weights of a footprint's pixels, from the moments of the pass before.
//!
//! A footprint that straddles two surfaces has tracks of both, and its first fit lies between them. Each further pass
//! weighs a pixel by `exp(-|e|² / s²)` (Welsch's redescending weight), where `e` is its departure from the footprint's mean
//! displacement and `s` shrinks with the power of `e`: the mean slides to the surface that has most of the weight. The
//! expected motion is a translation even where the final fit is affine, as an affine map explains a step between two
//! surfaces too well to let go of either.

use rayon::prelude::*;

use super::moments::{Displacements, FootprintMoments};

/// Residual power of the affine fit over that of the track noise from which a footprint is fitted again: half as much
/// again, plus three standard deviations of what a sample of the noise has.
const TRIGGER: f64 = 1.5;
const TRIGGER_DEVIATIONS: f64 = 3.0;
/// `s²` over the residual power; three passes at this rate settle 45 % of outliers on one side.
const SCALE_SQUARED: f64 = 0.64;
/// Least `s` in standard deviations of the tracks: noise alone is no outlier.
const LEAST_SIGNIFICANCE: f64 = 3.0;
/// A pass that leaves less of the weight than this has lost the footprint.
const LEAST_SHARE: f64 = 1e-3;

/// How often footprints are fitted again, and what counts as noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reweighting {
    /// Passes over the pixels after the first.
    pub passes: u32,
    /// Area over which track errors are alike, px², at least 1.
    pub noise_correlation_area: f64,
    /// Standard deviation, px, of what the tracks' own variances do not cover.
    pub noise_floor: f64,
}

/// The motion that a footprint's pixels are held against: a translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExpectedMotion {
    /// Pixels.
    pub displacement: [f64; 2],
    /// `1 / s²`, 1 / px²: a pixel's weight falls by `exp(-|residual|² / s²)`.
    pub inverse_scale_squared: f64,
}

impl Reweighting {
    /// The motion that the next pass expects of a footprint; `None` where its moments stand, as an affine map explains
    /// its tracks to their own noise.
    pub fn expected(&self, moments: &FootprintMoments) -> Option<ExpectedMotion> {
        let displacements = Displacements::of(moments)?;
        let noise = 2.0 * (displacements.track_variance + self.noise_floor.powi(2));
        let independent = displacements.independent_pixels(self.noise_correlation_area);
        let limit = TRIGGER * (1.0 + TRIGGER_DEVIATIONS / independent.sqrt());
        let is_explained = displacements.affine_residual_power() <= limit * noise;
        let scale_squared = (SCALE_SQUARED * displacements.power).max(LEAST_SIGNIFICANCE.powi(2) * noise);
        let is_usable = scale_squared.is_normal() && scale_squared.recip().is_finite();
        (!is_explained && is_usable).then(|| ExpectedMotion {
            displacement: displacements.mean.to_array(),
            inverse_scale_squared: scale_squared.recip(),
        })
    }

    /// The passes after the first, on one view's `moments`. `measure` sums the footprints of the given Gaussians again, in their
    /// order, each pixel's weight times the share that its residual leaves.
    pub fn apply<E>(
        &self,
        moments: &mut [FootprintMoments],
        mut measure: impl FnMut(&[(u32, ExpectedMotion)]) -> Result<Vec<FootprintMoments>, E>,
    ) -> Result<(), E> {
        let mut wanted: Vec<u32> = (0..moments.len() as u32).collect();
        for _ in 0..self.passes {
            let expect = |index: u32| Some((index, self.expected(&moments[index as usize])?));
            let expected: Vec<(u32, ExpectedMotion)> = wanted.into_par_iter().filter_map(expect).collect();
            if expected.is_empty() {
                break;
            }
            let reweighted = measure(&expected)?;
            // What stands once, stands.
            wanted = expected.into_iter().map(|(index, _)| index).collect();
            for (&index, reweighted) in wanted.iter().zip(reweighted) {
                moments[index as usize].reweigh(reweighted);
            }
        }
        Ok(())
    }
}

impl FootprintMoments {
    /// Takes the moments of a reweighting pass; what counts pixels or all of the blending weight stays, and everything
    /// does where hardly any weight is left.
    pub fn reweigh(&mut self, reweighted: Self) {
        if reweighted.weight > LEAST_SHARE * self.weight && reweighted.weight_squared > 0.0 {
            let residual = |first: Displacements| 0.5 * first.affine_residual_power();
            let contest = match self.contest {
                0.0 => Displacements::of(self).map_or(0.0, residual),
                first => first,
            };
            let Self { blend_weight, visible, pixels, .. } = *self;
            *self = Self { blend_weight, visible, pixels, contest, ..reweighted };
        }
    }
}
