//! Footprint moments beside those of the CPU engine, which is held against double precision where it is defined.

use splat::{
    cameras::Camera,
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    raster::CpuEngine,
    tracking::TrackField,
};

use splat_shaders::GpuEngine;

use crate::support::{arc, blobs, engine, open, rough_tracks};

const REWEIGHTING: Reweighting = Reweighting { passes: 3, noise_correlation_area: 1.0, noise_floor: 0.05 };

fn measure(
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
    reweighting: Option<&Reweighting>,
) -> Option<Vec<FootprintMoments>> {
    Some(engine()?.footprint_moments(gaussians, camera, tracks, reweighting).unwrap())
}

/// Largest error of the means, px per `1 px + a tenth of the footprint's extent`, and of the second moments and of the weights,
/// relative.
fn difference(found: &FootprintMoments, exact: &FootprintMoments) -> [f64; 3] {
    let largest = |found: &[f64], exact: &[f64]| {
        found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let second = |m: &FootprintMoments| [m.source.as_slice(), &m.cross, &[m.target]].concat();
    let first = |m: &FootprintMoments| [m.centroid, m.tracked_centroid].concat();
    let weights = |m: &FootprintMoments| [m.blend_weight, m.visible, m.variance].to_vec();
    let scale = exact.target + exact.source[0] + exact.source[2] + exact.weight;
    let extent = (scale / exact.weight - 1.0).max(0.0).sqrt();
    [
        largest(&first(found), &first(exact)) / (1.0 + 0.1 * extent),
        largest(&second(found), &second(exact)) / scale,
        largest(&weights(found), &weights(exact)) / exact.blend_weight
            + (found.weight / exact.weight - 1.0).abs()
            + (found.weight_squared / exact.weight_squared - 1.0).abs(),
    ]
}

/// Sums are good to what the CPU engine's are: 2e-5 px, 5e-6 of the second moments (`src/tests/moments.rs` holds them
/// against double precision on the device's own footprints). Projection in single precision adds 1e-7 of the image's size to a footprint's place, and up to six
/// times that to a pixel's weight, as the steepest footprint falls by six of its weight per pixel; means follow the place, and
/// tracks bend by up to two pixels per pixel.
fn assert_measured_alike(
    name: &str,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
    reweighting: Option<&Reweighting>,
) -> usize {
    let Some(ours) = measure(gaussians, camera, tracks, reweighting) else { return usize::MAX };
    let theirs = CpuEngine::default().footprint_moments(gaussians, camera, tracks, reweighting).unwrap();
    assert_eq!(ours.len(), theirs.len());
    // A reweighted pixel multiplies the error of alpha by its exponent, and passes pass it on.
    let factor = if reweighting.is_some() { 100.0 } else { 1.0 };
    let (mut compared, mut seen, mut worst) = (0, 0, [0.0_f64; 3]);
    for (found, exact) in ours.iter().zip(&theirs) {
        seen += usize::from(exact.pixels > 0);
        // A pixel at the threshold of alpha or of transmittance may be seen by one and not by the other.
        if found.pixels != exact.pixels || !(exact.weight_squared > 0.0) {
            continue;
        }
        compared += 1;
        let errors = difference(found, exact);
        worst = std::array::from_fn(|k| worst[k].max(errors[k]));
    }
    let [means, seconds, weights] = worst;
    println!(
        "{name}: {compared} of {seen}, means {means:.1e} px, second {seconds:.1e}, weights {weights:.1e}"
    );
    assert!(compared * 20 >= seen * 19, "{name}: {compared} of {seen} see the same pixels");
    let place = 1e-7 * f64::from(camera.width.max(camera.height));
    assert!(means < (2e-5 + 3.0 * place) * factor, "{name}: means off by {means:e} px");
    let weight = 5e-6 + 6.0 * place;
    assert!(seconds < weight * factor, "{name}: second moments off by {seconds:e}");
    // The figure adds four of them up.
    assert!(weights < 4.0 * weight * factor, "{name}: weights off by {weights:e}");
    compared
}

#[test]
fn random_scenes_are_measured_alike() {
    for (camera, seed) in [(&arc(3, 70, 45)[1], 1), (&arc(3, 64, 48)[0], 2), (&arc(3, 17, 13)[2], 3)] {
        let (gaussians, tracks) = (blobs(400, seed as u32 % 4, seed), rough_tracks(camera, 11.0, seed));
        for reweighting in [None, Some(&REWEIGHTING)] {
            let name = format!("seed {seed}, reweighted {}", reweighting.is_some());
            let compared = assert_measured_alike(&name, &gaussians, camera, &tracks, reweighting);
            assert!(compared > 30, "{compared} are no test");
        }
    }
}

#[test]
fn odd_image_sizes_are_measured_alike() {
    let gaussians = blobs(200, 1, 21);
    for (width, height) in [(1, 1), (17, 13), (16, 16), (1, 4096), (4096, 1)] {
        let mut camera = arc(1, width, height).swap_remove(0);
        camera.fx = 40.0;
        camera.fy = 40.0;
        let tracks = rough_tracks(&camera, 11.0, 5);
        assert_measured_alike(&format!("{width}x{height}"), &gaussians, &camera, &tracks, None);
    }
}

#[test]
fn one_gaussian_and_none_are_measured() {
    let camera = &arc(1, 17, 13)[0];
    let tracks = rough_tracks(camera, 11.0, 6);
    assert_measured_alike("one", &blobs(1, 3, 23), camera, &tracks, Some(&REWEIGHTING));
    let nothing = measure(&Gaussians::empty(3), camera, &tracks, Some(&REWEIGHTING));
    assert!(nothing.is_none_or(|moments| moments.is_empty()));
}

#[test]
fn giants_over_many_tiles_and_two_motions_are_measured_alike() {
    let camera = &arc(3, 200, 170)[0];
    let mut gaussians = blobs(30, 0, 40);
    for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
        *scales = [0.5, 0.2 * (index % 5) as f32, 0.8];
    }
    gaussians.logit_opacities.fill(-2.0);
    for jump in [0.0, 30.0, 300.0] {
        let tracks = rough_tracks(camera, jump, 7);
        for reweighting in [None, Some(&REWEIGHTING)] {
            let name = format!("giants, {jump} px apart, reweighted {}", reweighting.is_some());
            assert_measured_alike(&name, &gaussians, camera, &tracks, reweighting);
        }
    }
}

#[test]
fn small_footprints_far_from_the_origin_keep_their_shape() {
    // A wide image: positions are large against the footprints.
    let mut camera = arc(1, 2000, 40).swap_remove(0);
    (camera.fx, camera.fy) = (1800.0, 1800.0);
    let mut gaussians = blobs(600, 0, 41);
    for (mean, scales) in gaussians.means.iter_mut().zip(&mut gaussians.log_scales) {
        (mean[0], mean[1]) = (2.0 * mean[0], 0.04 * mean[1]);
        *scales = scales.map(|scale| scale - 4.5);
    }
    let tracks = rough_tracks(&camera, 11.0, 8);
    let compared = assert_measured_alike("wide", &gaussians, &camera, &tracks, None);
    assert!(compared > 100, "{compared} are no test");
}

#[test]
fn tracks_that_are_no_numbers_weigh_nothing() {
    let (gaussians, camera) = (blobs(100, 0, 5), &arc(1, 40, 30)[0]);
    let good = rough_tracks(camera, 11.0, 5);
    let (mut hidden, mut broken) = (good.clone(), good.clone());
    let junk = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -3e38];
    for (number, pixel) in (0..good.positions.len()).step_by(3).enumerate() {
        hidden.visible[pixel] = false;
        broken.visible[pixel] = true;
        let junk = junk[number % junk.len()];
        match number % 4 {
            0 => broken.positions[pixel] = [junk, 5.0],
            1 => broken.positions[pixel] = [5.0, junk],
            2 => broken.positions[pixel] = [junk; 2],
            _ => broken.sigma[pixel] = [f32::NAN, f32::INFINITY, 0.0, -1.0][number / 4 % 4],
        }
    }
    let Some(expected) = measure(&gaussians, camera, &hidden, Some(&REWEIGHTING)) else { return };
    assert_eq!(measure(&gaussians, camera, &broken, Some(&REWEIGHTING)), Some(expected));
    let mut blind = good;
    blind.visible.fill(false);
    let unseen = measure(&gaussians, camera, &blind, Some(&REWEIGHTING)).unwrap();
    assert!(unseen.iter().all(|m| m.weight == 0.0 && m.pixels == 0 && m.visible == 0.0));
    assert!(unseen.iter().any(|m| m.blend_weight > 0.0));
}

#[test]
fn claims_and_displacements_of_any_size_stay_finite() {
    let (gaussians, camera) = (blobs(60, 0, 6), &arc(1, 40, 30)[0]);
    for sigma in [1e-30, 1e-6, 1.0, 1e6, 1e30f32] {
        for jump in [0.0, 100.0, 6e4] {
            let mut tracks = rough_tracks(camera, jump, 6);
            tracks.sigma.fill(sigma);
            for m in measure(&gaussians, camera, &tracks, Some(&REWEIGHTING)).into_iter().flatten() {
                let values = [&m.source[..], &m.cross, &m.centroid, &m.tracked_centroid].concat();
                let all = values.iter().sum::<f64>() + m.target + m.weight + m.weight_squared + m.variance;
                assert!(all.is_finite() && m.target >= 0.0, "σ {sigma} jump {jump}: {m:?}");
            }
        }
    }
}

#[test]
fn two_runs_have_the_same_bytes() {
    let camera = &arc(3, 200, 170)[1];
    let (gaussians, tracks) = (blobs(2000, 1, 9), rough_tracks(camera, 11.0, 9));
    let first = measure(&gaussians, camera, &tracks, Some(&REWEIGHTING));
    assert_eq!(first, measure(&gaussians, camera, &tracks, Some(&REWEIGHTING)));
}

#[test]
fn more_intersections_than_there_is_room_for_are_measured_alike() {
    // 120 Gaussians in all of 143 tiles, where room is made for 4096 at first.
    let camera = &arc(3, 200, 170)[1];
    let mut gaussians = blobs(120, 0, 10);
    gaussians.log_scales.fill([0.8; 3]);
    gaussians.logit_opacities.fill(-3.0);
    assert_measured_alike("overflow", &gaussians, camera, &rough_tracks(camera, 11.0, 10), None);
}

#[test]
fn tracks_of_another_size_are_refused() {
    let Some(gpu) = engine() else { return };
    let tracks = rough_tracks(&arc(1, 17, 12)[0], 0.0, 1);
    let refused = gpu.footprint_moments(&blobs(3, 0, 1), &arc(1, 17, 13)[0], &tracks, None);
    assert!(matches!(refused, Err(EngineError::InvalidInput(_))), "{refused:?}");
}

#[test]
fn sums_take_the_room_of_the_intersections_that_there_are() {
    let Some(_) = engine() else { return };
    let camera = &arc(1, 17, 13)[0];
    let mut gaussians = blobs(20_000, 0, 11);
    // All but a few are behind the camera.
    gaussians.means[20..].iter_mut().for_each(|mean| mean[2] = -100.0);
    // Sums for the 80 000 intersections for which lists have room at first would be 6.4 MB, all else is below 7.
    let limited = GpuEngine::new(open().with_memory_limit(8_000_000)).unwrap();
    let tracks = rough_tracks(camera, 11.0, 11);
    let ours = limited.footprint_moments(&gaussians, camera, &tracks, None).unwrap();
    assert!(ours.iter().filter(|moments| moments.pixels > 0).count() > 5);
    let too_much = GpuEngine::new(open().with_memory_limit(1_000_000)).unwrap();
    let refused = too_much.footprint_moments(&gaussians, camera, &tracks, None);
    assert!(matches!(refused, Err(EngineError::OutOfResources { .. })), "{refused:?}");
}
