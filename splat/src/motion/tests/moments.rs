//! The CPU engine's moments against sums in double precision.

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::{
    engine::Engine,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    raster::CpuEngine,
    simd::Instructions,
    testing::{arc, blobs, on_threads},
    tracking::TrackField,
};

const REWEIGHTING: Reweighting = Reweighting { passes: 3, noise_correlation_area: 1.0, noise_floor: 0.05 };

/// Bent, noisy tracks with two motions, hidden pixels and claims from 0.01 to 3 px.
fn rough_tracks(camera: &Camera, seed: u64) -> TrackField {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pixels = (0..camera.height).flat_map(|row| (0..camera.width).map(move |column| (column, row)));
    let mut field = TrackField {
        width: camera.width,
        height: camera.height,
        positions: Vec::new(),
        visible: Vec::new(),
        sigma: Vec::new(),
    };
    for (column, row) in pixels {
        let (x, y) = (f64::from(column) + 0.5, f64::from(row) + 0.5);
        let sigma: f64 = 0.01 * 300f64.powf(random.random_range(0.0..1.0));
        let jump = if x + 0.3 * y > 40.0 { 11.0 } else { 0.0 };
        let mut noise = || sigma * random.random_range(-1.7..1.7);
        let target = [x + 3.0 + 0.05 * y + 1e-3 * x * x + jump + noise(), y - 2.0 - 0.03 * x + noise()];
        field.positions.push(target.map(|value| value as f32));
        field.visible.push(random.random_range(0.0..1.0) > 0.1);
        field.sigma.push(sigma as f32);
    }
    field
}

fn measure(
    instructions: Instructions,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
    reweighting: Option<&Reweighting>,
) -> Vec<FootprintMoments> {
    CpuEngine::new(instructions).footprint_moments(gaussians, camera, tracks, reweighting).unwrap()
}

/// Largest error of the means, px, and of the second moments and weights, relative.
fn difference(found: &FootprintMoments, exact: &FootprintMoments) -> [f64; 3] {
    let largest = |found: &[f64], exact: &[f64]| {
        found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let second = |m: &FootprintMoments| [m.source.as_slice(), &m.cross, &[m.target]].concat();
    let first = |m: &FootprintMoments| [m.centroid, m.tracked_centroid].concat();
    let weights = |m: &FootprintMoments| [m.blend_weight, m.visible, m.variance].to_vec();
    let scale = exact.target + exact.source[0] + exact.source[2] + exact.weight;
    [
        largest(&first(found), &first(exact)),
        largest(&second(found), &second(exact)) / scale,
        largest(&weights(found), &weights(exact)) / exact.blend_weight
            + (found.weight / exact.weight - 1.0).abs()
            + (found.weight_squared / exact.weight_squared - 1.0).abs(),
    ]
}

#[test]
fn single_precision_within_blocks_costs_no_accuracy() {
    // Sizes that leave parts of blocks outside the image.
    for (camera, seed) in [(&arc(3, 70, 45)[1], 1), (&arc(3, 64, 48)[0], 2), (&arc(3, 13, 7)[2], 3)] {
        let gaussians = blobs(150, seed);
        let tracks = rough_tracks(camera, seed);
        for reweighting in [None, Some(&REWEIGHTING)] {
            let exact = DenseEngine.footprint_moments(&gaussians, camera, &tracks, reweighting).unwrap();
            for instructions in Instructions::available() {
                let found = measure(instructions, &gaussians, camera, &tracks, reweighting);
                let mut compared = 0;
                for (index, (found, exact)) in found.iter().zip(&exact).enumerate() {
                    // A pixel at the threshold of alpha or of transmittance may be seen by one and not by the other.
                    if found.pixels != exact.pixels || exact.weight_squared == 0.0 {
                        continue;
                    }
                    compared += 1;
                    let [means, seconds, weights] = difference(found, exact);
                    // Alpha is good to 1e-6; a reweighted pixel multiplies that by its exponent, and passes pass it on.
                    let factor = if reweighting.is_some() { 100.0 } else { 1.0 };
                    assert!(means < 2e-5 * factor, "{index}: means off by {means:e} px");
                    assert!(seconds < 5e-6 * factor, "{index}: second moments off by {seconds:e}");
                    assert!(weights < 1e-5 * factor, "{index}: weights off by {weights:e}");
                }
                let seen = exact.iter().filter(|moments| moments.pixels > 0).count();
                assert!(compared * 20 >= seen * 19, "{compared} of {seen} see the same pixels");
                assert!(compared > 30, "{compared} are no test");
            }
        }
    }
}

#[test]
fn any_number_of_threads_and_both_wide_sets_give_the_same_bytes() {
    let (gaussians, camera) = (blobs(300, 4), &arc(3, 70, 45)[1]);
    let tracks = rough_tracks(camera, 4);
    let run = |threads, instructions| {
        on_threads(threads, || measure(instructions, &gaussians, camera, &tracks, Some(&REWEIGHTING)))
    };
    let one = run(1, Instructions::detect());
    assert_eq!(one, run(3, Instructions::detect()));
    for instructions in Instructions::available().filter(|set| set.set().to_string() != "baseline") {
        assert!(one == run(1, instructions), "{}", instructions.set());
    }
}

#[test]
fn tracks_that_are_no_numbers_weigh_nothing() {
    let (gaussians, camera) = (blobs(100, 5), &arc(1, 40, 30)[0]);
    let good = rough_tracks(camera, 5);
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
    let measure = |tracks| measure(Instructions::detect(), &gaussians, camera, tracks, Some(&REWEIGHTING));
    assert_eq!(measure(&hidden), measure(&broken));
    let mut blind = good;
    blind.visible.fill(false);
    let unseen = measure(&blind);
    assert!(unseen.iter().all(|m| m.weight == 0.0 && m.pixels == 0 && m.visible == 0.0));
    assert!(unseen.iter().any(|m| m.blend_weight > 0.0));
}

#[test]
fn claims_and_displacements_of_any_size_stay_finite() {
    let (gaussians, camera) = (blobs(60, 6), &arc(1, 40, 30)[0]);
    for sigma in [1e-30, 1e-6, 1.0, 1e6, 1e30f32] {
        for jump in [0.0, 1e-3, 100.0, 6e4f32] {
            let mut tracks = rough_tracks(camera, 6);
            tracks.sigma.fill(sigma);
            for (pixel, position) in tracks.positions.iter_mut().enumerate() {
                position[pixel % 2] += if pixel % 5 < 2 { jump } else { 0.0 };
            }
            for m in measure(Instructions::detect(), &gaussians, camera, &tracks, Some(&REWEIGHTING)) {
                let values = [&m.source[..], &m.cross, &m.centroid, &m.tracked_centroid].concat();
                let all = values.iter().sum::<f64>() + m.target + m.weight + m.weight_squared + m.variance;
                assert!(all.is_finite() && m.target >= 0.0, "σ {sigma} jump {jump}: {m:?}");
            }
        }
    }
}

/// One opaque Gaussian of standard deviation `size` px in the middle of an image, and its camera.
fn lone(size: f64) -> (Gaussians, Camera) {
    let camera = arc(1, 96, 64)[0].clone();
    let mut gaussians = blobs(1, 7);
    gaussians.means[0] = [0.0; 3];
    // Four units away at a focal length of 96 px.
    gaussians.log_scales[0] = [(size / 24.0).ln() as f32; 3];
    gaussians.logit_opacities[0] = 3.0;
    (gaussians, camera)
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 24,
        rng_seed: proptest::test_runner::RngSeed::Fixed(4),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// A footprint of which up to 40 % show another surface follows its own; so does one with up to 70 % of
    /// its tracks at random.
    #[test]
    fn a_footprint_follows_the_surface_that_it_belongs_to(
        size in 1.5f64..12.0,
        outliers in 0.0f64..0.4,
        jump in 3.0f64..30.0,
        angle in 0.0f64..std::f64::consts::TAU,
        noise in 0.02f64..0.3,
        seed in 0u64..1000,
    ) {
        let (gaussians, camera) = lone(size);
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let normal_quantile = edge(outliers);
        let is_scattered = seed % 2 == 0;
        let share = if is_scattered { outliers / 0.4 * 0.7 } else { outliers };
        let mut tracks = rough_tracks(&camera, 0);
        tracks.sigma.fill(noise as f32);
        tracks.visible.fill(true);
        for pixel in 0..tracks.positions.len() {
            let x = [(pixel % 96) as f64 + 0.5, (pixel / 96) as f64 + 0.5];
            let across = (x[0] - 48.0) * angle.cos() + (x[1] - 32.0) * angle.sin();
            let other = if is_scattered {
                let is_outlier = random.random_range(0.0..1.0) < share;
                let anywhere = [0, 1].map(|_| random.random_range(-jump..jump));
                if is_outlier { anywhere } else { [0.0; 2] }
            } else if across > normal_quantile * (size * size + 0.3).sqrt() {
                [jump * angle.sin(), -jump * angle.cos()]
            } else {
                [0.0; 2]
            };
            for axis in 0..2 {
                let noise = noise * random.random_range(-1.7..1.7);
                tracks.positions[pixel][axis] = (x[axis] + 5.0 + other[axis] + noise) as f32;
            }
        }
        let found = &measure(Instructions::detect(), &gaussians, &camera, &tracks, Some(&REWEIGHTING))[0];
        let error = (0..2).map(|k| found.tracked_centroid[k] - found.centroid[k] - 5.0).map(f64::abs);
        let error = error.fold(0.0, f64::max);
        // The noise of the mean of few pixels, and what an outlier within three deviations of the noise adds; the plain mean is
        // off by the share of outliers times their distance, several pixels.
        let limit = 0.1 + 2.5 * noise + 0.04 * jump / size;
        prop_assert!(error < limit, "off by {error} px, limit {limit}, plain {}", share * jump);
    }
}

/// Where a standard normal distribution has `share` of its weight beyond.
fn edge(share: f64) -> f64 {
    let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    let (mut x, mut beyond) = (6.0, 0.0);
    while beyond < share {
        x -= 1e-3;
        beyond += density(x) * 1e-3;
    }
    x
}
