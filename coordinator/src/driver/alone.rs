//! Tracks that no connected worker may make: the coordinator makes them itself, under leases of its own.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering::Relaxed},
};

use bytes::Bytes;
use futures::future::try_join_all;
use splat::{
    formats::{track_blob, track_state},
    image::Image,
    settings::Settings,
    tracking::{TrackField, TrackState, Tracker},
};
use tokio::{
    runtime::Handle,
    sync::{Notify, OnceCell},
};
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{self, Blob, FailureKind, TrackFrame, TrackJob, TrackedField};

use super::{Job, patience::patiently};
use crate::{blobs::BlobError, compute::go_on, failure::StageError, hub::Hub, queue::Lease};

impl Job {
    /// Tracks views whenever no connected worker may, until nobody has a view to track any more.
    pub(super) async fn track_alone(&self) -> Result<(), StageError> {
        let mut changed = self.changed.clone();
        loop {
            changed.borrow_and_update();
            if self.hub.open_tracks(&self.id).await? == 0 {
                return Ok(());
            }
            if self.hub.has_own_work(&self.id).await {
                let _turn = self.turn().await?;
                self.track_while_alone().await?;
                continue;
            }
            let woken = self.stop.run_until_cancelled(changed.changed()).await;
            woken.and_then(Result::ok).ok_or(StageError::Stopped)?;
        }
    }

    /// Tracks as many views at a time as the compute pool has threads, window by window. Windows that are begun are finished,
    /// though workers may come meanwhile: those take the others.
    async fn track_while_alone(&self) -> Result<(), StageError> {
        // One for all views: a network may be large.
        let tracker = OnceCell::new();
        let lanes = Lanes::default();
        // Polled together: a lane that rests while it holds the desk would keep the others from it for ever.
        let all = (0..self.hub.options.compute_threads.max(1)).map(|_| self.track_in_turn(&tracker, &lanes));
        try_join_all(all).await?;
        Ok(())
    }

    /// Tracks one window after the other. A lane without a view waits while another has one: a worker that goes leaves
    /// views behind.
    async fn track_in_turn(&self, tracker: &OnceCell<Arc<Tracker>>, lanes: &Lanes) -> Result<(), StageError> {
        let mut changed = self.changed.clone();
        loop {
            changed.borrow_and_update();
            if let Some((lease, request)) = self.hub.lease_own(&self.id, &self.stop).await? {
                lanes.busy.fetch_add(1, Relaxed);
                self.track_view(lease, request, tracker).await?;
                lanes.busy.fetch_sub(1, Relaxed);
                lanes.ended.notify_waiters();
                continue;
            }
            if lanes.busy.load(Relaxed) == 0 {
                return Ok(());
            }
            tokio::select! {
                () = lanes.ended.notified() => {}
                woken = changed.changed() => woken.map_err(|_| StageError::Stopped)?,
            }
        }
    }

    async fn track_view(
        &self,
        lease: Lease,
        request: TrackJob,
        tracker: &OnceCell<Arc<Tracker>>,
    ) -> Result<(), StageError> {
        let tracked = async {
            let wanted = request.tracker.clone().unwrap_or_default();
            let work = OwnTracking {
                hub: self.hub.clone(),
                lease: lease.clone(),
                request,
                tracker: tracker.get_or_try_init(|| self.tracker(wanted)).await?.clone(),
                settings: self.settings.clone(),
                stop: self.stop.clone(),
                runtime: Handle::current(),
            };
            self.hub.compute.run(move || work.run()).await
        };
        let ended = match tracked.await {
            Ok(state) => Ok(state),
            Err(StageError::Failed(reason)) => Err(reason),
            Err(error) => return Err(error),
        };
        self.hub.own_ended(&lease, ended).await
    }

    async fn tracker(&self, wanted: v1::Tracker) -> Result<Arc<Tracker>, StageError> {
        let (hub, stop, settings) = (self.hub.clone(), self.stop.clone(), self.settings.clone());
        let runtime = Handle::current();
        let load = move || -> Result<_, StageError> {
            let model = match &wanted.model {
                Some(blob) => {
                    let got = runtime.block_on(patiently(&stop, |_| true, || hub.blobs.get(blob)))?;
                    Some((got.to_vec(), wanted.model_name.as_str()))
                }
                None => None,
            };
            Ok(Arc::new(Tracker::new(model, &settings.tracking)?))
        };
        self.hub.compute.run(load).await
    }
}

/// What the lanes know of each other. They are polled by one task, so nothing happens between a look and a wait.
#[derive(Default)]
struct Lanes {
    busy: AtomicUsize,
    ended: Notify,
}

/// A window of the tracks of one view. Runs on threads of the compute pool, where waiting is allowed.
struct OwnTracking {
    hub: Arc<Hub>,
    lease: Lease,
    request: TrackJob,
    tracker: Arc<Tracker>,
    settings: Arc<Settings>,
    stop: CancellationToken,
    runtime: Handle,
}

impl OwnTracking {
    /// The state after the window, if it is wanted.
    fn run(&self) -> Result<Option<Blob>, StageError> {
        let (request, settings) = (&self.request, &self.settings.tracking);
        if request.window().is_empty() {
            return Ok(None);
        }
        let is_missing = |place: usize| request.frame_at(place).is_some_and(|frame| frame.tracks.is_none());
        let mut load = |place: usize| self.load(place);
        let mut emit = |place: usize, field: TrackField| self.emit(place, &field);
        let (from, window) = (self.state()?, request.window());
        let after = self.tracker.track_window(from, window, &is_missing, &mut load, settings, &mut emit)?;
        if !request.wants_state {
            return Ok(None);
        }
        let encoded = Bytes::from(track_state::encode(&after));
        Ok(Some(self.transfer(|| self.hub.blobs.put(encoded.clone()))?))
    }

    /// Waits for a transfer with the store, which may fail for a while.
    fn transfer<T, F: Future<Output = Result<T, BlobError>>>(
        &self,
        transfer: impl FnMut() -> F,
    ) -> Result<T, StageError> {
        self.runtime.block_on(patiently(&self.stop, |_| true, transfer))
    }

    /// What tracking goes on from.
    fn state(&self) -> Result<TrackState, StageError> {
        let Some(blob) = &self.request.state else { return Ok(TrackState::default()) };
        // What is gone from the store does not come back: the window before is leased.
        let may_pass =
            |error: &BlobError| !matches!(error, BlobError::Missing(_) | BlobError::Corrupt { .. });
        let got = patiently(&self.stop, may_pass, || self.hub.blobs.get(blob));
        let bytes = self.runtime.block_on(got)?;
        track_state::decode(&bytes).map_err(|error| {
            let message = format!("the tracker's state of view '{}': {error}", self.request.view);
            StageError::new(FailureKind::Bug, message)
        })
    }

    fn frame(&self, place: usize) -> Result<&TrackFrame, StageError> {
        self.request.frame_at(place).ok_or_else(|| {
            let message = format!("view '{}': the lease lacks the frame at place {place}", self.request.view);
            StageError::new(FailureKind::Bug, message)
        })
    }

    fn load(&self, place: usize) -> Result<Arc<Image>, StageError> {
        let frame = self.frame(place)?;
        let blob = frame.image.clone().unwrap_or_default();
        let bytes = self.transfer(|| self.hub.blobs.get(&blob))?;
        let image = Image::decode(&bytes).map_err(|error| {
            let view = &self.request.view;
            StageError::bad_input(format!("image of view '{view}' at frame {}: {error}", frame.frame))
        })?;
        Ok(Arc::new(image))
    }

    /// Stores and reports a field, unless it is there already.
    fn emit(&self, place: usize, field: &TrackField) -> Result<(), StageError> {
        go_on(&self.stop)?;
        let frame = self.frame(place)?;
        if frame.tracks.is_some() {
            return Ok(());
        }
        let encoded = Bytes::from(track_blob::encode(field));
        let tracks = Some(self.transfer(|| self.hub.blobs.put(encoded.clone()))?);
        let field = TrackedField { frame: frame.frame, tracks };
        self.runtime.block_on(self.hub.own_field(&self.lease, field))
    }
}
