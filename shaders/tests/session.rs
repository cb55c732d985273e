//! Optimisation sessions of the GPU engine beside those of the CPU engine.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod support;

use std::sync::Arc;

use splat::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::Gaussians,
    image::{Image, Mask},
    optim::LearningRates,
    raster::CpuEngine,
};
use support::{arc, blobs, engine};

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

/// Views of three sizes, as a rig has them.
fn input(gaussians: Gaussians, truth: &Gaussians) -> SessionInput {
    let sizes = [(48, 31), (33, 40), (16, 16)];
    let views = sizes.iter().enumerate().map(|(number, &(width, height))| {
        let camera = arc(3, width, height).swap_remove(number);
        TrainingView {
            image: Arc::new(CpuEngine::default().render(truth, &camera, BLACK).unwrap().image),
            camera,
            mask: None,
        }
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
    let losses = (0..steps).map(|step| session.step(step % 3, &RATES).unwrap().loss).collect();
    (session.gaussians().unwrap(), losses)
}

fn largest(ours: &[f32], theirs: &[f32]) -> f32 {
    ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_session_goes_the_way_of_the_cpu_session() {
    let Some(gpu) = engine() else { return };
    let (start, truth) = (blobs(300, 1, 1), blobs(300, 1, 2));
    let (ours, our_losses) = optimised(gpu, input(start.clone(), &truth), 12);
    let (theirs, their_losses) = optimised(&CpuEngine::default(), input(start, &truth), 12);
    println!("{our_losses:?}\n{their_losses:?}");
    for (ours, theirs) in our_losses.iter().zip(&their_losses) {
        assert!((ours - theirs).abs() < 1e-4 * theirs, "loss {ours}, the CPU engine has {theirs}");
    }
    for (name, ours, theirs, rate) in [
        ("means", ours.means.as_flattened(), theirs.means.as_flattened(), RATES.mean),
        ("log scales", ours.log_scales.as_flattened(), theirs.log_scales.as_flattened(), RATES.log_scale),
        ("opacities", &ours.logit_opacities, &theirs.logit_opacities, RATES.logit_opacity),
        ("sh", &ours.sh, &theirs.sh, RATES.sh_dc),
    ] {
        println!("{name} {:e} of {rate:e}", largest(ours, theirs));
    }
}
