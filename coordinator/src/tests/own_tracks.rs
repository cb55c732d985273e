#![allow(clippy::unwrap_used, reason = "tests")]
//! Tracks that the coordinator makes itself.

use std::{
    sync::mpsc,
    time::{Duration, Instant},
};

use trackersplat_proto::v1::{
    CancelRequest, FailureKind, JobState, SubmitRequest, TaskState, job_event::Event,
};

use super::{
    harness::*,
    tracks::{track_honestly, tracked_request},
};
use crate::{
    queue::{Lease, OWN_NAME, Queue, QueuePolicy, Task, TaskKey},
    store::ImageRecord,
};

/// Keeps the only compute thread busy until the sender is dropped or used.
async fn occupy(bench: &Bench) -> mpsc::Sender<()> {
    let compute = bench.hub().compute.clone();
    let (release, released) = mpsc::channel();
    let (begun, begins) = tokio::sync::oneshot::channel();
    let wait = move || {
        let _ = begun.send(());
        // Released, or the test is over.
        let _ = released.recv();
        Ok(())
    };
    tokio::spawn(async move { compute.run(wait).await });
    within(begins).await.unwrap();
    release
}

/// A job in which the coordinator holds the lease of cam00 and waits for its thread.
async fn tracking_alone(bench: &Bench) -> (String, Watch, mpsc::Sender<()>) {
    tracking_alone_on(bench, tracked_request(bench)).await
}

/// [`tracking_alone`] on any submission.
pub(super) async fn tracking_alone_on(
    bench: &Bench,
    request: SubmitRequest,
) -> (String, Watch, mpsc::Sender<()>) {
    // It is there while the job begins, so that the coordinator leaves the views to it.
    let idle = bench.worker("idle").await;
    let job = bench.submit(request).await.unwrap().job_id;
    let mut watch = bench.watch(&job, 0).await;
    // The key frame is given out once the static model is there and the views are ready.
    watch.until(|event| matches!(event, Event::FrameState(f) if f.frame == 1)).await;
    let busy = occupy(bench).await;
    drop(idle);
    let leased = |event: &Event| matches!(event, Event::TracksState(t) if t.state() == TaskState::Leased);
    let event = watch.until(leased).await;
    let Some(Event::TracksState(leased)) = event.event else { panic!("{event:?}") };
    assert_eq!((leased.view.as_str(), leased.worker_id.as_str(), leased.attempt), ("cam00", OWN_NAME, 1));
    (job, watch, busy)
}

async fn cancel(bench: &Bench, job: &str) {
    within(bench.jobs().cancel(CancelRequest { job_id: job.into() })).await.unwrap();
    assert_eq!(bench.ended(job).await.0, JobState::Cancelled);
}

#[tokio::test]
async fn a_job_that_is_cancelled_meanwhile_tracks_on_when_it_is_submitted_again() {
    let bench = Bench::start().await;
    let (job, _, busy) = tracking_alone(&bench).await;
    cancel(&bench, &job).await;
    drop(busy);
    assert!(bench.submit(tracked_request(&bench)).await.unwrap().resumed);
    let tracked = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
    bench.watch(&job, 0).await.until(tracked).await;
    let mut worker = bench.worker("w").await;
    for frame in 1..=3 {
        assert_eq!(worker.work_once(&bench).await, frame);
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn workers_that_come_meanwhile_take_the_other_views() {
    let bench = Bench::start().await;
    let (job, mut watch, busy) = tracking_alone(&bench).await;
    let mut worker = bench.worker("w").await;
    for view in ["cam01", "cam02"] {
        let lease = worker.lease().await;
        assert_eq!(track_job(&lease).view, view);
        track_honestly(&bench, &mut worker, &lease).await;
    }
    assert_eq!(worker.work_once(&bench).await, 1, "cam00 is not done twice");
    drop(busy);
    let done = |event: &Event| matches!(event, Event::TracksState(t) if t.view == "cam00" && t.state() == TaskState::Done);
    let event = watch.until(done).await;
    let Some(Event::TracksState(done)) = event.event else { panic!("{event:?}") };
    assert_eq!(done.worker_id, OWN_NAME);
    for frame in 2..=3 {
        assert_eq!(worker.work_once(&bench).await, frame);
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn an_image_that_cannot_be_read_fails_the_job_and_names_view_and_frame() {
    let bench = Bench::start().await;
    let (job, _, busy) = tracking_alone(&bench).await;
    cancel(&bench, &job).await;
    let image = bench.put(b"no image".to_vec()).await;
    let mut change = bench.hub().store.change().await.unwrap();
    change.set_images(&job, 2, &[ImageRecord { position: 0, image, mask: None }]).await.unwrap();
    change.commit().await.unwrap();
    drop(busy);
    assert!(bench.submit(tracked_request(&bench)).await.unwrap().resumed);
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("view 'cam00' at frame 2"), "{}", failure.message);
}

#[tokio::test]
async fn a_store_that_fails_for_a_moment_fails_no_attempt() {
    let bench = Bench::start().await;
    let (_, mut watch, busy) = tracking_alone(&bench).await;
    let (inside, aside) = (bench.options.root.join("blobs"), bench.folder.path().join("aside"));
    std::fs::rename(&inside, &aside).unwrap();
    // A folder that is a file is no answer, as an input or output error is none.
    std::fs::write(&inside, b"").unwrap();
    drop(busy);
    // Three attempts that fail at once are over by then, and the coordinator's patience is not.
    tokio::time::sleep(Duration::from_millis(500)).await;
    std::fs::remove_file(&inside).unwrap();
    std::fs::rename(&aside, &inside).unwrap();
    let tracked = |event: &Event| {
        if let Event::TracksState(t) = event {
            assert!(t.attempt <= 1 && t.failure.is_none(), "{t:?}");
        }
        matches!(event, Event::JobState(j) if j.state() == JobState::Frames)
    };
    watch.until(tracked).await;
}

#[tokio::test]
async fn frames_that_were_tracked_before_a_restart_are_given_out_after_it() {
    let mut bench = Bench::start().await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let tracked = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
    bench.watch(&job, 0).await.until(tracked).await;
    bench.stop().await;
    bench.restart().await;
    let mut worker = bench.worker("w").await;
    assert_eq!(worker.work_once(&bench).await, 1);
    for frame in 2..=3 {
        let lease = worker.lease().await;
        let request = frame_job(&lease);
        assert_eq!(request.frame, frame);
        assert!(request.training_views.iter().all(|view| view.tracks.is_some()));
        let success = bench.result(&lease).await;
        let outcome = trackersplat_proto::v1::report::Outcome::Success(success);
        assert!(worker.report(&lease, outcome).await.accepted);
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

/// The coordinator's own lease of the job's first view, as its queue gives it.
fn own_lease(job: &str, attempt: u32) -> Lease {
    let now = Instant::now();
    let lease_duration = Duration::from_secs(1);
    let policy = QueuePolicy { max_attempts: 3, lease_duration, reconnect_grace: Duration::ZERO };
    let mut queue = Queue::new(policy, now);
    let history = crate::queue::TaskHistory { attempts: attempt - 1, ..Default::default() };
    queue.add(TaskKey { job: job.into(), task: Task::Tracks(0) }, history);
    queue.lease_own(job, now, format!("own-{attempt}")).unwrap()
}

/// A coordinator that never tracks by itself within a test, with a job whose views are ready.
async fn waiting_job() -> (Bench, String) {
    let bench = Bench::start_with(|options| options.reconnect_grace = options.lease_duration).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let ready = |event: &Event| matches!(event, Event::TracksState(t) if t.view == "cam02");
    bench.watch(&job, 0).await.until(ready).await;
    (bench, job)
}

#[tokio::test]
async fn a_view_that_kills_the_coordinator_again_and_again_fails_the_job() {
    let (mut bench, job) = waiting_job().await;
    for attempt in 1..=3 {
        bench.stop().await;
        // As a killed coordinator leaves it.
        let store = crate::store::Store::open(&bench.options.root.join("state.sqlite")).await.unwrap();
        let mut change = store.change().await.unwrap();
        change.grant(&own_lease(&job, attempt)).await.unwrap();
        change.commit().await.unwrap();
        store.close().await;
        bench.restart().await;
        let key = own_lease(&job, attempt).key;
        assert_eq!(bench.hub().store.task(&key).await.unwrap().unwrap().failures, attempt);
    }
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::LostWorker));
    assert!(failure.message.contains("'cam00': the coordinator died"), "{}", failure.message);
}

#[tokio::test]
async fn an_orderly_end_of_the_coordinator_counts_as_no_failure() {
    let (mut bench, job) = waiting_job().await;
    let lease = own_lease(&job, 1);
    let mut change = bench.hub().store.change().await.unwrap();
    change.grant(&lease).await.unwrap();
    change.commit().await.unwrap();
    bench.stop().await;
    bench.restart().await;
    let record = bench.hub().store.task(&lease.key).await.unwrap().unwrap();
    assert_eq!((record.failures, record.attempts, record.state().unwrap().label()), (0, 1, "ready"));
}

#[tokio::test]
async fn views_that_end_while_others_begin_do_not_wait_for_each_other_for_ever() {
    let bench = Bench::start_with(|options| options.compute_threads = 3).await;
    for shade in 0..8 {
        write_clip(&bench.folder.path().join("clip"), shade);
        let mut request = tracked_request(&bench);
        request.output = bench.folder.path().join(format!("out{shade}")).display().to_string();
        let job = bench.submit(request).await.unwrap().job_id;
        let (hub, stirred) = (bench.hub(), job.as_str().into());
        let stirring = tokio::spawn(async move {
            loop {
                hub.stir(&stirred).await;
                tokio::task::yield_now().await;
            }
        });
        let is_over = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
        bench.watch(&job, 0).await.until(is_over).await;
        stirring.abort();
    }
}
