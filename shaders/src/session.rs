//! An optimisation session on a device: parameters, optimiser state, images and buffers stay there.
//!
//! A step only submits work. Nothing comes back until somebody asks: then the losses of all steps since, and whether a view
//! had more intersections than there is room for. From such a step on the device has done nothing; the host makes room
//! and submits the remembered steps again, so that the result is as if there had been room from the start.

use std::sync::Arc;

use bytemuck::bytes_of;
use splat::{
    engine::{DensityStatistics, EngineError, Session, SessionInput, TrainingView},
    gaussians::Gaussians,
    optim::LearningRates,
};
use wgpu::Buffer;

use crate::{
    buffers::{
        Buffers, FootprintBuffers, GradientBuffers, LossBuffers, OptimiserBuffers, ParameterBuffers, Request,
        Size, admit, allocate, first_capacity, separated, storage, training_image, training_requests,
    },
    device::GpuDevice,
    engine::Context,
    layout::{Density, GEOMETRY, State, Step, View},
    program::{Dispatch, record},
    readback::read,
    stages::{Binder, ViewBuffer},
    wanted::{WantedImage, is_eight_bits},
};

/// Steps that may be submitted before their losses are looked at.
const REMEMBERED: usize = 256;

/// Decay of the optimiser's moments, as in `splat::optim`.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;

pub(crate) struct SessionView {
    pub view: ViewBuffer,
    /// See [`WantedImage`].
    pub wanted: Buffer,
    /// The whole step.
    program: Vec<Dispatch>,
}

/// A submitted step whose outcome has not been looked at.
#[derive(Clone, Copy, Debug)]
struct Submitted {
    view: usize,
    rates: LearningRates,
    /// Number of the step in the optimiser's count, from 1.
    number: u64,
}

/// See [`Session`].
pub(crate) struct GpuSession {
    context: Arc<Context>,
    views: Vec<SessionView>,
    buffers: Buffers,
    gradients: GradientBuffers,
    optimiser: OptimiserBuffers,
    loss: LossBuffers,
    /// Empty: all Gaussians are optimised.
    active: Vec<bool>,
    count: usize,
    sh_degree: u32,
    steps: u64,
    submitted: Vec<Submitted>,
    losses: Vec<f32>,
}

impl GpuSession {
    pub(crate) fn new(context: Arc<Context>, input: SessionInput) -> Result<Self, EngineError> {
        input.validate()?;
        let device = &context.device;
        let gaussians = &input.gaussians;
        let images = || input.views.iter().map(|view| View::new(&view.camera, input.background));
        let (count, tiles) = (gaussians.len() as u64, images().map(|view| view.tile_count()).max());
        let tiles = u64::from(tiles.unwrap_or(0));
        let size = Size {
            count,
            coefficients: gaussians.sh_coefficients() as u64,
            pixels: images().map(|view| view.pixels()).max().unwrap_or(0),
            tiles,
            capacity: first_capacity(count, tiles),
            has_gradient: true,
        };
        let active: Vec<bool> = input.frozen.iter().map(|frozen| !frozen).collect();
        let pixels =
            input.views.iter().map(|view| (view.image.pixel_count() as u64, is_eight_bits(&view.image)));
        admit(device, &training_requests(&size, pixels, active.len(), REMEMBERED))?;
        let (background, weight) = (input.background, input.dssim_weight);
        let views = input.views.iter().map(|view| session_view(device, view, background, weight));
        let mut session = Self {
            views: views.collect::<Result<_, _>>()?,
            buffers: Buffers::new(device, ParameterBuffers::new(device, gaussians)?, &size)?,
            gradients: GradientBuffers::new(device, &size)?,
            optimiser: OptimiserBuffers::new(device, &size, &active)?,
            loss: LossBuffers::new(device, &size, REMEMBERED)?,
            active,
            count: gaussians.len(),
            sh_degree: gaussians.sh_degree,
            steps: 0,
            submitted: Vec::new(),
            losses: Vec::new(),
            context,
        };
        session.bind();
        Ok(session)
    }

    /// All buffers of a session of this size.
    fn requests(&self, size: &Size, active: usize) -> Vec<Request> {
        let views = self.views.iter().map(|view| &view.view.data);
        let pixels = views.map(|view| (view.pixels(), view.is_packed == 1));
        training_requests(size, pixels, active, REMEMBERED)
    }

    fn coefficients(&self) -> usize {
        splat::gaussians::sh::coefficients(self.sh_degree)
    }

    /// What a step on a view does: forward, loss, backward, optimiser.
    pub(crate) fn stages(&self, binder: &Binder<'_>, view: usize) -> [Vec<Dispatch>; 4] {
        let Self { buffers, gradients, optimiser, loss, .. } = self;
        let SessionView { view, wanted, .. } = &self.views[view];
        [
            binder.forward(buffers, view),
            binder.loss(buffers, gradients, loss, view, wanted).into(),
            binder.backward(buffers, gradients, view).into(),
            binder.adam(buffers, gradients, optimiser, self.coefficients() as u64).into(),
        ]
    }

    /// The buffers of a view, and their first view.
    pub(crate) fn first_view(&self) -> (&Buffers, &ViewBuffer) {
        (&self.buffers, &self.views[0].view)
    }

    /// Binds every view's program to the buffers as they are now, and clears the device's state.
    fn bind(&mut self) {
        let Context { device, kernels, .. } = &*self.context;
        let binder = Binder { device, kernels };
        let programs: Vec<_> =
            (0..self.views.len()).map(|view| self.stages(&binder, view).concat()).collect();
        for (view, program) in self.views.iter_mut().zip(programs) {
            view.program = program;
        }
        let state = State { gaussians: self.count as u32, ..State::default() };
        device.queue.write_buffer(&self.buffers.common.state, 0, bytes_of(&state));
    }

    /// Submits a step whose loss goes to `place`.
    fn submit(&self, step: &Submitted, place: usize) {
        let Context { device, .. } = &*self.context;
        let rates = &step.rates;
        let decay = |beta: f64| 1.0 - beta.powf(step.number as f64);
        let data = Step {
            count: self.count as u32,
            coefficients: self.coefficients() as u32,
            degree: rates.sh_degree.min(self.sh_degree),
            capacity: self.buffers.size.capacity as u32,
            rates: [rates.mean, rates.rotation, rates.log_scale, rates.logit_opacity],
            sh_rates: [rates.sh_dc, rates.sh_rest],
            first_correction: (1.0 / decay(BETA1)) as f32,
            second_correction: (1.0 / decay(BETA2).sqrt()) as f32,
            number: place as u32,
            loss_place: place as u32,
            has_active: u32::from(!self.active.is_empty()),
            padding: 0,
        };
        device.queue.write_buffer(&self.buffers.common.step, 0, bytes_of(&data));
        let mut encoder = device.device.create_command_encoder(&Default::default());
        record(&mut encoder, "step", &self.views[step.view].program);
        device.queue.submit([encoder.finish()]);
    }

    /// Looks at the outcome of all submitted steps, and repeats those for which there was no room.
    fn settle(&mut self) -> Result<(), EngineError> {
        while !self.submitted.is_empty() {
            let context = Arc::clone(&self.context);
            let state: Vec<State> = read(&context.device, &self.buffers.common.state, 1)?;
            let State { failed, failed_step, needed, .. } = state[0];
            let done = if failed == 0 { self.submitted.len() } else { failed_step as usize };
            let losses: Vec<f32> = read(&context.device, &self.loss.losses, done)?;
            if failed != 0 {
                // Before anything changes here: where there is no room, asking again must find what it found now.
                let size = self.buffers.size.with_room(&context.device, needed)?;
                admit(&context.device, &self.requests(&size, self.active.len()))?;
                self.buffers.resize(&context.device, size)?;
            }
            self.losses.extend(losses);
            self.submitted.drain(..done);
            if failed == 0 {
                break;
            }
            self.bind();
            for (place, step) in self.submitted.iter().enumerate() {
                self.submit(step, place);
            }
        }
        Ok(())
    }

    /// Moments of a set that takes those of the Gaussians in `source` over.
    fn moments_of(
        &self,
        source: &[Option<usize>],
        active: &[bool],
        size: &Size,
    ) -> Result<OptimiserBuffers, EngineError> {
        let Context { device, kernels, .. } = &*self.context;
        let count = size.count;
        let taken = OptimiserBuffers::new(device, size, active)?;
        let [sources] = allocate(device, [storage("sources", 4 * count)])?;
        let numbers: Vec<u32> = source.iter().map(|old| old.map_or(u32::MAX, |old| old as u32)).collect();
        device.queue.write_buffer(&sources, 0, bytemuck::cast_slice(&numbers));
        let binder = Binder { device, kernels };
        let widths = [GEOMETRY, GEOMETRY, 3 * self.coefficients(), 3 * self.coefficients()];
        let dispatches = self
            .optimiser
            .moments
            .iter()
            .zip(&taken.moments)
            .zip(widths)
            .map(|((old, new), width)| binder.replace(&sources, old, new, count, width as u64))
            .collect::<Result<Vec<_>, _>>()?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        record(&mut encoder, "replace", &dispatches);
        device.queue.submit([encoder.finish()]);
        Ok(taken)
    }
}

/// The uniform and the image of a training view.
pub(crate) fn session_view(
    device: &GpuDevice,
    training: &TrainingView,
    background: [f32; 3],
    dssim_weight: f32,
) -> Result<SessionView, EngineError> {
    let wanted = WantedImage::new(training);
    let mut view = View::new(&training.camera, background);
    if wanted.counted > 0 {
        let values = 3.0 * wanted.counted as f32;
        view.absolute = (1.0 - dssim_weight) / values;
        view.structural = dssim_weight / values;
    }
    view.is_packed = wanted.is_packed.into();
    let [buffer] = allocate(device, [training_image(view.pixels(), wanted.is_packed)])?;
    device.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&wanted.words));
    Ok(SessionView { view: ViewBuffer::new(device, view)?, wanted: buffer, program: Vec::new() })
}

impl Session for GpuSession {
    fn step(&mut self, view: usize, rates: &LearningRates) -> Result<(), EngineError> {
        if view >= self.views.len() {
            return Err(EngineError::InvalidInput(format!("view {view} of {}", self.views.len())));
        }
        if self.submitted.len() == REMEMBERED {
            self.settle()?;
        }
        self.steps += 1;
        let step = Submitted { view, rates: *rates, number: self.steps };
        self.submit(&step, self.submitted.len());
        self.submitted.push(step);
        Ok(())
    }

    fn take_losses(&mut self) -> Result<Vec<f32>, EngineError> {
        self.settle()?;
        Ok(std::mem::take(&mut self.losses))
    }

    fn gaussians(&mut self) -> Result<Gaussians, EngineError> {
        self.settle()?;
        let device = &self.context.device;
        let geometry: Vec<[f32; GEOMETRY]> = read(device, &self.buffers.parameters.geometry, self.count)?;
        let sh = read(device, &self.buffers.parameters.sh, 3 * self.coefficients() * self.count)?;
        Ok(separated(&geometry, sh, self.sh_degree))
    }

    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError> {
        self.settle()?;
        let device = &self.context.device;
        let density: Vec<Density> = read(device, &self.gradients.density, self.count)?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&self.gradients.density, 0, None);
        device.queue.submit([encoder.finish()]);
        Ok(DensityStatistics {
            gradient_norm: density.iter().map(|density| density.gradient_norm).collect(),
            visible_steps: density.iter().map(|density| density.visible_steps).collect(),
        })
    }

    fn replace(&mut self, gaussians: Gaussians, source: &[Option<usize>]) -> Result<(), EngineError> {
        check_replacement(&gaussians, source, self.count, self.sh_degree)?;
        self.settle()?;
        let active: Vec<bool> = if self.active.is_empty() {
            Vec::new()
        } else {
            source.iter().map(|old| old.is_none_or(|old| self.active[old])).collect()
        };
        let context = Arc::clone(&self.context);
        let device = &context.device;
        let size = Size { count: gaussians.len() as u64, ..self.buffers.size };
        admit(device, &self.requests(&size, active.len()))?;
        let optimiser = self.moments_of(source, &active, &size)?;
        self.buffers.parameters = ParameterBuffers::new(device, &gaussians)?;
        self.buffers.footprints = FootprintBuffers::new(device, size.count)?;
        self.buffers.size = size;
        self.gradients = GradientBuffers::new(device, &size)?;
        self.optimiser = optimiser;
        self.active = active;
        self.count = gaussians.len();
        self.bind();
        Ok(())
    }
}

fn check_replacement(
    gaussians: &Gaussians,
    source: &[Option<usize>],
    count: usize,
    sh_degree: u32,
) -> Result<(), EngineError> {
    let reason = if source.len() != gaussians.len() {
        format!("{} sources for {} Gaussians", source.len(), gaussians.len())
    } else if gaussians.sh_degree != sh_degree {
        format!("Gaussians of degree {} in a session of degree {sh_degree}", gaussians.sh_degree)
    } else if let Some(&old) = source.iter().flatten().find(|&&old| old >= count) {
        format!("source {old} of {count} Gaussians")
    } else {
        return Ok(());
    };
    Err(EngineError::InvalidInput(reason))
}
