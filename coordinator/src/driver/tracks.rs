//! Track fields from the key frame to every frame, per training view: computed, or imported. Once per clip.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use bytes::Bytes;
use rayon::prelude::*;
use splat::{
    clip::{Clip, Split},
    formats::{track_blob, track_npz},
    settings::{MotionSource, Settings},
    tracking::{TrackField, learned::LearnedTracker, track_view},
};
use tokio::sync::mpsc;
use trackersplat_proto::v1::{Blob, FailureKind};

use super::{Job, progress::StageProgress};
use crate::{
    compute::go_on,
    failure::StageError,
    keys::{TrackKey, VERSION, digest_of},
    model,
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
    /// The file to import, as submitted; `None`: track.
    file: Option<InputFile>,
}

/// An encoded field on its way to the store: position of the view, index of the frame.
type EncodedField = (usize, usize, Bytes);

impl Job {
    pub(super) async fn track(&mut self) -> Result<(), StageError> {
        if self.settings.motion_source == MotionSource::None || self.frames.len() < 2 {
            return Ok(());
        }
        let clip = self.clip().await?;
        let missing = self.missing_views(&clip).await?;
        if missing.is_empty() {
            tracing::info!(job_id = %self.id, "tracks reused");
            return Ok(());
        }
        let _turn = self.turn().await?;
        let (fields, mut incoming) = mpsc::channel::<EncodedField>(PENDING_FIELDS);
        let total = (missing.len() * (self.frames.len() - 1)) as u64;
        let model = self.learned_tracker().await?;
        let source = TrackRun {
            clip,
            model,
            frames: self.frames.clone(),
            settings: self.settings.clone(),
            progress: StageProgress::new(self, "tracking"),
            total,
            fields,
        };
        let work = self.hub.compute.run(move || missing.par_iter().try_for_each(|view| source.run(view)));
        let store = async {
            let mut stored = Ok(());
            while let Some((position, index, bytes)) = incoming.recv().await {
                stored = self.keep_tracks(position, index, bytes).await;
                if stored.is_err() {
                    // The computation ends at its next field.
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

    /// The network that tracks, if one does.
    async fn learned_tracker(&self) -> Result<Option<LearnedTracker>, StageError> {
        let TrackSource::Learned(file) = &self.request.tracks else { return Ok(None) };
        let (file, settings) = (file.clone(), self.settings.clone());
        let load = move || -> Result<LearnedTracker, StageError> {
            let bytes = model::read_again(&file).map_err(StageError::bad_input)?;
            Ok(LearnedTracker::from_onnx(bytes, &file.path, &settings.tracking.onnx)?)
        };
        self.hub.compute.run(load).await.map(Some)
    }

    async fn keep_tracks(&self, position: usize, index: usize, bytes: Bytes) -> Result<(), StageError> {
        let views = self.views().await?;
        let view = views.get(position).ok_or_else(|| {
            StageError::new(FailureKind::Bug, format!("view {position} is none of the job's {}", views.len()))
        })?;
        let key = self.track_key(position, &view.name, index)?;
        let artifact = Artifact { blob: self.hub.blobs.put(bytes).await?, note: String::new() };
        let mut change = self.hub.store.change().await?;
        change.put_artifact(&key, "tracks", &artifact).await?;
        Ok(change.commit().await?)
    }

    /// Key of the tracks of one view to the frame of an index.
    fn track_key(&self, position: usize, view: &str, index: usize) -> Result<String, StageError> {
        let settings;
        let source = match &self.request.tracks {
            TrackSource::Own => {
                settings = digest_of(&self.settings.tracking);
                settings.as_str()
            }
            TrackSource::Learned(model) => {
                settings = digest_of(&(&self.settings.tracking, &model.digest));
                settings.as_str()
            }
            TrackSource::Exact(_) | TrackSource::Files(_) => self.track_file(position, view)?.digest.as_str(),
        };
        let clip = &self.record.clip_digest;
        let frames = &self.frames[..=index];
        Ok(digest_of(&TrackKey { kind: "tracks", version: VERSION, source, clip, frames, view }))
    }

    /// The imported file of a training view: by name where every file is named after a view, else by order, as are those
    /// of the clip.
    fn track_file(&self, position: usize, view: &str) -> Result<&InputFile, StageError> {
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

    async fn missing_views(&self, clip: &Clip) -> Result<Vec<MissingView>, StageError> {
        let mut missing = Vec::new();
        for (position, view) in clip.views().iter().enumerate().filter(|(_, view)| view.split == Split::Train)
        {
            let file = match &self.request.tracks {
                TrackSource::Own | TrackSource::Learned(_) => None,
                TrackSource::Exact(_) | TrackSource::Files(_) => {
                    Some(self.track_file(position, &view.name)?.clone())
                }
            };
            if self.tracks_of(position, &view.name).await?.is_none() {
                let size = (view.camera.width, view.camera.height);
                missing.push(MissingView { position, name: view.name.clone(), size, file });
            }
        }
        Ok(missing)
    }

    /// The stored tracks of a training view by frame number; `None` if any is missing.
    pub(super) async fn tracks_of(
        &self,
        position: usize,
        view: &str,
    ) -> Result<Option<BTreeMap<u32, Blob>>, StageError> {
        let mut tracks = BTreeMap::new();
        for (index, &frame) in self.frames.iter().enumerate().skip(1) {
            let key = self.track_key(position, view, index)?;
            let Some(artifact) = self.held_artifact(&key).await? else { return Ok(None) };
            tracks.insert(frame, artifact.blob);
        }
        Ok(Some(tracks))
    }
}

/// One run over views whose tracks are missing.
struct TrackRun {
    clip: Arc<Clip>,
    frames: Vec<u32>,
    settings: Arc<Settings>,
    model: Option<LearnedTracker>,
    progress: StageProgress,
    total: u64,
    fields: mpsc::Sender<EncodedField>,
}

impl TrackRun {
    fn run(&self, view: &MissingView) -> Result<(), StageError> {
        let Some(file) = &view.file else { return self.track(view) };
        let path = Path::new(&file.path);
        let is_exact = path == self.clip.exact_flow_path(view.position);
        let read =
            if is_exact { track_npz::read_exact_flow(path) } else { track_npz::read_tracks(path, view.size) };
        // After reading: what was read is what is kept under the key of the submitted file.
        check_unchanged(view, file)?;
        let fields = read.map_err(|error| bad_tracks(view, error))?;
        let fields = match is_exact {
            true => exact_fields(view, &self.frames, fields)?,
            false => imported_fields(view, self.frames.len(), fields)?,
        };
        for (index, field) in (1..).zip(fields) {
            self.emit(view, index, &field)?;
        }
        Ok(())
    }

    fn track(&self, view: &MissingView) -> Result<(), StageError> {
        let mut load = |index: usize| {
            let image = self.clip.image(view.position, index);
            image.map_err(|error| StageError::bad_input(error.to_string()))
        };
        let mut emit = |index: usize, field: TrackField| self.emit(view, index, &field);
        let (frames, settings) = (self.frames.len(), &self.settings.tracking);
        match &self.model {
            None => track_view(frames, &mut load, settings, &mut emit),
            Some(model) => model.track_view(frames, &mut load, settings, &mut emit),
        }
    }

    /// Runs on a thread of the compute pool: waiting for the store is how the store slows the tracker down.
    fn emit(&self, view: &MissingView, index: usize, field: &TrackField) -> Result<(), StageError> {
        let encoded = Bytes::from(track_blob::encode(field));
        self.fields.blocking_send((view.position, index, encoded)).map_err(|_| StageError::Stopped)?;
        match self.progress.advance(self.total) {
            std::ops::ControlFlow::Continue(()) => Ok(()),
            std::ops::ControlFlow::Break(()) => Err(StageError::Stopped),
        }
    }
}

fn check_unchanged(view: &MissingView, submitted: &InputFile) -> Result<(), StageError> {
    let now = InputFile::read(Path::new(&submitted.path));
    let now = now.map_err(|error| bad_tracks(view, format!("{error}; check the path")))?;
    if now.digest != submitted.digest {
        let reason = "the file has changed since the job was submitted; submit the job again";
        return Err(bad_tracks(view, reason));
    }
    Ok(())
}

fn bad_tracks(view: &MissingView, reason: impl std::fmt::Display) -> StageError {
    let file = view.file.as_ref().map(|file| file.path.as_str()).unwrap_or_default();
    StageError::bad_input(format!("tracks of view '{}' in {file}: {reason}", view.name))
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
        MissingView { position: 0, name: "cam00".into(), size: (2, 1), file: Some(file) }
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
        let view = MissingView { file: Some(submitted.clone()), ..view() };
        check_unchanged(&view, &submitted).unwrap();
        std::fs::write(&path, b"changed").unwrap();
        let message = refusal(check_unchanged(&view, &submitted).map(|()| vec![]));
        assert!(message.contains("has changed"), "{message}");
        std::fs::remove_file(&path).unwrap();
        refusal(check_unchanged(&view, &submitted).map(|()| vec![]));
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
