//! Motion compensation: footprint moments → 2D motion → lift to 3D → regularised field.

pub mod moments;

use serde::{Deserialize, Serialize};

use crate::settings::Quality;

/// How Gaussians are moved from tracks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionSettings {}

impl Default for MotionSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl MotionSettings {
    /// The settings of a quality level.
    pub fn preset(_quality: Quality) -> Self {
        Self {}
    }
}

/// How a Gaussian's motion was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionOrigin {
    /// Its footprints do not move beyond the track noise; frozen downstream.
    Static,
    /// Solved from its own footprints.
    Solved,
    /// Taken from its neighbours' field.
    Propagated,
    /// Neither: it stays where it was.
    Unsolved,
}

/// Motion of every Gaussian from the key frame to one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionField {
    /// World displacement of each mean.
    pub translation: Vec<glam::DVec3>,
    /// World rotation of each Gaussian about its mean.
    pub rotation: Vec<glam::DQuat>,
    /// How each motion was found.
    pub origin: Vec<MotionOrigin>,
    /// Information matrix of each translation, 1 / world unit²: zero where nothing was observed.
    pub information: Vec<glam::DMat3>,
}

/// One view's camera and its tracks from the key frame to the target frame.
#[derive(Clone, Debug)]
pub struct MotionView {
    /// Where the view was taken from.
    pub camera: crate::cameras::Camera,
    /// Tracks, of the camera's size.
    pub tracks: std::sync::Arc<crate::tracking::TrackField>,
}

/// Motion of every Gaussian of the static model to the frame that the tracks lead to.
pub fn estimate(
    _engine: &dyn crate::engine::Engine,
    _gaussians: &crate::gaussians::Gaussians,
    _views: &[MotionView],
    _settings: &MotionSettings,
) -> Result<MotionField, crate::engine::EngineError> {
    unimplemented!("lands with the motion commit")
}

/// The Gaussians after a motion: means moved, rotations composed, spherical harmonics rotated with them.
pub fn apply(_gaussians: &crate::gaussians::Gaussians, _field: &MotionField) -> crate::gaussians::Gaussians {
    unimplemented!("lands with the motion commit")
}
