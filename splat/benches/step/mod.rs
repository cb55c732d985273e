//! One optimisation step taken apart into its stages, and whole.
#![allow(dead_code, reason = "each benchmark uses a part")]

use std::sync::Arc;

use splat::{
    engine::{DensityStatistics, Engine, EngineError, Session, SessionInput, TrainingView},
    gaussians::Gaussians,
    image::Image,
    loss::{LossWorkspace, PhotometricLoss},
    optim::{Adam, LearningRates},
    raster::{CpuEngine, Pass},
};

use crate::scene::Scene;

const BACKGROUND: [f32; 3] = [0.0; 3];
const DSSIM_WEIGHT: f32 = 0.2;

/// Name of a stage, and how to run it.
pub(crate) type Stage = (&'static str, fn(&mut Stages));

/// The stages in the order of a step.
pub(crate) const STAGES: [Stage; 6] = [
    ("project", Stages::project),
    ("bin", Stages::bin),
    ("blend", Stages::blend),
    ("loss", Stages::loss),
    ("blend_backward", Stages::blend_backward),
    ("descend", Stages::descend),
];

/// What the stages of a step work on. A stage may be repeated; its input is what the stages before it left.
pub(crate) struct Stages {
    scene: Scene,
    gaussians: Gaussians,
    pass: Pass,
    rendered: Image,
    loss: PhotometricLoss,
    workspace: LossWorkspace,
    image_gradient: Vec<f32>,
    adam: Adam,
    density: DensityStatistics,
    order: Vec<u32>,
}

impl Stages {
    /// At the start of an optimisation.
    pub(crate) fn new(scene: &Scene) -> Self {
        let rendered = Image::filled(scene.camera.width, scene.camera.height, BACKGROUND);
        Self {
            gaussians: scene.gaussians.clone(),
            pass: Pass::default(),
            loss: PhotometricLoss::new(&scene.target, None, DSSIM_WEIGHT),
            workspace: LossWorkspace::default(),
            image_gradient: vec![0.0; rendered.pixels.len()],
            rendered,
            density: DensityStatistics::zeros(scene.gaussians.len()),
            adam: Adam::new(&scene.gaussians),
            order: Vec::new(),
            scene: scene.clone(),
        }
    }

    /// All stages once.
    pub(crate) fn run(&mut self) {
        for (_, stage) in STAGES {
            stage(self);
        }
    }

    /// Footprints and colours.
    pub(crate) fn project(&mut self) {
        self.pass.project(&self.gaussians, &self.scene.camera, self.gaussians.sh_degree);
    }

    /// Depth order and bands.
    pub(crate) fn bin(&mut self) {
        self.pass.bin(&self.scene.camera, &mut self.order);
    }

    /// The rendering.
    pub(crate) fn blend(&mut self) {
        self.pass.blend(&self.scene.camera, BACKGROUND, &[], &mut self.rendered, &mut []);
    }

    /// L1 + D-SSIM and its gradient by the rendering.
    pub(crate) fn loss(&mut self) {
        let loss = self.loss.evaluate(&self.rendered, &mut self.workspace, &mut self.image_gradient);
        std::hint::black_box(loss);
    }

    /// Gradients of the footprints.
    pub(crate) fn blend_backward(&mut self) {
        self.pass.blend_backward(&self.scene.camera, BACKGROUND, &self.image_gradient, &[]);
    }

    /// Gradients of the parameters, and the update.
    pub(crate) fn descend(&mut self) {
        let rates = rates(self.gaussians.sh_degree);
        let camera = &self.scene.camera;
        self.pass.descend(&mut self.gaussians, camera, &rates, &mut self.adam, &mut self.density);
    }
}

/// An optimisation session on the scene: what users run, all stages in one call.
///
/// # Errors
/// If the scene is no valid input.
pub(crate) fn session(scene: &Scene) -> Result<Box<dyn Session>, EngineError> {
    CpuEngine::default().session(SessionInput {
        gaussians: scene.gaussians.clone(),
        views: vec![TrainingView {
            camera: scene.camera.clone(),
            image: Arc::new(scene.target.clone()),
            mask: None,
        }],
        background: BACKGROUND,
        dssim_weight: DSSIM_WEIGHT,
        frozen: Vec::new(),
    })
}

/// Means move as in refinement, so that their depth order changes as it does in use. All else hardly moves, so that many
/// steps blend the pairs that were counted before the first.
pub(crate) fn rates(sh_degree: u32) -> LearningRates {
    let still = 1e-7;
    LearningRates {
        mean: 8e-4,
        rotation: still,
        log_scale: still,
        logit_opacity: still,
        sh_dc: still,
        sh_rest: still,
        sh_degree,
    }
}
