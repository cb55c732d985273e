//! The [`Engine`] that the stages make.

use std::sync::Arc;

use bytemuck::bytes_of;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    image::Image,
    motion::moments::FootprintMoments,
    tracking::TrackField,
};

use crate::{
    buffers::{
        CommonBuffers, FootprintBuffers, ImageBuffers, IntersectionBuffers, ParameterBuffers, view_buffer,
    },
    device::GpuDevice,
    kernels::Kernels,
    layout::{State, Step, View},
    program::record,
    readback::read,
    stages::{Binder, Forward},
};

/// An opened device and its compiled kernels.
#[derive(Debug)]
pub(crate) struct Context {
    pub device: GpuDevice,
    pub kernels: Kernels,
}

/// The GPU engine.
#[derive(Clone, Debug)]
pub struct GpuEngine {
    context: Arc<Context>,
}

impl GpuEngine {
    /// Compiles the kernels for a device.
    pub fn new(device: GpuDevice) -> Result<Self, EngineError> {
        let kernels = Kernels::new(&device.device);
        device.check()?;
        Ok(Self { context: Arc::new(Context { device, kernels }) })
    }

    /// The device.
    pub fn device(&self) -> &GpuDevice {
        &self.context.device
    }
}

/// Room for intersections to start with: a footprint of a few pixels touches two or three tiles.
pub(crate) fn first_capacity(count: u64, view: &View) -> u64 {
    (4 * count).max(u64::from(view.tile_count())).max(1 << 12)
}

/// Room for intersections after a view had `needed`.
pub(crate) fn next_capacity(device: &GpuDevice, needed: u32) -> Result<u64, EngineError> {
    let needed = u64::from(needed);
    if needed >= u64::from(u32::MAX) {
        return Err(EngineError::OutOfResources { needed: 4 * needed, available: device.max_buffer() });
    }
    Ok((needed + needed / 4).min(u64::from(u32::MAX)))
}

impl Engine for GpuEngine {
    fn name(&self) -> &str {
        "gpu"
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        camera_has_pixels(camera)?;
        let Context { device, kernels } = &*self.context;
        let view = View::new(camera, background);
        let count = gaussians.len() as u64;
        let parameters = ParameterBuffers::new(device, gaussians)?;
        let common = CommonBuffers::new(device)?;
        let footprints = FootprintBuffers::new(device, count)?;
        let images = ImageBuffers::new(device, view.pixels(), view.tile_count().into())?;
        let view_buffer = view_buffer(device, &view)?;
        let mut capacity = first_capacity(count, &view);
        loop {
            let intersections = IntersectionBuffers::new(device, capacity)?;
            let buffers = Forward {
                parameters: &parameters,
                common: &common,
                footprints: &footprints,
                intersections: &intersections,
                images: &images,
                view: &view_buffer,
            };
            let step = Step {
                count: count as u32,
                coefficients: gaussians.sh_coefficients() as u32,
                degree: gaussians.sh_degree,
                capacity: capacity as u32,
                ..Step::default()
            };
            let state = State { gaussians: count as u32, ..State::default() };
            device.queue.write_buffer(&common.step, 0, bytes_of(&step));
            device.queue.write_buffer(&common.state, 0, bytes_of(&state));
            let mut encoder = device.device.create_command_encoder(&Default::default());
            record(&mut encoder, "render", &Binder { device, kernels }.forward(&buffers, &view));
            device.queue.submit([encoder.finish()]);
            let state: Vec<State> = read(device, &common.state, 1)?;
            if state[0].failed == 0 {
                break;
            }
            capacity = next_capacity(device, state[0].needed)?;
        }
        let pixels: Vec<[f32; 4]> = read(device, &images.rendered, view.pixels() as usize)?;
        let image = Image {
            width: camera.width,
            height: camera.height,
            pixels: pixels.iter().flat_map(|[red, green, blue, _]| [*red, *green, *blue]).collect(),
        };
        Ok(Rendering { image, alpha: pixels.iter().map(|[.., transmittance]| 1.0 - transmittance).collect() })
    }

    fn footprint_moments(
        &self,
        _gaussians: &Gaussians,
        _camera: &Camera,
        _tracks: &TrackField,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        Err(EngineError::InvalidInput(
            "the GPU engine does not measure footprints; use the CPU engine for motion".to_owned(),
        ))
    }

    fn session(&self, _input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("the GPU engine has no sessions".to_owned()))
    }
}

/// An image without pixels has no tiles to dispatch.
fn camera_has_pixels(camera: &Camera) -> Result<(), EngineError> {
    if camera.width == 0 || camera.height == 0 {
        let (width, height) = (camera.width, camera.height);
        return Err(EngineError::InvalidInput(format!("a camera of {width}x{height} pixels; it needs one")));
    }
    Ok(())
}
