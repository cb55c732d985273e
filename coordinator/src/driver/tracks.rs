//! Track fields from the key frame to every frame, per training view. Once per clip.
//!
//! Own tracks are tasks like frames: workers take them view by view, and the coordinator where no worker may. They need
//! the images only, so workers begin with them while the static model is made. After that a frame is published as soon as
//! every view is tracked to it, so that it is refined while later ones are tracked.

use std::{collections::BTreeMap, future::pending, pin::pin, sync::Arc};

use prost::Message;
use splat::{formats::track_state, settings::MotionSource, tracking::TrackingSettings};
use tokio::sync::watch;
use trackersplat_proto::v1::{Blob, FailureKind, Tracker};

use super::{Job, frames::FrameWork};
use crate::{
    failure::StageError,
    hub::Hub,
    keys::{TrackKey, VERSION, digest_of},
    ledger::{Field, State, TrackLedger, TrackedView},
    model,
    queue::JobId,
    request::{InputFile, TrackSource},
    store::ViewRecord,
};

/// The window that keys of fields name: however views are cut, their fields are the same. A constant, so that the keys stay
/// whatever the default becomes.
const KEYED_WINDOW: u32 = 16;

impl Job {
    /// Makes the static model while workers track.
    pub(super) async fn make_static_model_beside_tracks(&mut self) -> Result<(), StageError> {
        if !self.is_tracked() || self.frames.len() < 2 || self.imports_tracks() {
            return self.make_static_model().await;
        }
        self.offer_tracks().await?;
        let failed = tracks_failed(self.hub.clone(), self.id.clone(), self.changed.clone());
        let of_model = self.stop.child_token();
        let of_job = std::mem::replace(&mut self.stop, of_model.clone());
        let ended = {
            let mut making = pin!(self.make_static_model());
            tokio::select! {
                made = &mut making => made,
                reason = failed => {
                    of_model.cancel();
                    // It works on threads of its own, which end at its next step. That it was stopped is no reason.
                    let _ = making.await;
                    Err(reason)
                }
            }
        };
        self.stop = of_job;
        ended
    }

    pub(super) async fn track(&mut self) -> Result<(), StageError> {
        match self.is_tracked() && self.frames.len() >= 2 {
            false => Ok(()),
            true if self.imports_tracks() => self.import_tracks().await,
            true => self.compute_tracks().await,
        }
    }

    fn imports_tracks(&self) -> bool {
        matches!(self.request.tracks, TrackSource::Exact(_) | TrackSource::Files(_))
    }

    /// Whether the frames of this job start from tracks.
    pub(super) fn is_tracked(&self) -> bool {
        self.settings.motion_source == MotionSource::Tracks
    }

    async fn compute_tracks(&mut self) -> Result<(), StageError> {
        let work = self.frame_work().await?;
        self.offer_tracks().await?;
        tokio::try_join!(self.publish_tracked(&work), self.track_alone())?;
        self.published = self.frames.len();
        Ok(())
    }

    /// Views that lack fields become ready for workers, once in a run.
    async fn offer_tracks(&self) -> Result<(), StageError> {
        if self.hub.has_tracks(&self.id).await {
            // Who watches this stage is told how far it is, though nothing may change for long.
            let (done, total) = self.hub.tracks(&self.id, TrackLedger::counts).await?;
            if done < total {
                self.hub.progress(&self.id, "tracking", done, total);
            }
            return Ok(());
        }
        let ledger = self.ledger().await?;
        self.hub.begin_tracks(&self.id, &self.stop, ledger).await
    }

    /// Publishes every frame, in order, once all views are tracked to it.
    async fn publish_tracked(&self, work: &FrameWork) -> Result<(), StageError> {
        let mut changed = self.changed.clone();
        for &frame in &self.frames {
            let tracks = loop {
                changed.borrow_and_update();
                if let Some(tracks) = self.hub.tracks(&self.id, |ledger| ledger.at(frame)).await? {
                    break tracks;
                }
                let woken = self.stop.run_until_cancelled(changed.changed()).await;
                woken.and_then(Result::ok).ok_or(StageError::Stopped)?;
            };
            self.publish_frame(work, frame, &tracks).await?;
        }
        Ok(())
    }

    /// What is to be tracked, and what is in the store already.
    pub(super) async fn ledger(&self) -> Result<TrackLedger, StageError> {
        let uncut = TrackingSettings { window: KEYED_WINDOW, ..self.settings.tracking.clone() };
        let settings_json = serde_json::to_string(&uncut).map_err(|error| {
            StageError::new(FailureKind::Bug, format!("the tracker's settings as JSON: {error}"))
        })?;
        let tracker = match &self.request.tracks {
            TrackSource::Learned(file) => {
                let model = Some(self.model_blob(file).await?);
                Tracker { settings_json, model, model_name: file.name().to_owned() }
            }
            TrackSource::Own | TrackSource::Exact(_) | TrackSource::Files(_) => {
                Tracker { settings_json, ..Tracker::default() }
            }
        };
        let mut tracked = BTreeMap::new();
        let views = self.views().await?;
        for (position, view) in (0..).zip(&views).filter(|(_, view)| !view.held_out) {
            tracked.insert(position, self.tracked_view(position, view, &tracker).await?);
        }
        let reach = self.settings.tracking.reach() as usize;
        Ok(TrackLedger::new(self.id.clone(), self.key_frame(), tracker, reach, tracked))
    }

    /// The network in the store, where workers find it.
    async fn model_blob(&self, file: &InputFile) -> Result<Blob, StageError> {
        if let Some(held) = self.held_artifact(&model::key(file)).await? {
            return Ok(held.blob);
        }
        // It was put there at submission: somebody has removed it.
        let submitted = file.clone();
        let read = move || model::read_again(&submitted).map_err(StageError::bad_input);
        let bytes = self.hub.compute.run(read).await?;
        model::keep(&self.hub, file, bytes).await
    }

    async fn tracked_view(
        &self,
        position: u32,
        view: &ViewRecord,
        tracker: &Tracker,
    ) -> Result<TrackedView, StageError> {
        let images = self.hub.store.images_of_view(&self.id, position).await?;
        let mut images = images.into_iter();
        let (_, key_image) = images.next().ok_or_else(|| {
            let message = format!("the stored images of view '{}' are gone; submit the job again", view.name);
            StageError::new(FailureKind::Transient, message)
        })?;
        let size = (view.camera.width, view.camera.height);
        let state_size = match tracker.model {
            // At which resolution a network sees the images only it knows.
            Some(_) => size,
            None => self.settings.tracking.matched_size(size.0, size.1),
        };
        let window = self.window(size);
        let (mut fields, mut states) = (Vec::new(), Vec::new());
        let last = images.len();
        // A network is known by its bytes, whatever its file is called.
        let nameless = Tracker { model_name: String::new(), ..tracker.clone() };
        let tracker = blake3::hash(&nameless.encode_to_vec()).to_hex().to_string();
        let mut own_key = digest_of(&("tracks", VERSION, tracker, &key_image.digest));
        for (index, (frame, image)) in (1..).zip(images) {
            let key = match self.request.tracks {
                TrackSource::Own | TrackSource::Learned(_) => {
                    // Of the tracker and every image up to here: tracks are chained through them.
                    own_key = digest_of(&("tracks", VERSION, &own_key, &image.digest));
                    own_key.clone()
                }
                TrackSource::Exact(_) | TrackSource::Files(_) => {
                    self.imported_key(position as usize, &view.name, index)?
                }
            };
            let tracks: Option<Blob> = self.held_artifact(&key).await?.map(|artifact| artifact.blob);
            fields.push(Field { frame, image, key, tracks });
            if index % window == 0 && index < last {
                // Of the job and the view alone: each discards its own.
                let format = track_state::VERSION;
                let key = digest_of(&("track state", VERSION, format, &*self.id, position, &own_key));
                let blob = self.held_artifact(&key).await?.map(|artifact| artifact.blob);
                states.push(State { key, blob });
            }
        }
        Ok(TrackedView { name: view.name.clone(), size, state_size, key_image, fields, window, states })
    }

    /// Frames per lease of views of a size. Views whose states would be too large for a blob are not cut.
    fn window(&self, (width, height): (u32, u32)) -> usize {
        let tracking = &self.settings.tracking;
        let state = track_state::uncompressed_bytes(width, height, tracking.reach());
        if state > track_state::MAX_BYTES { usize::MAX } else { tracking.window.max(1) as usize }
    }

    /// Key of the imported tracks of one view to the frame of an index.
    fn imported_key(&self, position: usize, view: &str, index: usize) -> Result<String, StageError> {
        let source = self.track_file(position, view)?.digest.as_str();
        let clip = &self.record.clip_digest;
        let frames = &self.frames[..=index];
        Ok(digest_of(&TrackKey { kind: "imported tracks", version: VERSION, source, clip, frames, view }))
    }
}

/// Why a view cannot be tracked, once one cannot. A run that is stopped meanwhile ends by itself.
async fn tracks_failed(hub: Arc<Hub>, id: JobId, mut changed: watch::Receiver<()>) -> StageError {
    loop {
        changed.borrow_and_update();
        if let Err(error @ StageError::Failed(_)) = hub.tracks(&id, |_| ()).await {
            return error;
        }
        if changed.changed().await.is_err() {
            return pending().await;
        }
    }
}
