//! A device that goes away.

use std::sync::Arc;

use splat::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    image::Image,
    optim::LearningRates,
};

use super::support::{arc, blobs, engine, open};
use crate::GpuEngine;

const BLACK: [f32; 3] = [0.0; 3];

const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 1e-3,
    log_scale: 1e-3,
    logit_opacity: 1e-3,
    sh_dc: 1e-3,
    sh_rest: 1e-3,
    sh_degree: 0,
};

#[test]
fn a_lost_device_is_an_error_of_its_own() {
    if engine().is_none() {
        return;
    }
    // Not the one that other tests use.
    let doomed = GpuEngine::new(open()).unwrap();
    let camera = arc(1, 17, 13).swap_remove(0);
    let image = Arc::new(Image::filled(17, 13, BLACK));
    let mut session = doomed
        .session(SessionInput {
            gaussians: blobs(10, 0, 1),
            views: vec![TrainingView { camera: camera.clone(), image, mask: None }],
            background: BLACK,
            dssim_weight: 0.2,
            frozen: Vec::new(),
        })
        .unwrap();
    session.step(0, &RATES).unwrap();
    doomed.context.device.device.destroy();
    // A step only submits: what became of it shows where something is read back.
    let outcome = session.step(0, &RATES).and_then(|()| session.take_losses());
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    let outcome = session.gaussians();
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    let outcome = doomed.render(&blobs(10, 0, 1), &camera, BLACK);
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
}
