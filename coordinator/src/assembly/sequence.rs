//! `sequence.json`: what was run, what came out, how good it is, how long it took.

use std::{collections::BTreeMap, path::PathBuf};

use serde::{Deserialize, Serialize};
use splat::{cameras::Camera, clip::Split, formats::ply, frame::FrameReport, settings::Settings};

use super::{AssembledFrame, AssembledView, AssemblyError, AssemblyInput, SEQUENCE, delta_path, frame_path};
use crate::queue::task::TaskState;

/// Version of the layout of `sequence.json`; it grows when a reader must know of a change.
pub const SCHEMA_VERSION: u32 = 1;

/// The content of `sequence.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sequence {
    /// [`SCHEMA_VERSION`] of the program that wrote it.
    pub schema_version: u32,
    /// Version of the program that wrote it.
    pub program_version: String,
    /// The job.
    pub job_id: String,
    /// What was reconstructed.
    pub clip: SequenceClip,
    /// How it was reconstructed.
    pub settings: Settings,
    /// The key frame's Gaussians.
    pub static_model: SequenceStaticModel,
    /// Cameras, in order of the clip.
    pub views: Vec<SequenceView>,
    /// In order of frame number.
    pub frames: Vec<SequenceFrame>,
    /// Seconds per stage of the whole job.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Bytes of the stored inputs and results, by kind.
    pub bytes: BTreeMap<String, u64>,
}

/// What was reconstructed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceClip {
    /// Its folder, as the coordinator saw it.
    pub path: PathBuf,
    /// The object store that the folder was copied from; holds no credentials.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub url: Option<String>,
    /// BLAKE3 of its content, hexadecimal.
    pub digest: String,
}

/// The key frame's Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceStaticModel {
    /// File and size.
    #[serde(flatten)]
    pub file: SequenceFile,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Degree of the spherical harmonics.
    pub sh_degree: u32,
    /// How it came about: steps, loss, or that it was imported.
    pub report: serde_json::Value,
}

/// A file of the output folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceFile {
    /// Relative to the output folder.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
}

/// One camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceView {
    /// Name in the clip.
    pub name: String,
    /// Whether it was trained on or held out.
    pub split: Split,
    /// Intrinsics in pixels; world-to-camera pose in OpenCV axes, rotation by columns.
    pub camera: Camera,
}

/// One frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceFrame {
    /// Frame number in the clip.
    pub number: u32,
    /// `done`, `failed` or `cancelled`.
    pub state: String,
    /// Leases that were given for it.
    pub attempts: u32,
    /// Worker of the last attempt.
    pub worker: String,
    /// From lease to result.
    pub seconds: f64,
    /// Seconds per stage of the worker.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Its Gaussians, if done.
    pub ply: Option<SequenceFile>,
    /// The same against the static model, if done.
    pub delta: Option<SequenceFile>,
    /// Held-out metrics before and after refinement and where the motions came from, if done.
    pub report: Option<FrameReport>,
}

/// Why a folder is not a finished sequence.
#[derive(Debug, thiserror::Error)]
pub enum SequenceError {
    /// The file cannot be read.
    #[error("{path}: {source}; give the output folder of a finished job")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not of this layout.
    #[error("{path}: {reason}; give the output folder of a job of this version")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

impl Sequence {
    /// Reads the description of an output folder.
    pub fn read(output: &std::path::Path) -> Result<Self, SequenceError> {
        let path = output.join(SEQUENCE);
        let bytes =
            std::fs::read(&path).map_err(|source| SequenceError::Io { path: path.clone(), source })?;
        let content = |reason| SequenceError::Content { path: path.clone(), reason };
        let sequence: Self = serde_json::from_slice(&bytes).map_err(|error| content(error.to_string()))?;
        if sequence.schema_version != SCHEMA_VERSION {
            let found = sequence.schema_version;
            return Err(content(format!("schema version {found}, this program reads {SCHEMA_VERSION}")));
        }
        Ok(sequence)
    }

    /// The description of a job whose frames and static model are written.
    pub(super) fn describe(input: &AssemblyInput<'_>) -> Result<Self, AssemblyError> {
        let static_model = ply::parse_ply(&input.static_ply).map_err(|error| AssemblyError::Encode {
            file: super::STATIC_MODEL,
            reason: error.to_string(),
        })?;
        let frames = input.frames.iter().map(|frame| SequenceFrame::describe(&input.output, frame));
        Ok(Self {
            schema_version: SCHEMA_VERSION,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            job_id: input.job_id.clone(),
            clip: input.clip.clone(),
            settings: input.settings.clone(),
            static_model: SequenceStaticModel {
                file: SequenceFile { path: super::STATIC_MODEL.into(), bytes: input.static_ply.len() as u64 },
                gaussians: static_model.len(),
                sh_degree: static_model.sh_degree,
                report: input.static_report.clone(),
            },
            views: input.views.iter().map(SequenceView::describe).collect(),
            frames: frames.collect::<Result<_, _>>()?,
            stage_seconds: input.stage_seconds.clone(),
            bytes: input.bytes.clone(),
        })
    }

    pub(super) fn to_json(&self) -> Result<Vec<u8>, AssemblyError> {
        serde_json::to_vec_pretty(self)
            .map_err(|error| AssemblyError::Encode { file: SEQUENCE, reason: error.to_string() })
    }
}

impl SequenceView {
    fn describe(view: &AssembledView) -> Self {
        let split = if view.held_out { Split::Test } else { Split::Train };
        Self { name: view.name.clone(), split, camera: view.camera.clone() }
    }
}

impl SequenceFrame {
    fn describe(output: &std::path::Path, frame: &AssembledFrame) -> Result<Self, AssemblyError> {
        let is_done = frame.state == TaskState::Done;
        let file = |path| if is_done { file_of(output, path).map(Some) } else { Ok(None) };
        Ok(Self {
            number: frame.number,
            state: frame.state.label().to_owned(),
            attempts: frame.attempts,
            worker: frame.worker.clone(),
            seconds: frame.seconds,
            stage_seconds: frame.stage_seconds.clone(),
            ply: file(frame_path(frame.number))?,
            delta: file(delta_path(frame.number))?,
            report: frame.report.clone(),
        })
    }

    /// Whether its Gaussians are there.
    pub fn is_done(&self) -> bool {
        self.state == TaskState::Done.label()
    }
}

fn file_of(output: &std::path::Path, relative: PathBuf) -> Result<SequenceFile, AssemblyError> {
    let path = output.join(&relative);
    let metadata = std::fs::metadata(&path).map_err(|source| AssemblyError::Io { path, source })?;
    Ok(SequenceFile { path: relative, bytes: metadata.len() })
}
