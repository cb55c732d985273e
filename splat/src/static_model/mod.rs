//! Reconstruction of the key frame as a static set of Gaussians.

use serde::{Deserialize, Serialize};

use crate::settings::Quality;

/// How the key frame is reconstructed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StaticModelSettings {}

impl Default for StaticModelSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl StaticModelSettings {
    /// The settings of a quality level.
    pub fn preset(_quality: Quality) -> Self {
        Self {}
    }
}

/// A structure-from-motion point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SfmPoint {
    /// World position.
    pub position: glam::DVec3,
    /// sRGB in `[0, 1]`.
    pub colour: [f32; 3],
}

/// What the key frame is reconstructed from.
#[derive(Clone, Debug)]
pub struct StaticModelInput {
    /// Training images of the key frame; at least two.
    pub views: Vec<crate::engine::TrainingView>,
    /// Structure-from-motion points; random points in the common frustum if empty.
    pub points: Vec<SfmPoint>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Seed of every random choice.
    pub seed: u64,
    /// How.
    pub settings: StaticModelSettings,
}

/// Where the reconstruction is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StaticModelProgress {
    /// Optimisation steps done.
    pub step: u32,
    /// Steps at most; it may stop earlier.
    pub steps: u32,
    /// Gaussians now.
    pub gaussians: usize,
    /// Smoothed training loss.
    pub loss: f32,
}

/// Why there is no static model.
#[derive(Debug, thiserror::Error)]
pub enum StaticModelError {
    /// The input cannot be reconstructed.
    #[error("{0}")]
    BadInput(String),
    /// The device failed.
    #[error(transparent)]
    Engine(#[from] crate::engine::EngineError),
    /// The caller's progress function asked to stop.
    #[error("cancelled")]
    Cancelled,
}

/// Reconstructs the key frame; `progress` may stop it between steps.
pub fn reconstruct(
    _engine: &dyn crate::engine::Engine,
    _input: &StaticModelInput,
    _progress: &mut dyn FnMut(StaticModelProgress) -> std::ops::ControlFlow<()>,
) -> Result<crate::gaussians::Gaussians, StaticModelError> {
    unimplemented!("lands with the static-model commit")
}
