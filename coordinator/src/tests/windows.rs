#![allow(clippy::unwrap_used, reason = "tests")]
//! Views that are tracked window by window, by workers and by the coordinator.

use std::{ops::Range, sync::Arc};

use splat::{
    formats::{track_blob, track_state},
    image::Image,
    tracking::{TrackState, Tracker, TrackingSettings},
};
use trackersplat_proto::v1::{
    Blob, FailureKind, FieldReport, JobState, Lease, SubmitRequest, Tracked, TrackedField, job_event::Event,
    lease, report::Outcome, worker_message,
};

use super::{harness::*, tracks::shifted};
use crate::{
    failure::StageError,
    queue::{Task, TaskKey},
};

/// A clip of seven frames, in windows of two: the third window has two frames as well.
async fn bench() -> Bench {
    let bench = Bench::start().await;
    write_clip_of(7, &bench.folder.path().join("clip"), 0);
    bench
}

fn request(bench: &Bench, window: u32) -> SubmitRequest {
    SubmitRequest { settings_json: format!(r#"{{"tracking": {{"window": {window}}}}}"#), ..bench.request() }
}

/// The state of an honest tracker after the frame at a place, another one for every view.
pub(super) fn state_of(view: &str, place: usize) -> Vec<u8> {
    state_of_size((8, 6), view, 1..place + 1)
}

/// The state after tracking frames from the key frame on.
pub(super) fn state_of_size((width, height): (u32, u32), view: &str, frames: Range<usize>) -> Vec<u8> {
    let motion = 0.2 * (view.bytes().map(u32::from).sum::<u32>() % 7) as f32;
    let image = |place: usize| {
        let mut image = Image::filled(width, height, [0.0; 3]);
        for (index, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
            let (x, y) = (index % width as usize, index / width as usize);
            let x = x as f32 - motion * place as f32;
            pixel.fill(0.5 + 0.25 * (x * 0.9).sin() + 0.25 * (y as f32 * 0.7).cos());
        }
        Arc::new(image)
    };
    let mut load = |place| Ok::<_, StageError>(image(place));
    let settings = TrackingSettings::default();
    let nothing = TrackState::default();
    let tracked =
        Tracker::BuiltIn.track_window(nothing, frames, &|_| true, &mut load, &settings, &mut |_, _| Ok(()));
    track_state::encode(&tracked.ok().unwrap())
}

async fn field(bench: &Bench, frame: u32) -> TrackedField {
    let encoded = track_blob::encode(&shifted(8, frame as f32));
    TrackedField { frame, tracks: Some(bench.put(encoded).await) }
}

/// What an honest worker reports of a window.
async fn window(bench: &Bench, lease: &Lease) -> Tracked {
    let job = track_job(lease);
    let mut fields = Vec::new();
    for frame in job.frames[1..].iter().filter(|frame| frame.tracks.is_none()) {
        fields.push(field(bench, frame.frame).await);
    }
    let state = match job.wants_state {
        true => Some(bench.put(state_of(&job.view, job.window().end - 1)).await),
        false => None,
    };
    Tracked { fields, state }
}

/// Name of the view, numbers of the window's frames.
fn leased(lease: &Lease) -> (String, Vec<u32>) {
    let job = track_job(lease);
    (job.view, job.frames[1..].iter().map(|frame| frame.frame).collect())
}

impl Worker {
    /// Does a task honestly.
    async fn finish(&mut self, bench: &Bench, lease: &Lease) {
        let outcome = match &lease.task {
            Some(lease::Task::Tracks(_)) => Outcome::Tracked(window(bench, lease).await),
            _ => Outcome::Success(bench.result(lease).await),
        };
        let receipt = self.report(lease, outcome).await;
        assert!(receipt.accepted, "{receipt:?}");
    }

    /// The next window, once the frames before it are done.
    async fn window(&mut self, bench: &Bench) -> Lease {
        loop {
            let lease = self.lease().await;
            if let Some(lease::Task::Tracks(_)) = lease.task {
                return lease;
            }
            self.finish(bench, &lease).await;
        }
    }

    /// Does everything until the job ends; the windows that it was given.
    async fn finish_job(&mut self, bench: &Bench, job: &str) -> Vec<(String, Vec<u32>)> {
        let mut windows = Vec::new();
        loop {
            tokio::select! {
                (state, failure) = bench.ended(job) => {
                    assert_eq!(state, JobState::Done, "{failure:?}");
                    return windows;
                }
                lease = self.lease() => {
                    if let Some(lease::Task::Tracks(_)) = lease.task {
                        windows.push(leased(&lease));
                    }
                    self.finish(bench, &lease).await;
                }
            }
        }
    }
}

/// A worker, and a job of which it has done the first windows of all views.
async fn after_first_windows(bench: &Bench) -> (Worker, String) {
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(bench, 2)).await.unwrap().job_id;
    for view in ["cam00", "cam01", "cam02"] {
        let lease = worker.window(bench).await;
        assert_eq!(leased(&lease), (view.into(), vec![2, 3]));
        worker.finish(bench, &lease).await;
    }
    (worker, job)
}

#[tokio::test]
async fn views_take_turns_and_frames_are_done_while_later_windows_wait() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let mut watch = bench.watch(&job, 0).await;
    let mut order = Vec::new();
    for published in [3, 3, 3, 3, 5, 5, 5, 5, 5, 7, 7, 7, 7] {
        watch_frame(&mut watch, published, &order).await;
        let lease = worker.lease().await;
        order.push(match &lease.task {
            Some(lease::Task::Tracks(_)) => format!("{:?}", leased(&lease)),
            _ => frame_job(&lease).frame.to_string(),
        });
        worker.finish(&bench, &lease).await;
    }
    let expected = [
        "1",
        r#"("cam00", [4, 5])"#,
        r#"("cam01", [4, 5])"#,
        r#"("cam02", [4, 5])"#,
        "2",
        "3",
        r#"("cam00", [6, 7])"#,
        r#"("cam01", [6, 7])"#,
        r#"("cam02", [6, 7])"#,
        "4",
        "5",
        "6",
        "7",
    ];
    assert_eq!(order, expected);
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    for (view, place) in [("cam00", 2), ("cam00", 4), ("cam02", 4)] {
        let state = crate::blobs::name(&state_of(view, place));
        assert!(!bench.hub().blobs.holds(&state).await, "nobody goes on from {view} after {place}");
    }
}

fn state_file(bench: &Bench, view: &str, place: usize) -> std::path::PathBuf {
    let digest = crate::blobs::name(&state_of(view, place)).digest;
    bench.options.root.join("blobs").join(&digest[..2]).join(&digest)
}

fn remove_state(bench: &Bench, view: &str, place: usize) {
    std::fs::remove_file(state_file(bench, view, place)).unwrap();
}

/// Waits until a frame is published, unless it was waited for before.
async fn watch_frame(watch: &mut Watch, frame: u32, order: &[String]) {
    if matches!((frame, order.len()), (3, 0) | (5, 4) | (7, 9)) {
        watch.until(|event| matches!(event, Event::FrameState(f) if f.frame == frame)).await;
    }
}

#[tokio::test]
async fn a_worker_that_dies_in_a_window_costs_the_window() {
    let bench = bench().await;
    let (mut lost, job) = after_first_windows(&bench).await;
    let mut heir = bench.worker("heir").await;
    let lease = lost.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    let stored = field(&bench, 4).await;
    let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
    let report = FieldReport { lease_id, attempt, field: Some(stored.clone()) };
    lost.send(worker_message::Message::Field(report)).await;
    let counted = |event: &Event| matches!(event, Event::Progress(p) if p.stage == "tracking" && p.done == 7);
    bench.watch(&job, 0).await.until(counted).await;
    drop(lost);
    let is_lost = |event: &Event| matches!(event, Event::TracksState(t) if t.failure.is_some());
    bench.watch(&job, 0).await.until(is_lost).await;

    let again = heir.window(&bench).await;
    let request = track_job(&again);
    assert_eq!((leased(&again), again.attempt), (("cam00".into(), vec![4, 5]), 3));
    assert_eq!(request.state, Some(crate::blobs::name(&state_of("cam00", 2))));
    assert_eq!((request.first, request.past.iter().map(|frame| frame.frame).collect()), (3, vec![2, 3]));
    let exists: Vec<Option<Blob>> = request.frames.into_iter().map(|frame| frame.tracks).collect();
    assert_eq!(exists, [None, stored.tracks, None]);
    heir.finish(&bench, &again).await;
    let rest = heir.finish_job(&bench, &job).await;
    assert_eq!(rest.len(), 5, "{rest:?}");
}

/// A job whose first view has all its fields, while `w` has not reported yet.
async fn before_the_last_report(bench: &Bench) -> (Worker, String, Lease) {
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(bench, 16)).await.unwrap().job_id;
    let lease = worker.window(bench).await;
    for frame in 2..=7 {
        let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
        let report = FieldReport { lease_id, attempt, field: Some(field(bench, frame).await) };
        worker.send(worker_message::Message::Field(report)).await;
    }
    loop {
        let counts = bench.hub().tracks(&job.as_str().into(), |ledger| ledger.counts()).await.unwrap();
        if counts.0 == 6 {
            return (worker, job, lease);
        }
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn who_is_lost_between_the_last_field_and_the_report_leaves_an_heir_an_empty_window() {
    let bench = bench().await;
    let (lost, job, lease) = before_the_last_report(&bench).await;
    let mut heir = bench.worker("heir").await;
    drop(lost);
    let is_lost = |event: &Event| matches!(event, Event::TracksState(t) if t.failure.is_some());
    bench.watch(&job, 0).await.until(is_lost).await;
    let again = heir.window(&bench).await;
    assert_eq!(leased(&again), (leased(&lease).0, vec![]));
    let request = track_job(&again);
    assert_eq!((request.state, request.wants_state, request.frames.len()), (None, false, 1));
    heir.finish(&bench, &again).await;
    let rest = heir.finish_job(&bench, &job).await;
    assert_eq!(rest.len(), 2, "{rest:?}");
}

#[tokio::test]
async fn who_is_lost_between_the_last_field_and_the_report_leaves_the_coordinator_nothing_to_track() {
    let bench = bench().await;
    let (lost, job, _) = before_the_last_report(&bench).await;
    drop(lost);
    let tracked = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
    bench.watch(&job, 0).await.until(tracked).await;
    let rest = bench.worker("late").await.finish_job(&bench, &job).await;
    assert!(rest.is_empty(), "{rest:?}");
}

#[tokio::test]
async fn a_restarted_coordinator_goes_on_at_the_end_of_the_last_window() {
    let mut bench = bench().await;
    let (_, job) = after_first_windows(&bench).await;
    bench.stop().await;
    bench.restart().await;
    let mut worker = bench.worker("w").await;
    let windows = worker.finish_job(&bench, &job).await;
    let numbers: Vec<&[u32]> = windows.iter().map(|window| window.1.as_slice()).collect();
    assert_eq!(numbers, [[4, 5], [4, 5], [4, 5], [6, 7], [6, 7], [6, 7]]);
}

#[tokio::test]
async fn a_state_that_is_gone_or_damaged_costs_the_window_before_it_and_no_attempt() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let file = |view: &str| state_file(&bench, view, 2);
    std::fs::remove_file(file("cam00")).unwrap();
    let lease = worker.window(&bench).await;
    let request = track_job(&lease);
    assert_eq!((leased(&lease), request.first), (("cam00".into(), vec![2, 3]), 1));
    assert!(request.wants_state && request.frames[1..].iter().all(|frame| frame.tracks.is_some()));
    worker.finish(&bench, &lease).await;
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    worker.finish(&bench, &lease).await;

    let size = std::fs::metadata(file("cam01")).unwrap().len();
    std::fs::write(file("cam01"), vec![7; size as usize]).unwrap();
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam01".into(), vec![4, 5]));
    assert!(worker.fail(&lease, FailureKind::Transient).await.accepted);
    let lease = worker.window(&bench).await;
    assert_eq!((leased(&lease), lease.attempt), (("cam01".into(), vec![2, 3]), 3));
    let key = TaskKey { job: job.as_str().into(), task: Task::Tracks(1) };
    assert_eq!(bench.hub().store.task(&key).await.unwrap().unwrap().failures, 0);
    worker.finish(&bench, &lease).await;
    let rest = worker.finish_job(&bench, &job).await;
    assert_eq!(rest.len(), 5, "{rest:?}");
}

#[tokio::test]
async fn a_state_that_is_gone_in_the_third_window_costs_the_second_only() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    for _ in 0..3 {
        let lease = worker.window(&bench).await;
        worker.finish(&bench, &lease).await;
    }
    remove_state(&bench, "cam00", 4);
    let lease = worker.window(&bench).await;
    let request = track_job(&lease);
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    assert_eq!(request.state, Some(crate::blobs::name(&state_of("cam00", 2))));
    worker.finish(&bench, &lease).await;
    let rest = worker.finish_job(&bench, &job).await;
    assert_eq!(rest.len(), 3, "{rest:?}");
}

#[tokio::test]
async fn jobs_of_one_clip_keep_their_states_apart() {
    let bench = bench().await;
    let first = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    let mut held = Vec::new();
    for (name, view) in [("a", "cam00"), ("b", "cam01"), ("c", "cam02")] {
        let mut worker = bench.worker(name).await;
        let lease = worker.window(&bench).await;
        assert_eq!(leased(&lease).0, view);
        held.push((worker, lease));
    }
    let again = SubmitRequest { output: bench.path("again"), ..request(&bench, 2) };
    let second = bench.submit(again).await.unwrap().job_id;
    let mut other = bench.worker("d").await;
    let lease = other.window(&bench).await;
    assert_eq!((track_job(&lease).job_id, leased(&lease).0), (second.clone(), "cam00".into()));
    other.finish(&bench, &lease).await;

    let (worker, lease) = &mut held[0];
    worker.finish(&bench, lease).await;
    for frames in [[4, 5], [6, 7]] {
        let lease = worker.window(&bench).await;
        assert_eq!(
            (track_job(&lease).job_id, leased(&lease)),
            (first.clone(), ("cam00".into(), frames.into()))
        );
        worker.finish(&bench, &lease).await;
    }
    let of_second = |ledger: &crate::ledger::TrackLedger| ledger.next_state(0);
    let state = bench.hub().tracks(&second.as_str().into(), of_second).await.unwrap().unwrap();
    let blob = state.blob.unwrap();
    assert_eq!(blob, crate::blobs::name(&state_of("cam00", 2)));
    assert!(bench.hub().blobs.holds(&blob).await, "the first job has discarded its own only");
    assert!(bench.hub().store.artifact(&state.key).await.unwrap().is_some());
}

#[tokio::test]
async fn a_state_that_cannot_be_gone_on_from_is_made_again_and_the_failure_counts() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let key = TaskKey { job: job.as_str().into(), task: Task::Tracks(0) };
    for failures in 1..=3 {
        let lease = worker.window(&bench).await;
        assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
        assert!(worker.fail(&lease, FailureKind::Bug).await.accepted);
        let record = bench.hub().store.task(&key).await.unwrap().unwrap();
        assert_eq!(record.failures, failures, "a state that is made again is no progress");
        if failures < 3 {
            let lease = worker.window(&bench).await;
            assert_eq!((leased(&lease), track_job(&lease).state), (("cam00".into(), vec![2, 3]), None));
            worker.finish(&bench, &lease).await;
        }
    }
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::Bug));
    assert!(!state_file(&bench, "cam00", 2).exists(), "a resubmission begins before it");
}

#[tokio::test]
async fn a_store_that_keeps_no_state_fails_the_job() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let mut refused = Vec::new();
    for _ in 0..5 {
        remove_state(&bench, "cam00", 2);
        let lease = worker.window(&bench).await;
        assert_eq!(leased(&lease), ("cam00".into(), vec![2, 3]));
        let tracked = window(&bench, &lease).await;
        let receipt = worker.report(&lease, Outcome::Tracked(tracked)).await;
        refused.push((!receipt.accepted).then_some(receipt.reason));
    }
    assert!(refused[..2].iter().all(Option::is_none), "{refused:?}");
    assert!(refused[2..].iter().flatten().all(|reason| reason.contains("check its disk")), "{refused:?}");
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::Transient));
}

#[tokio::test]
async fn states_that_a_killed_coordinator_left_behind_are_removed() {
    let mut bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let id: crate::queue::JobId = job.as_str().into();
    let first = bench.hub().tracks(&id, |ledger| ledger.next_state(0)).await.unwrap().unwrap();
    let windows = worker.finish_job(&bench, &job).await;
    assert_eq!(windows.len(), 6);
    bench.stop().await;
    // As it is left between the report that completes a view and the removal of its states.
    let blob = first.blob.unwrap();
    let store = crate::store::Store::open(&bench.options.root.join("state.sqlite")).await.unwrap();
    let mut change = store.change().await.unwrap();
    let artifact = crate::store::Artifact { blob: blob.clone(), note: String::new() };
    change.put_artifact(&first.key, "track-state", &artifact).await.unwrap();
    change.commit().await.unwrap();
    store.close().await;
    let file = state_file(&bench, "cam00", 2);
    std::fs::write(&file, state_of("cam00", 2)).unwrap();
    std::fs::remove_dir_all(bench.path("out")).unwrap();
    bench.restart().await;
    assert!(bench.submit(request(&bench, 2)).await.unwrap().resumed);
    let mut worker = bench.worker("w").await;
    assert!(worker.finish_job(&bench, &job).await.is_empty());
    assert!(!file.exists() && bench.hub().store.artifact(&first.key).await.unwrap().is_none());
}

#[tokio::test]
async fn a_window_needs_its_state_and_one_of_its_own_frames() {
    let bench = bench().await;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    let states = [
        (None, "lacks the tracker's state"),
        (Some(bench.put(b"no state".to_vec()).await), "not a TSSTATE blob"),
    ];
    for (state, said) in states {
        let lease = worker.window(&bench).await;
        let tracked = Tracked { state, ..window(&bench, &lease).await };
        let receipt = worker.report(&lease, Outcome::Tracked(tracked)).await;
        assert!(!receipt.accepted && receipt.reason.contains(said), "{receipt:?}");
    }
    let lease = worker.window(&bench).await;
    let state = Some(bench.put(state_of("cam00", 3)).await);
    let receipt = worker.report(&lease, Outcome::Tracked(Tracked { fields: vec![], state })).await;
    assert!(!receipt.accepted, "{receipt:?}");
    assert!(receipt.reason.contains("remembers the view's frame 3, frames 1 to 2"), "{}", receipt.reason);
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::Bug));
}

#[tokio::test]
async fn the_coordinator_alone_tracks_in_windows_to_the_same_bytes() {
    let mut found = Vec::new();
    for window in [1, 2, 16] {
        let bench = bench().await;
        let job = bench.submit(request(&bench, window)).await.unwrap().job_id;
        let tracked = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
        bench.watch(&job, 0).await.until(tracked).await;
        let all =
            |ledger: &crate::ledger::TrackLedger| (2..=7).map(|frame| ledger.at(frame)).collect::<Vec<_>>();
        found.push(bench.hub().tracks(&job.as_str().into(), all).await.unwrap());
        assert!(found.iter().all(|fields| *fields == found[0] && fields.iter().all(Option::is_some)));

        let again = SubmitRequest { output: bench.path("again"), ..request(&bench, 3) };
        let other = bench.submit(again).await.unwrap().job_id;
        let mut watch = bench.watch(&other, 0).await;
        watch
            .until(|event| {
                assert!(!matches!(event, Event::TracksState(_)), "another cut has the same fields");
                tracked(event)
            })
            .await;
    }
}
