//! The ablation is known to be faithful: right where the released path must be right, wrong where it is known
//! to be wrong.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::Arc;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::{
    cameras::Camera,
    motion::{LiftMethod, MotionSettings, apply},
    raster::CpuEngine,
    testing::{arc, blobs},
};

/// Flat Gaussians that cover a part of the plane `z = 0`.
fn sheet(count: usize, seed: u64) -> Gaussians {
    let mut sheet = blobs(count, seed);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for index in 0..count {
        sheet.means[index][2] = 0.0;
        let spin = DQuat::from_rotation_z(random.random_range(0.0..6.0));
        sheet.rotations[index] = [spin.w, spin.x, spin.y, spin.z].map(|c| c as f32);
        sheet.log_scales[index] = [-2.5, random.random_range(-3.0..-2.5), -7.0];
    }
    sheet
}

/// Exact tracks of the plane `z = 0` under a motion.
fn plane_tracks(camera: &Camera, motion: impl Fn(DVec3) -> DVec3) -> TrackField {
    let pixels = (0..camera.height).flat_map(|row| (0..camera.width).map(move |column| (column, row)));
    let positions: Vec<[f32; 2]> = pixels
        .map(|(column, row)| {
            let slope = DVec3::new(
                (f64::from(column) + 0.5 - camera.cx) / camera.fx,
                (f64::from(row) + 0.5 - camera.cy) / camera.fy,
                1.0,
            );
            let (origin, ray) = (camera.centre(), camera.rotation.transpose() * slope);
            let target = camera.project_world(motion(origin - ray * (origin.z / ray.z))).unwrap();
            target.as_vec2().to_array()
        })
        .collect();
    let count = positions.len();
    let (width, height) = (camera.width, camera.height);
    TrackField { width, height, positions, visible: vec![true; count], sigma: vec![0.1; count] }
}

fn views(cameras: &[Camera], motion: impl Fn(DVec3) -> DVec3 + Copy) -> Vec<MotionView> {
    cameras
        .iter()
        .map(|camera| MotionView { camera: camera.clone(), tracks: Arc::new(plane_tracks(camera, motion)) })
        .collect()
}

fn run(gaussians: &Gaussians, views: &[MotionView]) -> MotionField {
    let settings = MotionSettings { lift: LiftMethod::Reference, ..MotionSettings::default() };
    crate::motion::estimate(&CpuEngine::default(), gaussians, views, &settings).unwrap()
}

fn projected(camera: &Camera, mean: DVec3, covariance: DMat3) -> DMat2 {
    let [u, v] = camera.world_jacobian(camera.to_camera(mean));
    let uv = u.dot(covariance * v);
    DMat2::from_cols(DVec2::new(u.dot(covariance * u), uv), DVec2::new(uv, v.dot(covariance * v)))
}

/// Lower triangular `l` with `l lᵀ = m`.
fn cholesky(m: DMat2) -> DMat2 {
    let a = m.x_axis.x.sqrt();
    let b = m.x_axis.y / a;
    DMat2::from_cols(DVec2::new(a, b), DVec2::new(0.0, (m.y_axis.y - b * b).sqrt()))
}

/// What exact fits say of a Gaussian that turns about its own mean: their `A S Aᵀ` is its new projection.
fn turned<'a>(cameras: &'a [Camera], gaussians: &Gaussians, index: usize, turn: DQuat) -> Vec<Seen<'a>> {
    let (mean, old) = (gaussians.mean(index), gaussians.covariance(index));
    let turn = DMat3::from_quat(turn);
    cameras
        .iter()
        .map(|camera| {
            let from = projected(camera, mean, old);
            let to = projected(camera, mean, turn * old * turn.transpose());
            let gradient = cholesky(to) * cholesky(from).inverse();
            let centre = camera.project_world(mean).unwrap();
            let affine = Affine { gradient, offset: centre - gradient * centre };
            Seen { camera, weight: 10.0, pixels: 50, affine }
        })
        .collect()
}

/// Rotations between 5° and 25° about any axis.
fn small_turn(random: &mut ChaCha8Rng) -> DQuat {
    let mut draw = || random.random_range(-1.0..1.0);
    let axis = DVec3::new(draw(), draw(), draw()).normalize();
    DQuat::from_axis_angle(axis, random.random_range(5f64..25.0).to_radians())
}

#[test]
fn exact_targets_give_exact_means() {
    let (cameras, gaussians) = (arc(5, 320, 180), blobs(50, 1));
    let shift = DVec3::new(0.3, -0.2, 0.25);
    for index in 0..gaussians.len() {
        let mean = gaussians.mean(index);
        let seen: Vec<Seen<'_>> = cameras
            .iter()
            .map(|camera| {
                let [from, to] = [mean, mean + shift].map(|x| camera.project_world(x).unwrap());
                let affine = Affine { gradient: DMat2::IDENTITY, offset: to - from };
                Seen { camera, weight: 1.0, pixels: 9, affine }
            })
            .collect();
        let (translation, confidence) = means::solve(&seen, mean).unwrap();
        assert!((translation - shift).length() < 1e-10, "{index}: {translation}");
        assert!((confidence - 1.0).abs() < 1e-9, "{confidence}");
    }
}

#[test]
fn affine_tracks_are_fitted_exactly() {
    let (gaussians, camera) = (sheet(40, 2), &arc(1, 96, 64)[0]);
    let map = Affine {
        gradient: DMat2::from_cols(DVec2::new(1.04, 0.17), DVec2::new(-0.21, 0.93)),
        offset: DVec2::new(7.5, -3.25),
    };
    let mut tracks = plane_tracks(camera, |x| x);
    for position in &mut tracks.positions {
        let [x, y] = position.map(f64::from);
        *position = map.of(DVec2::new(x, y)).as_vec2().to_array();
    }
    let views = [MotionView { camera: camera.clone(), tracks: Arc::new(tracks) }];
    let sights = sights(&CpuEngine::default(), &gaussians, &views).unwrap();
    let fitted: Vec<Affine> = sights.iter().flatten().filter_map(|sight| sight.affine).collect();
    assert!(fitted.len() > 30, "{}", fitted.len());
    for affine in fitted {
        // Tracks of single precision, 8e-6 px, over footprints of a few pixels.
        let error = affine.gradient - map.gradient;
        assert!(error.x_axis.length().max(error.y_axis.length()) < 1e-4, "{error}");
        assert!((affine.offset - map.offset).length() < 1e-2, "{}", affine.offset);
    }
}

#[test]
fn translation_of_a_plane_is_found() {
    let gaussians = sheet(200, 3);
    let shift = DVec3::new(0.2, -0.1, 0.0);
    let field = run(&gaussians, &views(&arc(5, 160, 120), |x| x + shift));
    let mut errors: Vec<f64> = (0..gaussians.len())
        .filter(|&index| field.origin[index] == MotionOrigin::Solved)
        .map(|index| (field.translation[index] - shift).length())
        .collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 150, "{} solved", errors.len());
    // A footprint's perspective is not affine; the cameras are four units away.
    assert!(errors[errors.len() / 2] < 2e-3, "median {}", errors[errors.len() / 2]);
}

#[test]
fn rotations_are_mostly_wrong_on_exact_data() {
    let (cameras, gaussians) = (arc(8, 320, 180), blobs(1500, 4));
    let mut random = ChaCha8Rng::seed_from_u64(4);
    for at_rest in [false, true] {
        let (mut right, mut same_shape, mut solved) = (0.0, 0.0, 0.0);
        for index in 0..gaussians.len() {
            let truth = if at_rest { DQuat::IDENTITY } else { small_turn(&mut random) };
            let seen = turned(&cameras, &gaussians, index, truth);
            let Some((turn, _)) = covariances::solve(&seen, &gaussians, index) else { continue };
            solved += 1.0;
            right += f64::from(u8::from(turn.angle_between(truth).to_degrees() < 1.0));
            let old = gaussians.covariance(index);
            let shape = |turn: DQuat| DMat3::from_quat(turn) * old * DMat3::from_quat(turn).transpose();
            let error = norm(shape(turn) - shape(truth)) / norm(old);
            same_shape += f64::from(u8::from(error < 0.1));
        }
        let [right, same_shape] = [right, same_shape].map(|count| count / solved);
        // All three signs right by luck: one in eight.
        assert!((0.08..0.18).contains(&right), "{right} of {solved}, at rest: {at_rest}");
        assert!((0.08..0.22).contains(&same_shape), "{same_shape} of {solved}, at rest: {at_rest}");
        assert!(solved > 1400.0, "{solved}");
    }
}

fn norm(m: DMat3) -> f64 {
    m.to_cols_array().iter().map(|value| value * value).sum::<f64>().sqrt()
}

#[test]
fn affine_noise_makes_eigenvalues_negative() {
    let (cameras, gaussians) = (arc(3, 320, 180), blobs(600, 5));
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut share = |noise: f64| {
        let refused = (0..gaussians.len())
            .filter(|&index| {
                let turn = small_turn(&mut random);
                let mut seen = turned(&cameras, &gaussians, index, turn);
                for view in &mut seen {
                    // Heavy enough for the threshold on residuals: only eigenvalues refuse.
                    view.weight = 1e4;
                    let mut draw = || random.random_range(-1.0..1.0) * noise * 3f64.sqrt();
                    let error = [DVec2::new(draw(), draw()), DVec2::new(draw(), draw())];
                    view.affine.gradient += DMat2::from_cols(error[0], error[1]);
                }
                covariances::solve(&seen, &gaussians, index).is_none()
            })
            .count();
        refused as f64 / gaussians.len() as f64
    };
    let (exact, noisy) = (share(0.0), share(0.1));
    assert!(exact < 0.02 && (0.13..0.6).contains(&noisy), "refused {exact} without noise, {noisy} with 10 %");
}

#[test]
fn disagreeing_views_get_a_negative_confidence() {
    let (cameras, mean) = (arc(4, 320, 180), DVec3::new(0.1, 0.05, -0.1));
    let confidence = |pixels: f64| {
        let seen: Vec<Seen<'_>> = cameras
            .iter()
            .enumerate()
            .map(|(view, camera)| {
                let offset = DVec2::new(0.0, if view % 2 == 0 { pixels } else { -pixels });
                let affine = Affine { gradient: DMat2::IDENTITY, offset };
                Seen { camera, weight: 1.0, pixels: 9, affine }
            })
            .collect();
        means::solve(&seen, mean).map(|(_, confidence)| confidence)
    };
    // The algebraic error of four views is about 4 · depth · pixels / half the height.
    assert!(confidence(2.0).unwrap() > 0.0);
    assert!(confidence(8.0).unwrap() < 0.0);
    assert_eq!(confidence(16.0), None);
}

#[test]
fn identity_tracks_fix_everything() {
    let gaussians = sheet(120, 6);
    let field = run(&gaussians, &views(&arc(5, 160, 120), |x| x));
    assert!(field.origin.iter().all(|&origin| origin == MotionOrigin::Static), "{:?}", field.origin);
    assert_eq!(apply(&gaussians, &field), gaussians);
}

#[test]
fn visibility_does_not_matter() {
    let gaussians = sheet(80, 7);
    let shift = DVec3::new(0.1, 0.05, 0.0);
    let seen = views(&arc(4, 160, 120), |x| x + shift);
    let mut hidden = seen.clone();
    for view in &mut hidden {
        let tracks = Arc::make_mut(&mut view.tracks);
        tracks.visible.fill(false);
        tracks.sigma.fill(7.0);
    }
    assert_eq!(run(&gaussians, &hidden), run(&gaussians, &seen));
}

#[test]
fn permuted_gaussians_give_the_permuted_motion() {
    let gaussians = sheet(150, 8);
    let turn = DQuat::from_rotation_z(0.1);
    let views = views(&arc(5, 160, 120), |x| turn * x);
    let field = run(&gaussians, &views);
    let order: Vec<usize> = (0..gaussians.len()).map(|i| (i * 77 + 13) % gaussians.len()).collect();
    let permuted = run(&gaussians.select(&order), &views);
    for (new, &old) in order.iter().enumerate() {
        assert_eq!(permuted.origin[new], field.origin[old]);
        assert!((permuted.translation[new] - field.translation[old]).length() < 1e-9);
    }
}

/// Gaussians on a line, one unit apart.
fn line(count: usize) -> Gaussians {
    let mut line = blobs(count, 9);
    for (index, mean) in line.means.iter_mut().enumerate() {
        *mean = [index as f32, 0.0, 0.0];
    }
    line
}

fn own(count: usize) -> OwnMotion {
    OwnMotion { translation: vec![None; count], rotation: vec![None; count], is_fixed: vec![false; count] }
}

#[test]
fn the_median_of_the_neighbours_replaces_the_own_value() {
    let mut motion = own(9);
    for (index, translation) in motion.translation.iter_mut().enumerate() {
        *translation = Some((if index == 4 { DVec3::splat(50.0) } else { DVec3::X * index as f64 }, 1.0));
    }
    let spread = spread::spread(&line(9), &motion).unwrap();
    // The upper median of 0, 1, 2, 3, 5, 6, 7, 8: good or bad, the own value has no part in it.
    assert_eq!(spread.translation[4], DVec3::X * 5.0);
    // Of 1, 2, 3, 50, 5, 6, 7, 8.
    assert_eq!(spread.translation[0], DVec3::new(6.0, 0.0, 0.0));
}

#[test]
fn every_hole_that_a_chain_of_neighbours_reaches_is_filled() {
    let mut motion = own(200);
    motion.translation[199] = Some((DVec3::Y, 1.0));
    motion.rotation[199] = Some((DQuat::from_rotation_z(0.3), 1.0));
    let spread = spread::spread(&line(200), &motion).unwrap();
    // The source comes last: the index has no say in who passes on.
    assert!(spread.is_reached.iter().all(|&is_reached| is_reached));
    for index in 0..200 {
        assert!((spread.translation[index] - DVec3::Y).length() < 1e-9, "{index}");
        assert!(spread.rotation[index].angle_between(DQuat::from_rotation_z(0.3)) < 1e-6, "{index}");
    }
}

#[test]
fn rest_closes_in_but_anchors_nobody() {
    let mut motion = own(40);
    motion.is_fixed[..12].fill(true);
    motion.is_fixed[5] = false;
    motion.translation[39] = Some((DVec3::Y, 1.0));
    let spread = spread::spread(&line(40), &motion).unwrap();
    assert!(spread.is_fixed[5], "eight fixed neighbours fix it");
    assert!(!spread.is_fixed[20]);
    assert_eq!(spread.translation[5], DVec3::ZERO);
    // A neighbour of resting Gaussians takes the motion of the far end.
    assert!((spread.translation[12] - DVec3::Y).length() < 1e-9, "{}", spread.translation[12]);
}

#[test]
fn degenerate_input_gives_finite_motion() {
    let empty = run(&Gaussians::empty(0), &views(&arc(4, 32, 24), |x| x));
    assert!(empty.translation.is_empty());
    let mut gaussians = sheet(60, 10);
    gaussians.means[3] = [0.0, 0.0, -30.0]; // behind every camera
    gaussians.means[4] = gaussians.means[5];
    gaussians.log_scales[6] = [-30.0; 3];
    gaussians.rotations[7] = [0.0; 4];
    gaussians.logit_opacities[8] = -40.0;
    let mut views = views(&arc(4, 64, 48), |x| x + DVec3::new(0.1, 0.0, 0.0));
    Arc::make_mut(&mut views[1].tracks).positions[900..1500].fill([f32::NAN; 2]);
    let field = run(&gaussians, &views);
    assert!(field.translation.iter().all(|d| d.is_finite()));
    assert!(field.rotation.iter().all(|q| q.is_finite() && q.is_normalized()));
    assert!(run(&gaussians, &[]).origin.iter().all(|&origin| origin == MotionOrigin::Unsolved));
}
