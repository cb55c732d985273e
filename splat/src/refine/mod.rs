//! Photometric refinement of one frame: every parameter class with its own rate, on all training views, without
//! densification (TrackerSplat, section on refinement).

mod settings;
#[cfg(test)]
mod tests;

use std::ops::ControlFlow;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

pub use settings::RefineSettings;

use crate::{
    cameras::{Camera, rig::scene_extent},
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::Gaussians,
    optim::{Epochs, LearningRates, Plateau},
};

/// What a refinement starts from.
#[derive(Clone, Debug)]
pub struct RefineInput {
    /// Gaussians after motion compensation.
    pub gaussians: Gaussians,
    /// Images of the frame; at least one.
    pub views: Vec<TrainingView>,
    /// Gaussians that stay as they are; empty: none.
    pub frozen: Vec<bool>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Seed of the order of the views.
    pub seed: u64,
}

/// What a refinement yields.
#[derive(Clone, Debug)]
pub struct Refined {
    /// As many Gaussians as before, in the same order.
    pub gaussians: Gaussians,
    /// Steps taken.
    pub steps: u32,
    /// Mean loss over the first and over the last epoch.
    pub loss: [f32; 2],
}

/// Refines a frame; `progress(done, total)` may stop it between steps, which yields `None`.
pub fn refine(
    engine: &dyn Engine,
    input: RefineInput,
    settings: &RefineSettings,
    progress: &mut dyn FnMut(u32, u32) -> ControlFlow<()>,
) -> Result<Option<Refined>, EngineError> {
    let all_frozen = !input.frozen.is_empty() && input.frozen.iter().all(|&frozen| frozen);
    if settings.iterations == 0 || input.gaussians.is_empty() || all_frozen {
        return Ok(Some(Refined { gaussians: input.gaussians, steps: 0, loss: [0.0; 2] }));
    }
    let cameras: Vec<&Camera> = input.views.iter().map(|view| &view.camera).collect();
    let extent = scene_extent(&cameras) as f32;
    let views = input.views.len();
    let sh_degree = input.gaussians.sh_degree;
    let mut session = engine.session(SessionInput {
        gaussians: input.gaussians,
        views: input.views,
        background: input.background,
        dssim_weight: settings.dssim_weight,
        frozen: input.frozen,
    })?;
    let mut random = ChaCha8Rng::seed_from_u64(input.seed);
    let mut epochs = Epochs::new(views);
    let mut plateau = Plateau::new(settings.plateau_window, settings.plateau_improvement, views);
    let mut losses = Vec::new();
    for step in 0..settings.iterations {
        let view = epochs.next(&mut random);
        session.step(view, &rates(settings, step, extent, sh_degree))?;
        let done = step + 1;
        if progress(done, settings.iterations).is_break() {
            return Ok(None);
        }
        // Losses wait on the device until they decide something.
        if !(plateau.is_due(done) || done == settings.iterations) {
            continue;
        }
        let mut is_flat = false;
        for loss in session.take_losses()? {
            is_flat |= plateau.is_reached(loss);
            losses.push(loss);
        }
        if is_flat {
            break;
        }
    }
    let mean = |part: &[f32]| part.iter().sum::<f32>() / part.len() as f32;
    let epoch = views.min(losses.len());
    Ok(Some(Refined {
        gaussians: session.gaussians()?,
        steps: losses.len() as u32,
        loss: [mean(&losses[..epoch]), mean(&losses[losses.len() - epoch..])],
    }))
}

fn rates(settings: &RefineSettings, step: u32, extent: f32, sh_degree: u32) -> LearningRates {
    let share = step as f32 / settings.iterations as f32;
    let fade = settings.final_rate_share.powf(share);
    LearningRates {
        mean: settings.mean_rate * extent * fade,
        rotation: settings.rotation_rate * fade,
        log_scale: settings.log_scale_rate * fade,
        logit_opacity: settings.logit_opacity_rate * fade,
        sh_dc: settings.sh_dc_rate * fade,
        sh_rest: settings.sh_rest_rate * fade,
        sh_degree,
    }
}
