//! The inputs of the frame that will likely come next, fetched and decoded while the present one is computed.

use std::sync::{Arc, Mutex, PoisonError};

use splat::frame::FrameInput;
use tokio_util::task::AbortOnDropHandle;
use trackersplat_proto::v1::{FrameJob, FrameView};

use crate::{
    blobs::Blobs,
    inputs::{self, InputCache},
    job::JobError,
};

/// Decoded inputs that may wait, beside those that are worked on; larger frames are loaded when their turn comes.
const MAX_BYTES: u64 = 2 << 30;
/// Of a decoded view, per pixel: colour 12, track 13, mask 1.
const BYTES_PER_PIXEL: u64 = 26;

/// At most one frame's inputs.
#[derive(Default)]
pub(crate) struct Ahead {
    slot: Mutex<Option<Loading>>,
}

struct Loading {
    job: FrameJob,
    task: AbortOnDropHandle<Result<FrameInput, JobError>>,
}

impl Ahead {
    /// Begins to load a frame's inputs.
    pub(crate) fn begin(&self, job: FrameJob, blobs: Blobs, cache: Arc<InputCache>) {
        if decoded_bytes(&job) > MAX_BYTES {
            return;
        }
        let work = {
            let job = job.clone();
            async move { inputs::load(&job, &blobs, &cache).await }
        };
        let task = AbortOnDropHandle::new(tokio::spawn(work));
        *self.slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(Loading { job, task });
    }

    /// Gives the memory back: the guess was wrong, or nobody knows when it will be right.
    pub(crate) fn forget(&self) {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    /// The inputs of `job` if they were begun and can be had; nobody hears of a failure, as they will be loaded again.
    pub(crate) async fn take(&self, job: &FrameJob) -> Option<FrameInput> {
        let loading = self.slot.lock().unwrap_or_else(PoisonError::into_inner).take()?;
        if loading.job != *job {
            return None;
        }
        loading.task.await.ok()?.ok()
    }
}

fn decoded_bytes(job: &FrameJob) -> u64 {
    let pixels = |view: &FrameView| {
        view.camera.as_ref().map_or(0, |camera| u64::from(camera.width) * u64::from(camera.height))
    };
    let views = job.training_views.iter().chain(&job.test_views).map(pixels).fold(0, u64::saturating_add);
    // Usually shared with the frame at hand; a large one may not stay in the cache.
    let static_model = job.static_model.as_ref().map_or(0, |blob| blob.size);
    views.saturating_mul(BYTES_PER_PIXEL).saturating_add(static_model)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use trackersplat_proto::v1::Welcome;

    use super::*;
    use crate::test_coordinator::{TestCoordinator, wire_camera};

    async fn bench() -> (TestCoordinator, Blobs, Arc<InputCache>) {
        let coordinator = TestCoordinator::start().await;
        let blobs = Blobs::open(&Welcome::default(), coordinator.channel()).await;
        (coordinator, blobs, Arc::default())
    }

    #[tokio::test]
    async fn what_was_begun_is_had_once_and_only_for_its_job() {
        let (coordinator, blobs, cache) = bench().await;
        let ahead = Ahead::default();
        let job = coordinator.frame_job(2);
        assert!(ahead.take(&job).await.is_none(), "nothing was begun");
        ahead.begin(job.clone(), blobs.clone(), cache.clone());
        let input = ahead.take(&job).await.unwrap();
        assert_eq!((input.training_views.len(), input.is_key_frame), (2, false));
        assert!(ahead.take(&job).await.is_none(), "it was taken");

        ahead.begin(job, blobs, cache);
        assert!(ahead.take(&coordinator.frame_job(3)).await.is_none(), "the guess was wrong");
        assert!(ahead.slot.lock().unwrap().is_none());
    }

    #[tokio::test]
    async fn a_failure_ahead_is_nobodys_business() {
        let (coordinator, blobs, cache) = bench().await;
        let mut job = coordinator.frame_job(2);
        job.training_views[0].image = Some(coordinator.store(b"\x89PNG cut short"));
        let ahead = Ahead::default();
        ahead.begin(job.clone(), blobs, cache);
        assert!(ahead.take(&job).await.is_none());
    }

    #[tokio::test]
    async fn a_frame_beyond_the_bound_waits_for_its_turn() {
        let (coordinator, blobs, cache) = bench().await;
        let mut job = coordinator.frame_job(2);
        for view in &mut job.training_views {
            view.camera = Some(wire_camera(u32::MAX, u32::MAX));
        }
        let ahead = Ahead::default();
        ahead.begin(job, blobs, cache);
        assert!(ahead.slot.lock().unwrap().is_none());
    }
}
