//! An optimisation session of the CPU engine: parameters, optimiser state, images and buffers live as long as it does.

use super::pass::Pass;
use crate::{
    cameras::Camera,
    engine::{DensityStatistics, EngineError, Session, SessionInput},
    gaussians::Gaussians,
    image::Image,
    loss::{LossWorkspace, PhotometricLoss},
    optim::{Adam, LearningRates},
    simd::Instructions,
};

struct SessionView {
    camera: Camera,
    /// Depth order of the last step on this view.
    order: Vec<u32>,
    loss: PhotometricLoss,
}

/// See [`Session`].
pub(super) struct CpuSession {
    gaussians: Gaussians,
    views: Vec<SessionView>,
    background: [f32; 3],
    /// Empty: all Gaussians are optimised.
    active: Vec<bool>,
    pass: Pass,
    rendered: Image,
    image_gradient: Vec<f32>,
    workspace: LossWorkspace,
    adam: Adam,
    density: DensityStatistics,
    /// Of the steps since they were last taken.
    losses: Vec<f32>,
}

impl CpuSession {
    pub(super) fn new(input: SessionInput, instructions: Instructions) -> Result<Self, EngineError> {
        input.validate()?;
        let count = input.gaussians.len();
        let views = input
            .views
            .iter()
            .map(|view| SessionView {
                camera: view.camera.clone(),
                order: Vec::new(),
                loss: PhotometricLoss::new(&view.image, view.mask.as_deref(), input.dssim_weight),
            })
            .collect();
        Ok(Self {
            adam: Adam::new(&input.gaussians),
            density: DensityStatistics::zeros(count),
            active: input.frozen.iter().map(|frozen| !frozen).collect(),
            gaussians: input.gaussians,
            views,
            background: input.background,
            pass: Pass::new(instructions),
            rendered: Image::filled(0, 0, [0.0; 3]),
            image_gradient: Vec::new(),
            workspace: LossWorkspace::new(instructions),
            losses: Vec::new(),
        })
    }

    fn prepare(&mut self, view: usize) {
        let camera = &self.views[view].camera;
        self.rendered.width = camera.width;
        self.rendered.height = camera.height;
        let values = self.rendered.pixel_count() * 3;
        self.rendered.pixels.resize(values, 0.0);
        self.image_gradient.resize(values, 0.0);
    }
}

impl Session for CpuSession {
    fn step(&mut self, view: usize, rates: &LearningRates) -> Result<(), EngineError> {
        if view >= self.views.len() {
            return Err(EngineError::InvalidInput(format!("view {view} of {}", self.views.len())));
        }
        self.prepare(view);
        let SessionView { camera, order, loss } = &mut self.views[view];
        self.pass.project(&self.gaussians, camera, rates.sh_degree);
        self.pass.bin(camera, order);
        self.pass.blend(camera, self.background, &self.active, &mut self.rendered, &mut []);
        let value = loss.evaluate(&self.rendered, &mut self.workspace, &mut self.image_gradient);
        self.pass.blend_backward(camera, self.background, &self.image_gradient, &[]);
        self.pass.descend(&mut self.gaussians, camera, rates, &mut self.adam, &mut self.density);
        self.losses.push(value);
        Ok(())
    }

    fn take_losses(&mut self) -> Result<Vec<f32>, EngineError> {
        Ok(std::mem::take(&mut self.losses))
    }

    fn gaussians(&mut self) -> Result<Gaussians, EngineError> {
        Ok(self.gaussians.clone())
    }

    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError> {
        Ok(std::mem::replace(&mut self.density, DensityStatistics::zeros(self.gaussians.len())))
    }

    fn replace(&mut self, gaussians: Gaussians, source: &[Option<usize>]) -> Result<(), EngineError> {
        if source.len() != gaussians.len() {
            return Err(EngineError::InvalidInput(format!(
                "{} sources for {} Gaussians",
                source.len(),
                gaussians.len()
            )));
        }
        if gaussians.sh_degree != self.gaussians.sh_degree {
            return Err(EngineError::InvalidInput(format!(
                "Gaussians of degree {} in a session of degree {}",
                gaussians.sh_degree, self.gaussians.sh_degree
            )));
        }
        if let Some(&old) = source.iter().flatten().find(|&&old| old >= self.gaussians.len()) {
            return Err(EngineError::InvalidInput(format!(
                "source {old} of {} Gaussians",
                self.gaussians.len()
            )));
        }
        if !self.active.is_empty() {
            self.active = source.iter().map(|old| old.is_none_or(|old| self.active[old])).collect();
        }
        self.adam.replace(source);
        self.density = DensityStatistics::zeros(gaussians.len());
        self.gaussians = gaussians;
        Ok(())
    }
}
