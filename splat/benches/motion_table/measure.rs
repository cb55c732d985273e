//! Times motion compensation of one scene.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use anyhow::{Context, Result};
use serde::Serialize;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{
        self, MotionOrigin, MotionSettings, MotionStage, MotionView, moments::FootprintMoments,
        reweighting::Reweighting,
    },
    raster::CpuEngine,
    tracking::TrackField,
};

use super::{
    clock::now,
    corner::{self, Motion},
};

/// Size of the track fields.
const IMAGE: (u32, u32) = (640, 360);
/// Half of the cameras' arc, degrees.
const HALF_ANGLE: f64 = 40.0;
const SEED: u64 = 1;
/// What the tracks claim, px.
const SIGMA: f32 = 0.1;

/// The columns of the table; the first two are what the library calls one stage.
pub(crate) const STAGES: [&str; 7] =
    ["moments", "fit", "neighbours", "lift", "rotation", "propagation", "regularisation"];

/// Fastest times of one scene, milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    pub(crate) gaussians: usize,
    pub(crate) views: usize,
    /// In the order of [`STAGES`].
    pub(crate) stages: [f64; STAGES.len()],
    /// The fastest whole run.
    pub(crate) whole: f64,
    /// Share of the Gaussians that are found at rest.
    pub(crate) at_rest: f64,
    /// Share that is solved from its own footprints.
    pub(crate) solved: f64,
}

impl Row {
    /// A third of the scene moves, the rest stays.
    pub(crate) fn measure(count: usize, views: usize, repeat: usize) -> Result<Self> {
        let gaussians = corner::gaussians(count, SEED);
        let floor = Some(2);
        let views: Vec<MotionView> = corner::arc(views, HALF_ANGLE, IMAGE)
            .into_iter()
            .map(|camera| {
                let tracks = Arc::new(corner::tracks(&camera, Motion::Rigid, floor, SIGMA));
                MotionView { camera, tracks }
            })
            .collect();
        let mut row = Self {
            gaussians: count,
            views: views.len(),
            stages: [f64::INFINITY; STAGES.len()],
            whole: f64::INFINITY,
            at_rest: 0.0,
            solved: 0.0,
        };
        for _ in 0..repeat {
            row.run(&gaussians, &views)?;
        }
        Ok(row)
    }

    fn run(&mut self, gaussians: &Gaussians, views: &[MotionView]) -> Result<()> {
        let engine = Timed { engine: CpuEngine::default(), moments: Mutex::default() };
        let mut entered: Vec<(MotionStage, Duration)> = Vec::new();
        let field =
            motion::estimate_staged(&engine, gaussians, views, &MotionSettings::default(), &mut |stage| {
                entered.push((stage, now()));
            })?;
        let end = now();
        let moments = engine.spent();
        for (number, &(stage, start)) in entered.iter().enumerate() {
            let until = entered.get(number + 1).map_or(end, |(_, next)| *next);
            let took = until.saturating_sub(start);
            match stage {
                MotionStage::Observe => {
                    self.keep(0, moments);
                    self.keep(1, took.saturating_sub(moments));
                }
                MotionStage::Neighbours => self.keep(2, took),
                MotionStage::Lift => self.keep(3, took),
                MotionStage::Turn => self.keep(4, took),
                MotionStage::Propagate => self.keep(5, took),
                MotionStage::Regularise => self.keep(6, took),
            }
        }
        let (_, start) = entered.first().context("the robust path enters its stages")?;
        self.whole = self.whole.min(milliseconds(end.saturating_sub(*start)));
        let share = |of: MotionOrigin| {
            field.origin.iter().filter(|&&origin| origin == of).count() as f64 / gaussians.len() as f64
        };
        (self.at_rest, self.solved) = (share(MotionOrigin::Static), share(MotionOrigin::Solved));
        Ok(())
    }

    fn keep(&mut self, stage: usize, took: Duration) {
        self.stages[stage] = self.stages[stage].min(milliseconds(took));
    }
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// The CPU engine, with a clock on its moments.
struct Timed {
    engine: CpuEngine,
    moments: Mutex<Duration>,
}

impl Timed {
    fn spent(&self) -> Duration {
        *self.moments.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Engine for Timed {
    fn name(&self) -> &str {
        self.engine.name()
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        self.engine.render(gaussians, camera, background)
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let start = now();
        let moments = self.engine.footprint_moments(gaussians, camera, tracks, reweighting);
        *self.moments.lock().unwrap_or_else(PoisonError::into_inner) += now().saturating_sub(start);
        moments
    }

    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        self.engine.session(input)
    }
}
