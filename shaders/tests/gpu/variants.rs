//! Forms of the kernels with and without optional features give the same bytes.

use std::sync::Arc;

use splat::{
    engine::{Engine, SessionInput, TrainingView},
    image::Image,
    motion::reweighting::Reweighting,
    optim::LearningRates,
};
use splat_shaders::GpuEngine;

use crate::support::{arc, blobs, engine, other_engine, rough_tracks, seeds};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

fn assert_same_bytes<T: PartialEq>(found: impl Fn(&GpuEngine) -> T) {
    let (Some(engine), Some(other)) = (engine(), other_engine()) else { return };
    assert_ne!(engine.device().uses_subgroups(), other.device().uses_subgroups());
    assert!(found(engine) == found(other), "the forms differ");
}

#[test]
fn subgroups_change_no_byte_of_images_and_gradients() {
    // Lists of a few and of some ten thousand intersections: one block of the sort and many.
    for (count, width, height) in [(1, 17, 13), (400, 64, 45), (6000, 200, 170)] {
        let (gaussians, camera) = (blobs(count, 1, 70), arc(1, width, height).swap_remove(0));
        assert_same_bytes(|engine| {
            let drawn = engine.render(&gaussians, &camera, BACKGROUND).unwrap();
            (drawn.image.pixels, drawn.alpha)
        });
        let seeds = seeds(3 * (width * height) as usize);
        assert_same_bytes(|engine| {
            let gradients = engine.render_backward(&gaussians, &camera, BACKGROUND, &seeds, &[]).unwrap();
            (gradients.means, gradients.rotations, gradients.log_scales, gradients.sh)
        });
    }
}

#[test]
fn subgroups_change_no_byte_of_moments() {
    let reweighting = Reweighting { passes: 2, noise_correlation_area: 1.0, noise_floor: 0.05 };
    let camera = &arc(3, 200, 170)[1];
    let (gaussians, tracks) = (blobs(2000, 1, 71), rough_tracks(camera, 11.0, 71));
    assert_same_bytes(|engine| {
        engine.footprint_moments(&gaussians, camera, &tracks, Some(&reweighting)).unwrap()
    });
}

#[test]
fn subgroups_change_no_byte_of_a_session() {
    let rates = LearningRates {
        mean: 1e-3,
        rotation: 1e-3,
        log_scale: 5e-3,
        logit_opacity: 0.05,
        sh_dc: 5e-3,
        sh_rest: 1e-4,
        sh_degree: 1,
    };
    let camera = arc(1, 90, 60).swap_remove(0);
    assert_same_bytes(|engine| {
        let image = Arc::new(Image::filled(90, 60, [0.5, 0.25, 0.75]));
        let mut session = engine
            .session(SessionInput {
                gaussians: blobs(1500, 1, 72),
                views: vec![TrainingView { camera: camera.clone(), image, mask: None }],
                background: BACKGROUND,
                dssim_weight: 0.2,
                frozen: Vec::new(),
            })
            .unwrap();
        (0..8).for_each(|_| session.step(0, &rates).unwrap());
        (session.gaussians().unwrap(), session.take_losses().unwrap())
    });
}
