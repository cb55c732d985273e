//! One stage of a step at a time, for figures: what each costs on the device.

use std::sync::Arc;

use splat::{
    engine::{EngineError, Session, SessionInput},
    optim::LearningRates,
    tracking::TrackField,
};
use wgpu::{
    BufferDescriptor, BufferUsages, ComputePassTimestampWrites, Features, QuerySetDescriptor, QueryType,
};

use crate::{
    buffers::MomentBuffers,
    engine::{Context, GpuEngine},
    layout::State,
    moments::every,
    program::{Dispatch, record_timed},
    session::GpuSession,
    stages::Binder,
    transfer::read,
};

/// Repeats in one submission: a set of queries is short.
const MOST: u32 = 128;

/// A part of the work on a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Projection, lists and blending.
    Forward,
    /// The loss and its gradient by the image.
    Loss,
    /// From the gradient by the image to that by every parameter.
    Backward,
    /// One step of Adam.
    Optimiser,
    /// Moments of every footprint, one pass, once the lists are there.
    Moments,
}

impl Stage {
    /// Every stage, in the order of a step; each can run once those before it have.
    pub const ALL: [Self; 5] = [Self::Forward, Self::Loss, Self::Backward, Self::Optimiser, Self::Moments];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Loss => "loss",
            Self::Backward => "backward",
            Self::Optimiser => "optimiser",
            Self::Moments => "moments",
        }
    }
}

/// A session on one view whose stages can be run apart. The optimiser's rates are zero, so that repeats see the same
/// Gaussians.
pub struct Probe {
    context: Arc<Context>,
    /// Holds the buffers that the programs are bound to.
    session: GpuSession,
    programs: [Vec<Dispatch>; 5],
}

impl Probe {
    /// Takes one step on the first view of `input`, so that every buffer has the room it needs, and binds the stages;
    /// `tracks` are of that view.
    pub fn new(engine: &GpuEngine, input: SessionInput, tracks: &TrackField) -> Result<Self, EngineError> {
        engine.context.device.guarded(|| Self::bound(engine, input, tracks))
    }

    fn bound(engine: &GpuEngine, input: SessionInput, tracks: &TrackField) -> Result<Self, EngineError> {
        let context = Arc::clone(&engine.context);
        let (count, sh_degree) = (input.gaussians.len(), input.gaussians.sh_degree);
        let rates = LearningRates {
            mean: 0.0,
            rotation: 0.0,
            log_scale: 0.0,
            logit_opacity: 0.0,
            sh_dc: 0.0,
            sh_rest: 0.0,
            sh_degree,
        };
        let mut session = GpuSession::new(Arc::clone(&context), input)?;
        session.step(0, &rates)?;
        session.take_losses()?;
        let Context { device, kernels, .. } = &*context;
        let binder = Binder { device, kernels };
        let (buffers, view) = session.first_view();
        let of_tracks = MomentBuffers::new(device, &buffers.size, tracks)?;
        let (expectations, all) = every(count);
        of_tracks.ask(device, &expectations, &all)?;
        let moments = binder.footprint_moments(buffers, &of_tracks, view, count as u64);
        let [forward, loss, backward, optimiser] = session.stages(&binder, 0);
        let programs = [forward, loss, backward, optimiser, moments.into()];
        Ok(Self { context, session, programs })
    }

    /// Intersections of footprints with tiles.
    pub fn intersections(&self) -> Result<u32, EngineError> {
        let ((buffers, _), device) = (self.session.first_view(), &self.context.device);
        device.guarded(|| Ok(read::<State>(device, &buffers.common.state, 1)?[0].needed))
    }

    /// Runs a stage so many times, 1 to 128, and waits for the last. Seconds of each by the device's own clock, where it has
    /// one; else nothing, and the caller's clock over all of them has to do.
    pub fn run(&self, stage: Stage, times: u32) -> Result<Option<Vec<f64>>, EngineError> {
        self.context.device.guarded(|| self.timed(stage, times))
    }

    fn timed(&self, stage: Stage, times: u32) -> Result<Option<Vec<f64>>, EngineError> {
        let device = &self.context.device;
        let times = times.clamp(1, MOST);
        let program = &self.programs[stage as usize];
        let mut encoder = device.device.create_command_encoder(&Default::default());
        if !device.device.features().contains(Features::TIMESTAMP_QUERY) {
            (0..times).for_each(|_| record_timed(&mut encoder, stage.name(), None, program));
            device.queue.submit([encoder.finish()]);
            self.intersections()?;
            return Ok(None);
        }
        let query_set = &device.device.create_query_set(&QuerySetDescriptor {
            label: Some("times"),
            ty: QueryType::Timestamp,
            count: 2 * times,
        });
        for repeat in 0..times {
            let writes = ComputePassTimestampWrites {
                query_set,
                beginning_of_pass_write_index: Some(2 * repeat),
                end_of_pass_write_index: Some(2 * repeat + 1),
            };
            record_timed(&mut encoder, stage.name(), Some(writes), program);
        }
        let resolved = device.device.create_buffer(&BufferDescriptor {
            label: Some("times"),
            size: 16 * u64::from(times),
            usage: BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        encoder.resolve_query_set(query_set, 0..2 * times, &resolved, 0);
        device.queue.submit([encoder.finish()]);
        let ticks: Vec<[u64; 2]> = read(device, &resolved, times as usize)?;
        let seconds = f64::from(device.queue.get_timestamp_period()) * 1e-9;
        Ok(Some(ticks.iter().map(|[start, end]| end.saturating_sub(*start) as f64 * seconds).collect()))
    }
}
