//! What a device offers to the algorithms above it.
//!
//! One trait, two engines: the CPU engine in [`crate::raster`], later a GPU engine beside it. Static-model
//! reconstruction, motion compensation and refinement are written once, against this trait.

use std::sync::Arc;

use thiserror::Error;

use crate::{
    cameras::Camera,
    gaussians::Gaussians,
    image::{Image, Mask},
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    optim::LearningRates,
    tracking::TrackField,
};

/// Why a device could not do what it was asked.
#[derive(Debug, Error)]
pub enum EngineError {
    /// The input breaks a documented precondition.
    #[error("invalid input to the engine: {0}")]
    InvalidInput(String),
    /// The device has not enough memory for the job.
    #[error(
        "the job needs {needed} bytes on the device, {available} are available; use fewer Gaussians, smaller images or another worker"
    )]
    OutOfResources {
        /// Bytes the job would take.
        needed: u64,
        /// Bytes the device grants.
        available: u64,
    },
    /// The device went away.
    #[error("the device was lost: {0}")]
    DeviceLost(String),
}

/// A rendered view.
#[derive(Clone, Debug)]
pub struct Rendering {
    /// Blended colour over the background, not clamped.
    pub image: Image,
    /// Accumulated opacity per pixel, `height × width`.
    pub alpha: Vec<f32>,
}

/// One training image of a session.
#[derive(Clone, Debug)]
pub struct TrainingView {
    /// Where it was taken from.
    pub camera: Camera,
    /// What it shows; of the camera's size.
    pub image: Arc<Image>,
    /// Pixels that count in the loss; all of them if `None`.
    pub mask: Option<Arc<Mask>>,
}

/// Which Gaussians and images an optimisation session works on.
#[derive(Clone, Debug)]
pub struct SessionInput {
    /// Starting parameters.
    pub gaussians: Gaussians,
    /// Training images; at least one.
    pub views: Vec<TrainingView>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Weight `w` of the structural term in `(1 - w) L1 + w (1 - SSIM)`.
    pub dssim_weight: f32,
    /// Gaussians that stay as they are, in every parameter; empty means none.
    pub frozen: Vec<bool>,
}

/// Statistics of one optimisation step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// The loss before the update.
    pub loss: f32,
}

/// Per-Gaussian statistics that densification decides by, summed since they were last taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensityStatistics {
    /// Sum over steps of the norm of the loss gradient by the projected mean, in units of half the image size
    /// (normalised device coordinates), as in the original 3D Gaussian Splatting.
    pub gradient_norm: Vec<f32>,
    /// Number of steps in which the Gaussian was visible.
    pub visible_steps: Vec<u32>,
}

/// Parameters, optimiser state and images kept on a device between steps.
pub trait Session: Send {
    /// One optimisation step on view `view` of the session's input.
    fn step(&mut self, view: usize, rates: &LearningRates) -> Result<StepReport, EngineError>;

    /// Reads the parameters back.
    fn gaussians(&self) -> Result<Gaussians, EngineError>;

    /// Reads the densification statistics back and resets them.
    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError>;

    /// Replaces the parameters. `source[i]` names the old Gaussian whose optimiser moments the new Gaussian `i`
    /// keeps; `None` starts it from zero moments.
    fn replace(&mut self, gaussians: Gaussians, source: &[Option<usize>]) -> Result<(), EngineError>;
}

/// A device that renders, measures footprints and optimises.
pub trait Engine: Send + Sync {
    /// Short name for reports, such as `cpu`.
    fn name(&self) -> &str;

    /// Renders one view.
    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError>;

    /// Weighted moments of every Gaussian's footprint under a track field of the camera's size, one entry per
    /// Gaussian.
    ///
    /// One rasterization pass without `reweighting`. With it, up to [`Reweighting::passes`] more: before each,
    /// [`Reweighting::expected`] says for which footprints and by which motion; their moments are then summed
    /// again with every pixel's weight times the share that its residual leaves, and go through
    /// [`FootprintMoments::reweigh`].
    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError>;

    /// Opens an optimisation session.
    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError>;
}
