#![allow(clippy::unwrap_used, reason = "tests")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::gaussians::{Gaussians, gradients::GaussianGradients};

const RATES: LearningRates = LearningRates {
    mean: 1e-4,
    rotation: 1e-3,
    log_scale: 5e-3,
    logit_opacity: 5e-2,
    sh_dc: 2.5e-3,
    sh_rest: 1.25e-4,
    sh_degree: 3,
};

fn random_gaussians(count: usize, seed: u64) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut value = || random.random_range(-1.0..1.0_f32);
    Gaussians {
        means: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        rotations: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        log_scales: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        logit_opacities: (0..count).map(|_| value()).collect(),
        sh: (0..count * 48).map(|_| value()).collect(),
        sh_degree: 3,
    }
}

/// Gradients from 1e-12 to 1, as they come from faint and from large Gaussians.
fn random_gradients(gaussians: &Gaussians, seed: u64) -> GaussianGradients {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut gradient = GaussianGradients::zeros(gaussians);
    let mut value = || random.random_range(-1.0..1.0_f32) * 10.0_f32.powf(random.random_range(-12.0..0.0));
    gradient.means.as_flattened_mut().fill_with(&mut value);
    gradient.rotations.as_flattened_mut().fill_with(&mut value);
    gradient.log_scales.as_flattened_mut().fill_with(&mut value);
    gradient.logit_opacities.fill_with(&mut value);
    gradient.sh.fill_with(&mut value);
    gradient
}

/// The parameters of a class with the rate of each, `None` where it must not change.
fn flat(gaussians: &Gaussians, rates: &LearningRates) -> Vec<(f32, Option<f32>)> {
    let active_sh = 3 * (rates.sh_degree as usize + 1).pow(2);
    let with = |values: &[f32], rate: f32| values.iter().map(|&v| (v, Some(rate))).collect::<Vec<_>>();
    let mut all = with(gaussians.means.as_flattened(), rates.mean);
    all.extend(with(gaussians.rotations.as_flattened(), rates.rotation));
    all.extend(with(gaussians.log_scales.as_flattened(), rates.log_scale));
    all.extend(with(&gaussians.logit_opacities, rates.logit_opacity));
    all.extend(gaussians.sh.iter().enumerate().map(|(index, &value)| match index % 48 {
        0..3 => (value, Some(rates.sh_dc)),
        within if within < active_sh => (value, Some(rates.sh_rest)),
        _ => (value, None),
    }));
    all
}

fn flat_gradient(gradient: &GaussianGradients) -> Vec<f32> {
    [
        gradient.means.as_flattened(),
        gradient.rotations.as_flattened(),
        gradient.log_scales.as_flattened(),
        &gradient.logit_opacities,
        &gradient.sh,
    ]
    .concat()
}

#[test]
fn follows_adam_in_double_precision() {
    let rates = LearningRates { sh_degree: 2, ..RATES };
    let start = random_gaussians(50, 1);
    let mut gaussians = start.clone();
    let mut adam = Adam::new(&gaussians);
    let mut expected: Vec<f64> = flat(&start, &rates).iter().map(|&(value, _)| value.into()).collect();
    let mut moments = vec![(0.0_f64, 0.0_f64); expected.len()];
    for step in 1..=40 {
        let gradient = random_gradients(&gaussians, 100 + step as u64);
        adam.step(&mut gaussians, &gradient, &rates, None);
        for (index, slope) in flat_gradient(&gradient).into_iter().map(f64::from).enumerate() {
            let Some(rate) = flat(&start, &rates)[index].1 else { continue };
            let (first, second) = &mut moments[index];
            *first = 0.9 * *first + 0.1 * slope;
            *second = 0.999 * *second + 0.001 * slope * slope;
            let corrected = (*second / (1.0 - 0.999_f64.powi(step))).sqrt() + 1e-15;
            expected[index] -= f64::from(rate) * *first / (1.0 - 0.9_f64.powi(step)) / corrected;
        }
    }
    for ((actual, rate), expected) in flat(&gaussians, &rates).into_iter().zip(&expected) {
        // 40 roundings of a value near 1, and of steps near the rate.
        let tolerance = 40.0 * f64::from(f32::EPSILON) * (1.0 + f64::from(rate.unwrap_or(0.0)));
        assert!((f64::from(actual) - expected).abs() < tolerance, "{actual} against {expected}");
    }
    assert_eq!(adam.steps(), 40);
}

#[test]
fn harmonics_above_the_degree_stay() {
    let start = random_gaussians(10, 2);
    for degree in 0..=3 {
        let mut gaussians = start.clone();
        let rates = LearningRates { sh_degree: degree, ..RATES };
        let mut gradient = GaussianGradients::zeros(&gaussians);
        gradient.sh.fill(1.0);
        Adam::new(&gaussians).step(&mut gaussians, &gradient, &rates, None);
        let active = 3 * (degree as usize + 1).pow(2);
        for (index, (new, old)) in gaussians.sh.iter().zip(&start.sh).enumerate() {
            assert_eq!(new == old, index % 48 >= active, "coefficient {index} at degree {degree}");
        }
    }
}

#[test]
fn a_degree_beyond_the_set_is_the_sets_own() {
    let mut gaussians = Gaussians { sh_degree: 0, ..random_gaussians(2, 3) };
    gaussians.sh.truncate(6);
    let mut gradient = GaussianGradients::zeros(&gaussians);
    gradient.sh.fill(1.0);
    let before = gaussians.sh.clone();
    Adam::new(&gaussians).step(&mut gaussians, &gradient, &RATES, None);
    assert!(gaussians.sh.iter().zip(&before).all(|(new, old)| new < old));
}

#[test]
fn frozen_gaussians_are_as_if_the_step_had_not_been() {
    let start = random_gaussians(6, 4);
    let active = [true, false, true, true, false, true];
    let mut all = start.clone();
    let mut some = start.clone();
    let (mut all_adam, mut some_adam) = (Adam::new(&all), Adam::new(&some));
    for seed in 0..3 {
        let gradient = random_gradients(&start, seed);
        all_adam.step(&mut all, &gradient, &RATES, None);
        some_adam.step(&mut some, &gradient, &RATES, Some(&active));
    }
    for (index, active) in active.into_iter().enumerate() {
        let expected = if active { &all } else { &start };
        assert_eq!(some.select(&[index]), expected.select(&[index]));
    }
}

#[test]
fn moments_follow_their_gaussians() {
    let start = random_gaussians(4, 5);
    let gradient = random_gradients(&start, 6);
    let mut original = start.clone();
    let mut adam = Adam::new(&original);
    adam.step(&mut original, &gradient, &RATES, None);

    let source = [Some(2), None, Some(0), Some(2), None];
    let mut moved = original.select(&[2, 1, 0, 2, 3]);
    let mut moved_adam = adam.clone();
    moved_adam.replace(&source);
    let zero = GaussianGradients::zeros(&moved);
    let before = moved.clone();
    moved_adam.step(&mut moved, &zero, &RATES, None);
    adam.step(&mut original, &GaussianGradients::zeros(&start), &RATES, None);

    // Under a zero gradient only the moments move a parameter.
    for (index, source) in source.into_iter().enumerate() {
        match source {
            Some(source) => assert_eq!(moved.select(&[index]), original.select(&[source])),
            None => assert_eq!(moved.select(&[index]), before.select(&[index])),
        }
    }
}

#[test]
fn any_thread_count_gives_the_same_bytes() {
    // More than two chunks.
    let start = random_gaussians(10_000, 7);
    let gradient = random_gradients(&start, 8);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut gaussians = start.clone();
        pool.install(|| Adam::new(&start).step(&mut gaussians, &gradient, &RATES, None));
        gaussians
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn an_empty_set_takes_steps() {
    let mut gaussians = Gaussians::empty(3);
    let mut adam = Adam::new(&gaussians);
    let gradient = GaussianGradients::zeros(&gaussians);
    adam.step(&mut gaussians, &gradient, &RATES, None);
    adam.replace(&[]);
    assert!(gaussians.is_empty());
}
