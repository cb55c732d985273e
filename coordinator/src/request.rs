//! What a submission asks for, as it is stored.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use splat::{clip::ClipOptions, settings::Settings};

use crate::{keys::digest_of, store::JobRecord};

/// Decoded images that a clip may keep in memory.
const CLIP_CACHE_BYTES: u64 = 256 << 20;

/// A file that the job reads.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct InputFile {
    pub(crate) path: String,
    pub(crate) digest: String,
}

impl InputFile {
    /// Reads the whole file for its digest.
    pub(crate) fn read(path: &Path) -> std::io::Result<Self> {
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(std::fs::File::open(path)?)?;
        Ok(Self { path: path.display().to_string(), digest: hasher.finalize().to_hex().to_string() })
    }

    /// File name.
    pub(crate) fn name(&self) -> &str {
        self.as_ref().file_name().and_then(|name| name.to_str()).unwrap_or_default()
    }
}

impl AsRef<Path> for InputFile {
    fn as_ref(&self) -> &Path {
        Path::new(&self.path)
    }
}

/// Where the tracks come from.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum TrackSource {
    #[default]
    Own,
    /// The clip's own, in order of the training views; none where the job needs no tracks.
    Exact(Vec<InputFile>),
    /// In order of the training views. Another name than `files`, under which earlier versions stored them as they came.
    #[serde(rename = "view-files")]
    Files(Vec<InputFile>),
    /// Computed by a neural network from this file.
    Learned(InputFile),
}

/// What a submission asks for besides clip, output and settings.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct JobRequest {
    /// First and last frame; `None`: all.
    pub(crate) frames: Option<(u32, u32)>,
    /// Empty: those that the data set names.
    pub(crate) test_views: Vec<String>,
    /// `None`: reconstruct it.
    pub(crate) static_model: Option<InputFile>,
    pub(crate) tracks: TrackSource,
    /// Positions of the training views in the clip.
    pub(crate) training_positions: Vec<usize>,
    /// Where the clip was copied from; holds no credentials.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) clip_url: Option<String>,
}

/// A text about a clip that was copied, with its URL in place of the copy's path.
pub(crate) fn by_url(text: &str, copy: &str, url: Option<&str>) -> String {
    url.map_or_else(|| text.to_owned(), |url| text.replace(copy, url))
}

/// The clip of a job as a person knows it: its URL, or its path.
pub(crate) fn clip_name(job: &JobRecord) -> String {
    let request: Option<JobRequest> = serde_json::from_str(&job.request).ok();
    request.and_then(|request| request.clip_url).unwrap_or_else(|| job.clip.clone())
}

impl JobRequest {
    /// `scratch` is the folder for frames that are decoded from videos.
    pub(crate) fn clip_options(&self, scratch: PathBuf) -> ClipOptions {
        ClipOptions {
            test_views: self.test_views.clone(),
            frames: self.frames,
            cache_bytes: CLIP_CACHE_BYTES,
            scratch: Some(scratch),
        }
    }

    /// Digest of everything that, with the clip, decides the results. Files count by content, not by name or place.
    pub(crate) fn settings_digest(&self, settings: &Settings) -> String {
        let mut request = Self { clip_url: None, ..self.clone() };
        let nameless = |file: &mut InputFile| file.path.clear();
        request.static_model.iter_mut().for_each(nameless);
        if let TrackSource::Learned(model) = &mut request.tracks {
            nameless(model);
        }
        if let TrackSource::Exact(files) | TrackSource::Files(files) = &mut request.tracks {
            files.iter_mut().for_each(nameless);
        }
        digest_of(&(settings, request))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_digest_knows_content_and_not_paths() {
        let settings = Settings::default();
        let file = |path: &str, digest: &str| InputFile { path: path.into(), digest: digest.into() };
        let request = JobRequest { static_model: Some(file("/a/s.ply", "1")), ..JobRequest::default() };
        let moved = JobRequest { static_model: Some(file("/b/t.ply", "1")), ..JobRequest::default() };
        let other = JobRequest { static_model: Some(file("/a/s.ply", "2")), ..JobRequest::default() };
        assert_eq!(request.settings_digest(&settings), moved.settings_digest(&settings));
        assert_ne!(request.settings_digest(&settings), other.settings_digest(&settings));
        let seeded = Settings { seed: 1, ..settings.clone() };
        assert_ne!(request.settings_digest(&settings), request.settings_digest(&seeded));
        let copied = JobRequest { clip_url: Some("s3://bucket/clip".into()), ..request.clone() };
        assert_eq!(request.settings_digest(&settings), copied.settings_digest(&settings));
        let some_frames = JobRequest { frames: Some((1, 2)), ..request.clone() };
        assert_ne!(request.settings_digest(&settings), some_frames.settings_digest(&settings));

        let tracked = |files: Vec<InputFile>| {
            let request = JobRequest { tracks: TrackSource::Files(files), ..JobRequest::default() };
            request.settings_digest(&settings)
        };
        let digest = tracked(vec![file("/a/cam00.npz", "1"), file("/a/cam01.npz", "2")]);
        assert_eq!(digest, tracked(vec![file("/b/first.npz", "1"), file("/b/second.npz", "2")]));
        assert_ne!(digest, tracked(vec![file("/a/cam00.npz", "2"), file("/a/cam01.npz", "1")]));

        let by = |model| JobRequest { tracks: TrackSource::Learned(model), ..JobRequest::default() };
        let digest = |path: &str, content: &str| by(file(path, content)).settings_digest(&settings);
        assert_eq!(digest("/a/raft.onnx", "1"), digest("/b/copy.onnx", "1"));
        assert_ne!(digest("/a/raft.onnx", "1"), digest("/a/raft.onnx", "2"));
        assert_ne!(digest("/a/raft.onnx", "1"), JobRequest::default().settings_digest(&settings));
    }
}
