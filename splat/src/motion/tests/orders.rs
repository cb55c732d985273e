//! The order of a footprint's motion, robust fits, scales.

use glam::{DMat2, DVec2};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    super::{
        fit2d::{self, Fit},
        no_surer_than,
        order::Order,
        within_mask,
    },
    dense::{Blend, moments},
    *,
};
use crate::{image::Mask, metrics, tracking::TrackField};

/// Pixels along each side of the simulated image.
const SIDE: usize = 224;

/// Blending weights of a lone footprint in the image's middle with standard deviations of `size` and up to a half
/// less, `LOW_PASS` included, and its mean.
fn footprint(size: f64, random: &mut ChaCha8Rng) -> (Blend, DVec2) {
    let mut draw = |low: f64, high: f64| random.random_range(low..high);
    let (sine, cosine) = draw(0.0, std::f64::consts::PI).sin_cos();
    let turn = DMat2::from_cols(DVec2::new(cosine, sine), DVec2::new(-sine, cosine));
    let variances = DVec2::new(size * size, (size * draw(0.5, 1.0)).powi(2));
    let covariance =
        turn * DMat2::from_diagonal(variances) * turn.transpose() + DMat2::from_diagonal(DVec2::splat(0.3));
    let inverse = covariance.inverse();
    let mean = DVec2::splat(SIDE as f64 / 2.0) + DVec2::new(draw(-0.5, 0.5), draw(-0.5, 0.5));
    let mut blend = Blend::new();
    for pixel in 0..SIDE * SIDE {
        let offset = centre(pixel) - mean;
        let alpha = 0.8 * (-0.5 * offset.dot(inverse * offset)).exp();
        if alpha > 1.0 / 255.0 {
            blend.push((pixel, alpha));
        }
    }
    (blend, mean)
}

fn centre(pixel: usize) -> DVec2 {
    DVec2::new((pixel % SIDE) as f64 + 0.5, (pixel / SIDE) as f64 + 0.5)
}

/// Tracks `mean + shift + gradient (x − mean)` with uniform noise of a standard deviation, which they claim with 0.05 px
/// added.
fn tracks(mean: DVec2, shift: DVec2, strain: DMat2, noise: f64, random: &mut ChaCha8Rng) -> TrackField {
    let half = noise * 3f64.sqrt() + 1e-12;
    let position = |pixel: usize| {
        let x = centre(pixel);
        let error = DVec2::new(random.random_range(-half..half), random.random_range(-half..half));
        (x + shift + strain * (x - mean) + error).as_vec2().to_array()
    };
    TrackField {
        width: SIDE as u32,
        height: SIDE as u32,
        positions: (0..SIDE * SIDE).map(position).collect(),
        visible: vec![true; SIDE * SIDE],
        sigma: vec![noise.hypot(0.05) as f32; SIDE * SIDE],
    }
}

fn fit(blend: &Blend, tracks: &TrackField, mean: DVec2) -> Fit {
    // Errors of these tracks are independent.
    let settings = MotionSettings { noise_correlation_area: 1.0, ..settings() };
    fit2d::fit(&moments(blend, tracks), mean, &settings).unwrap()
}

/// A motion of an order: strains of 0.02 to 0.5, displacements of 0.5 to 10 px.
fn motion(order: Order, random: &mut ChaCha8Rng) -> (DVec2, DMat2) {
    let mut draw = |low: f64, high: f64| random.random_range(low..high);
    let angle = draw(0.0, std::f64::consts::TAU);
    let shift = DVec2::new(angle.cos(), angle.sin()) * 0.5 * 20f64.powf(draw(0.0, 1.0));
    let size = 0.02 * 25f64.powf(draw(0.0, 1.0));
    let (p, q) = draw(0.0, std::f64::consts::TAU).sin_cos();
    let similarity = DMat2::from_cols(DVec2::new(p, q), DVec2::new(-q, p)) * (size / 2f64.sqrt());
    let (r, s) = draw(0.0, std::f64::consts::TAU).sin_cos();
    let shear = DMat2::from_cols(DVec2::new(r, s), DVec2::new(s, -r)) * (size / 2f64.sqrt());
    match order {
        Order::Static => (DVec2::ZERO, DMat2::ZERO),
        Order::Translation => (shift, DMat2::ZERO),
        Order::Similarity => (shift, similarity),
        Order::Affine => (shift, similarity + shear),
    }
}

const ORDERS: [Order; 4] = [Order::Static, Order::Translation, Order::Similarity, Order::Affine];

#[test]
#[allow(clippy::print_stdout, reason = "`--nocapture` shows the table of the document")]
fn the_right_order_is_found_where_the_tracks_show_it() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let sizes = [(0.3, 160), (1.0, 160), (3.0, 160), (10.0, 48), (30.0, 16)];
    println!("| noise, px |{}", sizes.map(|(size, _)| format!(" σ {size} px |")).concat());
    for (noise, least) in [
        (0.0, [0.4, 0.6, 0.8, 0.85, 0.85]),
        (0.5, [0.4, 0.5, 0.6, 0.8, 0.85]),
        (2.0, [0.2, 0.3, 0.45, 0.6, 0.85]),
    ] {
        let mut row = format!("| {noise} |");
        for ((size, count), least) in sizes.into_iter().zip(least) {
            let mut right = 0;
            for number in 0..count {
                let order = ORDERS[number % 4];
                let (blend, mean) = footprint(size, &mut random);
                let (shift, strain) = motion(order, &mut random);
                let found = fit(&blend, &tracks(mean, shift, strain, noise, &mut random), mean);
                right += usize::from(found.order == order);
            }
            let share = right as f64 / count as f64;
            row += &format!(" {:.0} % |", 100.0 * share);
            assert!(share >= least, "σ {size} px, noise {noise} px: {share} right");
        }
        println!("{row}");
    }
}

#[test]
fn clear_motions_get_their_order_and_their_parameters() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let (blend, mean) = footprint(8.0, &mut random);
    let similarity = DMat2::from_cols(DVec2::new(0.05, 0.08), DVec2::new(-0.08, 0.05));
    let affine = DMat2::from_cols(DVec2::new(0.1, -0.05), DVec2::new(0.15, 0.0));
    let shift = DVec2::new(2.0, -1.0);
    for (order, shift, strain) in [
        (Order::Static, DVec2::ZERO, DMat2::ZERO),
        (Order::Translation, shift, DMat2::ZERO),
        (Order::Similarity, shift, similarity),
        (Order::Affine, shift, affine),
        // What turns in place moves.
        (Order::Similarity, DVec2::ZERO, similarity),
    ] {
        let found = fit(&blend, &tracks(mean, shift, strain, 0.1, &mut random), mean);
        assert_eq!(found.order, order);
        // Four standard deviations of the worst entry.
        let deviation = 4.0 * found.affine_covariance.x_axis.x.max(found.affine_covariance.y_axis.y).sqrt();
        let error = found.gradient - DMat2::IDENTITY - strain;
        assert!(error.x_axis.abs().max(error.y_axis.abs()).max_element() < deviation, "{order:?}: {error}");
        assert!((found.target - mean - shift).length() < 4.0 * found.variance.sqrt(), "{order:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 48,
        rng_seed: proptest::test_runner::RngSeed::Fixed(4),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn exact_affine_tracks_give_their_map_at_any_size(
        log_size in -3.0f64..3.9,
        entries in prop::array::uniform4(-0.5f64..0.5),
        shift in prop::array::uniform2(-40.0f64..40.0),
        seed in 0u64..1000,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (blend, mean) = footprint(log_size.exp(), &mut random);
        let (shift, strain) = (DVec2::from_array(shift), DMat2::from_cols_array(&entries));
        let mut exact = tracks(mean, shift, strain, 0.0, &mut random);
        exact.sigma.fill(1e-4);
        prop_assume!(moments(&blend, &exact).pixels >= 4);
        let found = fit(&blend, &exact, mean);
        // Single precision of a track, 1.5e-5 px; over a footprint of at least half a pixel.
        prop_assert!((found.target - mean - shift).length() < 1e-3, "{} {shift}", found.target);
        let error = found.gradient - DMat2::IDENTITY - strain;
        prop_assert!(error.x_axis.abs().max(error.y_axis.abs()).max_element() < 2e-3, "{error}");
    }

    #[test]
    fn any_moments_give_a_finite_fit_or_none(
        log_size in -4.0f64..4.6,
        log_noise in -10.0f64..8.0,
        log_jump in -5.0f64..9.0,
        seed in 0u64..1000,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (blend, mean) = footprint(log_size.exp(), &mut random);
        let noise = log_noise.exp();
        let mut wild = tracks(mean, DVec2::splat(log_jump.exp()), DMat2::IDENTITY, noise, &mut random);
        for pixel in (0..SIDE * SIDE).step_by(3) {
            wild.positions[pixel] = [random.random_range(-1e4..1e4), f32::NAN];
            wild.positions[pixel / 2][0] += 500.0;
        }
        let settings = settings();
        if let Some(found) = fit2d::fit(&moments(&blend, &wild), mean, &settings) {
            prop_assert!(found.variance > 0.0 && found.variance.is_finite());
            prop_assert!(found.target.is_finite() && found.gradient.is_finite());
        }
    }
}

#[test]
fn contested_footprints_are_not_at_rest_and_trusted_less() {
    let (mut gaussians, camera) = (corner(60, 40), cameras(1));
    for mean in gaussians.means.iter_mut().skip(2).step_by(3) {
        // On the floor, less than a standard deviation from a wall.
        mean[0] = 0.03;
    }
    // The floor slides, the walls rest.
    let slide = |x: DVec3| if x.z.abs() < 1e-9 { x + DVec3::new(0.3, 0.3, 0.0) } else { x };
    let view = views(&camera, slide, 0.05).remove(0);
    let engine = crate::raster::CpuEngine::default();
    let observed = super::super::observe::observe(&engine, &gaussians, &[view], &settings()).unwrap();
    let mut contested = 0;
    for (index, list) in observed.iter().enumerate() {
        let Some(seen) = list.first() else { continue };
        let on_floor = index % 3 == 2;
        if on_floor {
            assert_ne!(seen.fit.order, Order::Static, "{index} slides");
        }
        contested += usize::from(seen.fit.variance > 1.0);
    }
    assert!(contested > 0, "some lie across the creases");
}

#[test]
fn what_grows_is_scaled_and_what_does_not_keeps_its_bytes() {
    let growth: f64 = 1.1;
    let gaussians = corner(120, 41);
    let field = run(&gaussians, &views(&cameras(8), |x| x * growth, 0.02));
    let mut strains: Vec<f64> = (0..gaussians.len())
        .filter(|&i| field.origin[i] == MotionOrigin::Solved)
        .flat_map(|i| [field.log_scale[i].x, field.log_scale[i].y])
        .collect();
    strains.sort_by(f64::total_cmp);
    let median = strains[strains.len() / 2];
    // Shrunk by its significance: the error that no number of views averages away is 0.01 and more.
    assert!(median > 0.6 * growth.ln() && median < 1.1 * growth.ln(), "median {median}");
    assert!(field.log_scale.iter().all(|s| s.z == 0.0), "the thin axis is not seen");

    let mut truth = gaussians.clone();
    for mean in &mut truth.means {
        *mean = mean.map(|c| c * growth as f32);
    }
    for scales in &mut truth.log_scales {
        *scales = [scales[0] + growth.ln() as f32, scales[1] + growth.ln() as f32, scales[2]];
    }
    let psnr = |field: &MotionField| {
        let draw = |gaussians: &Gaussians| crate::testing::render(gaussians, &cameras(8)[3], [0.0; 3]).image;
        metrics::psnr(&draw(&apply(&gaussians, field)), &draw(&truth))
    };
    let unscaled = MotionField { log_scale: vec![DVec3::ZERO; gaussians.len()], ..field.clone() };
    assert!(psnr(&field) > psnr(&unscaled) + 2.0, "{} and {} dB", psnr(&field), psnr(&unscaled));

    for noise in [0.0, 0.3] {
        let mut rigid = views(&cameras(8), |x| turn().of(x), 0.02);
        if noise > 0.0 {
            scenes::add_noise(&mut rigid, noise, 6);
        }
        let field = run(&gaussians, &rigid);
        assert!(field.log_scale.iter().all(|s| *s == DVec3::ZERO), "rigid motion at {noise} px of noise");
        assert_eq!(apply(&gaussians, &field).log_scales, gaussians.log_scales);
    }
}

#[test]
fn orders_are_counted() {
    let gaussians = corner(90, 42);
    let resting = run(&gaussians, &views(&cameras(4), |x| x, 0.05)).orders;
    assert!(resting.r#static > 200 && resting.translation + resting.similarity + resting.affine == 0);
    let turning = run(&gaussians, &views(&cameras(4), |x| turn().of(x), 0.05)).orders;
    let all = turning.r#static + turning.translation + turning.similarity + turning.affine;
    assert_eq!(all, resting.r#static);
    assert!(turning.affine + turning.similarity > all / 2, "{turning:?}");
}

#[test]
fn no_track_counts_as_surer_than_it_may() {
    let sigma = vec![0.01, 0.1, 3.0, 0.0, f32::NAN, f32::INFINITY];
    let field =
        TrackField { width: 6, height: 1, positions: vec![[0.5; 2]; 6], visible: vec![true; 6], sigma };
    let found = no_surer_than(&field, 0.1);
    assert_eq!(found.sigma[..4], [0.1, 0.1, 3.0, 0.1]);
    assert!(found.sigma[4].is_nan() && found.sigma[5] == f32::INFINITY);
    assert_eq!((&found.positions, &found.visible), (&field.positions, &field.visible));
    assert_eq!(no_surer_than(&field, 0.0).sigma[..4], field.sigma[..4]);
}

#[test]
fn tracks_that_leave_the_image_or_the_mask_are_not_used() {
    let camera = &cameras(1)[0];
    let gaussians = corner(60, 43);
    let mut view = views(std::slice::from_ref(camera), |x| x, 0.05).remove(0);
    let outside = |field: &TrackField| {
        let positions: Vec<[f32; 2]> = field.positions.iter().map(|p| [p[0] + 200.0, p[1]]).collect();
        TrackField { positions, ..field.clone() }
    };
    view.tracks = Arc::new(outside(&view.tracks));
    assert_eq!(share(&run(&gaussians, std::slice::from_ref(&view)), MotionOrigin::Unsolved), 1.0);
    assert_eq!(run(&gaussians, &[view.clone()]).orders, OrderCounts::default());

    let inside = scenes::tracks(camera, |x| x, 0.05);
    let half = Mask { width: 96, height: 64, inside: (0..96 * 64).map(|p| p % 96 < 48).collect() };
    let masked = within_mask(&inside, &half);
    for pixel in 0..96 * 64 {
        assert_eq!(masked.visible[pixel], inside.visible[pixel] && pixel % 96 < 48, "{pixel}");
    }
    let other_size = Mask { width: 1, height: 1, inside: vec![false] };
    assert_eq!(within_mask(&inside, &other_size).visible, inside.visible);
}
