//! What a device offers to the algorithms above it.
//!
//! One trait, two engines: the CPU engine in [`crate::raster`], and the GPU engine of `splat-shaders`. Static-model
//! reconstruction, motion compensation and refinement are written once, against this trait.

use std::sync::Arc;

use thiserror::Error;

use crate::{
    cameras::Camera,
    gaussians::{Gaussians, validate::validate},
    image::{Image, Mask},
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    optim::LearningRates,
    tracking::TrackField,
};

/// Why a device could not do what it was asked.
#[derive(Clone, Debug, Error)]
pub enum EngineError {
    /// The input breaks a documented precondition.
    #[error("invalid input to the engine: {0}")]
    InvalidInput(String),
    /// The device has not enough memory for the job.
    #[error(
        "the job needs {needed} bytes on the device, {}; use fewer Gaussians, smaller images or another worker",
        granted(*available)
    )]
    OutOfResources {
        /// Bytes the job would take.
        needed: u64,
        /// Bytes the device grants; 0 where the driver refused without saying.
        available: u64,
    },
    /// The device went away.
    #[error("the device was lost: {0}")]
    DeviceLost(String),
    /// The engine asked its device for what the device's rules forbid. The device works on.
    #[error("the engine broke a rule of its device: {0}; this is a bug, please report it")]
    Internal(String),
}

fn granted(available: u64) -> String {
    match available {
        0 => "its driver grants no more".to_owned(),
        bytes => format!("{bytes} are available"),
    }
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

impl SessionInput {
    /// Whether everything fits together; every engine's session starts with this.
    pub fn validate(&self) -> Result<(), EngineError> {
        if self.views.is_empty() {
            return Err(EngineError::InvalidInput("no training view; give at least one".into()));
        }
        validate(&self.gaussians).map_err(|error| EngineError::InvalidInput(error.to_string()))?;
        let count = self.gaussians.len();
        if !(self.frozen.is_empty() || self.frozen.len() == count) {
            return Err(EngineError::InvalidInput(format!(
                "{} frozen flags for {count} Gaussians",
                self.frozen.len()
            )));
        }
        for (number, view) in self.views.iter().enumerate() {
            let (image, camera) = (&view.image, &view.camera);
            check_size(camera)?;
            if (image.width, image.height) != (camera.width, camera.height) {
                return Err(EngineError::InvalidInput(format!(
                    "training image {number} is {}x{}, its camera {}x{}",
                    image.width, image.height, camera.width, camera.height
                )));
            }
            if let Some(mask) = &view.mask
                && (mask.width, mask.height) != (camera.width, camera.height)
            {
                return Err(EngineError::InvalidInput(format!(
                    "training mask {number} is {}x{}, its camera {}x{}",
                    mask.width, mask.height, camera.width, camera.height
                )));
            }
        }
        Ok(())
    }
}

/// An image without pixels has nothing to hand out to the parts of a device.
pub fn check_size(camera: &Camera) -> Result<(), EngineError> {
    if camera.width == 0 || camera.height == 0 {
        let (width, height) = (camera.width, camera.height);
        return Err(EngineError::InvalidInput(format!("a camera of {width}x{height} pixels; it needs one")));
    }
    Ok(())
}

/// Whether a track field has the camera's size.
pub fn check_tracks(camera: &Camera, tracks: &TrackField) -> Result<(), EngineError> {
    let pixels = camera.width as usize * camera.height as usize;
    let fits = tracks.width == camera.width
        && tracks.height == camera.height
        && [tracks.positions.len(), tracks.visible.len(), tracks.sigma.len()] == [pixels; 3];
    if fits {
        return Ok(());
    }
    Err(EngineError::InvalidInput(format!(
        "a track field of {}x{} for a camera of {}x{}; give tracks of the camera's size",
        tracks.width, tracks.height, camera.width, camera.height
    )))
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

impl DensityStatistics {
    /// Of `count` Gaussians before the first step.
    pub fn zeros(count: usize) -> Self {
        Self { gradient_norm: vec![0.0; count], visible_steps: vec![0; count] }
    }
}

/// Parameters, optimiser state and images kept on a device between steps.
pub trait Session: Send {
    /// One optimisation step on view `view` of the session's input. A device may still be at work on it, and on a few before it,
    /// afterwards: only the methods that read something back wait for it.
    fn step(&mut self, view: usize, rates: &LearningRates) -> Result<(), EngineError>;

    /// Reads back the losses, each before its update, of the steps since this was last asked, oldest first.
    fn take_losses(&mut self) -> Result<Vec<f32>, EngineError>;

    /// Reads the parameters back.
    fn gaussians(&mut self) -> Result<Gaussians, EngineError>;

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

    /// The device and its driver, for people; `None` for the processor that runs this program.
    fn device_name(&self) -> Option<&str> {
        None
    }

    /// Whether the device is there to work. An engine that can come back to a lost device does so here.
    fn check(&self) -> Result<(), EngineError> {
        Ok(())
    }

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
