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
use wgpu::SubmissionIndex;

use crate::{
    buffers::{
        Buffer, Buffers, FootprintBuffers, GradientBuffers, LossBuffers, OptimiserBuffers, ParameterBuffers,
        Request, Size, admit, admit_instead, allocate, first_capacity, parameters::check_lengths, separated,
        storage, total, training_image, training_requests,
    },
    device::GpuDevice,
    engine::Context,
    layout::{Density, GEOMETRY, State, Step, View},
    program::{Dispatch, record},
    stages::{Binder, ViewBuffer},
    transfer::{read, write},
    wanted::{WantedImage, is_eight_bits},
};

/// Steps that may be submitted before their losses are looked at.
const REMEMBERED: usize = 256;

/// Steps that may be at work or wait for it. Enough that the device never waits for the host; few, so that the steps that were asked
/// for are about those that are done, for who counts them and for who stops.
const IN_FLIGHT: usize = 16;

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
#[derive(Clone, Debug)]
struct Submitted {
    view: usize,
    rates: LearningRates,
    /// Number of the step in the optimiser's count, from 1.
    number: u64,
    /// What to wait for.
    submission: SubmissionIndex,
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
    /// What left the session without a whole state.
    failure: Option<EngineError>,
}

impl GpuSession {
    /// `input` is valid.
    pub(crate) fn new(context: Arc<Context>, input: SessionInput) -> Result<Self, EngineError> {
        let device = &context.device;
        // Whoever optimises a set has measured it.
        context.measured.forget();
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
            failure: None,
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

    /// Submits step `number` on a view; its loss goes to `place`.
    fn submit(&self, view: usize, rates: &LearningRates, number: u64, place: usize) -> SubmissionIndex {
        let Context { device, .. } = &*self.context;
        let decay = |beta: f64| 1.0 - beta.powf(number as f64);
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
        record(&mut encoder, "step", &self.views[view].program);
        device.queue.submit([encoder.finish()])
    }

    /// Does something unless the session is broken. It is broken by what ends in the middle of a change, and by work that the
    /// device did not take.
    fn guarded<T>(
        &mut self,
        operation: impl FnOnce(&mut Self) -> Result<T, EngineError>,
    ) -> Result<T, EngineError> {
        if let Some(failure) = &self.failure {
            return Err(failure.clone());
        }
        let context = Arc::clone(&self.context);
        let outcome = context.device.guarded(|| operation(self));
        if let Err(failure @ EngineError::Internal(_)) = &outcome {
            self.failure = Some(failure.clone());
        }
        outcome
    }

    /// Waits for one step after the other: how long one may take is known, how long all of them may is not.
    fn wait(&self) -> Result<(), EngineError> {
        let device = &self.context.device;
        self.submitted.iter().try_for_each(|step| device.wait(Some(step.submission.clone())))
    }

    /// Waits until few of the steps before the one at `place` are at work.
    fn leave_few_before(&self, place: usize) -> Result<(), EngineError> {
        match place.checked_sub(IN_FLIGHT).and_then(|earlier| self.submitted.get(earlier)) {
            Some(earlier) => self.context.device.wait(Some(earlier.submission.clone())),
            None => Ok(()),
        }
    }

    /// Makes every later step one that the device refuses.
    #[cfg(test)]
    pub(crate) fn break_buffers(&self) {
        self.buffers.footprints.footprints.destroy();
    }

    /// Unbinds everything, so that a buffer that is dropped is freed.
    fn unbind(&mut self) {
        self.views.iter_mut().for_each(|view| view.program.clear());
    }

    /// Looks at the outcome of all submitted steps, and repeats those for which there was no room.
    fn settle(&mut self) -> Result<(), EngineError> {
        while !self.submitted.is_empty() {
            self.wait()?;
            let context = Arc::clone(&self.context);
            let state: Vec<State> = read(&context.device, &self.buffers.common.state, 1)?;
            let State { failed, failed_step, needed, .. } = state[0];
            let done = if failed == 0 { self.submitted.len() } else { failed_step as usize };
            let losses: Vec<f32> = read(&context.device, &self.loss.losses, done)?;
            if failed != 0 {
                // Where there is no room, nothing changes here: asking again must find what it found now.
                let size = self.buffers.size.with_room(&context.device, needed)?;
                let [old, new] =
                    [&self.buffers.size, &size].map(|size| self.requests(size, self.active.len()));
                admit_instead(&context.device, &new, total(&old))?;
                self.unbind();
                self.buffers
                    .resize(&context.device, size)
                    .inspect_err(|error| self.failure = Some(error.clone()))?;
            }
            self.losses.extend(losses);
            self.submitted.drain(..done);
            if failed == 0 {
                break;
            }
            self.bind();
            for place in 0..self.submitted.len() {
                self.leave_few_before(place)?;
                let Submitted { view, rates, number, .. } = self.submitted[place].clone();
                self.submitted[place].submission = self.submit(view, &rates, number, place);
            }
        }
        Ok(())
    }

    /// Gives the optimiser the moments of a set that takes those of the Gaussians in `source` over, one array after the other, so that
    /// there is one of them twice at most.
    fn take_moments_over(&mut self, source: &[Option<usize>], size: &Size) -> Result<(), EngineError> {
        let context = Arc::clone(&self.context);
        let Context { device, kernels, .. } = &*context;
        let taken = OptimiserBuffers::new(device, &Size { count: 0, ..*size }, &self.active)?;
        let [sources] = allocate(device, [storage("sources", 4 * size.count)])?;
        let numbers: Vec<u32> = source.iter().map(|old| old.map_or(u32::MAX, |old| old as u32)).collect();
        write(device, &sources, &numbers)?;
        let binder = Binder { device, kernels };
        let widths = [GEOMETRY, GEOMETRY, 3 * self.coefficients(), 3 * self.coefficients()];
        for (moments, width) in self.optimiser.moments.iter_mut().zip(widths) {
            let [new] = allocate(device, [storage("moments", 4 * width as u64 * size.count)])?;
            let dispatch = binder.replace(&sources, moments, &new, size.count, width as u64)?;
            let mut encoder = device.device.create_command_encoder(&Default::default());
            record(&mut encoder, "replace", [&dispatch]);
            let submission = device.queue.submit([encoder.finish()]);
            device.wait(Some(submission))?;
            *moments = new;
        }
        self.optimiser.active = taken.active;
        Ok(())
    }

    /// Has the buffers of another set instead of those of this one, which are freed first.
    fn change(
        &mut self,
        gaussians: &Gaussians,
        source: &[Option<usize>],
        active: Vec<bool>,
    ) -> Result<(), EngineError> {
        let context = Arc::clone(&self.context);
        let device = &context.device;
        let none = Size { count: 0, ..self.buffers.size };
        let size = Size { count: gaussians.len() as u64, ..self.buffers.size };
        self.unbind();
        self.buffers.parameters = ParameterBuffers::new(device, &Gaussians::empty(self.sh_degree))?;
        self.buffers.footprints = FootprintBuffers::new(device, 0)?;
        self.gradients = GradientBuffers::new(device, &none)?;
        self.active = active;
        self.take_moments_over(source, &size)?;
        self.buffers.parameters = ParameterBuffers::new(device, gaussians)?;
        self.buffers.footprints = FootprintBuffers::new(device, size.count)?;
        self.gradients = GradientBuffers::new(device, &size)?;
        self.buffers.size = size;
        self.count = gaussians.len();
        self.bind();
        Ok(())
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
    write(device, &buffer, &wanted.words)?;
    Ok(SessionView { view: ViewBuffer::new(device, view)?, wanted: buffer, program: Vec::new() })
}

impl Session for GpuSession {
    fn step(&mut self, view: usize, rates: &LearningRates) -> Result<(), EngineError> {
        if view >= self.views.len() {
            return Err(EngineError::InvalidInput(format!("view {view} of {}", self.views.len())));
        }
        self.guarded(|session| {
            if session.submitted.len() == REMEMBERED {
                session.settle()?;
            }
            session.leave_few_before(session.submitted.len())?;
            session.steps += 1;
            let number = session.steps;
            let submission = session.submit(view, rates, number, session.submitted.len());
            session.submitted.push(Submitted { view, rates: *rates, number, submission });
            Ok(())
        })
    }

    fn take_losses(&mut self) -> Result<Vec<f32>, EngineError> {
        self.guarded(Self::settle)?;
        Ok(std::mem::take(&mut self.losses))
    }

    fn gaussians(&mut self) -> Result<Gaussians, EngineError> {
        self.guarded(|session| {
            session.settle()?;
            let (device, parameters) = (&session.context.device, &session.buffers.parameters);
            let geometry: Vec<[f32; GEOMETRY]> = read(device, &parameters.geometry, session.count)?;
            let sh = read(device, &parameters.sh, 3 * session.coefficients() * session.count)?;
            Ok(separated(&geometry, sh, session.sh_degree))
        })
    }

    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError> {
        self.guarded(|session| {
            session.settle()?;
            let device = &session.context.device;
            let density: Vec<Density> = read(device, &session.gradients.density, session.count)?;
            let mut encoder = device.device.create_command_encoder(&Default::default());
            encoder.clear_buffer(&session.gradients.density, 0, None);
            device.queue.submit([encoder.finish()]);
            Ok(DensityStatistics {
                gradient_norm: density.iter().map(|density| density.gradient_norm).collect(),
                visible_steps: density.iter().map(|density| density.visible_steps).collect(),
            })
        })
    }

    fn replace(&mut self, gaussians: Gaussians, source: &[Option<usize>]) -> Result<(), EngineError> {
        check_replacement(&gaussians, source, self.count, self.sh_degree)?;
        check_lengths(&gaussians)?;
        let active: Vec<bool> = if self.active.is_empty() {
            Vec::new()
        } else {
            source.iter().map(|old| old.is_none_or(|old| self.active[old])).collect()
        };
        self.guarded(|session| {
            session.settle()?;
            // As long as nothing has changed.
            let old = session.requests(&session.buffers.size, session.active.len());
            let size = Size { count: gaussians.len() as u64, ..session.buffers.size };
            let mut new = session.requests(&size, active.len());
            new.push(twice(&size));
            admit_instead(&session.context.device, &new, total(&old))?;
            session
                .change(&gaussians, source, active)
                .inspect_err(|error| session.failure = Some(error.clone()))
        })
    }
}

/// What a change of the set takes beyond the set: the largest array of moments is there twice, and where they come from.
fn twice(size: &Size) -> Request {
    let width = (GEOMETRY as u64).max(3 * size.coefficients);
    storage("moments", 4 * (width + 1) * size.count)
}

impl Drop for GpuSession {
    fn drop(&mut self) {
        // Buffers that a device is at work on are not freed with their last owner. A device that is lost has nothing to free.
        let _ = self.wait();
        let _ = self.context.device.wait(None);
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
