//! Reconstruction of the key frame as a static set of Gaussians.

mod densify;
mod init;
mod settings;
#[cfg(test)]
mod tests;

use std::ops::ControlFlow;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

pub use settings::StaticModelSettings;

use crate::{
    cameras::{Camera, rig::scene_extent},
    engine::{Engine, EngineError, Session, SessionInput, TrainingView},
    gaussians::Gaussians,
    optim::{Epochs, LearningRates, Plateau},
};

/// A structure-from-motion point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SfmPoint {
    /// World position.
    pub position: glam::DVec3,
    /// sRGB in `[0, 1]`.
    pub colour: [f32; 3],
}

/// What the key frame is reconstructed from.
#[derive(Clone, Debug)]
pub struct StaticModelInput {
    /// Training images of the key frame; at least two.
    pub views: Vec<TrainingView>,
    /// Structure-from-motion points; random points in the common frustum if empty.
    pub points: Vec<SfmPoint>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Seed of every random choice.
    pub seed: u64,
    /// How.
    pub settings: StaticModelSettings,
}

/// Where the reconstruction is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StaticModelProgress {
    /// Optimisation steps done.
    pub step: u32,
    /// Steps at most; it may stop earlier.
    pub steps: u32,
    /// Gaussians now.
    pub gaussians: usize,
    /// Smoothed training loss.
    pub loss: f32,
}

/// Why there is no static model.
#[derive(Debug, thiserror::Error)]
pub enum StaticModelError {
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

/// Reconstructs the key frame; `progress` may stop it between steps.
///
/// 3D Gaussian Splatting (Kerbl et al. 2023) with adaptive density control under a hard cap, on a schedule that ends
/// when the training loss flattens.
pub fn reconstruct(
    engine: &dyn Engine,
    input: &StaticModelInput,
    progress: &mut dyn FnMut(StaticModelProgress) -> ControlFlow<()>,
) -> Result<Gaussians, StaticModelError> {
    if input.views.len() < 2 {
        return Err(StaticModelError::BadInput(format!(
            "{} training view: a scene needs at least two; hold out fewer views",
            input.views.len()
        )));
    }
    let cameras: Vec<&Camera> = input.views.iter().map(|view| &view.camera).collect();
    let extent = scene_extent(&cameras);
    let mut random = ChaCha8Rng::seed_from_u64(input.seed);
    let gaussians = initial(input, &cameras, &mut random)?;
    let session = engine.session(SessionInput {
        gaussians,
        views: input.views.clone(),
        background: input.background,
        dssim_weight: input.settings.dssim_weight,
        frozen: Vec::new(),
    })?;
    Optimisation { session, settings: &input.settings, extent, random, views: input.views.len() }
        .run(progress)
}

fn initial(
    input: &StaticModelInput,
    cameras: &[&Camera],
    random: &mut ChaCha8Rng,
) -> Result<Gaussians, StaticModelError> {
    let settings = &input.settings;
    let drawn;
    let points = if input.points.is_empty() {
        drawn = init::random_points(cameras, settings.random_points.min(settings.max_gaussians), random);
        &drawn
    } else {
        &input.points
    };
    if points.is_empty() {
        return Err(StaticModelError::BadInput(
            "no point of space is seen by two training views; check the poses or give sparse points".into(),
        ));
    }
    let stride = points.len().div_ceil(settings.max_gaussians.max(1));
    let thinned: Vec<SfmPoint> = points.iter().step_by(stride).copied().collect();
    Ok(init::from_points(&thinned, settings.sh_degree_for(input.views.len())))
}

/// The Gaussians whose every parameter is a finite number.
fn finite(gaussians: &Gaussians) -> Result<Gaussians, StaticModelError> {
    let kept: Vec<usize> = (0..gaussians.len()).filter(|&index| gaussians.is_finite(index)).collect();
    if kept.is_empty() {
        return Err(StaticModelError::BadInput(
            "the optimisation diverged; lower the rates of `static_model`".into(),
        ));
    }
    Ok(gaussians.select(&kept))
}

/// Steps between two looks at the loss for reports: a device need not wait for the host in between.
const LOSS_INTERVAL: u32 = 16;

struct Optimisation<'a> {
    session: Box<dyn Session>,
    settings: &'a StaticModelSettings,
    extent: f64,
    random: ChaCha8Rng,
    views: usize,
}

impl Optimisation<'_> {
    fn run(
        mut self,
        progress: &mut dyn FnMut(StaticModelProgress) -> ControlFlow<()>,
    ) -> Result<Gaussians, StaticModelError> {
        let steps = self.settings.max_steps;
        let grow_until = (self.settings.densify_until * steps as f32) as u32;
        let mut plateau =
            Plateau::new(self.settings.plateau_window, self.settings.plateau_improvement, self.views);
        let mut epochs = Epochs::new(self.views);
        let mut count = self.session.gaussians()?.len();
        let (mut loss, mut losses) = (0.0, 0);
        for step in 0..steps {
            let view = epochs.next(&mut self.random);
            self.session.step(view, &self.rates(step))?;
            let done = step + 1;
            if done >= self.settings.densify_from
                && done <= grow_until
                && done.is_multiple_of(self.settings.densify_interval.max(1))
            {
                count = self.densify(done < grow_until)?;
            }
            let is_due = done > grow_until && plateau.is_due(done - grow_until);
            let mut is_flat = false;
            if is_due || done == steps || done.is_multiple_of(LOSS_INTERVAL) {
                for value in self.session.take_losses()? {
                    (loss, losses) = (value, losses + 1);
                    is_flat |= losses > grow_until && plateau.is_reached(value);
                }
            }
            let report = StaticModelProgress { step: done, steps, gaussians: count, loss };
            if progress(report).is_break() {
                return Err(StaticModelError::Cancelled);
            }
            if is_flat {
                break;
            }
        }
        finite(&self.session.gaussians()?)
    }

    fn densify(&mut self, grow: bool) -> Result<usize, StaticModelError> {
        let statistics = self.session.take_density_statistics()?;
        let gaussians = self.session.gaussians()?;
        let densified =
            densify::densify(&gaussians, &statistics, self.settings, self.extent, grow, &mut self.random);
        let count = densified.gaussians.len();
        if count == 0 {
            return Err(StaticModelError::BadInput(
                "every Gaussian was pruned: the images show nothing that the cameras agree on; check the poses".into(),
            ));
        }
        self.session.replace(densified.gaussians, &densified.source)?;
        Ok(count)
    }

    fn rates(&self, step: u32) -> LearningRates {
        let settings = self.settings;
        let share = step as f32 / settings.max_steps.max(1) as f32;
        let mean = settings.mean_rate.powf(1.0 - share) * settings.mean_rate_final.powf(share);
        LearningRates {
            mean: mean * self.extent as f32,
            rotation: settings.rotation_rate,
            log_scale: settings.log_scale_rate,
            logit_opacity: settings.logit_opacity_rate,
            sh_dc: settings.sh_dc_rate,
            sh_rest: settings.sh_rest_rate,
            sh_degree: (step / settings.sh_degree_interval.max(1)).min(settings.sh_degree),
        }
    }
}
