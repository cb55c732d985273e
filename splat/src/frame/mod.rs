//! One frame job: motion compensation, rollback, refinement, evaluation. A pure function of its input.

mod rest;
#[cfg(test)]
mod tests;

use std::{ops::ControlFlow, sync::Arc};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{
    cameras::Camera,
    engine::{Engine, EngineError, TrainingView},
    gaussians::{Gaussians, validate::validate},
    image::{Image, Mask},
    metrics,
    motion::{self, MotionOrigin, MotionView, OrderCounts},
    refine::{self, RefineInput},
    settings::{MaskUse, MotionSource, Settings},
    tracking::TrackField,
};

/// One view of the frame.
#[derive(Clone, Debug)]
pub struct FrameView {
    /// Name in the clip.
    pub name: String,
    /// Where it was taken from.
    pub camera: Camera,
    /// What it shows at this frame; of the camera's size.
    pub image: Arc<Image>,
    /// The clip's mask at this frame; [`crate::settings::MaskUse`] says what for.
    pub mask: Option<Arc<Mask>>,
    /// Tracks from the key frame to this frame; training views only.
    pub tracks: Option<Arc<TrackField>>,
}

/// What a frame job starts from.
#[derive(Clone, Debug)]
pub struct FrameInput {
    /// The key frame's Gaussians.
    pub static_model: Arc<Gaussians>,
    /// Views to train on; at least one.
    pub training_views: Vec<FrameView>,
    /// Held-out views to evaluate on.
    pub test_views: Vec<FrameView>,
    /// Settings of the job.
    pub settings: Settings,
    /// Whether this is the key frame itself: nothing moves and nothing is refined, it is only evaluated.
    pub is_key_frame: bool,
}

/// Where a frame job is; sent at every change and now and then in between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameProgress {
    /// `motion`, `refine` or `evaluate`.
    pub stage: &'static str,
    /// Units of the stage that are done.
    pub done: u64,
    /// Units of the stage in all.
    pub total: u64,
}

/// Quality on one view, or the mean over views.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewMetrics {
    /// View name; `mean` for the mean over views.
    pub view: String,
    /// Peak signal-to-noise ratio, dB.
    pub psnr: f64,
    /// Structural similarity, 11×11 Gaussian window.
    pub ssim: f64,
    /// PSNR over the pixels of the moving region; absent where the clip has no mask or nothing moves.
    pub moving_psnr: Option<f64>,
}

/// How many Gaussians got their motion from where.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MotionCounts {
    /// Did not move.
    pub r#static: usize,
    /// Solved from their own footprints.
    pub solved: usize,
    /// Filled from neighbours.
    pub propagated: usize,
    /// Left where they were.
    pub unsolved: usize,
}

/// What is known of a finished frame, besides its Gaussians.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameReport {
    /// Held-out metrics after motion compensation, before refinement.
    pub before: Vec<ViewMetrics>,
    /// Held-out metrics of the result.
    pub after: Vec<ViewMetrics>,
    /// Where the motions came from, as motion compensation found them; if `rolled_back`, none was applied.
    pub motion: MotionCounts,
    /// Which 2D models the footprints got, over all Gaussians and the training views that see them.
    #[serde(default)]
    pub orders: OrderCounts,
    /// Whether motion compensation rendered worse than no motion on the training views and was undone.
    pub rolled_back: bool,
    /// Gaussians whose refinement left the range of numbers; they are as motion compensation left them.
    pub restored: usize,
    /// Optimisation steps taken.
    pub refine_steps: u32,
    /// Mean training loss at the start and at the end of refinement.
    pub refine_loss: [f32; 2],
    /// The device that computed it, with its driver; `cpu` for the processor. Results differ between devices by rounding.
    #[serde(default)]
    pub device: String,
}

/// What a frame job yields.
#[derive(Clone, Debug)]
pub struct FrameResult {
    /// As many Gaussians as the static model, in the same order.
    pub gaussians: Gaussians,
    /// Metrics and counts.
    pub report: FrameReport,
}

/// Why a frame job failed.
#[derive(Debug, Error)]
pub enum FrameError {
    /// The input cannot be reconstructed.
    #[error("{0}")]
    BadInput(String),
    /// The device failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The caller's progress function asked to stop.
    #[error("cancelled")]
    Cancelled,
}

/// Runs one frame job; `progress` may stop it between optimisation steps.
///
/// Motion compensation is undone where it renders the training views worse than no motion: a wrong start costs more
/// than none.
pub fn reconstruct_frame(
    engine: &dyn Engine,
    input: &FrameInput,
    progress: &mut dyn FnMut(FrameProgress) -> ControlFlow<()>,
) -> Result<FrameResult, FrameError> {
    check(input)?;
    let mut advance = |stage, done, total| match progress(FrameProgress { stage, done, total }) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(FrameError::Cancelled),
    };
    advance("motion", 0, 1)?;
    let start = compensate(engine, input)?;
    let mut report = FrameReport {
        motion: start.counts,
        orders: start.orders,
        rolled_back: start.rolled_back,
        device: engine.device_name().unwrap_or(engine.name()).to_owned(),
        ..FrameReport::default()
    };
    advance("evaluate", 0, 1)?;
    report.before = evaluate(engine, &start.gaussians, input)?;
    if input.is_key_frame {
        report.after = report.before.clone();
        return Ok(FrameResult { gaussians: start.gaussians, report });
    }
    let mut refined = refine::refine(
        engine,
        RefineInput {
            gaussians: start.gaussians.clone(),
            views: training_views(input),
            frozen: start.frozen,
            background: input.settings.background,
            seed: input.settings.seed,
        },
        &input.settings.refine,
        &mut |done, total| match advance("refine", done.into(), total.into()) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        },
    )?
    .ok_or(FrameError::Cancelled)?;
    report.restored = restore_broken(&mut refined.gaussians, &start.gaussians);
    report.refine_steps = refined.steps;
    report.refine_loss = refined.loss;
    advance("evaluate", 0, 1)?;
    report.after = evaluate(engine, &refined.gaussians, input)?;
    Ok(FrameResult { gaussians: refined.gaussians, report })
}

fn check(input: &FrameInput) -> Result<(), FrameError> {
    if input.training_views.is_empty() {
        return Err(FrameError::BadInput("a frame without training views; hold out fewer".into()));
    }
    validate(&input.static_model).map_err(|error| FrameError::BadInput(format!("static model: {error}")))?;
    for view in input.training_views.iter().chain(&input.test_views) {
        let size = (view.camera.width, view.camera.height);
        if (view.image.width, view.image.height) != size {
            return Err(FrameError::BadInput(format!(
                "view {}: the image is {}x{}, its camera {}x{}; give images of the camera's size",
                view.name, view.image.width, view.image.height, size.0, size.1
            )));
        }
        if let Some(mask) = &view.mask
            && (mask.width, mask.height) != size
        {
            return Err(FrameError::BadInput(format!(
                "view {}: the mask is {}x{}, its camera {}x{}; give masks of the camera's size",
                view.name, mask.width, mask.height, size.0, size.1
            )));
        }
    }
    Ok(())
}

/// Gaussians that refinement starts from.
struct Start {
    gaussians: Gaussians,
    frozen: Vec<bool>,
    counts: MotionCounts,
    orders: OrderCounts,
    rolled_back: bool,
}

fn compensate(engine: &dyn Engine, input: &FrameInput) -> Result<Start, FrameError> {
    let views: Vec<MotionView> = input
        .training_views
        .iter()
        .filter_map(|view| {
            let tracks = view.tracks.as_ref()?;
            let tracks = motion::no_surer_than(tracks, input.settings.motion.least_track_sigma);
            let mask = view.mask.as_ref().filter(|_| input.settings.masks == MaskUse::Train);
            let tracks = match mask {
                Some(mask) => motion::within_mask(&tracks, mask),
                None => tracks,
            };
            Some(MotionView { camera: view.camera.clone(), tracks: Arc::new(tracks) })
        })
        .collect();
    if input.is_key_frame || views.is_empty() || input.settings.motion_source == MotionSource::None {
        return Ok(Start {
            gaussians: input.static_model.as_ref().clone(),
            frozen: Vec::new(),
            counts: MotionCounts::default(),
            orders: OrderCounts::default(),
            rolled_back: false,
        });
    }
    let field = motion::estimate(engine, &input.static_model, &views, &input.settings.motion)?;
    let counts = count(&field.origin);
    let moved = motion::apply(&input.static_model, &field);
    let rolled_back =
        training_psnr(engine, &moved, input)? < training_psnr(engine, &input.static_model, input)?;
    let gaussians = if rolled_back { input.static_model.as_ref().clone() } else { moved };
    let frozen = rest::frozen(
        engine,
        &gaussians,
        &field.origin,
        &input.training_views,
        input.settings.background,
        &input.settings.refine,
    )?;
    Ok(Start { gaussians, frozen, counts, orders: field.orders, rolled_back })
}

/// Puts Gaussians with a parameter that is no finite number back to where they started; returns how many.
fn restore_broken(gaussians: &mut Gaussians, start: &Gaussians) -> usize {
    let broken: Vec<usize> = (0..gaussians.len()).filter(|&index| !gaussians.is_finite(index)).collect();
    let stride = gaussians.sh_coefficients() * 3;
    for &index in &broken {
        gaussians.means[index] = start.means[index];
        gaussians.rotations[index] = start.rotations[index];
        gaussians.log_scales[index] = start.log_scales[index];
        gaussians.logit_opacities[index] = start.logit_opacities[index];
        gaussians.sh[index * stride..(index + 1) * stride].copy_from_slice(start.sh_of(index));
    }
    broken.len()
}

fn count(origins: &[MotionOrigin]) -> MotionCounts {
    let mut counts = MotionCounts::default();
    for origin in origins {
        *match origin {
            MotionOrigin::Static => &mut counts.r#static,
            MotionOrigin::Solved => &mut counts.solved,
            MotionOrigin::Propagated => &mut counts.propagated,
            MotionOrigin::Unsolved => &mut counts.unsolved,
        } += 1;
    }
    counts
}

fn training_views(input: &FrameInput) -> Vec<TrainingView> {
    input
        .training_views
        .iter()
        .map(|view| TrainingView {
            camera: view.camera.clone(),
            image: view.image.clone(),
            mask: view.mask.clone().filter(|_| input.settings.masks == MaskUse::Train),
        })
        .collect()
}

/// Mean PSNR over the training views, dB.
fn training_psnr(engine: &dyn Engine, gaussians: &Gaussians, input: &FrameInput) -> Result<f64, FrameError> {
    let views = training_views(input);
    let mut sum = 0.0;
    for view in &views {
        let rendered = engine.render(gaussians, &view.camera, input.settings.background)?.image;
        sum += match &view.mask {
            Some(mask) => metrics::masked_psnr(&rendered, &view.image, mask).unwrap_or(0.0),
            None => metrics::psnr(&rendered, &view.image),
        };
    }
    Ok(sum / views.len() as f64)
}

/// Metrics on every test view, then their mean.
fn evaluate(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    input: &FrameInput,
) -> Result<Vec<ViewMetrics>, FrameError> {
    let mut metrics = Vec::with_capacity(input.test_views.len() + 1);
    for view in &input.test_views {
        let rendered = engine.render(gaussians, &view.camera, input.settings.background)?.image;
        let moving = view.mask.as_deref().filter(|_| input.settings.masks == MaskUse::Evaluate);
        metrics.push(view_metrics(&view.name, &rendered, &view.image, moving));
    }
    metrics.extend(mean(&metrics));
    Ok(metrics)
}

/// Quality of one rendered view; `moving` marks the moving region.
pub fn view_metrics(name: &str, rendered: &Image, truth: &Image, moving: Option<&Mask>) -> ViewMetrics {
    ViewMetrics {
        view: name.to_owned(),
        psnr: metrics::psnr(rendered, truth),
        ssim: metrics::ssim(rendered, truth),
        moving_psnr: moving.and_then(|mask| metrics::masked_psnr(rendered, truth, mask)),
    }
}

/// Mean over views or frames, named `mean`; the moving region's over those that have one. `None` of none.
pub fn mean<'a>(metrics: impl IntoIterator<Item = &'a ViewMetrics>) -> Option<ViewMetrics> {
    let metrics: Vec<_> = metrics.into_iter().collect();
    let average =
        |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    let moving: Vec<f64> = metrics.iter().filter_map(|view| view.moving_psnr).collect();
    Some(ViewMetrics {
        view: "mean".to_owned(),
        psnr: average(&metrics.iter().map(|view| view.psnr).collect::<Vec<_>>())?,
        ssim: average(&metrics.iter().map(|view| view.ssim).collect::<Vec<_>>())?,
        moving_psnr: average(&moving),
    })
}
