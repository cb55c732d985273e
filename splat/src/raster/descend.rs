//! Stages 5 and 6 of a step in one: each group's gradients go from a small buffer straight into Adam, so that those of all
//! Gaussians are neither written to memory nor kept.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    local::Lens,
    project_backward::{Backward, GRANULE, SUMS, group_backward},
};
use crate::{
    engine::DensityStatistics,
    gaussians::part::PartMut,
    optim::{AdamPart, Descent},
    simd::{LANES, Simd, simd_kernel},
};

/// Gradients of some Gaussians, of any degree.
struct Buffer {
    means: [[f32; 3]; GRANULE],
    rotations: [[f32; 4]; GRANULE],
    log_scales: [[f32; 3]; GRANULE],
    logit_opacities: [f32; GRANULE],
    sh: [f32; 48 * GRANULE],
    projected_means: [[f32; 2]; GRANULE],
}

impl Buffer {
    const ZEROS: Self = Self {
        means: [[0.0; 3]; GRANULE],
        rotations: [[0.0; 4]; GRANULE],
        log_scales: [[0.0; 3]; GRANULE],
        logit_opacities: [0.0; GRANULE],
        sh: [0.0; 48 * GRANULE],
        projected_means: [[0.0; 2]; GRANULE],
    };

    /// The first `count` Gaussians, of `sh_stride` coefficients, and the gradients by their projected means.
    #[inline(always)]
    fn part(&mut self, count: usize, sh_stride: usize) -> (PartMut<'_>, &mut [[f32; 2]]) {
        let part = PartMut {
            means: &mut self.means[..count],
            rotations: &mut self.rotations[..count],
            log_scales: &mut self.log_scales[..count],
            logit_opacities: &mut self.logit_opacities[..count],
            sh: &mut self.sh[..count * sh_stride],
        };
        (part, &mut self.projected_means[..count])
    }
}

/// Density statistics of consecutive Gaussians.
pub(super) struct DensityPart<'a> {
    gradient_norm: &'a mut [f32],
    visible_steps: &'a mut [u32],
    /// Half the image, pixels.
    half_size: [f32; 2],
}

impl<'a> DensityPart<'a> {
    /// Parts of `size` Gaussians for an image of `width × height` pixels.
    pub(super) fn parts(
        density: &'a mut DensityStatistics,
        size: usize,
        [width, height]: [u32; 2],
    ) -> impl IndexedParallelIterator<Item = Self> {
        let half_size = [width as f32 / 2.0, height as f32 / 2.0];
        let norms = density.gradient_norm.par_chunks_mut(size);
        norms
            .zip(density.visible_steps.par_chunks_mut(size))
            .map(move |(gradient_norm, visible_steps)| Self { gradient_norm, visible_steps, half_size })
    }

    /// Adds what a step found about the Gaussians of `range`; bit `n` of `visible` is that of the `n`-th.
    #[inline(always)]
    fn add(&mut self, range: Range<usize>, visible: u16, projected_means: &[[f32; 2]]) {
        let statistics = self.gradient_norm[range.clone()].iter_mut().zip(&mut self.visible_steps[range]);
        for (lane, ((norm, steps), [x, y])) in statistics.zip(projected_means).enumerate() {
            let (x, y) = (f64::from(x * self.half_size[0]), f64::from(y * self.half_size[1]));
            // Those that are not visible have no gradient.
            *norm += (x * x + y * y).sqrt() as f32;
            *steps += u32::from(visible >> lane & 1);
        }
    }
}

simd_kernel! {
    /// Takes the step of a part, the first Gaussian of which is number `first` of the view.
    pub(super) fn descend(
        part: AdamPart<'_>,
        backward: &Backward<'_>,
        first: usize,
        descent: &Descent,
        density: DensityPart<'_>,
    ) = descend_kernel
}

#[inline(always)]
fn descend_kernel<S: Simd>(
    mut part: AdamPart<'_>,
    backward: &Backward<'_>,
    first: usize,
    descent: &Descent,
    mut density: DensityPart<'_>,
) {
    let lens = Lens::<S::Doubles>::new(backward.view.camera);
    let mut buffer = Buffer::ZEROS;
    let mut sums = [[[0.0; LANES]; SUMS]; GRANULE / LANES];
    let count = part.values.means.len();
    let stride = part.values.as_part().sh_stride();
    for place in (0..count).step_by(GRANULE) {
        let end = count.min(place + GRANULE);
        let (mut gradients, projected_means) = buffer.part(end - place, stride);
        backward.gather(first + place, end - place, &mut sums);
        for (group, sums) in (place..end).step_by(LANES).zip(&sums) {
            let to = group - place..end.min(group + LANES) - place;
            let projected_means = &mut projected_means[to.clone()];
            let visible = backward.visible(first + group, to.len());
            let range = group..group + to.len();
            group_backward::<S>(
                &part.values.as_part(),
                group,
                backward,
                first + group,
                sums,
                &lens,
                gradients.slice(to),
                projected_means,
            );
            density.add(range, visible, projected_means);
        }
        let active = backward.active.get(first + place..first + end).unwrap_or_default();
        part.slice(place..end).descend(gradients.as_part(), active, descent);
    }
}
