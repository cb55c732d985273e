//! Adam (Kingma and Ba 2015) with dense moments.

use std::ops::Range;

use rayon::prelude::*;

use super::LearningRates;
use crate::gaussians::{Gaussians, gradients::GaussianGradients, sh};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
/// As in 3D Gaussian Splatting: gradients of a mean loss over a whole image are tiny.
const EPSILON: f32 = 1e-15;

/// Gaussians of one parallel task.
const CHUNK: usize = 4096;

/// Optimiser state of a set of Gaussians: two moments per parameter and one step count.
#[derive(Clone, Debug)]
pub struct Adam {
    steps: u64,
    gaussians: usize,
    means: Moments,
    rotations: Moments,
    log_scales: Moments,
    logit_opacities: Moments,
    sh: Moments,
}

/// First and second moments of one parameter class, `N × width`.
#[derive(Clone, Debug)]
struct Moments {
    width: usize,
    first: Vec<f32>,
    second: Vec<f32>,
}

/// Parameters of a class, counted within one Gaussian, that share a rate.
struct Span {
    range: Range<usize>,
    rate: f32,
}

/// What one step's update has in common for all parameters.
#[derive(Clone, Copy)]
struct Correction {
    /// `1 / (1 - beta1^t)`.
    first: f32,
    /// `1 / sqrt(1 - beta2^t)`.
    second_root: f32,
}

impl Adam {
    /// Zero moments for a set.
    pub fn new(gaussians: &Gaussians) -> Self {
        let count = gaussians.len();
        let zeros = |width| Moments::zeros(count, width);
        Self {
            steps: 0,
            gaussians: count,
            means: zeros(3),
            rotations: zeros(4),
            log_scales: zeros(3),
            logit_opacities: zeros(1),
            sh: zeros(3 * gaussians.sh_coefficients()),
        }
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
        assert_eq!(gaussians.len(), self.gaussians, "the optimiser was made for another number of Gaussians");
        assert!(
            active.is_none_or(|active| active.len() == self.gaussians),
            "one active flag per Gaussian is needed"
        );

        self.steps += 1;
        let steps = self.steps as f64;
        let correction = Correction {
            first: (1.0 / (1.0 - BETA1.powf(steps))) as f32,
            second_root: (1.0 / (1.0 - BETA2.powf(steps)).sqrt()) as f32,
        };
        let coefficients = sh::coefficients(rates.sh_degree.min(gaussians.sh_degree));
        let whole = |range, rate| [Span { range, rate }];

        let update = |moments: &mut Moments, values: &mut [f32], gradient: &[f32], spans: &[Span]| {
            moments.update(values, gradient, spans, active, correction);
        };
        update(
            &mut self.means,
            gaussians.means.as_flattened_mut(),
            gradient.means.as_flattened(),
            &whole(0..3, rates.mean),
        );
        update(
            &mut self.rotations,
            gaussians.rotations.as_flattened_mut(),
            gradient.rotations.as_flattened(),
            &whole(0..4, rates.rotation),
        );
        update(
            &mut self.log_scales,
            gaussians.log_scales.as_flattened_mut(),
            gradient.log_scales.as_flattened(),
            &whole(0..3, rates.log_scale),
        );
        update(
            &mut self.logit_opacities,
            &mut gaussians.logit_opacities,
            &gradient.logit_opacities,
            &whole(0..1, rates.logit_opacity),
        );
        let bands = [
            Span { range: 0..3, rate: rates.sh_dc },
            Span { range: 3..3 * coefficients, rate: rates.sh_rest },
        ];
        update(&mut self.sh, &mut gaussians.sh, &gradient.sh, &bands);
    }

    /// Follows a change of the set: new Gaussian `i` takes over the moments of the old Gaussian `source[i]`, or starts
    /// from zero where that is `None`. The step count goes on.
    ///
    /// # Panics
    /// If `source` names a Gaussian that is not in the old set.
    pub fn replace(&mut self, source: &[Option<usize>]) {
        self.gaussians = source.len();
        let classes = [
            &mut self.means,
            &mut self.rotations,
            &mut self.log_scales,
            &mut self.logit_opacities,
            &mut self.sh,
        ];
        for moments in classes {
            moments.replace(source);
        }
    }
}

impl Moments {
    fn zeros(count: usize, width: usize) -> Self {
        Self { width, first: vec![0.0; count * width], second: vec![0.0; count * width] }
    }

    fn update(
        &mut self,
        values: &mut [f32],
        gradient: &[f32],
        spans: &[Span],
        active: Option<&[bool]>,
        correction: Correction,
    ) {
        assert_eq!(values.len(), self.first.len(), "the optimiser was made for another set of Gaussians");
        assert_eq!(gradient.len(), self.first.len(), "one gradient per parameter is needed");
        let width = self.width;
        values
            .par_chunks_mut(CHUNK * width)
            .zip(gradient.par_chunks(CHUNK * width))
            .zip(self.first.par_chunks_mut(CHUNK * width))
            .zip(self.second.par_chunks_mut(CHUNK * width))
            .enumerate()
            .for_each(|(chunk, (((values, gradient), first), second))| {
                // One rate for everything: no need to go Gaussian by Gaussian.
                if let ([span], None) = (spans, active) {
                    return descend(values, gradient, first, second, span.rate, correction);
                }
                for gaussian in 0..values.len() / width {
                    if active.is_some_and(|active| !active[chunk * CHUNK + gaussian]) {
                        continue;
                    }
                    for span in spans {
                        let range = gaussian * width + span.range.start..gaussian * width + span.range.end;
                        descend(
                            &mut values[range.clone()],
                            &gradient[range.clone()],
                            &mut first[range.clone()],
                            &mut second[range],
                            span.rate,
                            correction,
                        );
                    }
                }
            });
    }

    fn replace(&mut self, source: &[Option<usize>]) {
        let mut new = Self::zeros(source.len(), self.width);
        for (target, source) in source.iter().enumerate() {
            let Some(source) = source else { continue };
            let (from, to) = (source * self.width, target * self.width);
            new.first[to..to + self.width].copy_from_slice(&self.first[from..from + self.width]);
            new.second[to..to + self.width].copy_from_slice(&self.second[from..from + self.width]);
        }
        *self = new;
    }
}

/// Updates parameters of one rate together with their moments.
#[inline]
fn descend(
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    rate: f32,
    correction: Correction,
) {
    const B1: f32 = BETA1 as f32;
    const B2: f32 = BETA2 as f32;
    const ONE_MINUS_B1: f32 = (1.0 - BETA1) as f32;
    const ONE_MINUS_B2: f32 = (1.0 - BETA2) as f32;
    let step = rate * correction.first;
    let length = values.len();
    let (gradient, first, second) = (&gradient[..length], &mut first[..length], &mut second[..length]);
    for at in 0..length {
        let slope = gradient[at];
        first[at] = B1 * first[at] + ONE_MINUS_B1 * slope;
        second[at] = B2 * second[at] + ONE_MINUS_B2 * (slope * slope);
        values[at] -= step * first[at] / (second[at].sqrt() * correction.second_root + EPSILON);
    }
}
