//! What the golden data do not show: sessions, thread counts, and input at the extremes.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::Arc;

use super::{CpuEngine, Pass, blocks::RoundLimit};
use crate::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    optim::LearningRates,
    simd::{InstructionSet, Instructions},
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
    for step in 0..steps {
        session.step(step % 3, &RATES).unwrap();
    }
    (session.gaussians().unwrap(), session.take_losses().unwrap())
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
    session.take_losses().unwrap();
    session.step(0, &RATES).unwrap();
    assert!(session.take_losses().unwrap()[0] < 1e-6);
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

/// Everything that the engine computes on one small scene: image, alpha, and the gradient for seeds of random signs.
fn computed(instructions: Instructions) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (gaussians, camera) = (blobs(120, 31), &arc(3, 70, 45)[0]);
    let engine = CpuEngine::new(instructions);
    let rendering = engine.render(&gaussians, camera, [0.1, 0.2, 0.3]).unwrap();
    let seeds = seeds(rendering.image.pixels.len());
    let gradients =
        engine.render_backward(&gaussians, camera, [0.1, 0.2, 0.3], &seeds, &seeds[..rendering.alpha.len()]);
    (rendering.image.pixels, rendering.alpha, flat(&gradients))
}

fn seeds(count: usize) -> Vec<f32> {
    (0..count).map(|place| (place as f32 * 12.9898).sin()).collect()
}

fn flat(gradients: &GaussianGradients) -> Vec<f32> {
    let GaussianGradients { means, rotations, log_scales, logit_opacities, sh } = gradients;
    [means.as_flattened(), rotations.as_flattened(), log_scales.as_flattened(), logit_opacities, sh].concat()
}

#[test]
fn instruction_sets_agree() {
    let widest = computed(Instructions::detect());
    for instructions in Instructions::available() {
        let (image, alpha, gradient) = computed(instructions);
        if instructions.set() != InstructionSet::Baseline {
            assert_eq!((image, alpha, gradient), widest, "{}", instructions.set());
            continue;
        }
        // Two roundings instead of one per multiplication and addition: a few units in the last place per blend, and
        // no pixel of this scene lies so near a threshold that it decides otherwise.
        let difference = |ours: &[f32], theirs: &[f32]| {
            let largest = theirs.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
            ours.iter().zip(theirs).fold(0.0_f32, |worst, (a, b)| worst.max((a - b).abs())) / largest
        };
        assert!(difference(&image, &widest.0) < 2e-6);
        assert!(difference(&alpha, &widest.1) < 2e-6);
        assert!(difference(&gradient, &widest.2) < 1e-5);
    }
}

#[test]
fn gradients_are_finite_differences_on_every_instruction_set() {
    let camera = &arc(3, 37, 29)[1];
    let background = [0.3, 0.2, 0.1];
    let mut start = blobs(8, 41);
    // All of them reach every pixel: one that enters or leaves a footprint at alpha = 1/255 is a jump that no derivative
    // has, and so is one that stops.
    for scales in &mut start.log_scales {
        *scales = scales.map(|scale| 0.2 * scale + 0.9);
    }
    start.logit_opacities.fill(-1.0);
    let seeds: Vec<f32> = (0..3 * 37 * 29).map(|place| (place as f32 * 0.01).sin()).collect();
    let objective = |engine: &CpuEngine, gaussians: &Gaussians| -> f64 {
        let image = engine.render(gaussians, camera, background).unwrap().image;
        image.pixels.iter().zip(&seeds).map(|(&value, &seed)| f64::from(value) * f64::from(seed)).sum()
    };
    for instructions in Instructions::available() {
        let engine = CpuEngine::new(instructions);
        let analytic = flat(&engine.render_backward(&start, camera, background, &seeds, &[]));
        let numeric: Vec<f64> = (0..analytic.len())
            .map(|place| {
                let step = 2e-3;
                let moved = |by: f32| {
                    let mut gaussians = start.clone();
                    *parameter(&mut gaussians, place) += by;
                    objective(&engine, &gaussians)
                };
                (moved(step) - moved(-step)) / (2.0 * f64::from(step))
            })
            .collect();
        let mut first = 0;
        for (class, width) in
            [("means", 3), ("rotations", 4), ("log scales", 3), ("opacities", 1), ("sh", 12)]
        {
            let range = first..first + width * start.len();
            first = range.end;
            let (ours, theirs) = (&analytic[range.clone()], &numeric[range]);
            let error: f64 = ours.iter().zip(theirs).map(|(&a, n)| (f64::from(a) - n).powi(2)).sum();
            let size: f64 = theirs.iter().map(|n| n * n).sum();
            let share = (error / size).sqrt();
            assert!(share < 0.01, "{}: {class} off by {share}", instructions.set());
        }
        assert_eq!(first, analytic.len());
    }
}

/// The parameter behind entry `place` of [`flat`].
fn parameter(gaussians: &mut Gaussians, place: usize) -> &mut f32 {
    let Gaussians { means, rotations, log_scales, logit_opacities, sh, .. } = gaussians;
    let mut place = place;
    for class in [means.as_flattened_mut(), rotations.as_flattened_mut(), log_scales.as_flattened_mut()] {
        if place < class.len() {
            return &mut class[place];
        }
        place -= class.len();
    }
    if place < logit_opacities.len() {
        return &mut logit_opacities[place];
    }
    &mut sh[place - logit_opacities.len()]
}

#[test]
fn a_footprint_that_covers_the_image_from_far_outside_is_drawn() {
    let camera = &arc(1, 33, 21)[0];
    let mut gaussians = blobs(1, 5);
    gaussians.log_scales[0] = [6.0; 3];
    gaussians.logit_opacities[0] = 0.0;
    for offset in [10.0, 100.0] {
        gaussians.means[0] = [offset, 0.0, 0.0];
        let rendering = render(&gaussians, camera, BLACK);
        assert!(
            rendering.alpha.iter().all(|&alpha| alpha > 0.1),
            "offset {offset}: {:?}",
            rendering.alpha[0]
        );
    }
}

#[test]
fn a_pixel_stops_before_the_footprint_that_would_leave_less_than_the_least() {
    let camera = &arc(1, 1, 1)[0];
    let mut gaussians = blobs(40, 6);
    gaussians.means.fill([0.0; 3]);
    gaussians.log_scales.fill([3.0; 3]);
    gaussians.logit_opacities.fill(0.0);
    let rendering = render(&gaussians, camera, BLACK);
    // Halved thirteen times; the fourteenth would leave 6.1e-5.
    let left = 1.0 - rendering.alpha[0];
    assert!((left - 0.5_f32.powi(13)).abs() < 1e-6, "{left}");
}

#[test]
fn frozen_gaussians_leave_the_gradients_of_the_others_as_they_are() {
    let (gaussians, camera) = (blobs(200, 51), &arc(3, 70, 45)[2]);
    let frozen = |index: usize| index.is_multiple_of(3);
    let seeds = seeds(3 * 70 * 45);
    let gradients = |active: &[bool]| {
        let mut pass = Pass::default();
        let mut image = Image::filled(70, 45, BLACK);
        let degree = gaussians.sh_degree;
        pass.project(&gaussians, camera, degree);
        pass.bin(camera, &mut Vec::new());
        pass.blend(camera, BLACK, active, &mut image, &mut []);
        pass.blend_backward(camera, BLACK, &seeds, &[]);
        let mut gradients = GaussianGradients::zeros(&gaussians);
        pass.project_backward(&gaussians, camera, degree, &mut gradients);
        gradients
    };
    let all = gradients(&[]);
    let some = gradients(&(0..200).map(|index| !frozen(index)).collect::<Vec<_>>());
    for index in 0..200 {
        let expected = if frozen(index) { [0.0; 3] } else { all.means[index] };
        // Sums are taken four footprints at a time, each in its own lanes: who else is among the four changes nothing.
        assert_eq!(some.means[index], expected, "Gaussian {index}");
    }
}

#[test]
fn more_gaussians_than_a_chunk_are_drawn_and_differentiated_as_their_permutation() {
    let (gaussians, camera) = (blobs(1100, 52), &arc(3, 70, 45)[1]);
    let order: Vec<usize> = (0..1100).map(|place| (place * 7 + 3) % 1100).collect();
    let permuted = gaussians.select(&order);
    let (a, b) = (render(&gaussians, camera, BLACK), render(&permuted, camera, BLACK));
    assert_eq!(a.image, b.image);
    let seeds = seeds(3 * 70 * 45);
    let engine = CpuEngine::default();
    let a = engine.render_backward(&gaussians, camera, BLACK, &seeds, &[]);
    let b = engine.render_backward(&permuted, camera, BLACK, &seeds, &[]);
    for (place, &index) in order.iter().enumerate() {
        assert_eq!(a.means[index], b.means[place]);
        assert_eq!(a.rotations[index], b.rotations[place]);
        assert_eq!(a.sh[12 * index..12 * index + 12], b.sh[12 * place..12 * place + 12]);
    }
}

/// Image, alpha and gradient of a pass whose rounds hold no more than `limit`.
fn in_rounds(gaussians: &Gaussians, limit: RoundLimit, instructions: Instructions) -> (Vec<f32>, Vec<f32>) {
    let camera = &arc(3, 70, 45)[1];
    let background = [0.3, 0.2, 0.1];
    let seeds = seeds(3 * 70 * 45);
    let mut pass = Pass::new(instructions);
    pass.limit = limit;
    let mut image = Image::filled(70, 45, BLACK);
    let mut alpha = vec![0.0; 70 * 45];
    let degree = gaussians.sh_degree;
    pass.forward(gaussians, camera, degree, background, &mut image, &mut alpha);
    pass.blend_backward(camera, background, &seeds, &seeds[..70 * 45]);
    let mut gradients = GaussianGradients::zeros(gaussians);
    pass.project_backward(gaussians, camera, degree, &mut gradients);
    ([image.pixels, alpha].concat(), flat(&gradients))
}

#[test]
fn rounds_of_any_size_give_the_same_bytes() {
    // Giants that fill the image, faint in one set so that no pixel stops and opaque in the other so that all do, before
    // the last of the smaller ones.
    let scene = |logit: f32| {
        let mut gaussians = blobs(600, 61);
        for index in (0..600).step_by(3) {
            gaussians.log_scales[index] = [2.0; 3];
            gaussians.logit_opacities[index] = logit;
        }
        gaussians
    };
    let small = [(1 << 16, 40), (100, 1 << 18), (64, 300), (1, 1 << 18)];
    for (gaussians, instructions) in [-5.0, 1.0]
        .into_iter()
        .flat_map(|logit| Instructions::available().map(move |set| (scene(logit), set)))
    {
        let whole = in_rounds(&gaussians, RoundLimit::default(), instructions);
        for (footprints, places) in small {
            let parts = in_rounds(&gaussians, RoundLimit { footprints, places }, instructions);
            assert!(parts == whole, "{footprints} footprints or {places} places at {}", instructions.set());
        }
    }
}

#[test]
fn a_stripe_whose_mean_is_out_of_single_precisions_squares_is_drawn() {
    let camera = &arc(1, 64, 48)[0];
    let mut gaussians = blobs(1, 5);
    gaussians.means[0] = [0.0, 2e18, 0.0];
    gaussians.rotations[0] = [1.0, 0.0, 0.0, 0.0];
    gaussians.log_scales[0] = [-2.0, 42.0, -2.0];
    gaussians.logit_opacities[0] = 2.0;
    let rendering = render(&gaussians, camera, BLACK);
    assert!(rendering.alpha[24 * 64 + 32] > 0.1, "{}", rendering.alpha[24 * 64 + 32]);
    assert!(rendering.alpha[24 * 64 + 2] < 0.01);
}

#[test]
fn a_camera_without_pixels_is_refused() {
    for (width, height) in [(0, 17), (17, 0)] {
        let mut camera = arc(1, 17, 17)[0].clone();
        (camera.width, camera.height) = (width, height);
        let refused = CpuEngine::default().render(&blobs(3, 1), &camera, BLACK);
        assert!(matches!(refused, Err(EngineError::InvalidInput(_))), "{width}x{height}");
    }
}

#[test]
fn a_replacement_that_does_not_fit_is_refused() {
    let truth = blobs(10, 9);
    let mut session = CpuEngine::default().session(input(truth.clone(), &truth)).unwrap();
    assert!(session.replace(truth.select(&[0]), &[Some(99)]).is_err());
    let other = Gaussians { sh: vec![0.0; 3], sh_degree: 0, ..truth.select(&[0]) };
    assert!(session.replace(other, &[None]).is_err());
    assert!(session.step(0, &RATES).is_ok(), "the session goes on");
}
