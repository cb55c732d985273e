//! What working on sixteen Gaussians at a time, and fusing their gradients with the step, must not change.
#![allow(clippy::unwrap_used, reason = "tests")]

use super::{CpuEngine, Pass};
use crate::{
    engine::DensityStatistics,
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    optim::{Adam, LearningRates},
    simd::Instructions,
    testing::{arc, blobs, on_threads},
};

const BLACK: [f32; 3] = [0.0; 3];

const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 1e-3,
    log_scale: 5e-3,
    logit_opacity: 0.05,
    sh_dc: 5e-3,
    sh_rest: 1e-4,
    sh_degree: 3,
};

/// Blobs with harmonics of a degree.
fn coloured(count: usize, sh_degree: u32) -> Gaussians {
    let values = 3 * (sh_degree as usize + 1).pow(2);
    let sh = (0..count * values).map(|place| (place as f32 * 0.7).sin() * 0.3).collect();
    Gaussians { sh, sh_degree, ..blobs(count, 71) }
}

fn seeds(count: usize) -> Vec<f32> {
    (0..count).map(|place| (place as f32 * 12.9898).sin()).collect()
}

fn gradients(instructions: Instructions, gaussians: &Gaussians) -> GaussianGradients {
    let camera = &arc(3, 70, 45)[1];
    CpuEngine::new(instructions).render_backward(gaussians, camera, BLACK, &seeds(3 * 70 * 45), &[])
}

/// Gradients of one Gaussian.
fn of(gradients: &GaussianGradients, index: usize) -> (Vec<f32>, Vec<f32>) {
    let stride = gradients.sh.len() / gradients.means.len();
    let geometry = [
        &gradients.means[index][..],
        &gradients.rotations[index],
        &gradients.log_scales[index],
        &gradients.logit_opacities[index..=index],
    ];
    (geometry.concat(), gradients.sh[index * stride..(index + 1) * stride].to_vec())
}

#[test]
fn the_place_in_a_group_changes_nothing() {
    for instructions in Instructions::available() {
        for (count, degree) in [(1, 3), (7, 0), (8, 2), (9, 1), (16, 3), (17, 3), (31, 0), (33, 2)] {
            let gaussians = coloured(count, degree);
            let backwards: Vec<usize> = (0..count).rev().collect();
            let (a, b) =
                (gradients(instructions, &gaussians), gradients(instructions, &gaussians.select(&backwards)));
            for index in 0..count {
                assert_eq!(of(&a, index), of(&b, count - 1 - index), "{index} of {count}");
            }
            assert!(a.sh.iter().any(|&value| value != 0.0));
        }
    }
}

#[test]
fn a_neighbour_that_is_not_drawn_changes_nothing() {
    let whole = coloured(20, 3);
    let breaks: [fn(&mut Gaussians); 6] = [
        |g| g.means[5] = [f32::NAN; 3],
        |g| g.means[5][2] = -10.0,
        |g| g.log_scales[5] = [f32::INFINITY, 0.0, 0.0],
        |g| g.log_scales[5] = [800.0; 3],
        |g| g.logit_opacities[5] = f32::NAN,
        |g| g.sh[5 * 48 + 20] = f32::INFINITY,
    ];
    let others: Vec<usize> = (0..20).filter(|&index| index != 5).collect();
    for instructions in Instructions::available() {
        let expected = gradients(instructions, &whole.select(&others));
        for (number, change) in breaks.iter().enumerate() {
            let mut gaussians = whole.clone();
            change(&mut gaussians);
            let found = gradients(instructions, &gaussians);
            for (place, &index) in others.iter().enumerate() {
                assert_eq!(of(&found, index), of(&expected, place), "break {number}, Gaussian {index}");
            }
            let (geometry, sh) = of(&found, 5);
            assert!(geometry.iter().chain(&sh).all(|&value| value == 0.0), "break {number}");
        }
    }
}

#[test]
fn rotations_without_direction_are_the_identity_and_get_no_gradient() {
    let mut plain = coloured(4, 0);
    plain.rotations[2] = [1.0, 0.0, 0.0, 0.0];
    for instructions in Instructions::available() {
        let expected = gradients(instructions, &plain);
        for rotation in [[0.0; 4], [f32::INFINITY, 0.0, 0.0, 0.0], [0.3, f32::NAN, 0.1, 0.2]] {
            let mut gaussians = plain.clone();
            gaussians.rotations[2] = rotation;
            let found = gradients(instructions, &gaussians);
            assert_eq!(found.means, expected.means, "{rotation:?}");
            assert_eq!(found.rotations[2], [0.0; 4], "{rotation:?}");
        }
        assert_ne!(expected.rotations[2], [0.0; 4]);
    }
}

/// A few steps over two views; `step` is the last stage.
fn stepped(
    start: &Gaussians,
    active: &[bool],
    step: impl Fn(&mut Pass, &mut Gaussians, usize, &mut Adam, &mut DensityStatistics),
) -> (Gaussians, DensityStatistics) {
    let (mut gaussians, cameras) = (start.clone(), arc(2, 70, 45));
    let (mut pass, mut adam) = (Pass::default(), Adam::new(start));
    let mut density = DensityStatistics::zeros(start.len());
    let mut image = Image::filled(70, 45, BLACK);
    for number in 0..4 {
        let view = number % 2;
        pass.project(&gaussians, &cameras[view], RATES.sh_degree);
        pass.bin(&cameras[view], &mut Vec::new());
        pass.blend(&cameras[view], BLACK, active, &mut image, &mut []);
        pass.blend_backward(&cameras[view], BLACK, &seeds(3 * 70 * 45), &[]);
        step(&mut pass, &mut gaussians, view, &mut adam, &mut density);
    }
    (gaussians, density)
}

#[test]
fn the_fused_step_is_the_gradient_and_then_the_step() {
    let cameras = arc(2, 70, 45);
    // More than a chunk and no whole number of groups; every third behind the camera.
    let count = 533;
    for degree in 0..=3 {
        let mut start = coloured(count, degree);
        start.means.iter_mut().step_by(3).for_each(|mean| mean[2] -= 10.0);
        let some: Vec<bool> =
            (0..count).map(|index| index % 5 != 0 && !(100..150).contains(&index)).collect();
        for active in [&[][..], &some] {
            let apart = stepped(&start, active, |pass, gaussians, view, adam, _| {
                let mut gradients = GaussianGradients::zeros(gaussians);
                pass.project_backward(gaussians, &cameras[view], RATES.sh_degree, &mut gradients);
                adam.step(gaussians, &gradients, &RATES, (!active.is_empty()).then_some(active));
            });
            for threads in [1, 3] {
                let fused = || {
                    stepped(&start, active, |pass, gaussians, view, adam, density| {
                        pass.descend(gaussians, &cameras[view], &RATES, adam, density);
                    })
                };
                let (gaussians, density) = on_threads(threads, fused);
                assert_eq!(gaussians, apart.0, "degree {degree}, {threads} threads");
                for index in 0..count {
                    let is_seen = index % 3 != 0;
                    assert!(is_seen || density.visible_steps[index] == 0);
                    let is_counted = density.gradient_norm[index] > 0.0;
                    assert!(!is_counted || (is_seen && active.get(index).is_none_or(|&active| active)));
                }
                assert!(density.gradient_norm.iter().sum::<f32>() > 0.0);
                assert!(density.visible_steps.iter().filter(|&&steps| steps == 4).count() > count / 2);
            }
        }
    }
}
