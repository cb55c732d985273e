//! The algorithms above the engine end on the device where they end on the CPU.

use std::{ops::ControlFlow, sync::Arc};

use splat::{
    engine::{Engine, TrainingView},
    gaussians::Gaussians,
    metrics,
    raster::CpuEngine,
    refine::{RefineInput, RefineSettings, refine},
    static_model::{SfmPoint, StaticModelInput, StaticModelSettings, reconstruct},
};

use crate::support::{arc, blobs, engine};

const BLACK: [f32; 3] = [0.0; 3];

fn views(truth: &Gaussians, count: usize) -> Vec<TrainingView> {
    let view = |camera| TrainingView {
        image: Arc::new(CpuEngine::default().render(truth, &camera, BLACK).unwrap().image),
        camera,
        mask: None,
    };
    arc(count, 48, 32).into_iter().map(view).collect()
}

/// Over the training views, dB, drawn by the CPU engine.
fn psnr(gaussians: &Gaussians, views: &[TrainingView]) -> f64 {
    let drawn =
        |view: &TrainingView| CpuEngine::default().render(gaussians, &view.camera, BLACK).unwrap().image;
    views.iter().map(|view| metrics::psnr(&drawn(view), &view.image)).sum::<f64>() / views.len() as f64
}

#[test]
fn refinement_ends_where_that_of_the_cpu_engine_does() {
    let Some(gpu) = engine() else { return };
    let truth = blobs(60, 0, 41);
    let mut start = truth.clone();
    for mean in &mut start.means {
        mean[1] += 0.02;
    }
    let views = views(&truth, 3);
    // The loss falls from window to window, but not to a twentieth: the second one ends the run.
    let settings = RefineSettings {
        iterations: 200,
        plateau_window: 30,
        plateau_improvement: 0.95,
        ..Default::default()
    };
    let refined = |engine: &dyn Engine| {
        let input = RefineInput {
            gaussians: start.clone(),
            views: views.clone(),
            frozen: Vec::new(),
            background: BLACK,
            seed: 1,
        };
        refine(engine, input, &settings, &mut |_, _| ControlFlow::Continue(())).unwrap().unwrap()
    };
    let (ours, theirs) = (refined(gpu), refined(&CpuEngine::default()));
    let (our_psnr, their_psnr) = (psnr(&ours.gaussians, &views), psnr(&theirs.gaussians, &views));
    println!("{} and {} steps, {our_psnr} and {their_psnr} dB", ours.steps, theirs.steps);
    assert_eq!(ours.steps, theirs.steps);
    assert!(
        (ours.loss[1] - theirs.loss[1]).abs() < 0.05 * theirs.loss[1],
        "{:?} {:?}",
        ours.loss,
        theirs.loss
    );
    assert!((our_psnr - their_psnr).abs() < 0.1, "{our_psnr} dB, the CPU engine's {their_psnr} dB");
    assert!(our_psnr > psnr(&start, &views) + 3.0, "nothing was learned");
}

#[test]
fn a_static_model_is_as_good_as_that_of_the_cpu_engine() {
    let Some(gpu) = engine() else { return };
    let truth = blobs(80, 0, 42);
    let views = views(&truth, 5);
    let points: Vec<_> =
        (0..truth.len()).map(|index| SfmPoint { position: truth.mean(index), colour: [0.5; 3] }).collect();
    let reconstructed = |engine: &dyn Engine| {
        let settings = StaticModelSettings {
            max_steps: 150,
            densify_from: 60,
            densify_interval: 30,
            ..StaticModelSettings::default()
        };
        let (views, points) = (views.clone(), points.clone());
        let input = StaticModelInput { views, points, background: BLACK, seed: 3, settings };
        let mut last = 0.0;
        let model = reconstruct(engine, &input, &mut |progress| {
            last = progress.loss;
            ControlFlow::Continue(())
        });
        (model.unwrap(), last)
    };
    let ((ours, our_loss), (theirs, their_loss)) = (reconstructed(gpu), reconstructed(&CpuEngine::default()));
    let (our_psnr, their_psnr) = (psnr(&ours, &views), psnr(&theirs, &views));
    println!("{} and {} Gaussians, {our_psnr} and {their_psnr} dB", ours.len(), theirs.len());
    // Which Gaussians are split is a matter of thresholds, and what comes of it of random numbers.
    assert!(ours.len().abs_diff(theirs.len()) < 5 + theirs.len() / 20);
    assert!((our_psnr - their_psnr).abs() < 0.3, "{our_psnr} dB, the CPU engine's {their_psnr} dB");
    assert!((our_loss - their_loss).abs() < 0.05 * their_loss, "{our_loss}, {their_loss}");
}
