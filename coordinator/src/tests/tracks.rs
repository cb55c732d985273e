#![allow(clippy::unwrap_used, reason = "tests")]
//! Tracks of views as tasks: given out, reported field by field, resumed.

use splat::{formats::track_blob, tracking::TrackField};
use trackersplat_proto::v1::{
    Blob, CancelLease, FailureKind, FieldReport, JobState, Lease, SubmitRequest, TaskState, Tracked,
    TrackedField, coordinator_message, job_event::Event, report::Outcome, worker_message,
};

use super::harness::*;

/// A field of the clip's size whose tracks all move by `x` pixels.
pub(super) fn shifted(width: u32, x: f32) -> TrackField {
    let pixels = width as usize * 6;
    let centre =
        |index: usize| [(index % width as usize) as f32 + 0.5, (index / width as usize) as f32 + 0.5];
    TrackField {
        width,
        height: 6,
        positions: (0..pixels).map(|index| [centre(index)[0] + x, centre(index)[1]]).collect(),
        visible: vec![true; pixels],
        sigma: vec![0.5; pixels],
    }
}

pub(super) fn encoded(width: u32, x: f32) -> Vec<u8> {
    track_blob::encode(&shifted(width, x))
}

async fn field(bench: &Bench, frame: u32) -> TrackedField {
    TrackedField { frame, tracks: Some(bench.put(encoded(8, frame as f32)).await) }
}

async fn say(worker: &Worker, lease: &Lease, field: TrackedField) {
    let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
    let report = FieldReport { lease_id, attempt, field: Some(field) };
    worker.send(worker_message::Message::Field(report)).await;
}

async fn cancelled(worker: &mut Worker) -> CancelLease {
    match worker.receive().await.unwrap() {
        coordinator_message::Message::CancelLease(cancel) => cancel,
        other => panic!("{other:?}"),
    }
}

/// Says the fields to frames 2 and 3 and that the view is complete.
pub(super) async fn track_honestly(bench: &Bench, worker: &mut Worker, lease: &Lease) {
    let fields = vec![field(bench, 2).await, field(bench, 3).await];
    let receipt = worker.report(lease, Outcome::Tracked(Tracked { fields, state: None })).await;
    assert!(receipt.accepted, "{receipt:?}");
}

pub(super) fn tracked_request(bench: &Bench) -> SubmitRequest {
    SubmitRequest { settings_json: String::new(), ..bench.request() }
}

/// Workers that are there before the job, so that the coordinator leaves the tracks to them.
async fn workers<const N: usize>(bench: &Bench) -> [Worker; N] {
    let mut workers = Vec::new();
    for index in 0..N {
        workers.push(bench.worker(&format!("w{index}")).await);
    }
    workers.try_into().ok().unwrap()
}

#[tokio::test]
async fn a_frame_is_given_out_once_every_view_is_tracked_to_it() {
    let bench = Bench::start().await;
    let [mut a, mut b, mut c, mut refiner] = workers(&bench).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let mut leases = Vec::new();
    for worker in [&mut a, &mut b, &mut c] {
        leases.push(worker.lease().await);
    }
    let views: Vec<String> = leases.iter().map(|lease| track_job(lease).view).collect();
    assert_eq!(views, ["cam00", "cam01", "cam02"], "the test view is not tracked");
    let frames: Vec<u32> = track_job(&leases[0]).frames.iter().map(|frame| frame.frame).collect();
    assert_eq!(frames, [1, 2, 3]);
    assert_eq!(refiner.work_once(&bench).await, 1, "the key frame needs no tracks");

    refiner.ask().await;
    let second = field(&bench, 2).await;
    for (worker, lease) in [(&a, &leases[0]), (&b, &leases[1]), (&c, &leases[2])] {
        say(worker, lease, second.clone()).await;
    }
    let lease = refiner.leased().await;
    let request = frame_job(&lease);
    assert_eq!(request.frame, 2);
    assert!(request.training_views.iter().all(|view| view.tracks == second.tracks));
    let success = bench.result(&lease).await;
    assert!(refiner.report(&lease, Outcome::Success(success)).await.accepted);

    let mut watch = bench.watch(&job, 0).await;
    watch.frame(2, TaskState::Done).await;
    let listed = bench.jobs().list(trackersplat_proto::v1::ListRequest {}).await.unwrap().into_inner();
    assert_eq!(listed.jobs[0].state(), JobState::Tracking, "frame 2 is done while frame 3 is not tracked");
    for (worker, lease) in [(&mut a, &leases[0]), (&mut b, &leases[1]), (&mut c, &leases[2])] {
        track_honestly(&bench, worker, lease).await;
    }
    assert_eq!(refiner.work_once(&bench).await, 3);
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn tracks_of_a_lost_worker_go_on_with_the_fields_that_it_had_stored() {
    let mut bench = Bench::start().await;
    let [lost, mut heir] = workers(&bench).await;
    let mut lost = lost;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let lease = lost.lease().await;
    assert_eq!((track_job(&lease).view.as_str(), lease.attempt), ("cam00", 1));
    let stored = field(&bench, 2).await;
    say(&lost, &lease, stored.clone()).await;
    let mut watch = bench.watch(&job, 0).await;
    watch.until(|event| matches!(event, Event::Progress(p) if p.stage == "tracking" && p.done == 1)).await;
    drop(lost);
    let is_lost =
        |event: &Event| matches!(event, Event::TracksState(t) if t.view == "cam00" && t.failure.is_some());
    let event = watch.until(is_lost).await;
    let Some(Event::TracksState(changed)) = event.event else { panic!("{event:?}") };
    assert_eq!(changed.failure.unwrap().kind(), FailureKind::LostWorker);

    let again = heir.lease().await;
    assert_eq!((track_job(&again).view.as_str(), again.attempt), ("cam00", 2));
    let exists: Vec<Option<Blob>> = track_job(&again).frames.into_iter().map(|frame| frame.tracks).collect();
    assert_eq!(exists, [None, stored.tracks, None]);

    // So does a coordinator that was killed: its leases are void, the fields are on disk.
    bench.stop().await;
    // However long the heir takes to come back, the coordinator tracks nothing by itself.
    bench.options.reconnect_grace = bench.options.lease_duration;
    bench.restart().await;
    let mut heir = bench.worker("w1").await;
    let stale = Tracked { fields: vec![field(&bench, 3).await], state: None };
    assert!(!heir.report(&again, Outcome::Tracked(stale.clone())).await.accepted);
    assert_eq!(bench.ended_tracking(&job, &mut heir).await, ["cam00", "cam01", "cam02"]);
}

#[tokio::test]
async fn tracks_under_the_lease_of_a_frame_fail_it_and_count_for_no_view() {
    let bench = Bench::start().await;
    let [mut a, mut b, mut c, mut refiner] = workers(&bench).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    for worker in [&mut a, &mut b, &mut c] {
        worker.lease().await;
    }
    let lease = refiner.lease().await;
    // There is a view at the position of this number.
    assert_eq!(frame_job(&lease).frame, 1);
    say(&refiner, &lease, field(&bench, 2).await).await;
    let reason = cancelled(&mut refiner).await.reason;
    assert!(reason.contains("under the lease of a frame"), "{reason}");
    let failure = bench.watch(&job, 0).await.frame(1, TaskState::Ready).await.unwrap();
    assert_eq!(failure.kind(), FailureKind::Bug);
    let known = bench.hub().tracks(&job.as_str().into(), |ledger| ledger.tracks(1, 2)).await.unwrap();
    assert_eq!(known, None);
    assert_eq!(refiner.work_once(&bench).await, 1);
}

#[tokio::test]
async fn a_field_that_claims_another_size_is_not_even_decompressed() {
    let bench = Bench::start().await;
    let [mut worker] = workers(&bench).await;
    bench.submit(tracked_request(&bench)).await.unwrap();
    let lease = worker.lease().await;
    let content = [[8192_u32, 8192].map(u32::to_le_bytes).concat(), vec![0; 20]].concat();
    let claiming = [&b"TSTRACK\x01"[..], blake3::hash(&content).as_bytes(), &content].concat();
    let field = TrackedField { frame: 2, tracks: Some(bench.put(claiming).await) };
    say(&worker, &lease, field).await;
    let reason = cancelled(&mut worker).await.reason;
    assert!(reason.contains("8192 x 8192 pixels, the view of 8 x 6"), "{reason}");
}

#[tokio::test]
async fn fields_that_do_not_verify_or_differ_fail_the_attempt() {
    let bench = Bench::start().await;
    let [mut worker] = workers(&bench).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let mut watch = bench.watch(&job, 0).await;
    let large = TrackedField { frame: 2, tracks: Some(bench.put(encoded(9, 1.0)).await) };
    let lease = worker.lease().await;
    say(&worker, &lease, large).await;
    assert!(cancelled(&mut worker).await.reason.contains("9 x 6"));
    let failed = |event: &Event| matches!(event, Event::TracksState(t) if t.failure.is_some());
    let event = watch.until(failed).await;
    let Some(Event::TracksState(changed)) = event.event else { panic!("{event:?}") };
    assert_eq!((changed.state(), changed.failure.unwrap().kind()), (TaskState::Ready, FailureKind::Bug));
    say(&worker, &lease, field(&bench, 2).await).await;
    assert!(cancelled(&mut worker).await.reason.contains("not held"), "a stale field changes nothing");

    let lease = worker.lease().await;
    assert!(track_job(&lease).frames.iter().all(|frame| frame.tracks.is_none()));
    let mut fields = vec![field(&bench, 2).await];
    let receipt =
        worker.report(&lease, Outcome::Tracked(Tracked { fields: fields.clone(), state: None })).await;
    assert!(!receipt.accepted && receipt.reason.contains("lacks the tracks to frame 3"), "{receipt:?}");

    let lease = worker.lease().await;
    assert_eq!(track_job(&lease).frames[1].tracks, fields[0].tracks, "what was verified counts");
    fields[0].tracks = Some(bench.put(encoded(8, 7.0)).await);
    let receipt =
        worker.report(&lease, Outcome::Tracked(Tracked { fields: fields.clone(), state: None })).await;
    assert!(!receipt.accepted && receipt.reason.contains("was reported before"), "{receipt:?}");
    let lease = worker.lease().await;
    assert_eq!(lease.attempt, 4, "the failure before the field was kept does not count any more");
    assert!(!worker.report(&lease, Outcome::Tracked(Tracked { fields, state: None })).await.accepted);
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::Bug), "the third failure since");
    assert!(failure.message.contains("cam00"), "{}", failure.message);
}

#[tokio::test]
async fn a_view_that_cannot_be_tracked_fails_the_job_which_may_be_submitted_again() {
    let bench = Bench::start().await;
    let [mut worker] = workers(&bench).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let lease = worker.lease().await;
    let success = trackersplat_proto::v1::Success::default();
    let receipt = worker.report(&lease, Outcome::Success(success)).await;
    assert!(receipt.accepted, "a report of another kind is a failure that the coordinator has taken");
    let lease = worker.lease().await;
    assert_eq!((track_job(&lease).view.as_str(), lease.attempt), ("cam00", 2));
    assert!(worker.fail(&lease, FailureKind::BadInput).await.accepted);
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("tracks of view 'cam00': bad input in a test"), "{}", failure.message);

    assert!(bench.submit(tracked_request(&bench)).await.unwrap().resumed);
    assert_eq!(bench.ended_tracking(&job, &mut worker).await, ["cam00", "cam01", "cam02"]);
}

#[tokio::test]
async fn without_a_worker_the_coordinator_tracks_by_itself_and_another_job_reuses_it() {
    let bench = Bench::start().await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let is_over = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Frames);
    let mut watch = bench.watch(&job, 0).await;
    let mut done = Vec::new();
    watch
        .until(|event| {
            if let Event::TracksState(t) = event
                && t.state() == TaskState::Done
            {
                assert_eq!((t.worker_id.as_str(), t.attempt), ("(coordinator)", 1));
                done.push(t.view.clone());
            }
            is_over(event)
        })
        .await;
    done.sort();
    assert_eq!(done, ["cam00", "cam01", "cam02"]);
    let mut worker = bench.worker("w").await;
    for frame in 1..=3 {
        assert_eq!(worker.work_once(&bench).await, frame, "frames are for workers");
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    let again = SubmitRequest { output: bench.path("again"), ..tracked_request(&bench) };
    let other = bench.submit(again).await.unwrap().job_id;
    let events = bench.watch(&other, 0).await.rest().await;
    assert!(!events.iter().any(|event| matches!(event.event, Some(Event::TracksState(_)))));
    assert_eq!(bench.ended(&other).await.0, JobState::Done, "with the tracks and frames of the first");
}

#[tokio::test]
async fn of_two_jobs_that_track_the_same_view_the_first_field_counts_for_both() {
    let bench = Bench::start().await;
    let [mut slow, mut b, mut c, mut fast] = workers(&bench).await;
    let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
    let lease = slow.lease().await;
    for worker in [&mut b, &mut c] {
        worker.lease().await;
    }
    assert_eq!(fast.work_once(&bench).await, 1, "no view is left");
    let again = SubmitRequest { output: bench.path("again"), ..tracked_request(&bench) };
    let other = bench.submit(again).await.unwrap().job_id;
    let theirs = fast.lease().await;
    assert_eq!((track_job(&theirs).job_id, track_job(&theirs).view), (other.clone(), "cam00".into()));
    let first = field(&bench, 2).await;
    let mut watch = bench.watch(&other, 0).await;
    say(&fast, &theirs, first.clone()).await;
    let kept = |event: &Event| matches!(event, Event::Progress(p) if p.stage == "tracking" && p.done == 1);
    watch.until(kept).await;

    let different = TrackedField { frame: 2, tracks: Some(bench.put(encoded(8, 9.0)).await) };
    say(&slow, &lease, different.clone()).await;
    let fields = vec![different, field(&bench, 3).await];
    let receipt = slow.report(&lease, Outcome::Tracked(Tracked { fields, state: None })).await;
    assert!(receipt.accepted, "{receipt:?}");
    let known = bench.hub().tracks(&job.as_str().into(), |ledger| ledger.tracks(0, 2)).await.unwrap();
    assert_eq!(known, first.tracks);
    track_honestly(&bench, &mut fast, &theirs).await;
}

impl Bench {
    /// Does every task of a job as one worker until the job is done; the views that were tracked, in order.
    async fn ended_tracking(&self, job: &str, worker: &mut Worker) -> Vec<String> {
        let mut views = Vec::new();
        for _ in 0..6 {
            let lease = worker.lease().await;
            let Some(trackersplat_proto::v1::lease::Task::Tracks(request)) = lease.task.clone() else {
                let success = self.result(&lease).await;
                assert!(worker.report(&lease, Outcome::Success(success)).await.accepted);
                continue;
            };
            views.push(request.view);
            let mut fields = Vec::new();
            for frame in request.frames.iter().skip(1).filter(|frame| frame.tracks.is_none()) {
                fields.push(field(self, frame.frame).await);
            }
            let receipt = worker.report(&lease, Outcome::Tracked(Tracked { fields, state: None })).await;
            assert!(receipt.accepted, "{receipt:?}");
        }
        assert_eq!(self.ended(job).await.0, JobState::Done);
        views
    }
}
