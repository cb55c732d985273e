//! The [`Engine`] that the stages make.

use std::sync::Arc;

use bytemuck::bytes_of;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput, check_size, check_tracks},
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};

use crate::{
    buffers::{
        Buffers, GradientBuffers, ParameterBuffers, Size, admit, allocate, first_capacity, separated, storage,
    },
    device::GpuDevice,
    kernels::Kernels,
    layout::{GEOMETRY, State, Step, View},
    moments::{LastMeasured, footprint_moments},
    program::{Dispatch, record},
    session::GpuSession,
    stages::{Binder, ViewBuffer},
    transfer::{read, write},
};

/// An opened device and its compiled kernels.
#[derive(Debug)]
pub(crate) struct Context {
    pub device: GpuDevice,
    pub kernels: Kernels,
    pub measured: LastMeasured,
}

/// The GPU engine.
#[derive(Clone, Debug)]
pub struct GpuEngine {
    pub(crate) context: Arc<Context>,
}

impl GpuEngine {
    /// Compiles the kernels for a device.
    pub fn new(device: GpuDevice) -> Result<Self, EngineError> {
        let kernels = device.guarded(|| Ok(Kernels::new(&device.device, device.uses_subgroups())))?;
        let context = Context { device, kernels, measured: LastMeasured::default() };
        Ok(Self { context: Arc::new(context) })
    }

    /// The device.
    pub fn device(&self) -> &GpuDevice {
        &self.context.device
    }

    /// A rendering as 8-bit RGB, `H × W × 3`, values rounded and clamped to `[0, 1]`: a fifth of the bytes to read back.
    pub fn render_rgb8(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Vec<u8>, EngineError> {
        check_size(camera)?;
        self.context.device.guarded(|| self.rgb8(gaussians, camera, background))
    }

    fn rgb8(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Vec<u8>, EngineError> {
        let Context { device, kernels, .. } = &*self.context;
        let view = ViewBuffer::new(device, View::new(camera, background))?;
        let buffers = self.draw(gaussians, &view, self.buffers(gaussians, &view.data, false)?)?;
        let pixels = view.data.pixels();
        let [bytes] = allocate(device, [storage("8-bit image", 12 * pixels.div_ceil(4))])?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        record(&mut encoder, "quantize", [&Binder { device, kernels }.quantize(&buffers, &bytes, &view)]);
        device.queue.submit([encoder.finish()]);
        let words: Vec<[u8; 12]> = read(device, &bytes, pixels.div_ceil(4) as usize)?;
        let mut image = words.into_flattened();
        image.truncate(3 * pixels as usize);
        Ok(image)
    }

    /// Gradient of `Σ image · image_gradient + Σ alpha · alpha_gradient` by every parameter; `image_gradient` is
    /// `H × W × 3`, `alpha_gradient` `H × W` or empty; other lengths are invalid input.
    pub fn render_backward(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
    ) -> Result<GaussianGradients, EngineError> {
        check_size(camera)?;
        check_seeds(camera, image_gradient, alpha_gradient)?;
        let alpha = alpha_gradient.iter().copied().chain(std::iter::repeat(0.0));
        let seeds: Vec<f32> = image_gradient
            .as_chunks::<3>()
            .0
            .iter()
            .zip(alpha)
            .flat_map(|([red, green, blue], alpha)| [*red, *green, *blue, alpha])
            .collect();
        self.context.device.guarded(|| self.gradients(gaussians, camera, background, &seeds))
    }

    /// Gradient by every parameter of the sum of `seeds`, four per pixel, times colour and alpha.
    fn gradients(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        seeds: &[f32],
    ) -> Result<GaussianGradients, EngineError> {
        let Context { device, kernels, .. } = &*self.context;
        let view = ViewBuffer::new(device, View::new(camera, background))?;
        let buffers = self.draw(gaussians, &view, self.buffers(gaussians, &view.data, true)?)?;
        let gradients = GradientBuffers::new(device, &buffers.size)?;
        write(device, &gradients.image, seeds)?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        record(&mut encoder, "gradient", &Binder { device, kernels }.backward(&buffers, &gradients, &view));
        device.queue.submit([encoder.finish()]);
        let geometry: Vec<[f32; GEOMETRY]> = read(device, &gradients.geometry, gaussians.len())?;
        let sh = read(device, &gradients.sh, gaussians.sh.len())?;
        let Gaussians { means, rotations, log_scales, logit_opacities, sh, .. } =
            separated(&geometry, sh, gaussians.sh_degree);
        Ok(GaussianGradients { means, rotations, log_scales, logit_opacities, sh })
    }

    /// Buffers for one view with room for what it probably needs.
    pub(crate) fn buffers(
        &self,
        gaussians: &Gaussians,
        view: &View,
        has_gradient: bool,
    ) -> Result<Buffers, EngineError> {
        let device = &self.context.device;
        let size = self.size(gaussians.len(), gaussians.sh_coefficients(), view, has_gradient)?;
        admit(device, &Buffers::requests(&size))?;
        Buffers::new(device, ParameterBuffers::new(device, gaussians)?, &size)
    }

    /// What [`GpuEngine::buffers`] takes.
    pub(crate) fn size(
        &self,
        count: usize,
        coefficients: usize,
        view: &View,
        has_gradient: bool,
    ) -> Result<Size, EngineError> {
        let device = &self.context.device;
        // Before the sizes of buffers are no numbers any more.
        if view.pixels() > u64::from(u32::MAX) {
            let needed = view.pixels().saturating_mul(16);
            return Err(EngineError::OutOfResources { needed, available: device.max_buffer() });
        }
        let (count, tiles) = (count as u64, view.tile_count().into());
        Ok(Size {
            count,
            coefficients: coefficients as u64,
            pixels: view.pixels(),
            tiles,
            capacity: first_capacity(count, tiles),
            has_gradient,
        })
    }

    /// Stages 1 to 3, with more room until there is enough.
    pub(crate) fn draw(
        &self,
        gaussians: &Gaussians,
        view: &ViewBuffer,
        buffers: Buffers,
    ) -> Result<Buffers, EngineError> {
        let (buffers, _) =
            self.run(gaussians, view, buffers, |binder, buffers, view| binder.forward(buffers, view))?;
        Ok(buffers)
    }

    /// Stages of a view, the lists among them, with more room until there is enough; says how many intersections there are.
    pub(crate) fn run(
        &self,
        gaussians: &Gaussians,
        view: &ViewBuffer,
        mut buffers: Buffers,
        stages: fn(&Binder<'_>, &Buffers, &ViewBuffer) -> Vec<Dispatch>,
    ) -> Result<(Buffers, u32), EngineError> {
        let Context { device, kernels, .. } = &*self.context;
        loop {
            let step = Step {
                count: gaussians.len() as u32,
                coefficients: gaussians.sh_coefficients() as u32,
                degree: gaussians.sh_degree,
                capacity: buffers.size.capacity as u32,
                ..Step::default()
            };
            let state = State { gaussians: step.count, ..State::default() };
            device.queue.write_buffer(&buffers.common.step, 0, bytes_of(&step));
            device.queue.write_buffer(&buffers.common.state, 0, bytes_of(&state));
            let mut encoder = device.device.create_command_encoder(&Default::default());
            record(&mut encoder, "render", &stages(&Binder { device, kernels }, &buffers, view));
            device.queue.submit([encoder.finish()]);
            let state: Vec<State> = read(device, &buffers.common.state, 1)?;
            if state[0].failed == 0 {
                return Ok((buffers, state[0].needed));
            }
            buffers.resize(device, buffers.size.with_room(device, state[0].needed)?)?;
        }
    }
}

fn check_seeds(camera: &Camera, image: &[f32], alpha: &[f32]) -> Result<(), EngineError> {
    let pixels = camera.width as usize * camera.height as usize;
    if image.len() == 3 * pixels && (alpha.is_empty() || alpha.len() == pixels) {
        return Ok(());
    }
    Err(EngineError::InvalidInput(format!(
        "gradients by {} values and {} alphas for {pixels} pixels; give three values per pixel, and one alpha or none",
        image.len(),
        alpha.len()
    )))
}

impl Engine for GpuEngine {
    fn name(&self) -> &str {
        "gpu"
    }

    fn device_name(&self) -> Option<&str> {
        Some(self.context.device.label())
    }

    fn check(&self) -> Result<(), EngineError> {
        self.context.device.check()
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        check_size(camera)?;
        let device = &self.context.device;
        let pixels: Vec<[f32; 4]> = device.guarded(|| {
            let view = ViewBuffer::new(device, View::new(camera, background))?;
            let buffers = self.buffers(gaussians, &view.data, false)?;
            let buffers = self.draw(gaussians, &view, buffers)?;
            read(device, &buffers.images.rendered, view.data.pixels() as usize)
        })?;
        let image = Image {
            width: camera.width,
            height: camera.height,
            pixels: pixels.iter().flat_map(|[red, green, blue, _]| [*red, *green, *blue]).collect(),
        };
        Ok(Rendering { image, alpha: pixels.iter().map(|[.., transmittance]| 1.0 - transmittance).collect() })
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        check_size(camera)?;
        check_tracks(camera, tracks)?;
        self.context.device.guarded(|| footprint_moments(self, gaussians, camera, tracks, reweighting))
    }

    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        input.validate()?;
        let session = || GpuSession::new(Arc::clone(&self.context), input);
        Ok(Box::new(self.context.device.guarded(session)?))
    }
}
