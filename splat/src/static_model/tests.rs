#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::Arc;

use glam::DVec3;

use super::{densify::densify, *};
use crate::{
    engine::DensityStatistics,
    gaussians::{logit, sh},
    metrics,
    raster::CpuEngine,
    testing::{arc, blobs, render},
};

const BLACK: [f32; 3] = [0.0; 3];

fn settings(max_steps: u32) -> StaticModelSettings {
    StaticModelSettings {
        max_steps,
        densify_from: 100,
        densify_interval: 50,
        ..StaticModelSettings::default()
    }
}

fn input(max_steps: u32, with_points: bool) -> (StaticModelInput, Gaussians) {
    let mut truth = blobs(80, 1);
    // Five views determine no more than degree 0.
    for coefficients in truth.sh.chunks_exact_mut(12) {
        coefficients[3..].fill(0.0);
    }
    let views = arc(5, 64, 48)
        .into_iter()
        .map(|camera| TrainingView {
            image: Arc::new(render(&truth, &camera, BLACK).image),
            camera,
            mask: None,
        })
        .collect();
    let points = (0..truth.len())
        .map(|index| SfmPoint { position: truth.mean(index), colour: [0.5; 3] })
        .filter(|_| with_points)
        .collect();
    (StaticModelInput { views, points, background: BLACK, seed: 3, settings: settings(max_steps) }, truth)
}

fn go_on(_: StaticModelProgress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn training_psnr(gaussians: &Gaussians, input: &StaticModelInput) -> f64 {
    let values = input
        .views
        .iter()
        .map(|view| metrics::psnr(&render(gaussians, &view.camera, input.background).image, &view.image));
    values.sum::<f64>() / input.views.len() as f64
}

/// Gain of 400 steps over 10, dB.
fn gain(with_points: bool) -> f64 {
    let psnr = |steps| {
        let (mut input, _) = input(steps, with_points);
        input.settings.random_points = 600;
        if with_points {
            // As many as the truth has: only their parameters are to be found.
            input.settings.densify_until = 0.0;
            input.settings.plateau_window = 0;
        }
        let model = reconstruct(&CpuEngine::default(), &input, &mut go_on).unwrap();
        assert!(model.len() <= input.settings.max_gaussians);
        training_psnr(&model, &input)
    };
    psnr(400) - psnr(10)
}

#[test]
fn a_scene_is_reconstructed_from_its_points() {
    let gain = gain(true);
    assert!(gain > 4.0, "{gain} dB");
}

#[test]
fn without_points_it_starts_from_random_ones_in_view_of_the_cameras() {
    let gain = gain(false);
    assert!(gain > 3.0, "{gain} dB");
}

#[test]
fn the_same_seed_gives_the_same_model() {
    let (input, _) = input(90, true);
    let first = reconstruct(&CpuEngine::default(), &input, &mut go_on).unwrap();
    assert_eq!(first, reconstruct(&CpuEngine::default(), &input, &mut go_on).unwrap());
}

#[test]
fn it_refuses_one_view_and_cameras_that_share_nothing() {
    let (mut one_view, _) = input(10, true);
    one_view.views.truncate(1);
    assert!(matches!(
        reconstruct(&CpuEngine::default(), &one_view, &mut go_on),
        Err(StaticModelError::BadInput(_))
    ));
    let (mut apart, _) = input(10, false);
    apart.views.truncate(2);
    // Back to back.
    apart.views[1].camera.rotation =
        glam::DMat3::from_rotation_y(std::f64::consts::PI) * apart.views[0].camera.rotation;
    apart.views[1].camera.translation = DVec3::new(0.0, 0.0, -40.0);
    apart.views[0].camera.translation = DVec3::new(0.0, 0.0, -40.0);
    assert!(matches!(
        reconstruct(&CpuEngine::default(), &apart, &mut go_on),
        Err(StaticModelError::BadInput(_))
    ));
}

#[test]
fn it_stops_when_asked() {
    let (input, _) = input(50, true);
    let mut stop = |progress: StaticModelProgress| {
        if progress.step == 7 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    assert!(matches!(
        reconstruct(&CpuEngine::default(), &input, &mut stop),
        Err(StaticModelError::Cancelled)
    ));
}

#[test]
fn harmonics_need_two_views_per_coefficient() {
    let settings = StaticModelSettings::default();
    let degrees = [1, 2, 7, 8, 17, 18, 31, 32, 100].map(|views| settings.sh_degree_for(views));
    assert_eq!(degrees, [0, 0, 0, 1, 1, 2, 2, 3, 3]);
    let free = StaticModelSettings { sh_views_per_coefficient: 0, ..settings };
    assert_eq!(free.sh_degree_for(2), 3);
}

#[test]
fn densification_clones_small_splits_large_and_removes_faint_ones_under_the_cap() {
    let mut gaussians = Gaussians::empty(0);
    for (log_scale, opacity) in [(-6.0f32, 0.5), (-2.5, 0.5), (-6.0, 0.001), (-6.0, 0.5), (3.0, 0.5)] {
        gaussians.means.push([0.0; 3]);
        gaussians.rotations.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.log_scales.push([log_scale; 3]);
        gaussians.logit_opacities.push(logit(opacity) as f32);
        gaussians.sh.extend([0.0; sh::coefficients(0) * 3]);
    }
    let statistics =
        DensityStatistics { gradient_norm: vec![1.0, 0.9, 1.0, 0.0, 1.0], visible_steps: vec![10; 5] };
    let grow = |max_gaussians| {
        let settings = StaticModelSettings { max_gaussians, ..StaticModelSettings::default() };
        densify(&gaussians, &statistics, &settings, 1.0, true, &mut ChaCha8Rng::seed_from_u64(0))
    };
    let free = grow(100);
    assert_eq!(free.source, [Some(0), None, None, None, Some(3)], "clone 0, split 1, drop 2 and 4, keep 3");
    assert!(free.gaussians.log_scales[2][0] < -2.5, "halves are smaller");
    assert_eq!(grow(4).source, [Some(0), None, Some(1), Some(3)], "room for the strongest only");
}
