//! Puts the finished frames together: viewers' PLY files, deltas, `sequence.json`, `metrics.csv`, a contact sheet.
//!
//! ```text
//! static.ply                the key frame
//! frames/frame_0001.ply     every finished frame, as viewers expect
//! deltas/frame_0001.delta   the same against static.ply, a fraction of the size
//! sequence.json             what was run and how good it is, see [`sequence::Sequence`]
//! metrics.csv               a row per frame and held-out view
//! contact_sheet.png         truth, reconstruction and difference of a held-out view
//! ```
//! Every file is written under a temporary name and renamed, so that what has its name is complete.

mod contact_sheet;
mod files;
mod font;
mod metrics_table;
pub mod sequence;
#[cfg(test)]
mod tests;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use bytes::Bytes;
use splat::{
    cameras::Camera,
    engine::Engine,
    formats::ply,
    frame::FrameReport,
    gaussians::{Gaussians, delta},
    image::Image,
    settings::Settings,
};

use self::files::write_atomically;
pub use self::files::{delta_path, frame_path, holds_results};
use crate::queue::task::TaskState;

/// The key frame's file in the output folder.
pub const STATIC_MODEL: &str = "static.ply";
/// The description of the sequence in the output folder.
pub const SEQUENCE: &str = "sequence.json";
/// The table of metrics in the output folder.
pub const METRICS: &str = "metrics.csv";
/// The contact sheet in the output folder.
pub const CONTACT_SHEET: &str = "contact_sheet.png";

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
    /// A delta does not fit its static model, or the frame cannot be rendered.
    #[error("frame {frame}: {reason}")]
    Frame {
        /// The frame.
        frame: u32,
        /// What is wrong.
        reason: String,
    },
    /// A description cannot be written as JSON or CSV.
    #[error("cannot write {file}: {reason}")]
    Encode {
        /// The file.
        file: &'static str,
        /// What is wrong.
        reason: String,
    },
}

/// One frame of the sequence.
pub struct AssembledFrame {
    /// Frame number.
    pub number: u32,
    /// Done, failed or cancelled.
    pub state: TaskState,
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
    /// The clip.
    pub clip: sequence::SequenceClip,
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

/// Writes everything but the frames' PLY files and deltas, which [`write_frame`] has written.
///
/// Writes `sequence.json` last: a folder that has it is complete.
pub fn write_outputs(input: &AssemblyInput<'_>) -> Result<(), AssemblyError> {
    write_atomically(&input.output.join(STATIC_MODEL), &input.static_ply)?;
    write_atomically(&input.output.join(METRICS), &metrics_table::csv(&input.frames)?)?;
    if let Some(sheet) = contact_sheet::draw(input)? {
        write_atomically(&input.output.join(CONTACT_SHEET), &sheet.encode_png())?;
    }
    let sequence = sequence::Sequence::describe(input)?;
    write_atomically(&input.output.join(SEQUENCE), &sequence.to_json()?)
}

/// Writes one frame's PLY and delta.
pub fn write_frame(
    output: &Path,
    number: u32,
    static_model: &Gaussians,
    static_digest: &str,
    delta: &[u8],
) -> Result<(), AssemblyError> {
    let failed = |reason| AssemblyError::Frame { frame: number, reason };
    let digest = blake3::Hash::from_hex(static_digest).map_err(|error| failed(error.to_string()))?;
    let frame =
        delta::apply(static_model, digest.as_bytes(), delta).map_err(|error| failed(error.to_string()))?;
    write_atomically(&output.join(delta_path(number)), delta)?;
    write_atomically(&output.join(frame_path(number)), &ply::write_ply(&frame))
}
