//! The GPU engine against dense float64 references, by the tolerances of the CPU engine.
use splat_shaders::GpuEngine;
use trackersplat_tests::golden::{Golden, check_moments, for_each_scene};

use crate::support::engines;

fn for_each_golden(check: impl Fn(&str, &Golden, &GpuEngine)) {
    for engine in engines() {
        for_each_scene(|name, golden| check(name, golden, engine));
    }
}

#[test]
fn images_match_the_dense_reference() {
    for_each_golden(|name, golden, engine| golden.check_image(name, engine));
}

#[test]
fn gradients_match_automatic_differentiation() {
    for_each_golden(|name, golden, engine| {
        let [image, alpha] = golden.seeds();
        let (gaussians, camera) = (golden.gaussians(), golden.camera());
        let gradients = engine.render_backward(&gaussians, &camera, golden.background(), &image, &alpha);
        golden.check_gradients(name, gradients.unwrap());
    });
}

#[test]
fn blending_weights_of_a_footprint_match() {
    for_each_golden(|name, golden, engine| golden.check_blending_weights(name, engine));
}

#[test]
fn footprint_moments_match_on_every_track_field() {
    engines().for_each(|engine| check_moments(engine));
}
