//! Tracks that no connected worker may make: the coordinator makes them itself, under leases of its own.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering::Relaxed},
};

use bytes::Bytes;
use futures::future::try_join_all;
use splat::{
    formats::track_blob,
    image::Image,
    settings::Settings,
    tracking::{TrackField, Tracker},
};
use tokio::{
    runtime::Handle,
    sync::{Notify, OnceCell},
};
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{self, TrackJob, TrackedField};

use super::Job;
use crate::{compute::go_on, failure::StageError, hub::Hub, queue::Lease};

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

    /// Tracks as many views at a time as the compute pool has threads. Views that are begun are finished, though workers
    /// may come meanwhile: those take the others.
    async fn track_while_alone(&self) -> Result<(), StageError> {
        // One for all views: a network may be large.
        let tracker = OnceCell::new();
        let lanes = Lanes::default();
        // Polled together: a lane that rests while it holds the desk would keep the others from it for ever.
        let all = (0..self.hub.options.compute_threads.max(1)).map(|_| self.track_in_turn(&tracker, &lanes));
        try_join_all(all).await?;
        Ok(())
    }

    /// Tracks one view after the other. A lane without a view waits while another has one: a worker that goes leaves
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
            Ok(()) => Ok(()),
            Err(StageError::Failed(reason)) => Err(reason),
            Err(error) => return Err(error),
        };
        self.hub.own_ended(&lease, ended).await
    }

    async fn tracker(&self, wanted: v1::Tracker) -> Result<Arc<Tracker>, StageError> {
        let bytes = match &wanted.model {
            Some(blob) => Some(self.hub.blobs.get(blob).await?.to_vec()),
            None => None,
        };
        let settings = self.settings.clone();
        let load = move || -> Result<_, StageError> {
            let model = bytes.map(|bytes| (bytes, wanted.model_name.as_str()));
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

/// The tracks of one view. Runs on threads of the compute pool, where waiting is allowed.
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
    fn run(&self) -> Result<(), StageError> {
        let frames = &self.request.frames;
        let mut load = |index: usize| self.load(index);
        let mut emit = |index: usize, field: TrackField| self.emit(index, &field);
        let is_missing = |index: usize| frames[index].tracks.is_none();
        self.tracker.track_missing(frames.len(), &is_missing, &mut load, &self.settings.tracking, &mut emit)
    }

    fn load(&self, index: usize) -> Result<Arc<Image>, StageError> {
        let frame = &self.request.frames[index];
        let bytes = self.runtime.block_on(self.hub.blobs.get(&frame.image.clone().unwrap_or_default()))?;
        let image = Image::decode(&bytes).map_err(|error| {
            let view = &self.request.view;
            StageError::bad_input(format!("image of view '{view}' at frame {}: {error}", frame.frame))
        })?;
        Ok(Arc::new(image))
    }

    /// Stores and reports a field, unless it is there already.
    fn emit(&self, index: usize, field: &TrackField) -> Result<(), StageError> {
        go_on(&self.stop)?;
        let frame = &self.request.frames[index];
        if frame.tracks.is_some() {
            return Ok(());
        }
        let encoded = Bytes::from(track_blob::encode(field));
        self.runtime.block_on(async {
            let tracks = Some(self.hub.blobs.put(encoded).await?);
            self.hub.own_field(&self.lease, TrackedField { frame: frame.frame, tracks }).await
        })
    }
}
