#![allow(clippy::unwrap_used, reason = "tests")]

use std::{ops::ControlFlow, sync::Arc};

use super::*;
use crate::{
    raster::CpuEngine,
    testing::{arc, blobs, render},
};

const BLACK: [f32; 3] = [0.0; 3];

fn input(gaussians: Gaussians, truth: &Gaussians) -> RefineInput {
    let views = arc(3, 60, 40)
        .into_iter()
        .map(|camera| TrainingView {
            image: Arc::new(render(truth, &camera, BLACK).image),
            camera,
            mask: None,
        })
        .collect();
    RefineInput { gaussians, views, frozen: Vec::new(), background: BLACK, seed: 1 }
}

fn settings(iterations: u32) -> RefineSettings {
    RefineSettings { iterations, ..RefineSettings::default() }
}

fn displaced(truth: &Gaussians) -> Gaussians {
    let mut start = truth.clone();
    for mean in &mut start.means {
        mean[1] += 0.02;
    }
    start
}

#[test]
fn a_displaced_set_comes_closer_to_the_images() {
    let truth = blobs(60, 1);
    let keep_going = &mut |_, _| ControlFlow::Continue(());
    let settings = RefineSettings { plateau_window: 0, ..settings(120) };
    let refined = refine(&CpuEngine::default(), input(displaced(&truth), &truth), &settings, keep_going)
        .unwrap()
        .unwrap();
    assert_eq!(refined.steps, 120);
    assert_eq!(refined.gaussians.len(), truth.len());
    assert!(refined.loss[1] < 0.5 * refined.loss[0], "{:?}", refined.loss);
}

#[test]
fn a_flat_loss_ends_it_early() {
    let truth = blobs(20, 2);
    let keep_going = &mut |_, _| ControlFlow::Continue(());
    let settings =
        RefineSettings { mean_rate: 0.0, plateau_window: 9, plateau_improvement: 0.9, ..settings(500) };
    let refined = refine(&CpuEngine::default(), input(displaced(&truth), &truth), &settings, keep_going)
        .unwrap()
        .unwrap();
    assert!(refined.steps < 500, "{} steps", refined.steps);
}

#[test]
fn no_iterations_change_nothing() {
    let truth = blobs(10, 3);
    let keep_going = &mut |_, _| ControlFlow::Continue(());
    let refined = refine(&CpuEngine::default(), input(truth.clone(), &truth), &settings(0), keep_going)
        .unwrap()
        .unwrap();
    assert_eq!((refined.gaussians, refined.steps), (truth, 0));
}

#[test]
fn it_stops_when_asked() {
    let truth = blobs(10, 4);
    let stop_at_five =
        &mut |done, _| if done == 5 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
    assert!(
        refine(&CpuEngine::default(), input(truth.clone(), &truth), &settings(50), stop_at_five)
            .unwrap()
            .is_none()
    );
}
