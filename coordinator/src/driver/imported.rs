//! Tracks from files: the coordinator converts them itself, once per clip.

use std::{collections::BTreeMap, ops::ControlFlow, path::Path, sync::Arc};

use bytes::Bytes;
use rayon::prelude::*;
use splat::{
    clip::{Clip, Split},
    formats::{track_blob, track_npz},
    tracking::TrackField,
};
use tokio::sync::mpsc;
use trackersplat_proto::v1::FailureKind;

use super::{Job, progress::StageProgress};
use crate::{
    compute::go_on,
    failure::StageError,
    ledger::TrackLedger,
    request::{InputFile, TrackSource},
    store::Artifact,
};

/// Encoded fields that may wait to be stored.
const PENDING_FIELDS: usize = 4;

/// A view whose tracks are missing.
#[derive(Clone, Debug)]
struct MissingView {
    /// Position in the clip.
    position: usize,
    name: String,
    size: (u32, u32),
    /// The file to import, as submitted.
    file: InputFile,
}

/// An encoded field on its way to the store, with its key.
type EncodedField = (String, Bytes);

impl Job {
    pub(super) async fn import_tracks(&mut self) -> Result<(), StageError> {
        let clip = self.clip().await?;
        let ledger = self.ledger().await?;
        let missing = self.missing_views(&clip, &ledger)?;
        if missing.is_empty() {
            tracing::info!(job_id = %self.id, "tracks reused");
            return Ok(());
        }
        let _turn = self.turn().await?;
        let (fields, mut incoming) = mpsc::channel::<EncodedField>(PENDING_FIELDS);
        let keys = missing.iter().map(|view| (view.position, ledger.keys(view.position as u32)));
        let source = ImportRun {
            clip,
            frames: self.frames.clone(),
            progress: StageProgress::new(self, "tracking"),
            total: (missing.len() * (self.frames.len() - 1)) as u64,
            keys: keys.collect(),
            fields,
        };
        let work = self.hub.compute.run(move || missing.par_iter().try_for_each(|view| source.run(view)));
        let store = async {
            let mut stored = Ok(());
            while let Some((key, bytes)) = incoming.recv().await {
                stored = self.keep_tracks(&key, bytes).await;
                if stored.is_err() {
                    // The conversion ends at its next field.
                    incoming.close();
                    break;
                }
            }
            stored
        };
        let (computed, stored) = tokio::join!(work, store);
        stored?;
        computed?;
        go_on(&self.stop)
    }

    async fn keep_tracks(&self, key: &str, bytes: Bytes) -> Result<(), StageError> {
        let artifact = Artifact { blob: self.hub.blobs.put(bytes).await?, note: String::new() };
        let mut change = self.hub.store.change().await?;
        change.put_artifact(key, "tracks", &artifact).await?;
        Ok(change.commit().await?)
    }

    fn missing_views(&self, clip: &Clip, ledger: &TrackLedger) -> Result<Vec<MissingView>, StageError> {
        let mut missing = Vec::new();
        for (position, view) in clip.views().iter().enumerate().filter(|(_, view)| view.split == Split::Train)
        {
            let file = self.track_file(position, &view.name)?.clone();
            if ledger.missing(position as u32).is_some() {
                let size = (view.camera.width, view.camera.height);
                missing.push(MissingView { position, name: view.name.clone(), size, file });
            }
        }
        Ok(missing)
    }

    /// The imported file of a training view.
    pub(super) fn track_file(&self, position: usize, view: &str) -> Result<&InputFile, StageError> {
        let (TrackSource::Files(files) | TrackSource::Exact(files)) = &self.request.tracks else {
            return Err(StageError::new(FailureKind::Bug, "the job imports no tracks"));
        };
        let rank = self.request.training_positions.iter().position(|&known| known == position);
        // At submission every training view had its file.
        rank.and_then(|rank| files.get(rank)).ok_or_else(|| {
            StageError::new(FailureKind::Bug, format!("the job has no track file for view '{view}'"))
        })
    }
}

/// One run over views whose tracks are missing.
struct ImportRun {
    clip: Arc<Clip>,
    frames: Vec<u32>,
    progress: StageProgress,
    total: u64,
    /// Keys of a view's fields in order, by position.
    keys: BTreeMap<usize, Vec<String>>,
    fields: mpsc::Sender<EncodedField>,
}

impl ImportRun {
    fn run(&self, view: &MissingView) -> Result<(), StageError> {
        let path = Path::new(&view.file.path);
        let is_exact = path == self.clip.exact_flow_path(view.position);
        let opened = match is_exact {
            true => track_npz::open_exact_flow(path),
            false => track_npz::open_tracks(path, view.size),
        };
        // After reading: what was read is what is kept under the key of the submitted file.
        check_unchanged(view)?;
        let tracks = opened.map_err(|error| bad_tracks(view, error))?;
        let wanted = match is_exact {
            true => exact_indices(view, &self.frames, tracks.count())?,
            false => imported_indices(view, self.frames.len(), tracks.count())?,
        };
        check_size(view, tracks.size())?;
        let keys = self.keys.get(&view.position).map(Vec::as_slice).unwrap_or_default();
        let fields = wanted.into_iter().filter_map(|index| tracks.field(index));
        keys.iter().zip(fields).try_for_each(|(key, field)| self.emit(key, &field))
    }

    /// Runs on a thread of the compute pool: waiting for the store is how the store slows the conversion down.
    fn emit(&self, key: &str, field: &TrackField) -> Result<(), StageError> {
        let encoded = Bytes::from(track_blob::encode(field));
        self.fields.blocking_send((key.to_owned(), encoded)).map_err(|_| StageError::Stopped)?;
        match self.progress.advance(self.total) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(StageError::Stopped),
        }
    }
}

fn check_unchanged(view: &MissingView) -> Result<(), StageError> {
    let submitted = &view.file;
    let now = InputFile::read(Path::new(&submitted.path));
    let now = now.map_err(|error| bad_tracks(view, format!("{error}; check the path")))?;
    if now.digest != submitted.digest {
        let reason = "the file has changed since the job was submitted; submit the job again";
        return Err(bad_tracks(view, reason));
    }
    Ok(())
}

fn bad_tracks(view: &MissingView, reason: impl std::fmt::Display) -> StageError {
    StageError::bad_input(format!("tracks of view '{}' in {}: {reason}", view.name, view.file.path))
}

/// Which of `held` fields of exact flow the frames take: flow leads from the clip's frame 1 to frame `t` at index `t - 2`.
fn exact_indices(view: &MissingView, frames: &[u32], held: usize) -> Result<Vec<usize>, StageError> {
    if frames.first() != Some(&1) {
        let key_frame = frames.first().copied().unwrap_or_default();
        return Err(bad_tracks(
            view,
            format!(
                "exact tracks start at frame 1, the key frame is {key_frame}; begin with frame 1 or use own tracks"
            ),
        ));
    }
    let last = frames.last().copied().unwrap_or_default() as usize;
    if held + 1 < last {
        let reason =
            format!("it reaches frame {}, the job needs frame {last}; reconstruct fewer frames", held + 1);
        return Err(bad_tracks(view, reason));
    }
    Ok(frames[1..].iter().map(|&frame| frame as usize - 2).collect())
}

/// Which of `held` imported fields are taken: there is one for every frame after the key frame, or for more.
fn imported_indices(view: &MissingView, frames: usize, held: usize) -> Result<Vec<usize>, StageError> {
    let wanted = frames - 1;
    if held < wanted {
        let reason = format!(
            "it reaches {held} frames beyond the key frame, the job needs {wanted}; reconstruct fewer frames"
        );
        return Err(bad_tracks(view, reason));
    }
    Ok((0..wanted).collect())
}

fn check_size(view: &MissingView, size: (u32, u32)) -> Result<(), StageError> {
    if size == view.size {
        return Ok(());
    }
    let reason = format!(
        "they are of {} x {} pixels, the view of {} x {}; give tracks at the size of the images",
        size.0, size.1, view.size.0, view.size.1
    );
    Err(bad_tracks(view, reason))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn view() -> MissingView {
        let file = InputFile { path: "flow/cam00.npz".into(), digest: String::new() };
        MissingView { position: 0, name: "cam00".into(), size: (2, 1), file }
    }

    fn refusal<T: std::fmt::Debug>(result: Result<T, StageError>) -> String {
        let Err(StageError::Failed(failure)) = result else { panic!("{result:?}") };
        assert_eq!(failure.kind(), FailureKind::BadInput);
        assert!(failure.message.contains("cam00") && failure.message.contains("flow/cam00.npz"));
        failure.message
    }

    #[test]
    fn a_track_file_that_has_changed_since_the_submission_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flow/cam00.npz");
        std::fs::create_dir(folder.path().join("flow")).unwrap();
        std::fs::write(&path, b"submitted").unwrap();
        let submitted = InputFile::read(&path).unwrap();
        let view = MissingView { file: submitted, ..view() };
        check_unchanged(&view).unwrap();
        std::fs::write(&path, b"changed").unwrap();
        let message = refusal(check_unchanged(&view));
        assert!(message.contains("has changed"), "{message}");
        std::fs::remove_file(&path).unwrap();
        refusal(check_unchanged(&view));
    }

    #[test]
    fn exact_flow_is_taken_by_frame_number() {
        assert_eq!(exact_indices(&view(), &[1, 2, 4], 3).unwrap(), [0, 2]);
        assert!(refusal(exact_indices(&view(), &[2, 3], 3)).contains("key frame is 2"));
        assert!(refusal(exact_indices(&view(), &[1, 2, 3, 4, 5], 3)).contains("reaches frame 4"));
    }

    #[test]
    fn imported_tracks_may_reach_beyond_the_job_and_must_reach_its_end() {
        assert_eq!(imported_indices(&view(), 3, 3).unwrap(), [0, 1]);
        assert_eq!(imported_indices(&view(), 4, 3).unwrap(), [0, 1, 2]);
        let message = refusal(imported_indices(&view(), 5, 3));
        assert!(message.contains("reaches 3") && message.contains("needs 4"), "{message}");
    }

    #[test]
    fn tracks_of_another_size_are_refused_by_both_sizes() {
        check_size(&view(), (2, 1)).unwrap();
        let message = refusal(check_size(&view(), (4, 2)));
        assert!(message.contains("4 x 2") && message.contains("2 x 1"), "{message}");
    }
}
