//! Photometric refinement of one frame.

use serde::{Deserialize, Serialize};

use crate::settings::Quality;

/// How a frame is refined after motion compensation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineSettings {}

impl Default for RefineSettings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl RefineSettings {
    /// The settings of a quality level.
    pub fn preset(_quality: Quality) -> Self {
        Self {}
    }
}
