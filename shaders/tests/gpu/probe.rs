//! Stages of a step run apart.

use std::sync::Arc;

use splat::{
    engine::{SessionInput, TrainingView},
    image::Image,
};
use splat_shaders::{Probe, Stage};

use crate::support::{arc, blobs, engine, rough_tracks};

#[test]
fn every_stage_runs_as_often_as_it_is_told() {
    let Some(gpu) = engine() else { return };
    let camera = arc(1, 70, 45).swap_remove(0);
    let tracks = rough_tracks(&camera, 11.0, 1);
    let image = Arc::new(Image::filled(70, 45, [0.5; 3]));
    let input = SessionInput {
        gaussians: blobs(400, 2, 71),
        views: vec![TrainingView { camera, image, mask: None }],
        background: [0.0; 3],
        dssim_weight: 0.2,
        frozen: Vec::new(),
    };
    let probe = Probe::new(gpu, input, &tracks).unwrap();
    let intersections = probe.intersections().unwrap();
    assert!(intersections > 400, "{intersections}");
    for stage in Stage::ALL {
        for times in [1, 5] {
            let seconds = probe.run(stage, times).unwrap();
            println!("{}: {seconds:?}", stage.name());
            // A device without a clock says nothing.
            let is_sound = |seconds: &Vec<f64>| {
                seconds.len() == times as usize && seconds.iter().all(|second| (0.0..60.0).contains(second))
            };
            assert!(seconds.as_ref().is_none_or(is_sound), "{}: {seconds:?}", stage.name());
        }
    }
    // The optimiser stood still: the same Gaussians reach the same tiles.
    assert_eq!(probe.intersections().unwrap(), intersections);
}
