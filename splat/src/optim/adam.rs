//! Adam (Kingma and Ba 2015) with dense moments.

use std::ops::Range;

use rayon::prelude::*;

use super::LearningRates;
use crate::gaussians::{
    Gaussians,
    gradients::GaussianGradients,
    part::{Part, PartMut},
    sh,
};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
/// As in 3D Gaussian Splatting: gradients of a mean loss over a whole image are tiny.
const EPSILON: f32 = 1e-15;

/// Gaussians of one parallel task.
const CHUNK: usize = 4096;

/// Spherical-harmonic values of a Gaussian of the highest degree.
const MOST_SH: usize = 3 * sh::coefficients(sh::MAX_DEGREE);

/// Optimiser state of a set of Gaussians: two moments per parameter and one step count.
#[derive(Clone, Debug)]
pub struct Adam {
    steps: u64,
    /// Spherical-harmonic values per Gaussian.
    sh_stride: usize,
    first: GaussianGradients,
    second: GaussianGradients,
}

/// Parameters and moments of consecutive Gaussians.
pub(crate) struct AdamPart<'a> {
    pub values: PartMut<'a>,
    first: PartMut<'a>,
    second: PartMut<'a>,
}

/// What one step's update has in common for all Gaussians: the rate of each class times the correction
/// `1 / (1 - beta1^t)`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Descent {
    mean: f32,
    rotation: f32,
    log_scale: f32,
    logit_opacity: f32,
    /// Of each spherical-harmonic value of a Gaussian.
    sh: [f32; MOST_SH],
    /// How many of them are updated.
    sh_used: usize,
    /// `1 / sqrt(1 - beta2^t)`.
    second_root: f32,
}

impl Adam {
    /// Zero moments for a set.
    pub fn new(gaussians: &Gaussians) -> Self {
        let zeros = GaussianGradients::zeros(gaussians);
        Self { steps: 0, sh_stride: 3 * gaussians.sh_coefficients(), first: zeros.clone(), second: zeros }
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// One descent step. Gaussians that are not `active` keep their parameters and moments, and so do harmonics above
    /// `rates.sh_degree`. The bias correction counts all steps of this optimiser, also for Gaussians that joined
    /// later, as in the original 3D Gaussian Splatting. A parameter whose gradient is so large that its square overflows,
    /// beyond 1e19, takes no step, then or later. The same bytes for every number of threads.
    ///
    /// # Panics
    /// If Gaussians, gradients or `active` differ in size from the set this state was made for.
    pub fn step(
        &mut self,
        gaussians: &mut Gaussians,
        gradient: &GaussianGradients,
        rates: &LearningRates,
        active: Option<&[bool]>,
    ) {
        assert!(
            active.is_none_or(|active| active.len() == gaussians.len()),
            "one active flag per Gaussian is needed"
        );
        let active = active.unwrap_or_default();
        let descent = self.begin_step(gaussians, rates);
        self.parts(gaussians, CHUNK).enumerate().for_each(|(chunk, mut part)| {
            let range = chunk * CHUNK..chunk * CHUNK + part.values.means.len();
            let active = active.get(range.clone()).unwrap_or_default();
            part.descend(gradient.part().slice(range), active, &descent);
        });
    }

    /// Counts a step that [`AdamPart::descend`] then takes, part by part.
    pub(crate) fn begin_step(&mut self, gaussians: &Gaussians, rates: &LearningRates) -> Descent {
        self.steps += 1;
        let steps = self.steps as f64;
        let correction = (1.0 / (1.0 - BETA1.powf(steps))) as f32;
        let mut sh = [rates.sh_rest * correction; MOST_SH];
        sh[..3].fill(rates.sh_dc * correction);
        Descent {
            mean: rates.mean * correction,
            rotation: rates.rotation * correction,
            log_scale: rates.log_scale * correction,
            logit_opacity: rates.logit_opacity * correction,
            sh,
            sh_used: 3 * sh::coefficients(rates.sh_degree.min(gaussians.sh_degree)),
            second_root: (1.0 / (1.0 - BETA2.powf(steps)).sqrt()) as f32,
        }
    }

    /// Parameters and moments for parallel tasks of `size` Gaussians.
    ///
    /// # Panics
    /// If this state was made for another set.
    pub(crate) fn parts<'a>(
        &'a mut self,
        gaussians: &'a mut Gaussians,
        size: usize,
    ) -> impl IndexedParallelIterator<Item = AdamPart<'a>> {
        let fits = gaussians.len() == self.first.means.len() && gaussians.sh.len() == self.first.sh.len();
        assert!(fits, "the optimiser was made for another set of Gaussians");
        let arrays = (gaussians.parts_mut(size), self.first.parts_mut(size), self.second.parts_mut(size));
        arrays.into_par_iter().map(|(values, first, second)| AdamPart { values, first, second })
    }

    /// Follows a change of the set: new Gaussian `i` takes over the moments of the old Gaussian `source[i]`, or starts
    /// from zero where that is `None`. The step count goes on.
    ///
    /// # Panics
    /// If `source` names a Gaussian that is not in the old set.
    pub fn replace(&mut self, source: &[Option<usize>]) {
        for moments in [&mut self.first, &mut self.second] {
            let GaussianGradients { means, rotations, log_scales, logit_opacities, sh } = &*moments;
            *moments = GaussianGradients {
                means: taken(means, source),
                rotations: taken(rotations, source),
                log_scales: taken(log_scales, source),
                logit_opacities: taken(logit_opacities, source),
                sh: taken_rows(sh, self.sh_stride, source),
            };
        }
    }
}

fn taken<T: Copy + Default>(old: &[T], source: &[Option<usize>]) -> Vec<T> {
    source.iter().map(|source| source.map_or_else(T::default, |source| old[source])).collect()
}

fn taken_rows(old: &[f32], width: usize, source: &[Option<usize>]) -> Vec<f32> {
    let mut new = vec![0.0; source.len() * width];
    for (target, source) in new.chunks_exact_mut(width).zip(source) {
        if let Some(source) = source {
            target.copy_from_slice(&old[source * width..(source + 1) * width]);
        }
    }
    new
}

impl AdamPart<'_> {
    /// The Gaussians of `range`.
    #[inline(always)]
    pub(crate) fn slice(&mut self, range: Range<usize>) -> AdamPart<'_> {
        AdamPart {
            values: self.values.slice(range.clone()),
            first: self.first.slice(range.clone()),
            second: self.second.slice(range),
        }
    }

    /// Updates the Gaussians of the part that are `active` (empty: all).
    #[inline(always)]
    pub(crate) fn descend(&mut self, gradient: Part<'_>, active: &[bool], descent: &Descent) {
        if active.is_empty() {
            return self.descend_all(gradient, descent);
        }
        let mut start = 0;
        for run in active.chunk_by(PartialEq::eq) {
            let range = start..start + run.len();
            start = range.end;
            if run[0] {
                self.slice(range.clone()).descend_all(gradient.slice(range), descent);
            }
        }
    }

    #[inline(always)]
    fn descend_all(&mut self, gradient: Part<'_>, descent: &Descent) {
        let (values, first, second) = (&mut self.values, &mut self.first, &mut self.second);
        let root = descent.second_root;
        descend(
            values.means.as_flattened_mut(),
            gradient.means.as_flattened(),
            first.means.as_flattened_mut(),
            second.means.as_flattened_mut(),
            descent.mean,
            root,
        );
        descend(
            values.rotations.as_flattened_mut(),
            gradient.rotations.as_flattened(),
            first.rotations.as_flattened_mut(),
            second.rotations.as_flattened_mut(),
            descent.rotation,
            root,
        );
        descend(
            values.log_scales.as_flattened_mut(),
            gradient.log_scales.as_flattened(),
            first.log_scales.as_flattened_mut(),
            second.log_scales.as_flattened_mut(),
            descent.log_scale,
            root,
        );
        descend(
            values.logit_opacities,
            gradient.logit_opacities,
            first.logit_opacities,
            second.logit_opacities,
            descent.logit_opacity,
            root,
        );
        // As many loops as there are degrees, each of a length that the compiler knows.
        match descent.sh_used {
            3 => self.descend_coefficients::<3>(gradient, descent),
            12 => self.descend_coefficients::<12>(gradient, descent),
            27 => self.descend_coefficients::<27>(gradient, descent),
            _ => self.descend_coefficients::<MOST_SH>(gradient, descent),
        }
    }

    /// Updates the first `USED` spherical-harmonic values of each Gaussian.
    #[inline(always)]
    fn descend_coefficients<const USED: usize>(&mut self, gradient: Part<'_>, descent: &Descent) {
        let stride = gradient.sh_stride();
        for row in 0..gradient.len() {
            let at = row * stride;
            let arrays = (
                self.values.sh[at..].first_chunk_mut::<USED>(),
                gradient.sh[at..].first_chunk::<USED>(),
                self.first.sh[at..].first_chunk_mut::<USED>(),
                self.second.sh[at..].first_chunk_mut::<USED>(),
            );
            let (Some(values), Some(gradient), Some(first), Some(second)) = arrays else { return };
            for at in 0..USED {
                let step = descent.sh[at];
                (values[at], first[at], second[at]) =
                    descended(values[at], gradient[at], first[at], second[at], step, descent.second_root);
            }
        }
    }
}

/// Updates parameters of one rate together with their moments.
#[inline(always)]
fn descend(
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    step: f32,
    second_root: f32,
) {
    let length = values.len();
    let (gradient, first, second) = (&gradient[..length], &mut first[..length], &mut second[..length]);
    for at in 0..length {
        (values[at], first[at], second[at]) =
            descended(values[at], gradient[at], first[at], second[at], step, second_root);
    }
}

/// One parameter and its moments after the step.
#[inline(always)]
fn descended(
    value: f32,
    slope: f32,
    first: f32,
    second: f32,
    step: f32,
    second_root: f32,
) -> (f32, f32, f32) {
    const B1: f32 = BETA1 as f32;
    const B2: f32 = BETA2 as f32;
    const ONE_MINUS_B1: f32 = (1.0 - BETA1) as f32;
    const ONE_MINUS_B2: f32 = (1.0 - BETA2) as f32;
    let first = B1 * first + ONE_MINUS_B1 * slope;
    let second = B2 * second + ONE_MINUS_B2 * (slope * slope);
    (value - step * first / (second.sqrt() * second_root + EPSILON), first, second)
}
