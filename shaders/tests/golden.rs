//! The GPU engine against dense float64 references.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod support;

use splat::engine::Engine;
use splat_shaders::GpuEngine;
use support::engine;
use trackersplat_tests::golden::{Golden, largest_difference};

const SCENES: [&str; 7] = ["basic", "degree0", "needles", "opaque", "near", "faint", "unnormalised"];

const IMAGE_TOLERANCE: f64 = 2e-5;

fn for_each_golden(check: impl Fn(&str, &Golden, &GpuEngine)) {
    let Some(engine) = engine() else { return };
    for scene in SCENES {
        for camera in 0..2 {
            let name = format!("raster_{scene}_cam{camera}");
            check(&name, &Golden::open(&name), engine);
        }
    }
}

fn wide(values: &[f32]) -> impl Iterator<Item = f64> + '_ {
    values.iter().map(|&value| f64::from(value))
}

fn background(golden: &Golden) -> [f32; 3] {
    std::array::from_fn(|channel| golden.values("background")[channel] as f32)
}

#[test]
fn images_match_the_dense_reference() {
    for_each_golden(|name, golden, engine| {
        let rendering = engine.render(&golden.gaussians(), &golden.camera(), background(golden)).unwrap();
        let image = largest_difference(wide(&rendering.image.pixels), golden.values("image"));
        let alpha = largest_difference(wide(&rendering.alpha), golden.values("alpha"));
        println!("{name}: image {image:.1e}, alpha {alpha:.1e}");
        assert!(image < IMAGE_TOLERANCE, "{name}: image differs by {image:e}");
        assert!(alpha < IMAGE_TOLERANCE, "{name}: alpha differs by {alpha:e}");
    });
}
