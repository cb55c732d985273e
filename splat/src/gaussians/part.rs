//! Consecutive Gaussians of a set: what a parallel task works on.

use std::ops::Range;

use rayon::prelude::*;

use super::{Gaussians, gradients::GaussianGradients};

/// Arrays of consecutive Gaussians, of the shapes of [`Gaussians`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Part<'a> {
    pub means: &'a [[f32; 3]],
    pub rotations: &'a [[f32; 4]],
    pub log_scales: &'a [[f32; 3]],
    pub logit_opacities: &'a [f32],
    pub sh: &'a [f32],
}

/// [`Part`] to write to.
#[derive(Debug)]
pub(crate) struct PartMut<'a> {
    pub means: &'a mut [[f32; 3]],
    pub rotations: &'a mut [[f32; 4]],
    pub log_scales: &'a mut [[f32; 3]],
    pub logit_opacities: &'a mut [f32],
    pub sh: &'a mut [f32],
}

impl<'a> Part<'a> {
    /// Number of Gaussians.
    #[inline(always)]
    pub(crate) fn len(&self) -> usize {
        self.means.len()
    }

    /// Spherical-harmonic coefficients of one Gaussian, all channels.
    #[inline(always)]
    pub(crate) fn sh_stride(&self) -> usize {
        self.sh.len() / self.len().max(1)
    }

    /// The Gaussians of `range`.
    #[inline(always)]
    pub(crate) fn slice(self, range: Range<usize>) -> Part<'a> {
        let stride = self.sh_stride();
        Part {
            means: &self.means[range.clone()],
            rotations: &self.rotations[range.clone()],
            log_scales: &self.log_scales[range.clone()],
            logit_opacities: &self.logit_opacities[range.clone()],
            sh: &self.sh[range.start * stride..range.end * stride],
        }
    }
}

impl PartMut<'_> {
    /// The same to read from.
    #[inline(always)]
    pub(crate) fn as_part(&self) -> Part<'_> {
        Part {
            means: self.means,
            rotations: self.rotations,
            log_scales: self.log_scales,
            logit_opacities: self.logit_opacities,
            sh: self.sh,
        }
    }

    /// The Gaussians of `range`.
    #[inline(always)]
    pub(crate) fn slice(&mut self, range: Range<usize>) -> PartMut<'_> {
        let stride = self.as_part().sh_stride();
        PartMut {
            means: &mut self.means[range.clone()],
            rotations: &mut self.rotations[range.clone()],
            log_scales: &mut self.log_scales[range.clone()],
            logit_opacities: &mut self.logit_opacities[range.clone()],
            sh: &mut self.sh[range.start * stride..range.end * stride],
        }
    }
}

/// The arrays of a set as one part, and in parts of `size` Gaussians for parallel tasks.
macro_rules! parts {
    ($set:ty) => {
        impl $set {
            pub(crate) fn part(&self) -> Part<'_> {
                Part {
                    means: &self.means,
                    rotations: &self.rotations,
                    log_scales: &self.log_scales,
                    logit_opacities: &self.logit_opacities,
                    sh: &self.sh,
                }
            }

            pub(crate) fn parts_mut(
                &mut self,
                size: usize,
            ) -> impl IndexedParallelIterator<Item = PartMut<'_>> {
                let stride = self.part().sh_stride().max(1);
                let arrays = (
                    self.means.par_chunks_mut(size),
                    self.rotations.par_chunks_mut(size),
                    self.log_scales.par_chunks_mut(size),
                    self.logit_opacities.par_chunks_mut(size),
                    self.sh.par_chunks_mut(size * stride),
                );
                arrays.into_par_iter().map(|(means, rotations, log_scales, logit_opacities, sh)| PartMut {
                    means,
                    rotations,
                    log_scales,
                    logit_opacities,
                    sh,
                })
            }
        }
    };
}

parts!(Gaussians);
parts!(GaussianGradients);
