//! Renderings of random and extreme scenes beside those of the CPU engine.

use splat::{
    cameras::Camera,
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    image::Image,
    raster::CpuEngine,
};

use crate::support::{arc, blobs, engine, seeds};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// Single precision keeps most values within 2e-5: a few units in the last place of a position in pixels, about 1e-7 of the
/// image's width, times the slope of a footprint. Where an alpha rounds across the cut-off, a transmittance across the least or
/// two depths past each other, a pixel gains or loses a footprint of 1/255, what 1e-4 lets through, or their difference.
fn assert_close(name: &str, ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len());
    let difference = |(a, b): (&f32, &f32)| (a - b).abs();
    let off = ours.iter().zip(theirs).filter(|&pair| !(difference(pair) < 2e-5)).count();
    let worst = ours.iter().zip(theirs).map(difference).fold(0.0, f32::max);
    println!("{name}: {off} of {} beyond 2e-5, worst {worst:e}", ours.len());
    assert!(off <= 6 + ours.len() / 500, "{name}: {off} of {} values differ", ours.len());
    assert!(worst < 6e-3, "{name}: a value differs by {worst}");
}

fn assert_drawn_alike(name: &str, gaussians: &Gaussians, camera: &Camera) {
    let Some(gpu) = engine() else { return };
    let ours = gpu.render(gaussians, camera, BACKGROUND).unwrap();
    let theirs = CpuEngine::default().render(gaussians, camera, BACKGROUND).unwrap();
    assert_eq!((ours.image.width, ours.image.height), (camera.width, camera.height));
    assert_close(name, &ours.image.pixels, &theirs.image.pixels);
    assert_close(name, &ours.alpha, &theirs.alpha);
}

#[test]
fn random_scenes_are_drawn_alike() {
    for seed in 0..6 {
        let mut gaussians = blobs(400 + 300 * seed as usize, seed as u32 % 4, seed);
        for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
            scales[index % 3] -= 0.05 * (index % 100) as f32;
        }
        for camera in arc(3, 64, 45) {
            assert_drawn_alike(&format!("seed {seed}"), &gaussians, &camera);
        }
    }
}

#[test]
fn odd_image_sizes_are_drawn_alike() {
    let gaussians = blobs(200, 1, 21);
    for (width, height) in [(1, 1), (17, 13), (16, 16), (15, 33), (1, 4096), (4096, 1)] {
        let mut camera = arc(1, width, height).swap_remove(0);
        camera.fx = 40.0;
        camera.fy = 40.0;
        assert_drawn_alike(&format!("{width}x{height}"), &gaussians, &camera);
    }
}

#[test]
fn more_tiles_than_a_row_of_workgroups_are_drawn_alike() {
    // 65 538 tiles below each other.
    let mut camera = arc(1, 3, 16 * 65_538).swap_remove(0);
    camera.fx = 3.0;
    let mut gaussians = blobs(60, 0, 22);
    for (index, mean) in gaussians.means.iter_mut().enumerate() {
        mean[1] = (index as f32 / 60.0 - 0.5) * 1.4e6;
    }
    camera.fy = 2.0;
    assert_drawn_alike("a column of tiles", &gaussians, &camera);
}

#[test]
fn one_gaussian_and_none_are_drawn_alike() {
    let camera = &arc(1, 17, 13)[0];
    assert_drawn_alike("one", &blobs(1, 3, 23), camera);
    let Some(gpu) = engine() else { return };
    let nothing = gpu.render(&Gaussians::empty(3), camera, BACKGROUND).unwrap();
    assert_eq!(nothing.image, Image::filled(17, 13, BACKGROUND));
    assert!(nothing.alpha.iter().all(|&alpha| alpha == 0.0));
    let seeds = seeds(3 * 17 * 13);
    let gradients = gpu.render_backward(&Gaussians::empty(3), camera, BACKGROUND, &seeds, &[]).unwrap();
    assert!(gradients.means.is_empty() && gradients.sh.is_empty());
}

#[test]
fn equal_depths_are_drawn_in_the_order_of_the_set() {
    let mut gaussians = blobs(300, 0, 24);
    for (index, mean) in gaussians.means.iter_mut().enumerate() {
        mean[2] = if index % 2 == 0 { 0.0 } else { -0.25 };
    }
    // The middle camera looks along z: half of the set has the same depth, exactly.
    assert_drawn_alike("ties", &gaussians, &arc(3, 48, 48)[1]);
}

#[test]
fn a_camera_far_from_the_origin_loses_nothing() {
    let mut gaussians = blobs(150, 1, 25);
    let far = [4096.0, -2048.0, 8192.0];
    for mean in &mut gaussians.means {
        // Steps of 1/1024 are exact at this distance.
        *mean = std::array::from_fn(|axis| (mean[axis] * 1024.0).round() / 1024.0 + far[axis]);
    }
    let mut camera = arc(3, 64, 48).swap_remove(2);
    camera.translation -= camera.rotation * glam::DVec3::from_array(far.map(f64::from));
    assert_drawn_alike("far", &gaussians, &camera);
}

#[test]
fn giants_and_needles_are_drawn_alike() {
    let mut gaussians = blobs(200, 1, 26);
    for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
        // Standard deviations from 1e-4 to 1e2 of the scene, up to 1e6 apart in one Gaussian.
        *scales = [index % 4, index / 4 % 4, index / 16 % 4].map(|place| 4.6 * (place as f32 - 2.0));
    }
    gaussians.logit_opacities.fill(-2.0);
    assert_drawn_alike("giants and needles", &gaussians, &arc(3, 40, 30)[0]);
}

#[test]
fn extreme_parameters_give_finite_images_and_gradients() {
    let Some(gpu) = engine() else { return };
    let camera = &arc(1, 40, 30)[0];
    let extremes: [fn(&mut Gaussians); 8] = [
        |g| g.log_scales[0] = [60.0, -60.0, 0.0],
        |g| g.log_scales[0] = [-80.0; 3],
        |g| g.log_scales[0] = [12.0; 3],
        |g| g.logit_opacities[0] = 1e30,
        |g| g.logit_opacities[0] = -1e30,
        |g| g.rotations[0] = [0.0; 4],
        |g| g.rotations[0] = [1e20, -1e20, 3e19, 1e-20],
        |g| g.means[0] = [1e30, -1e30, 1e30],
    ];
    for (number, change) in extremes.iter().enumerate() {
        let mut gaussians = blobs(12, 1, 11);
        change(&mut gaussians);
        let rendering = gpu.render(&gaussians, camera, BACKGROUND).unwrap();
        assert!(rendering.image.pixels.iter().all(|value| value.is_finite()), "image {number}");
        let seed = vec![1.0; rendering.image.pixels.len()];
        let gradients = gpu.render_backward(&gaussians, camera, BACKGROUND, &seed, &[]).unwrap();
        let all = gradients.means.as_flattened().iter().chain(gradients.rotations.as_flattened());
        let all = all.chain(gradients.log_scales.as_flattened()).chain(&gradients.logit_opacities);
        assert!(all.chain(&gradients.sh).all(|value| value.is_finite()), "gradient {number}");
    }
}

#[test]
fn gaussians_that_are_no_numbers_are_not_drawn() {
    let Some(gpu) = engine() else { return };
    let camera = &arc(1, 40, 30)[0];
    let whole = blobs(12, 1, 12);
    let expected = gpu.render(&whole.select(&(1..12).collect::<Vec<_>>()), camera, BACKGROUND).unwrap();
    let breaks: [fn(&mut Gaussians); 5] = [
        |g| g.means[0][0] = f32::NAN,
        |g| g.log_scales[0][1] = f32::INFINITY,
        |g| g.log_scales[0][1] = f32::NAN,
        |g| g.logit_opacities[0] = f32::NAN,
        |g| g.sh[0] = f32::NAN,
    ];
    for change in breaks {
        let mut gaussians = whole.clone();
        change(&mut gaussians);
        let image = gpu.render(&gaussians, camera, BACKGROUND).unwrap().image;
        assert_eq!(image, expected.image, "{:?}", gaussians.select(&[0]));
    }
}

#[test]
fn gradients_of_random_scenes_are_those_of_the_cpu_engine() {
    for seed in 0..4 {
        let gaussians = blobs(500, seed as u32, 30 + seed);
        assert_gradients_alike(&format!("seed {seed}"), &gaussians, &arc(3, 53, 37)[seed as usize % 3]);
    }
}

#[test]
fn gradients_of_giants_are_those_of_the_cpu_engine() {
    // Most of them reach all of 143 tiles.
    let mut gaussians = blobs(30, 1, 40);
    for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
        *scales = [0.5, 0.2 * (index % 5) as f32, 0.8];
    }
    gaussians.logit_opacities.fill(-2.0);
    assert_gradients_alike("giants", &gaussians, &arc(3, 200, 170)[0]);
}

fn assert_gradients_alike(name: &str, gaussians: &Gaussians, camera: &Camera) {
    let Some(gpu) = engine() else { return };
    let pixels = camera.width as usize * camera.height as usize;
    let image_seeds = seeds(3 * pixels);
    let alpha_seeds = &image_seeds[..pixels];
    let ours = gpu.render_backward(gaussians, camera, BACKGROUND, &image_seeds, alpha_seeds).unwrap();
    let theirs =
        CpuEngine::default().render_backward(gaussians, camera, BACKGROUND, &image_seeds, alpha_seeds);
    for (array, ours, theirs) in [
        ("means", ours.means.as_flattened(), theirs.means.as_flattened()),
        ("rotations", ours.rotations.as_flattened(), theirs.rotations.as_flattened()),
        ("log scales", ours.log_scales.as_flattened(), theirs.log_scales.as_flattened()),
        ("opacities", &ours.logit_opacities, &theirs.logit_opacities),
        ("sh", &ours.sh, &theirs.sh),
    ] {
        let square = |values: &mut dyn Iterator<Item = f32>| -> f64 {
            values.map(|value| f64::from(value).powi(2)).sum::<f64>().sqrt()
        };
        let error =
            square(&mut ours.iter().zip(theirs).map(|(a, b)| a - b)) / square(&mut theirs.iter().copied());
        println!("{name}, {array}: {error:.1e}");
        // A pixel that rounds across the cut-off changes a gradient by its share of 1/255.
        assert!(error < 1e-3, "{name}: gradient by {array} off by {error:e}");
    }
}

#[test]
fn eight_bits_are_the_rounded_rendering() {
    let Some(gpu) = engine() else { return };
    for (width, height) in [(1, 1), (17, 13), (64, 48)] {
        // Brighter than white in places.
        let mut gaussians = blobs(200, 1, 61);
        gaussians.sh.iter_mut().for_each(|value| *value *= 2.0);
        let camera = &arc(1, width, height)[0];
        let expected = gpu.render(&gaussians, camera, BACKGROUND).unwrap().image.to_rgb8();
        assert_eq!(gpu.render_rgb8(&gaussians, camera, BACKGROUND).unwrap(), expected, "{width}x{height}");
    }
}

#[test]
fn a_camera_without_pixels_is_refused() {
    let Some(gpu) = engine() else { return };
    for (width, height) in [(0, 17), (17, 0)] {
        let mut camera = arc(1, 17, 17).swap_remove(0);
        (camera.width, camera.height) = (width, height);
        let refused = gpu.render(&blobs(3, 1, 1), &camera, BACKGROUND);
        assert!(matches!(refused, Err(EngineError::InvalidInput(_))), "{width}x{height}");
    }
}

#[test]
fn a_camera_beyond_all_memory_is_refused_with_figures() {
    let Some(gpu) = engine() else { return };
    // In the last two, bytes or tiles exceed what counts them.
    for (width, height) in [(1 << 20, 1 << 20), (1 << 30, 1 << 30), (u32::MAX, u32::MAX)] {
        let camera = Camera { width, height, ..arc(1, 17, 17).swap_remove(0) };
        let refused = gpu.render(&blobs(3, 1, 1), &camera, BACKGROUND);
        assert!(matches!(refused, Err(EngineError::OutOfResources { .. })), "{width}x{height}");
    }
    // The device is as it was.
    assert_drawn_alike("after a refusal", &blobs(30, 1, 1), &arc(1, 17, 17)[0]);
}

#[test]
fn gradients_by_another_number_of_pixels_are_refused() {
    let Some(gpu) = engine() else { return };
    let (gaussians, camera) = (blobs(3, 1, 1), &arc(1, 17, 13)[0]);
    let pixels = 17 * 13;
    for (image, alpha) in [(3 * pixels - 1, 0), (3 * pixels + 3, 0), (0, 0), (3 * pixels, 1)] {
        let refused =
            gpu.render_backward(&gaussians, camera, BACKGROUND, &vec![1.0; image], &vec![1.0; alpha]);
        assert!(matches!(refused, Err(EngineError::InvalidInput(_))), "{image} values, {alpha} alphas");
    }
}

#[test]
fn more_intersections_than_32_bits_count_are_refused() {
    let Some(gpu) = engine() else { return };
    // 65 538 tiles beside each other, all of them reached by each of 70 000 Gaussians: 4.6e9.
    let camera = &arc(1, 16 * 65_538, 3)[0];
    let mut gaussians = blobs(70_000, 0, 23);
    gaussians.log_scales.fill([8.0; 3]);
    match gpu.render(&gaussians, camera, BACKGROUND) {
        Err(EngineError::OutOfResources { needed, .. }) => assert_eq!(needed, 4 * u64::from(u32::MAX)),
        other => panic!("{:?}", other.map(|drawn| drawn.alpha.len())),
    }
}

#[test]
fn arrays_of_different_lengths_are_refused() {
    let Some(gpu) = engine() else { return };
    let camera = &arc(1, 17, 13)[0];
    let breaks: [fn(&mut Gaussians); 5] = [
        |g| g.rotations.truncate(2),
        |g| g.log_scales.push([0.0; 3]),
        |g| g.logit_opacities.clear(),
        |g| g.sh.truncate(5),
        |g| g.sh.extend([0.0; 1000]),
    ];
    for (number, change) in breaks.iter().enumerate() {
        let mut gaussians = blobs(3, 1, 1);
        change(&mut gaussians);
        let refused = gpu.render(&gaussians, camera, BACKGROUND).err();
        assert!(matches!(refused, Some(EngineError::InvalidInput(_))), "change {number}: {refused:?}");
    }
    // The device is as it was.
    assert_drawn_alike("after refusals", &blobs(30, 1, 1), camera);
}
