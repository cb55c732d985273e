//! The rasterizer and its gradients against dense float64 references.

use splat::{raster::CpuEngine, simd::Instructions};
use trackersplat_tests::golden::{Golden, check_moments, for_each_scene};

/// Every scene with every instruction set of this machine.
fn for_each_golden(check: impl Fn(&str, &Golden, &CpuEngine)) {
    for_each_scene(|name, golden| {
        for instructions in Instructions::available() {
            check(&format!("{name} {}", instructions.set()), golden, &CpuEngine::new(instructions));
        }
    });
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
        golden.check_gradients(name, gradients);
    });
}

#[test]
fn blending_weights_of_a_footprint_match() {
    for_each_golden(|name, golden, engine| golden.check_blending_weights(name, engine));
}

#[test]
fn footprint_moments_match_on_every_track_field() {
    for instructions in Instructions::available() {
        check_moments(&CpuEngine::new(instructions));
    }
}
