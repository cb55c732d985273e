//! The GPU engine against dense float64 references.
use crate::support::engine;
use splat::engine::Engine;
use splat_shaders::GpuEngine;
use trackersplat_tests::golden::{Golden, largest_difference, relative_norm};

const SCENES: [&str; 7] = ["basic", "degree0", "needles", "opaque", "near", "faint", "unnormalised"];

/// That of the CPU engine, which has the same reason: single precision carries a pixel's few hundred blends to about 1e-6,
/// and one pixel's alpha may round across the cut-off at a transmittance of one percent.
const IMAGE_TOLERANCE: f64 = 2e-5;

/// Relative norm per gradient array, as for the CPU engine.
const GRADIENT_TOLERANCE: f64 = 1e-4;

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

#[test]
fn gradients_match_automatic_differentiation() {
    for_each_golden(|name, golden, engine| {
        let image_seed: Vec<f32> = golden.values("seed_image").iter().map(|&value| value as f32).collect();
        let alpha_seed: Vec<f32> = golden.values("seed_alpha").iter().map(|&value| value as f32).collect();
        let gradients = engine
            .render_backward(
                &golden.gaussians(),
                &golden.camera(),
                background(golden),
                &image_seed,
                &alpha_seed,
            )
            .unwrap();
        let arrays: [(&str, Vec<f32>); 5] = [
            ("mean", gradients.means.into_flattened()),
            ("rotation", gradients.rotations.into_flattened()),
            ("log_scale", gradients.log_scales.into_flattened()),
            ("logit_opacity", gradients.logit_opacities),
            ("sh", gradients.sh),
        ];
        for (array, ours) in arrays {
            let error = relative_norm(wide(&ours), golden.values(&format!("grad_{array}")));
            println!("{name}: {array} {error:.1e}");
            assert!(error < GRADIENT_TOLERANCE, "{name}: gradient by {array} off by {error:e}");
        }
    });
}
