//! Puts the finished frames together. Stand-in; replaced on merge.

use std::{collections::BTreeMap, path::{Path, PathBuf}};

use bytes::Bytes;
use splat::{cameras::Camera, engine::Engine, frame::FrameReport, gaussians::Gaussians, image::Image, settings::Settings};

use crate::queue::frame::FrameState;

/// Why the outputs could not be written.
#[derive(Debug, thiserror::Error)]
pub enum AssemblyError {
    /// A file cannot be written.
    #[error("{path}: {source}; check that the folder can be written and the disk is not full")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A delta does not fit its static model.
    #[error("frame {frame}: {reason}")]
    Frame {
        /// The frame.
        frame: u32,
        /// What is wrong.
        reason: String,
    },
}

/// One frame of the sequence.
pub struct AssembledFrame {
    /// Frame number.
    pub number: u32,
    /// Done, failed or cancelled.
    pub state: FrameState,
    /// Leases given.
    pub attempts: u32,
    /// Worker of the last attempt.
    pub worker: String,
    /// Metrics and counts, if done.
    pub report: Option<FrameReport>,
    /// From lease to result.
    pub seconds: f64,
    /// Seconds per stage of the worker.
    pub stage_seconds: BTreeMap<String, f64>,
    /// The result, if done.
    pub delta: Option<Bytes>,
}

/// One view of the clip.
pub struct AssembledView {
    /// Name in the clip.
    pub name: String,
    /// Whether it is held out for evaluation.
    pub held_out: bool,
    /// Where it was taken from.
    pub camera: Camera,
}

/// Everything that the outputs are made of.
pub struct AssemblyInput<'a> {
    /// The output folder.
    pub output: PathBuf,
    /// The job.
    pub job_id: String,
    /// Path of the clip.
    pub clip_path: PathBuf,
    /// Digest of its content.
    pub clip_digest: String,
    /// Settings of the job.
    pub settings: &'a Settings,
    /// Gaussian PLY of the key frame.
    pub static_ply: Bytes,
    /// How it came about.
    pub static_report: serde_json::Value,
    /// In order of frame number.
    pub frames: Vec<AssembledFrame>,
    /// In order of the clip.
    pub views: Vec<AssembledView>,
    /// Image of a view at a frame, from the store.
    pub test_image: &'a (dyn Fn(&str, u32) -> Option<Image> + Sync),
    /// Renders the contact sheet.
    pub engine: &'a dyn Engine,
    /// Seconds per stage of the job.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Bytes of the stored inputs and results: `images`, `tracks`, `static_model`, `deltas`.
    pub bytes: BTreeMap<String, u64>,
}

/// Writes everything but the frames' PLY files, which [`write_frame`] has written.
pub fn write_outputs(_input: &AssemblyInput<'_>) -> Result<(), AssemblyError> {
    Ok(())
}

/// Writes one frame's PLY: temporary name, then rename.
pub fn write_frame(
    _output: &Path,
    _number: u32,
    _static_model: &Gaussians,
    _static_digest: &str,
    _delta: &[u8],
) -> Result<(), AssemblyError> {
    Ok(())
}
