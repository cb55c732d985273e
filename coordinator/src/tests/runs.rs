#![allow(clippy::unwrap_used, reason = "tests")]
//! Runs of one job, one after the other, at the hub itself.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{Blob, FailureKind};

use super::harness::{BackgroundEngine, within};
use crate::{
    ServeOptions,
    blobs::BlobStore,
    compute::Compute,
    failure::{StageError, failure},
    hub::Hub,
    queue::{JobId, job::JobState},
    store::{NewJob, Store},
};

async fn hub(folder: &tempfile::TempDir) -> Arc<Hub> {
    let store = Store::open(&folder.path().join("state.sqlite")).await.unwrap();
    let blobs = BlobStore::open(folder.path()).unwrap();
    let job = NewJob {
        id: "a".into(),
        clip: "/clip".into(),
        clip_digest: "c".into(),
        output: "/out".into(),
        output_request: "/out".into(),
        settings: "{}".into(),
        settings_digest: "s".into(),
        request: "{}".into(),
        frame_numbers: "[1]".into(),
    };
    let mut change = store.change().await.unwrap();
    change.insert_job(&job).await.unwrap();
    change.commit().await.unwrap();
    let (compute, engine) = (Compute::new(1).unwrap(), Arc::new(BackgroundEngine));
    let options = ServeOptions { root: folder.path().to_owned(), ..ServeOptions::default() };
    Arc::new(Hub::new(options, store, blobs, Blob::default(), compute, engine, CancellationToken::new()))
}

async fn state(hub: &Hub, job: &JobId) -> JobState {
    hub.store.job(job).await.unwrap().unwrap().state().unwrap()
}

#[tokio::test]
async fn a_run_that_was_stopped_neither_advances_nor_fails_the_run_after_it() {
    let folder = tempfile::tempdir().unwrap();
    let hub = hub(&folder).await;
    let job: JobId = "a".into();
    let (old, new) = (CancellationToken::new(), CancellationToken::new());
    old.cancel();
    let late = hub.advance(&job, &old, JobState::Ingesting).await;
    assert!(matches!(late, Err(StageError::Stopped)), "{late:?}");
    hub.fail_run(&job, &old, failure(FailureKind::Bug, "late")).await.unwrap();
    assert_eq!(state(&hub, &job).await, JobState::Ingesting);

    let other_stage = hub.advance(&job, &new, JobState::Tracking).await;
    assert!(matches!(other_stage, Err(StageError::Stopped)), "{other_stage:?}");
    assert_eq!(hub.advance(&job, &new, JobState::Ingesting).await.unwrap(), JobState::StaticModel);
    hub.fail_run(&job, &new, failure(FailureKind::Bug, "now")).await.unwrap();
    assert_eq!(state(&hub, &job).await, JobState::Failed);
}

#[tokio::test]
async fn a_driver_that_panics_fails_its_job_and_says_what_happened() {
    let folder = tempfile::tempdir().unwrap();
    let hub = hub(&folder).await;
    let job: JobId = "a".into();
    hub.spawn_driver(job.clone(), CancellationToken::new(), async { panic!("index 7") });
    within(hub.drivers_ended()).await;
    assert_eq!(state(&hub, &job).await, JobState::Failed);
    let failure = hub.store.job(&job).await.unwrap().unwrap().failure().unwrap();
    assert_eq!(failure.kind(), FailureKind::Bug);
    assert!(failure.message.contains("index 7"), "{}", failure.message);
}

#[tokio::test]
async fn frames_are_cancelled_as_the_change_that_ends_their_job_sees_them() {
    let folder = tempfile::tempdir().unwrap();
    let hub = hub(&folder).await;
    let job: JobId = "a".into();
    let request = trackersplat_proto::v1::FrameJob { job_id: "a".into(), frame: 1, ..Default::default() };
    let mut change = hub.store.change().await.unwrap();
    change.publish_frame(&request, "key").await.unwrap();
    // Read inside the change: what it has written is seen before it is committed.
    assert_eq!(change.frames(&job).await.unwrap().len(), 1);
    assert!(hub.store.frames(&job).await.unwrap().is_empty());
    change.commit().await.unwrap();
    assert_eq!(within(hub.cancel_job(&job)).await.unwrap(), JobState::Cancelled);
    let frames = hub.store.frames(&job).await.unwrap();
    assert_eq!(frames[0].state().unwrap(), crate::queue::task::TaskState::Cancelled);
}
