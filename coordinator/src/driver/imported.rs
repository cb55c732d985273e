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

    /// The imported file of a training view: by name where every file is named after a view, else by order, as are those
    /// of the clip.
    pub(super) fn track_file(&self, position: usize, view: &str) -> Result<&InputFile, StageError> {
        let (TrackSource::Files(files) | TrackSource::Exact(files)) = &self.request.tracks else {
            return Err(StageError::new(FailureKind::Bug, "the job imports no tracks"));
        };
        let found = match self.request.track_files_by_name {
            true => files.iter().find(|file| file.stem() == view),
            false => {
                let rank = self.request.training_positions.iter().position(|&known| known == position);
                rank.and_then(|rank| files.get(rank))
            }
        };
        found.ok_or_else(|| {
            StageError::bad_input(format!(
                "no track file for the training view '{view}' among {} files; give one npz per training view, in view \
                 order or named after the views",
                files.len()
            ))
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
        let read =
            if is_exact { track_npz::read_exact_flow(path) } else { track_npz::read_tracks(path, view.size) };
        // After reading: what was read is what is kept under the key of the submitted file.
        check_unchanged(view)?;
        let fields = read.map_err(|error| bad_tracks(view, error))?;
        let fields = match is_exact {
            true => exact_fields(view, &self.frames, fields)?,
            false => imported_fields(view, self.frames.len(), fields)?,
        };
        let keys = self.keys.get(&view.position).map(Vec::as_slice).unwrap_or_default();
        keys.iter().zip(&fields).try_for_each(|(key, field)| self.emit(key, field))
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

/// Exact flow leads from the clip's frame 1 to frame `t` at index `t - 2`.
fn exact_fields(
    view: &MissingView,
    frames: &[u32],
    mut fields: Vec<TrackField>,
) -> Result<Vec<TrackField>, StageError> {
    if frames.first() != Some(&1) {
        let key_frame = frames.first().copied().unwrap_or_default();
        return Err(bad_tracks(
            view,
            format!(
                "exact tracks start at frame 1, the key frame is {key_frame}; begin with frame 1 or use own tracks"
            ),
        ));
    }
    let held = fields.len();
    let last = frames.last().copied().unwrap_or_default() as usize;
    if held + 1 < last {
        let reason =
            format!("it reaches frame {}, the job needs frame {last}; reconstruct fewer frames", held + 1);
        return Err(bad_tracks(view, reason));
    }
    let wanted: Vec<usize> = frames[1..].iter().map(|&frame| frame as usize - 2).collect();
    let mut index = 0;
    fields.retain(|_| {
        index += 1;
        wanted.binary_search(&(index - 1)).is_ok()
    });
    check_size(view, &fields)?;
    Ok(fields)
}

/// Imported tracks hold a field for every frame after the key frame, or for more.
fn imported_fields(
    view: &MissingView,
    frames: usize,
    mut fields: Vec<TrackField>,
) -> Result<Vec<TrackField>, StageError> {
    let wanted = frames - 1;
    if fields.len() < wanted {
        let reason = format!(
            "it reaches {} frames beyond the key frame, the job needs {wanted}; reconstruct fewer frames",
            fields.len()
        );
        return Err(bad_tracks(view, reason));
    }
    fields.truncate(wanted);
    check_size(view, &fields)?;
    Ok(fields)
}

fn check_size(view: &MissingView, fields: &[TrackField]) -> Result<(), StageError> {
    let wrong = fields.iter().find(|field| (field.width, field.height) != view.size);
    wrong.map_or(Ok(()), |field| {
        Err(bad_tracks(
            view,
            format!(
                "they are of {} x {} pixels, the view of {} x {}; give tracks at the size of the images",
                field.width, field.height, view.size.0, view.size.1
            ),
        ))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn view() -> MissingView {
        let file = InputFile { path: "flow/cam00.npz".into(), digest: String::new() };
        MissingView { position: 0, name: "cam00".into(), size: (2, 1), file }
    }

    fn field(x: f32) -> TrackField {
        TrackField {
            width: 2,
            height: 1,
            positions: vec![[x, 0.0]; 2],
            visible: vec![true; 2],
            sigma: vec![0.1; 2],
        }
    }

    fn refusal(result: Result<Vec<TrackField>, StageError>) -> String {
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
        let message = refusal(check_unchanged(&view).map(|()| vec![]));
        assert!(message.contains("has changed"), "{message}");
        std::fs::remove_file(&path).unwrap();
        refusal(check_unchanged(&view).map(|()| vec![]));
    }

    #[test]
    fn exact_flow_is_taken_by_frame_number() {
        let fields = || vec![field(2.0), field(3.0), field(4.0)];
        let taken = exact_fields(&view(), &[1, 2, 4], fields()).unwrap();
        assert_eq!(taken, [field(2.0), field(4.0)]);
        assert!(refusal(exact_fields(&view(), &[2, 3], fields())).contains("key frame is 2"));
        assert!(refusal(exact_fields(&view(), &[1, 2, 3, 4, 5], fields())).contains("reaches frame 4"));
    }

    #[test]
    fn imported_tracks_may_reach_beyond_the_job_and_must_reach_its_end() {
        let fields = || vec![field(2.0), field(3.0), field(4.0)];
        assert_eq!(imported_fields(&view(), 3, fields()).unwrap(), [field(2.0), field(3.0)]);
        assert_eq!(imported_fields(&view(), 4, fields()).unwrap(), fields());
        let message = refusal(imported_fields(&view(), 5, fields()));
        assert!(message.contains("reaches 3") && message.contains("needs 4"), "{message}");
    }

    #[test]
    fn tracks_of_another_size_are_refused_by_both_sizes() {
        let other = MissingView { size: (4, 2), ..view() };
        let message = refusal(imported_fields(&other, 2, vec![field(2.0)]));
        assert!(message.contains("2 x 1") && message.contains("4 x 2"), "{message}");
        refusal(exact_fields(&other, &[1, 2], vec![field(2.0)]));
    }
}
