//! What the golden data do not show: sessions, thread counts, and input at the extremes.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::Arc;

use super::CpuEngine;
use crate::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::Gaussians,
    image::Image,
    optim::LearningRates,
    testing::{arc, blobs, on_threads, render},
};

const BLACK: [f32; 3] = [0.0; 3];

const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 1e-3,
    log_scale: 5e-3,
    logit_opacity: 0.05,
    sh_dc: 5e-3,
    sh_rest: 1e-4,
    sh_degree: 1,
};

fn input(gaussians: Gaussians, truth: &Gaussians) -> SessionInput {
    let views = arc(3, 70, 45)
        .into_iter()
        .map(|camera| TrainingView {
            image: Arc::new(render(truth, &camera, BLACK).image),
            camera,
            mask: None,
        })
        .collect();
    SessionInput { gaussians, views, background: BLACK, dssim_weight: 0.2, frozen: Vec::new() }
}

fn optimised(input: SessionInput, steps: usize) -> (Gaussians, Vec<f32>) {
    let mut session = CpuEngine::default().session(input).unwrap();
    let losses = (0..steps).map(|step| session.step(step % 3, &RATES).unwrap().loss).collect();
    (session.gaussians().unwrap(), losses)
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let (start, truth) = (blobs(300, 1), blobs(300, 2));
    let one = on_threads(1, || optimised(input(start.clone(), &truth), 6));
    let three = on_threads(3, || optimised(input(start.clone(), &truth), 6));
    assert_eq!(one, three);
}

#[test]
fn a_session_lowers_the_loss() {
    let truth = blobs(60, 3);
    let mut start = truth.clone();
    for mean in &mut start.means {
        mean[0] += 0.02;
    }
    let (_, losses) = optimised(input(start, &truth), 90);
    let (first, last) = (losses[..3].iter().sum::<f32>(), losses[87..].iter().sum::<f32>());
    assert!(last < 0.5 * first, "{first} to {last}");
}

#[test]
fn frozen_gaussians_stay_and_the_others_move() {
    let (start, truth) = (blobs(40, 4), blobs(40, 5));
    let mut input = input(start.clone(), &truth);
    input.frozen = (0..40).map(|index| index % 2 == 0).collect();
    let (result, _) = optimised(input, 5);
    for index in 0..40 {
        let unchanged = result.select(&[index]) == start.select(&[index]);
        assert_eq!(unchanged, index % 2 == 0, "Gaussian {index}");
    }
}

#[test]
fn replaced_gaussians_are_optimised_from_where_they_are_put() {
    let truth = blobs(30, 6);
    let mut session = CpuEngine::default().session(input(blobs(30, 7), &truth)).unwrap();
    session.step(0, &RATES).unwrap();
    session.replace(truth.clone(), &vec![None; 30]).unwrap();
    assert_eq!(session.gaussians().unwrap(), truth);
    // The truth renders as the images: nothing is left to learn but single precision.
    assert!(session.step(0, &RATES).unwrap().loss < 1e-6);
    assert_eq!(session.take_density_statistics().unwrap().visible_steps.len(), 30);
}

#[test]
fn a_session_refuses_what_does_not_fit() {
    let truth = blobs(5, 8);
    let refused = |change: &dyn Fn(&mut SessionInput)| {
        let mut input = input(truth.clone(), &truth);
        change(&mut input);
        matches!(CpuEngine::default().session(input).err(), Some(EngineError::InvalidInput(_)))
    };
    assert!(refused(&|input| input.views.clear()), "no view");
    assert!(refused(&|input| input.frozen = vec![true]), "flags for other Gaussians");
    assert!(refused(&|input| input.views[0].image = Arc::new(Image::filled(3, 3, BLACK))), "another size");
    assert!(refused(&|input| input.gaussians.means[2][1] = f32::NAN), "a NaN");
    assert!(refused(&|input| {
        input.gaussians.sh.pop();
    }));
    let mut session = CpuEngine::default().session(input(truth.clone(), &truth)).unwrap();
    assert!(session.step(3, &RATES).is_err(), "no such view");
    assert!(session.replace(truth, &[]).is_err(), "sources of other Gaussians");
}

#[test]
fn nothing_to_see_is_background() {
    let camera = &arc(1, 17, 13)[0];
    let mut behind = blobs(20, 9);
    for mean in &mut behind.means {
        mean[2] -= 10.0;
    }
    for gaussians in [Gaussians::empty(3), behind] {
        let rendering = render(&gaussians, camera, [0.25, 0.5, 0.75]);
        assert_eq!(rendering.image, Image::filled(17, 13, [0.25, 0.5, 0.75]));
        assert!(rendering.alpha.iter().all(|&alpha| alpha == 0.0));
    }
}

#[test]
fn odd_image_sizes_are_drawn() {
    for (width, height) in [(1, 1), (17, 13), (1, 300), (300, 1), (16, 16)] {
        let camera = &arc(1, width, height)[0];
        let rendering = render(&blobs(50, 10), camera, BLACK);
        assert_eq!(rendering.image.pixels.len(), (3 * width * height) as usize);
        assert!(rendering.image.pixels.iter().all(|value| value.is_finite()), "{width}x{height}");
    }
}

#[test]
fn extreme_parameters_give_finite_images_and_gradients() {
    let camera = &arc(1, 40, 30)[0];
    let extremes: [fn(&mut Gaussians); 8] = [
        |g| g.log_scales[0] = [60.0, -60.0, 0.0],
        |g| g.log_scales[0] = [-80.0; 3],
        |g| g.log_scales[0] = [12.0; 3],
        |g| g.logit_opacities[0] = 1e30,
        |g| g.logit_opacities[0] = -1e30,
        |g| g.rotations[0] = [0.0; 4],
        |g| g.rotations[0] = [1e20, -1e20, 3e19, 1e-20],
        |g| g.means[0] = [1e30, -1e30, 1e30],
    ];
    for (number, change) in extremes.iter().enumerate() {
        let mut gaussians = blobs(12, 11);
        change(&mut gaussians);
        let rendering = render(&gaussians, camera, BLACK);
        assert!(rendering.image.pixels.iter().all(|value| value.is_finite()), "image {number}");
        let seed = vec![1.0; rendering.image.pixels.len()];
        let gradients = CpuEngine::default().render_backward(&gaussians, camera, BLACK, &seed, &[]);
        let all = gradients.means.as_flattened().iter().chain(gradients.rotations.as_flattened());
        let all = all.chain(gradients.log_scales.as_flattened()).chain(&gradients.logit_opacities);
        assert!(all.chain(&gradients.sh).all(|value| value.is_finite()), "gradient {number}");
    }
}

#[test]
fn gaussians_that_are_no_numbers_are_not_drawn() {
    let camera = &arc(1, 40, 30)[0];
    let whole = blobs(12, 12);
    let without_first = whole.select(&(1..12).collect::<Vec<_>>());
    let breaks: [fn(&mut Gaussians); 5] = [
        |g| g.means[0][0] = f32::NAN,
        |g| g.log_scales[0][1] = f32::INFINITY,
        |g| g.log_scales[0][1] = f32::NAN,
        |g| g.logit_opacities[0] = f32::NAN,
        |g| g.sh[0] = f32::NAN,
    ];
    for change in breaks {
        let mut gaussians = whole.clone();
        change(&mut gaussians);
        assert_eq!(
            render(&gaussians, camera, BLACK).image,
            render(&without_first, camera, BLACK).image,
            "{:?}",
            gaussians.select(&[0])
        );
    }
}
