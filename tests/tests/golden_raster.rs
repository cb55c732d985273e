//! The rasterizer and its gradients against dense float64 references.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

use splat::{engine::Engine, raster::CpuEngine, simd::Instructions, tracking::TrackField};
use trackersplat_tests::golden::{Golden, largest_difference, relative_norm};

const SCENES: [&str; 7] = ["basic", "degree0", "needles", "opaque", "near", "faint", "unnormalised"];

/// Single precision carries a pixel's few hundred blends to about 1e-6; the bound leaves room for one pixel whose
/// alpha rounds across the cut-off at a transmittance of one percent.
const IMAGE_TOLERANCE: f64 = 2e-5;

/// Relative norm per gradient array in single precision.
const GRADIENT_TOLERANCE: f64 = 1e-4;

/// Every scene with every instruction set of this machine.
fn for_each_golden(check: impl Fn(&str, &Golden, CpuEngine)) {
    for scene in SCENES {
        for camera in 0..2 {
            let name = format!("raster_{scene}_cam{camera}");
            let golden = Golden::open(&name);
            for instructions in Instructions::available() {
                check(&format!("{name} {}", instructions.set()), &golden, CpuEngine::new(instructions));
            }
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
        let gradients = engine.render_backward(
            &golden.gaussians(),
            &golden.camera(),
            background(golden),
            &image_seed,
            &alpha_seed,
        );
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

#[test]
fn blending_weights_of_a_footprint_match() {
    for_each_golden(|name, golden, engine| {
        let camera = golden.camera();
        let pixels = camera.width as usize * camera.height as usize;
        let tracks = TrackField {
            width: camera.width,
            height: camera.height,
            positions: vec![[0.0; 2]; pixels],
            visible: vec![true; pixels],
            sigma: vec![1.0; pixels],
        };
        let moments = engine.footprint_moments(&golden.gaussians(), &camera, &tracks, None).unwrap();
        let error = relative_norm(moments.iter().map(|m| m.blend_weight), golden.values("weight_sum"));
        assert!(error < 1e-5, "{name}: weights off by {error:e}");
    });
}

#[test]
fn footprint_moments_match_on_every_track_field() {
    for field in ["affine", "noisy", "bent"] {
        let golden = Golden::open(&format!("motion_{field}"));
        let camera = golden.camera();
        let tracks = TrackField {
            width: camera.width,
            height: camera.height,
            positions: golden
                .values("track")
                .chunks_exact(2)
                .map(|xy| [xy[0] as f32, xy[1] as f32])
                .collect(),
            visible: vec![true; camera.width as usize * camera.height as usize],
            sigma: vec![1.0; camera.width as usize * camera.height as usize],
        };
        let moments =
            CpuEngine::default().footprint_moments(&golden.gaussians(), &camera, &tracks, None).unwrap();
        let golden_pixels = golden.values("pixel_count");
        for (index, found) in moments.iter().enumerate() {
            assert_eq!(f64::from(found.pixels), golden_pixels[index], "{field}: pixels of Gaussian {index}");
            if found.pixels == 0 {
                continue;
            }
            let central = &golden.values("central_moments")[8 * index..8 * index + 8];
            let ours = [found.source.as_slice(), &found.cross, &[found.target]].concat();
            // Alpha is single precision (1e-6) and tracks are rounded to f32 (4e-6 px): relative to the
            // footprint's own spread, plus that rounding on a footprint of one pixel.
            let scale = central.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
            let error = largest_difference(ours, central);
            assert!(
                error < 1e-5 * scale + 1e-5 * found.weight,
                "{field}: moments of {index} off by {error:e}"
            );
            for (ours, name) in [(found.centroid, "centroid"), (found.tracked_centroid, "tracked_centroid")] {
                let error = largest_difference(ours, &golden.values(name)[2 * index..2 * index + 2]);
                assert!(error < 2e-5, "{field}: {name} of {index} off by {error:e} px");
            }
        }
    }
}
