#![allow(clippy::unwrap_used, reason = "tests")]
//! Views that are tracked window by window, by workers and by the coordinator.

use std::{ops::Range, sync::Arc};

use splat::{
    formats::{track_blob, track_state},
    image::Image,
    tracking::{TrackState, Tracker, TrackingSettings},
};
use trackersplat_proto::v1::{
    Blob, CancelRequest, FieldReport, JobState, Lease, SubmitRequest, Tracked, TrackedField,
    coordinator_message, job_event::Event, lease, report::Outcome, worker_message,
};

use super::{harness::*, tracks::shifted};
use crate::{ServeOptions, failure::StageError};

/// A clip of seven frames, in windows of two: the third window has two frames as well.
pub(super) async fn bench() -> Bench {
    bench_with(|_| {}).await
}

pub(super) async fn bench_with(adjust: impl FnOnce(&mut ServeOptions)) -> Bench {
    let bench = Bench::start_with(adjust).await;
    write_clip_of(7, &bench.folder.path().join("clip"), 0);
    bench
}

pub(super) fn request(bench: &Bench, window: u32) -> SubmitRequest {
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

pub(super) async fn field(bench: &Bench, frame: u32) -> TrackedField {
    let encoded = track_blob::encode(&shifted(8, frame as f32));
    TrackedField { frame, tracks: Some(bench.put(encoded).await) }
}

/// What an honest worker reports of a window.
pub(super) async fn window(bench: &Bench, lease: &Lease) -> Tracked {
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
pub(super) fn leased(lease: &Lease) -> (String, Vec<u32>) {
    let job = track_job(lease);
    (job.view, job.frames[1..].iter().map(|frame| frame.frame).collect())
}

impl Worker {
    /// Does a task honestly.
    pub(super) async fn finish(&mut self, bench: &Bench, lease: &Lease) {
        let outcome = match &lease.task {
            Some(lease::Task::Tracks(_)) => Outcome::Tracked(window(bench, lease).await),
            _ => Outcome::Success(bench.result(lease).await),
        };
        let receipt = self.report(lease, outcome).await;
        assert!(receipt.accepted, "{receipt:?}");
    }

    /// The next window, once the frames before it are done.
    pub(super) async fn window(&mut self, bench: &Bench) -> Lease {
        loop {
            let lease = self.lease().await;
            if let Some(lease::Task::Tracks(_)) = lease.task {
                return lease;
            }
            self.finish(bench, &lease).await;
        }
    }

    /// Does everything until the job ends; the windows that it was given.
    pub(super) async fn finish_job(&mut self, bench: &Bench, job: &str) -> Vec<(String, Vec<u32>)> {
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
pub(super) async fn after_first_windows(bench: &Bench) -> (Worker, String) {
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

pub(super) fn state_file(bench: &Bench, view: &str, place: usize) -> std::path::PathBuf {
    let digest = crate::blobs::name(&state_of(view, place)).digest;
    bench.options.root.join("blobs").join(&digest[..2]).join(&digest)
}

pub(super) fn remove_state(bench: &Bench, view: &str, place: usize) {
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
    // However long the worker takes to come back, the coordinator tracks nothing by itself.
    let mut bench = bench_with(|options| options.reconnect_grace = options.lease_duration).await;
    let (_, job) = after_first_windows(&bench).await;
    bench.stop().await;
    bench.restart().await;
    let mut worker = bench.worker("w").await;
    let windows = worker.finish_job(&bench, &job).await;
    let numbers: Vec<&[u32]> = windows.iter().map(|window| window.1.as_slice()).collect();
    assert_eq!(numbers, [[4, 5], [4, 5], [4, 5], [6, 7], [6, 7], [6, 7]]);
}

#[tokio::test]
async fn a_job_that_is_cancelled_between_two_windows_goes_on_at_the_end_of_the_last_one() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    within(bench.jobs().cancel(CancelRequest { job_id: job.clone() })).await.unwrap();
    assert_eq!(bench.ended(&job).await.0, JobState::Cancelled);
    assert!(bench.submit(request(&bench, 2)).await.unwrap().resumed);
    let windows = worker.finish_job(&bench, &job).await;
    let numbers: Vec<&[u32]> = windows.iter().map(|window| window.1.as_slice()).collect();
    assert_eq!(numbers, [[4, 5], [4, 5], [4, 5], [6, 7], [6, 7], [6, 7]]);
}

#[tokio::test]
async fn a_window_that_is_reported_again_is_accepted_and_changes_nothing() {
    let bench = bench().await;
    let (mut first, mut second) = (bench.worker("first").await, bench.worker("second").await);
    let job = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    let lease = first.window(&bench).await;
    let outcome = Outcome::Tracked(window(&bench, &lease).await);
    assert!(first.report(&lease, outcome.clone()).await.accepted);
    // The receipt was lost.
    let mut next = second.window(&bench).await;
    while leased(&next).0 != "cam00" {
        second.finish(&bench, &next).await;
        next = second.window(&bench).await;
    }
    assert_eq!((leased(&next), next.attempt), (("cam00".into(), vec![4, 5]), 2));
    assert!(first.report(&lease, outcome).await.accepted);
    second.finish(&bench, &next).await;
    let rest = first.finish_job(&bench, &job).await;
    assert!(!rest.contains(&("cam00".into(), vec![2, 3])) && !rest.contains(&leased(&next)), "{rest:?}");
}

#[tokio::test]
async fn a_field_of_another_window_fails_the_attempt() {
    let bench = bench().await;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![2, 3]));
    let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
    let report = FieldReport { lease_id, attempt, field: Some(field(&bench, 4).await) };
    worker.send(worker_message::Message::Field(report)).await;
    let cancelled = worker.receive().await.unwrap();
    let coordinator_message::Message::CancelLease(cancel) = cancelled else { panic!("{cancelled:?}") };
    assert!(cancel.reason.contains("frame 4: not of the window"), "{}", cancel.reason);
    let lease = worker.window(&bench).await;
    assert_eq!((leased(&lease), lease.attempt), (("cam00".into(), vec![2, 3]), 2));
    let mut tracked = window(&bench, &lease).await;
    tracked.fields.push(field(&bench, 5).await);
    let receipt = worker.report(&lease, Outcome::Tracked(tracked)).await;
    assert!(!receipt.accepted && receipt.reason.contains("frame 5: not of the window"), "{receipt:?}");
    let later = |ledger: &crate::ledger::TrackLedger| (ledger.tracks(0, 4), ledger.tracks(0, 5));
    assert_eq!(bench.hub().tracks(&job.as_str().into(), later).await.unwrap(), (None, None));
}

#[tokio::test]
async fn of_two_jobs_of_one_clip_one_tracks_and_the_other_takes_over() {
    let bench = bench().await;
    let (mut worker, first) = after_first_windows(&bench).await;
    let again = SubmitRequest { output: bench.path("again"), ..request(&bench, 2) };
    let second = bench.submit(again).await.unwrap().job_id;
    let ready = |event: &Event| matches!(event, Event::TracksState(t) if t.view == "cam02");
    bench.watch(&second, 0).await.until(ready).await;
    let windows = worker.finish_job(&bench, &second).await;
    assert_eq!(bench.ended(&first).await.0, JobState::Done);
    let (empty, tracked): (Vec<_>, Vec<_>) = windows.into_iter().partition(|window| window.1.is_empty());
    let views: Vec<&str> = empty.iter().map(|window| window.0.as_str()).collect();
    assert_eq!(views, ["cam00", "cam01", "cam02"], "of the second job only the reports are left");
    assert_eq!(tracked.len(), 6, "{tracked:?}");
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
