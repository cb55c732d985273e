//! Optimisation sessions of the GPU engine beside those of the CPU engine.
use std::sync::Arc;

use splat_shaders::GpuEngine;

use crate::support::{arc, blobs, engine, open};
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::Gaussians,
    image::{Image, Mask},
    optim::LearningRates,
    raster::CpuEngine,
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

/// Views of three sizes, as a rig has them, one of them in 8 bits.
fn input(gaussians: Gaussians, truth: &Gaussians) -> SessionInput {
    let sizes = [(48, 31), (33, 40), (16, 16)];
    let views = sizes.iter().enumerate().map(|(number, &(width, height))| {
        let camera = arc(3, width, height).swap_remove(number);
        let mut image = CpuEngine::default().render(truth, &camera, BLACK).unwrap().image;
        if number == 0 {
            // As from an 8-bit file.
            image.pixels = image.to_rgb8().into_iter().map(|byte| f32::from(byte) / 255.0).collect();
        }
        TrainingView { image: Arc::new(image), camera, mask: None }
    });
    SessionInput {
        gaussians,
        views: views.collect(),
        background: BLACK,
        dssim_weight: 0.2,
        frozen: Vec::new(),
    }
}

fn optimised(engine: &dyn Engine, input: SessionInput, steps: usize) -> (Gaussians, Vec<f32>) {
    let mut session = engine.session(input).unwrap();
    for step in 0..steps {
        session.step(step % 3, &RATES).unwrap();
    }
    (session.gaussians().unwrap(), session.take_losses().unwrap())
}

fn flat(gaussians: &Gaussians) -> [(&'static str, &[f32], f32); 5] {
    [
        ("means", gaussians.means.as_flattened(), RATES.mean),
        ("rotations", gaussians.rotations.as_flattened(), RATES.rotation),
        ("log scales", gaussians.log_scales.as_flattened(), RATES.log_scale),
        ("opacities", &gaussians.logit_opacities, RATES.logit_opacity),
        ("sh", &gaussians.sh, RATES.sh_dc),
    ]
}

/// Adam divides the gradient by its size, so that a parameter whose gradient is all rounding may go either way; few are.
fn assert_parameters_close(ours: &Gaussians, theirs: &Gaussians) {
    for ((name, ours, rate), (_, theirs, _)) in flat(ours).into_iter().zip(flat(theirs)) {
        let off = ours.iter().zip(theirs).filter(|(a, b)| (*a - *b).abs() > 0.02 * rate).count();
        println!("{name}: {off} of {} off by more than 2 % of a step", ours.len());
        assert!(100 * off <= ours.len(), "{name}: {off} of {} went another way", ours.len());
    }
}

fn assert_losses_close(ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert!((ours - theirs).abs() < 1e-4 * theirs, "loss {ours}, the CPU engine has {theirs}");
    }
}

#[test]
fn a_session_goes_the_way_of_the_cpu_session() {
    let Some(gpu) = engine() else { return };
    let (start, truth) = (blobs(300, 1, 1), blobs(300, 1, 2));
    let (ours, our_losses) = optimised(gpu, input(start.clone(), &truth), 12);
    let (theirs, their_losses) = optimised(&CpuEngine::default(), input(start, &truth), 12);
    assert_losses_close(&our_losses, &their_losses);
    assert_parameters_close(&ours, &theirs);
}

#[test]
fn masks_frozen_gaussians_and_lower_degrees_are_those_of_the_cpu_session() {
    let Some(gpu) = engine() else { return };
    let (start, truth) = (blobs(120, 2, 3), blobs(120, 2, 4));
    let made = || {
        let mut input = input(start.clone(), &truth);
        input.frozen = (0..120).map(|index| index % 3 == 0).collect();
        for view in &mut input.views {
            let (width, height) = (view.camera.width, view.camera.height);
            let inside = (0..width * height).map(|pixel| pixel % width > width / 3).collect();
            view.mask = Some(Arc::new(Mask { width, height, inside }));
        }
        // Nothing counts in this one: a step on it changes nothing by its gradient.
        let (width, height) = (input.views[2].camera.width, input.views[2].camera.height);
        let inside = vec![false; (width * height) as usize];
        input.views[2].mask = Some(Arc::new(Mask { width, height, inside }));
        input
    };
    let (ours, our_losses) = optimised(gpu, made(), 6);
    let (theirs, their_losses) = optimised(&CpuEngine::default(), made(), 6);
    assert_eq!([our_losses[2], our_losses[5]], [0.0; 2]);
    for place in [0, 1, 3, 4] {
        assert_losses_close(&our_losses[place..place + 1], &their_losses[place..place + 1]);
    }
    assert_parameters_close(&ours, &theirs);
    for index in (0..120).step_by(3) {
        assert_eq!(ours.select(&[index]), start.select(&[index]), "frozen Gaussian {index}");
    }
    // Harmonics above the degree that is optimised stay.
    for index in 0..120 {
        assert_eq!(ours.sh_of(index)[12..], start.sh_of(index)[12..]);
    }
}

#[test]
fn two_runs_give_the_same_bytes() {
    let Some(gpu) = engine() else { return };
    let (start, truth) = (blobs(200, 1, 5), blobs(200, 1, 6));
    let run = || optimised(gpu, input(start.clone(), &truth), 7);
    assert_eq!(run(), run());
}

#[test]
fn views_with_more_intersections_than_there_is_room_for_are_repeated() {
    let Some(gpu) = engine() else { return };
    let (mut start, truth) = (blobs(700, 1, 7), blobs(50, 1, 8));
    // Every one of them reaches every tile: 6300 intersections in the larger views, there is room for 4096. The small view
    // in between fits, and must not be repeated or left out.
    start.log_scales.fill([0.5, 0.8, 0.2]);
    start.logit_opacities.fill(-4.0);
    let order = [2, 0, 2, 1, 2, 0];
    let run = |engine: &dyn Engine| {
        let mut session = engine.session(input(start.clone(), &truth)).unwrap();
        for view in order {
            session.step(view, &RATES).unwrap();
        }
        let losses = session.take_losses().unwrap();
        (session.gaussians().unwrap(), losses)
    };
    let (ours, our_losses) = run(gpu);
    let (theirs, their_losses) = run(&CpuEngine::default());
    assert_losses_close(&our_losses, &their_losses);
    assert_parameters_close(&ours, &theirs);
}

#[test]
fn losses_wait_until_they_are_taken() {
    let Some(gpu) = engine() else { return };
    let truth = blobs(3, 0, 9);
    let mut session = gpu.session(input(blobs(3, 0, 10), &truth)).unwrap();
    assert!(session.take_losses().unwrap().is_empty());
    // More than the device remembers at a time.
    for _ in 0..300 {
        session.step(2, &RATES).unwrap();
    }
    let losses = session.take_losses().unwrap();
    assert_eq!(losses.len(), 300);
    assert!(losses.iter().all(|loss| loss.is_finite() && *loss > 0.0));
    assert!(session.take_losses().unwrap().is_empty());
}

#[test]
fn replaced_gaussians_keep_the_moments_of_their_sources() {
    let Some(gpu) = engine() else { return };
    let (start, truth) = (blobs(60, 1, 11), blobs(60, 1, 12));
    // Each old Gaussian once at most: which of two equal ones is in front is a matter of rounding after a step.
    let source: Vec<_> = (0..50).map(|index| (index % 4 != 3).then_some((index * 7) % 60)).collect();
    let run = |engine: &dyn Engine| {
        let mut input = input(start.clone(), &truth);
        input.frozen = (0..60).map(|index| index % 5 == 0).collect();
        let mut session = engine.session(input).unwrap();
        for step in 0..3 {
            session.step(step, &RATES).unwrap();
        }
        let before = session.take_density_statistics().unwrap();
        let grown = session.gaussians().unwrap();
        let places: Vec<_> = (0..50).map(|index| (index * 7) % 60).collect();
        session.replace(grown.select(&places), &source).unwrap();
        for step in 0..3 {
            session.step(step, &RATES).unwrap();
        }
        let after = session.take_density_statistics().unwrap();
        (session.gaussians().unwrap(), session.take_losses().unwrap(), before, after)
    };
    let (ours, our_losses, our_before, our_after) = run(gpu);
    let (theirs, their_losses, their_before, their_after) = run(&CpuEngine::default());
    assert_losses_close(&our_losses, &their_losses);
    assert_parameters_close(&ours, &theirs);
    for (ours, theirs) in [(our_before, their_before), (our_after, their_after)] {
        assert_eq!(ours.visible_steps, theirs.visible_steps);
        for (index, (ours, theirs)) in ours.gradient_norm.iter().zip(&theirs.gradient_norm).enumerate() {
            // The CPU engine takes no gradient for those that are frozen.
            assert!((ours - theirs).abs() <= 1e-3 * theirs || *theirs == 0.0, "{index}: {ours}, {theirs}");
        }
    }
}

#[test]
fn a_session_refuses_what_does_not_fit() {
    let Some(gpu) = engine() else { return };
    let truth = blobs(5, 1, 13);
    let refused = |change: &dyn Fn(&mut SessionInput)| {
        let mut input = input(truth.clone(), &truth);
        change(&mut input);
        matches!(gpu.session(input).err(), Some(EngineError::InvalidInput(_)))
    };
    assert!(refused(&|input| input.views.clear()), "no view");
    assert!(refused(&|input| input.frozen = vec![true]), "flags for other Gaussians");
    assert!(refused(&|input| input.views[0].image = Arc::new(Image::filled(3, 3, BLACK))), "another size");
    assert!(refused(&|input| input.gaussians.means[2][1] = f32::NAN), "a NaN");
    let mut session = gpu.session(input(truth.clone(), &truth)).unwrap();
    assert!(session.step(3, &RATES).is_err(), "no such view");
    assert!(session.replace(truth.clone(), &[]).is_err(), "sources of other Gaussians");
    assert!(session.replace(truth.select(&[0]), &[Some(99)]).is_err(), "no such source");
    let flat = Gaussians { sh: vec![0.0; 3], sh_degree: 0, ..truth.select(&[0]) };
    assert!(session.replace(flat, &[None]).is_err(), "another degree");
    assert!(session.step(0, &RATES).is_ok(), "the session goes on");
    assert_eq!(session.take_losses().unwrap().len(), 1);
}

#[test]
fn an_empty_set_takes_steps() {
    let Some(gpu) = engine() else { return };
    let truth = blobs(5, 1, 14);
    let mut session = gpu.session(input(Gaussians::empty(1), &truth)).unwrap();
    session.step(0, &RATES).unwrap();
    assert!(session.gaussians().unwrap().is_empty());
    session.replace(truth.clone(), &[None; 5]).unwrap();
    session.step(1, &RATES).unwrap();
    let losses = session.take_losses().unwrap();
    assert!(losses[1] < 1e-5 && losses[0] > 0.01, "{losses:?}");
    session.replace(Gaussians::empty(1), &[]).unwrap();
    session.step(2, &RATES).unwrap();
    assert!(session.take_density_statistics().unwrap().gradient_norm.is_empty());
}

#[test]
fn what_does_not_fit_is_refused_with_figures() {
    let Some(_) = engine() else { return };
    // Parameters, optimiser state and gradients of 5000 Gaussians of degree 3 alone are 5 MB.
    let limited = GpuEngine::new(open().with_memory_limit(5_000_000)).unwrap();
    let truth = blobs(3, 3, 15);
    match limited.session(input(blobs(5000, 3, 16), &truth)).err() {
        Some(EngineError::OutOfResources { needed, available }) => {
            assert!((5_000_000..20_000_000).contains(&needed), "{needed}");
            assert_eq!(available, 5_000_000);
        }
        other => panic!("{other:?}"),
    }
    let mut session = limited.session(input(blobs(100, 3, 17), &truth)).unwrap();
    session.step(0, &RATES).unwrap();
    let refused = session.replace(blobs(5000, 3, 18), &vec![None; 5000]).err();
    assert!(matches!(refused, Some(EngineError::OutOfResources { .. })), "{refused:?}");
    session.step(1, &RATES).unwrap();
    assert_eq!(session.take_losses().unwrap().len(), 2, "the session goes on with what it had");
    // Intersections, not Gaussians, are too many: known only once the device has counted them.
    let mut giants = blobs(300, 0, 19);
    giants.log_scales.fill([3.0; 3]);
    let refused = limited.render(&giants, &arc(1, 512, 512)[0], BLACK).err();
    assert!(matches!(refused, Some(EngineError::OutOfResources { .. })), "{refused:?}");
}

#[test]
fn a_session_that_runs_out_of_room_says_so_every_time() {
    let Some(_) = engine() else { return };
    let limited = GpuEngine::new(open().with_memory_limit(12_000_000)).unwrap();
    let camera = arc(1, 320, 320).swap_remove(0);
    let small = arc(1, 16, 16).swap_remove(0);
    let view = |camera: Camera| TrainingView {
        image: Arc::new(Image::filled(camera.width, camera.height, BLACK)),
        camera,
        mask: None,
    };
    // 400 tiles each in the large view, one in the small.
    let mut giants = blobs(700, 0, 20);
    giants.log_scales.fill([3.0; 3]);
    let mut session = limited
        .session(SessionInput {
            gaussians: giants,
            views: vec![view(small), view(camera)],
            background: BLACK,
            dssim_weight: 0.2,
            frozen: Vec::new(),
        })
        .unwrap();
    for step in [0, 0, 1, 0] {
        session.step(step, &RATES).unwrap();
    }
    for _ in 0..3 {
        let refused = session.take_losses().err();
        assert!(matches!(refused, Some(EngineError::OutOfResources { .. })), "{refused:?}");
    }
}
