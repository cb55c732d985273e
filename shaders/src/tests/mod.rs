//! Stage by stage against straightforward references.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the errors that were found"
)]

mod layout;
mod lost;
mod memory;
mod moments;
mod optimisation;
mod projection;
mod sorting;
mod stages;
#[path = "../../tests/gpu/support.rs"]
pub(crate) mod support;

use std::sync::Arc;

use splat::{
    engine::{SessionInput, TrainingView},
    gaussians::Gaussians,
    image::Image,
    optim::LearningRates,
};

use crate::{
    engine::Context,
    program::{Dispatch, record},
};

/// Runs dispatches.
fn run(context: &Context, dispatches: &[Dispatch]) {
    let mut encoder = context.device.device.create_command_encoder(&Default::default());
    record(&mut encoder, "test", dispatches);
    context.device.queue.submit([encoder.finish()]);
}

const BLACK: [f32; 3] = [0.0; 3];

/// Slow, and of degree 1.
const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 1e-3,
    log_scale: 1e-3,
    logit_opacity: 1e-3,
    sh_dc: 1e-3,
    sh_rest: 1e-3,
    sh_degree: 1,
};

/// What a session over one black view is opened with.
fn black_view(gaussians: Gaussians, width: u32, height: u32) -> SessionInput {
    let camera = support::arc(1, width, height).swap_remove(0);
    let image = Arc::new(Image::filled(width, height, BLACK));
    SessionInput {
        gaussians,
        views: vec![TrainingView { camera, image, mask: None }],
        background: BLACK,
        dssim_weight: 0.2,
        frozen: Vec::new(),
    }
}
