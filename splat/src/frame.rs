//! One frame job: motion compensation, rollback, refinement, evaluation. A pure function of its input.

use std::{ops::ControlFlow, sync::Arc};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{
    cameras::Camera,
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    image::{Image, Mask},
    settings::Settings,
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
    /// Did not move; frozen in refinement.
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
    /// Where the motions came from.
    pub motion: MotionCounts,
    /// Whether motion compensation rendered worse than no motion on the training views and was undone.
    pub rolled_back: bool,
    /// Optimisation steps taken.
    pub refine_steps: u32,
    /// Mean training loss at the start and at the end of refinement.
    pub refine_loss: [f32; 2],
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
pub fn reconstruct_frame(
    _engine: &dyn Engine,
    _input: &FrameInput,
    _progress: &mut dyn FnMut(FrameProgress) -> ControlFlow<()>,
) -> Result<FrameResult, FrameError> {
    unimplemented!("lands with the refinement commit")
}
