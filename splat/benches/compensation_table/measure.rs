//! Compensates a frame, refines it, and looks at what was held out.

use std::{ops::ControlFlow, sync::Arc};

use anyhow::{Context, Result};
use serde::Serialize;
use splat::{
    clip::Split,
    engine::Engine,
    frame::{self, ViewMetrics},
    gaussians::Gaussians,
    motion::{self, LiftMethod, MotionOrigin, MotionSettings},
    raster::CpuEngine,
    refine::{self, RefineInput, RefineSettings},
    settings::Settings,
};

use super::{Tracks, clip::ClipInput};

/// What a frame starts from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Method {
    /// The static model as it is.
    None,
    /// The released code's compensation.
    Reference,
    /// The project's.
    Robust,
}

impl Method {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Reference => "reference",
            Self::Robust => "robust",
        }
    }

    fn lift(self) -> Option<LiftMethod> {
        match self {
            Self::None => None,
            Self::Reference => Some(LiftMethod::Reference),
            Self::Robust => Some(LiftMethod::Robust),
        }
    }
}

/// Quality after some refinement, mean over the held-out views.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Quality {
    pub(crate) iterations: u32,
    /// PSNR of the moving region, dB; absent where nothing moves.
    pub(crate) moving_psnr: Option<f64>,
    /// PSNR of whole images, dB.
    pub(crate) psnr: f64,
}

/// One frame from one start.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Run {
    pub(crate) clip: String,
    pub(crate) frame: u32,
    pub(crate) tracks: Option<Tracks>,
    pub(crate) method: Method,
    /// Share of the Gaussians whose motion was solved, taken from others, called static.
    pub(crate) origins: [f64; 3],
    pub(crate) quality: Vec<Quality>,
}

impl ClipInput {
    /// Refines frame number `frame` from one start, as often as there are numbers of iterations.
    ///
    /// Compensation is never undone and nothing is frozen, as a job may: what is compared is the compensation.
    pub(crate) fn measure(
        &self,
        frame: u32,
        method: Method,
        tracks: Option<Tracks>,
        iterations: &[u32],
        settings: &Settings,
    ) -> Result<Run> {
        let index = frame as usize - 1;
        let engine = CpuEngine::default();
        let (start, origins) = match (method.lift(), tracks) {
            (Some(lift), Some(tracks)) => {
                let motion_settings = MotionSettings { lift, ..settings.motion.clone() };
                let mut views = self.motion_views(tracks, index)?;
                for view in &mut views {
                    let least = settings.motion.least_track_sigma;
                    view.tracks = Arc::new(motion::no_surer_than(&view.tracks, least));
                }
                let field = motion::estimate(&engine, &self.static_model, &views, &motion_settings)?;
                (motion::apply(&self.static_model, &field), shares(&field.origin))
            }
            _ => (self.static_model.clone(), [0.0; 3]),
        };
        let quality = iterations
            .iter()
            .map(|&iterations| {
                let refined = self.refined(&engine, &start, index, iterations, settings)?;
                self.quality(&engine, &refined, index, iterations, settings)
            })
            .collect::<Result<_>>()?;
        Ok(Run { clip: self.name.clone(), frame, tracks, method, origins, quality })
    }

    fn refined(
        &self,
        engine: &dyn Engine,
        start: &Gaussians,
        frame: usize,
        iterations: u32,
        settings: &Settings,
    ) -> Result<Gaussians> {
        let input = RefineInput {
            gaussians: start.clone(),
            views: self.training_views(frame)?,
            frozen: Vec::new(),
            background: settings.background,
            seed: settings.seed,
        };
        // Exactly as many as stated, whether or not the loss still falls.
        let refine = RefineSettings { iterations, plateau_window: 0, ..settings.refine.clone() };
        let refined = refine::refine(engine, input, &refine, &mut |_, _| ControlFlow::Continue(()))?;
        Ok(refined.context("nobody stops the refinement")?.gaussians)
    }

    pub(crate) fn quality(
        &self,
        engine: &dyn Engine,
        gaussians: &Gaussians,
        frame: usize,
        iterations: u32,
        settings: &Settings,
    ) -> Result<Quality> {
        let metrics = self
            .views(Split::Test)
            .map(|index| {
                let view = &self.clip.views()[index];
                let rendered = engine.render(gaussians, &view.camera, settings.background)?.image;
                let (truth, moving) = (self.clip.image(index, frame)?, self.clip.mask(index, frame)?);
                Ok(frame::view_metrics(&view.name, &rendered, &truth, moving.as_deref()))
            })
            .collect::<Result<Vec<ViewMetrics>>>()?;
        let mean = frame::mean(&metrics).context("the clip holds no view out")?;
        Ok(Quality { iterations, moving_psnr: mean.moving_psnr, psnr: mean.psnr })
    }
}

fn shares(origins: &[MotionOrigin]) -> [f64; 3] {
    [MotionOrigin::Solved, MotionOrigin::Propagated, MotionOrigin::Static]
        .map(|of| origins.iter().filter(|&&origin| origin == of).count() as f64 / origins.len().max(1) as f64)
}
