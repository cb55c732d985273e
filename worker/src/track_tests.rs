//! What a coordinator sees of a worker that tracks a view.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use splat::{frame::FrameError, image::Image, raster::CpuEngine, tracking::TrackingSettings};
use tokio::task::JoinHandle;
use trackersplat_proto::v1::{
    Blob, CancelLease, FieldReport, Lease, Report, TrackFrame, TrackJob, Tracker, coordinator_message, lease,
    report, worker_message,
};

use super::*;
use crate::{
    Exit, WorkerError, WorkerOptions,
    job::Reconstruct,
    run::run_with,
    test_coordinator::{Session, TestCoordinator},
};

fn start(
    coordinator: &TestCoordinator,
    threads: usize,
) -> (JoinHandle<Result<Exit, WorkerError>>, CancellationToken) {
    let options = WorkerOptions {
        coordinator: coordinator.address.clone(),
        threads,
        worker_id: Some("worker-a".into()),
        state_dir: None,
        reconnect_for: Duration::from_secs(15),
        remote_blobs: false,
    };
    let no_frames: Reconstruct = Arc::new(|_, _| Err(FrameError::BadInput("no frame in this test".into())));
    let shutdown = CancellationToken::new();
    let engine = Arc::new(CpuEngine::default());
    (tokio::spawn(run_with(options, engine, no_frames, shutdown.clone())), shutdown)
}

/// A textured image whose texture moves by one pixel per frame.
fn image(frame: u32) -> Vec<u8> {
    let mut image = Image::filled(24, 16, [0.0; 3]);
    for (index, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
        let (x, y) = ((index % 24) as f32 - frame as f32, (index / 24) as f32);
        pixel.fill(0.5 + 0.25 * (x * 0.9).sin() + 0.25 * (y * 0.7 + x * 0.2).cos());
    }
    image.encode_png()
}

/// One view over some frames, frame 1 first.
fn track_job(coordinator: &TestCoordinator, frames: u32) -> TrackJob {
    let frame = |frame| TrackFrame { frame, image: Some(coordinator.store(&image(frame))), tracks: None };
    let settings_json = serde_json::to_string(&TrackingSettings::default()).unwrap();
    TrackJob {
        job_id: "job".into(),
        view: "cam00".into(),
        tracker: Some(Tracker { settings_json, ..Tracker::default() }),
        frames: (1..=frames).map(frame).collect(),
        first: 1,
        ..TrackJob::default()
    }
}

async fn lease(session: &Session, lease_id: &str, job: TrackJob) {
    let task = Some(lease::Task::Tracks(job));
    let lease = Lease { lease_id: lease_id.into(), attempt: 1, task, likely_next: None };
    session.send(coordinator_message::Message::Lease(lease)).await;
}

async fn next_field(session: &mut Session) -> FieldReport {
    session
        .wait_for(
            |message| if let worker_message::Message::Field(field) = message { Some(field) } else { None },
        )
        .await
}

fn fields_of(report: Report) -> Vec<(u32, Blob)> {
    let Some(report::Outcome::Tracked(tracked)) = report.outcome else { panic!("{report:?}") };
    tracked.fields.into_iter().map(|field| (field.frame, field.tracks.unwrap())).collect()
}

/// The report of a fresh worker with some threads.
async fn tracked_with(coordinator: &TestCoordinator, threads: usize, job: TrackJob) -> Vec<(u32, Blob)> {
    let (_worker, shutdown) = start(coordinator, threads);
    let mut session = coordinator.welcome().await;
    lease(&session, "lease-1", job).await;
    let report = session.wait_for_report().await;
    session.acknowledge(&report).await;
    session.wait_for_lease_request().await;
    shutdown.cancel();
    fields_of(report)
}

#[tokio::test]
async fn every_field_is_stored_and_said_before_the_report_that_names_them_all() {
    let coordinator = TestCoordinator::start().await;
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    session.wait_for_lease_request().await;
    lease(&session, "lease-1", track_job(&coordinator, 4)).await;
    let first = next_field(&mut session).await;
    assert_eq!((first.lease_id.as_str(), first.attempt), ("lease-1", 1));
    let first = first.field.unwrap();
    assert_eq!(first.frame, 2, "in order of frames");
    let stored = coordinator.stored(&first.tracks.clone().unwrap().digest);
    let field = track_blob::decode(&stored).unwrap();
    assert_eq!((field.width, field.height), (24, 16));
    let fields = fields_of(session.wait_for_report().await);
    assert_eq!(fields.iter().map(|field| field.0).collect::<Vec<_>>(), [2, 3, 4]);
    assert_eq!(Some(&fields[0].1), first.tracks.as_ref());
}

#[tokio::test]
async fn any_number_of_threads_and_any_resumption_give_the_same_fields() {
    let coordinator = TestCoordinator::start().await;
    let job = track_job(&coordinator, 5);
    let whole = tracked_with(&coordinator, 1, job.clone()).await;
    assert_eq!(tracked_with(&coordinator, 3, job.clone()).await, whole);

    let mut resumed = job.clone();
    for (frame, blob) in [&whole[0], &whole[1], &whole[3]] {
        resumed.frames[*frame as usize - 1].tracks = Some(blob.clone());
    }
    assert_eq!(tracked_with(&coordinator, 1, resumed).await, [whole[2].clone()], "only what is missing");
    let mut complete = job;
    for (frame, blob) in &whole {
        complete.frames[*frame as usize - 1].tracks = Some(blob.clone());
    }
    assert_eq!(tracked_with(&coordinator, 1, complete).await, []);
}

#[tokio::test]
async fn bad_images_and_settings_name_the_view_and_are_bad_input() {
    let coordinator = TestCoordinator::start().await;
    let mut damaged = track_job(&coordinator, 3);
    damaged.frames[2].image = Some(coordinator.store(b"\x89PNG cut short"));
    let mut nameless = track_job(&coordinator, 2);
    nameless.frames[1].image = None;
    let mut unset = track_job(&coordinator, 2);
    unset.tracker = Some(Tracker { settings_json: r#"{"gap": 3}"#.into(), ..Tracker::default() });
    let mut no_network = track_job(&coordinator, 2);
    give(&coordinator, &mut no_network, b"no network");
    let mut too_large = no_network.clone();
    if let Some(model) = too_large.tracker.as_mut().and_then(|tracker| tracker.model.as_mut()) {
        model.size = u64::MAX;
    }
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    for (job, said) in [
        (damaged, "'cam00' at frame 3"),
        (nameless, "no image at frame 2"),
        (unset, "gap"),
        (no_network, "net.onnx: cannot load"),
        (too_large, "net.onnx: 18446744073709551615 bytes"),
    ] {
        lease(&session, said, job).await;
        let report = session.wait_for_report().await;
        session.acknowledge(&report).await;
        session.wait_for_lease_request().await;
        let Some(report::Outcome::Failure(failure)) = report.outcome else { panic!("{report:?}") };
        assert_eq!(failure.kind(), FailureKind::BadInput);
        assert!(failure.message.contains(said), "{}", failure.message);
    }
}

/// A length-delimited field of an ONNX message; numbers of fields below 16, lengths below 16384.
fn part(number: u8, content: &[u8]) -> Vec<u8> {
    let length = content.len();
    [&[number << 3 | 2, (length & 0x7f) as u8 | 0x80, (length >> 7) as u8], content].concat()
}

/// A network for images of 24 × 16 that sees everything, moved alike.
fn network(motion: [f32; 2]) -> Vec<u8> {
    let (columns, rows) = (24, 16);
    let output = |name: &str, channels: &[f32]| {
        let constant = format!("constant of {name}");
        let values: Vec<u8> = channels
            .iter()
            .flat_map(|value| value.to_le_bytes().repeat(usize::from(columns) * usize::from(rows)))
            .collect();
        let shape = [8, 1, 8, channels.len() as u8, 8, rows, 8, columns];
        let float = [16, 1];
        let tensor = [&shape[..], &float, &part(8, constant.as_bytes()), &part(9, &values)].concat();
        let identity =
            [part(1, constant.as_bytes()), part(2, name.as_bytes()), part(4, b"Identity")].concat();
        [part(5, &tensor), part(1, &identity), part(12, &part(1, name.as_bytes()))].concat()
    };
    let inputs = [b"image1", b"image2"].map(|name| part(11, &part(1, name))).concat();
    let graph = [inputs, output("flow", &motion), output("visibility", &[1.0])].concat();
    [&[8, 8], &part(7, &graph)[..], &part(8, &[16, 17])].concat()
}

fn give(coordinator: &TestCoordinator, job: &mut TrackJob, network: &[u8]) {
    if let Some(tracker) = &mut job.tracker {
        tracker.model = Some(coordinator.store(network));
        tracker.model_name = "net.onnx".into();
    }
}

#[tokio::test]
async fn a_network_that_comes_with_the_job_tracks() {
    let coordinator = TestCoordinator::start().await;
    let mut job = track_job(&coordinator, 3);
    give(&coordinator, &mut job, &network([2.0, -0.25]));
    let fields = tracked_with(&coordinator, 1, job).await;
    assert_eq!(fields.len(), 2);
    for (_, blob) in fields {
        let field = track_blob::decode(&coordinator.stored(&blob.digest)).unwrap();
        assert_eq!((field.width, field.height), (24, 16));
        // Multiples of a 64th of a pixel are stored exactly.
        assert_eq!(field.positions[5 * 24 + 7], [7.5 + 2.0, 5.5 - 0.25]);
        assert!(field.visible[5 * 24 + 7]);
    }
}

#[test]
fn a_tracker_is_used_again_for_the_same_model_and_settings_only() {
    let last = LastTracker::default();
    let wanted = |settings_json: &str| Tracker { settings_json: settings_json.into(), ..Tracker::default() };
    assert!(last.of(&wanted("{}")).is_none());
    let loaded = Arc::new(splat::tracking::Tracker::BuiltIn);
    last.replace(wanted("{}"), loaded.clone());
    assert!(Arc::ptr_eq(&last.of(&wanted("{}")).unwrap(), &loaded));
    assert!(last.of(&wanted(r#"{"a": 1}"#)).is_none());
    let model = Some(Blob { digest: "another network".into(), size: 1 });
    assert!(last.of(&Tracker { model, ..wanted("{}") }).is_none());
}

#[tokio::test]
async fn a_cancelled_view_is_dropped_without_a_report() {
    let coordinator = TestCoordinator::start().await;
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    session.wait_for_lease_request().await;
    lease(&session, "lease-1", track_job(&coordinator, 200)).await;
    next_field(&mut session).await;
    let cancel = CancelLease { lease_id: "lease-1".into(), reason: "the job was cancelled".into() };
    session.send(coordinator_message::Message::CancelLease(cancel)).await;
    let asked = session.wait_for(|message| match message {
        worker_message::Message::LeaseRequest(_) => Some(true),
        worker_message::Message::Report(_) => Some(false),
        _ => None,
    });
    assert!(asked.await, "it asks for something else");
}

#[tokio::test]
async fn tracking_goes_on_over_a_broken_stream_and_the_report_names_what_was_not_heard() {
    let coordinator = TestCoordinator::start().await;
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    lease(&session, "lease-1", track_job(&coordinator, 12)).await;
    next_field(&mut session).await;
    drop(session);
    let mut session = coordinator.welcome().await;
    assert_eq!(session.register.held_lease_id, "lease-1");
    let fields = fields_of(session.wait_for_report().await);
    assert_eq!(fields.iter().map(|field| field.0).collect::<Vec<_>>(), (2..=12).collect::<Vec<_>>());
}

/// The window of a job that begins at a place and has some frames.
fn cut(job: &TrackJob, first: usize, frames: usize, state: Option<Blob>) -> TrackJob {
    let mut window = job.clone();
    window.frames = [&job.frames[..1], &job.frames[first..first + frames]].concat();
    window.first = first as u32;
    window.past = job.frames[first.saturating_sub(2).max(1)..first].to_vec();
    window.state = state;
    window.wants_state = first + frames < job.frames.len();
    window
}

async fn outcome_of(session: &mut Session, lease_id: &str, job: TrackJob) -> report::Outcome {
    lease(session, lease_id, job).await;
    let report = session.wait_for_report().await;
    session.acknowledge(&report).await;
    session.wait_for_lease_request().await;
    report.outcome.unwrap()
}

#[tokio::test]
async fn windows_give_the_fields_of_the_whole_and_go_on_from_a_stored_state() {
    let coordinator = TestCoordinator::start().await;
    let job = track_job(&coordinator, 6);
    let whole = tracked_with(&coordinator, 1, job.clone()).await;
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    let (mut fields, mut state) = (Vec::new(), None);
    for first in [1, 3, 5] {
        let window = cut(&job, first, if first == 5 { 1 } else { 2 }, state.take());
        let outcome = outcome_of(&mut session, &format!("from {first}"), window).await;
        let report::Outcome::Tracked(tracked) = outcome else { panic!("{outcome:?}") };
        fields.extend(tracked.fields.into_iter().map(|field| (field.frame, field.tracks.unwrap())));
        state = tracked.state;
        assert_eq!(state.is_some(), first < 5);
    }
    assert_eq!(fields, whole);
}

#[tokio::test]
async fn a_state_that_is_gone_or_damaged_is_reported_at_once() {
    let coordinator = TestCoordinator::start().await;
    let job = track_job(&coordinator, 4);
    let damaged = coordinator.store(b"a state");
    coordinator.damage(&damaged.digest);
    let gone = Blob { digest: crate::blobs::digest_of(b"never stored"), size: 12 };
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    for (state, lease_id) in [(damaged, "damaged"), (gone, "gone")] {
        // Any other transfer is tried again for minutes.
        let outcome = outcome_of(&mut session, lease_id, cut(&job, 3, 1, Some(state)));
        let outcome = tokio::time::timeout(Duration::from_secs(15), outcome).await.unwrap();
        let report::Outcome::Failure(failure) = outcome else { panic!("{outcome:?}") };
        assert_eq!(failure.kind(), FailureKind::Transient);
    }
}

#[tokio::test]
async fn a_window_of_no_frames_ends_in_an_empty_report() {
    let coordinator = TestCoordinator::start().await;
    let mut job = track_job(&coordinator, 1);
    job.frames[0].image = None;
    assert_eq!(tracked_with(&coordinator, 1, job).await, [], "not even the key frame is read");
}

#[tokio::test]
async fn a_state_that_does_not_fit_is_a_defect_and_says_so() {
    let coordinator = TestCoordinator::start().await;
    let job = track_job(&coordinator, 6);
    let (_worker, _shutdown) = start(&coordinator, 1);
    let mut session = coordinator.welcome().await;
    let outcome = outcome_of(&mut session, "first", cut(&job, 1, 3, None)).await;
    let report::Outcome::Tracked(Tracked { state, .. }) = outcome else { panic!("{outcome:?}") };
    let no_state = Some(coordinator.store(b"no state"));
    let no_images = TrackJob { past: Vec::new(), ..cut(&job, 4, 1, state.clone()) };
    for (window, said) in [
        (cut(&job, 4, 1, no_state), "not a TSSTATE blob"),
        (cut(&job, 3, 1, state), "it knows frame 3, from 3 on"),
        (no_images, "lacks the frame at place 2"),
    ] {
        let outcome = outcome_of(&mut session, said, window).await;
        let report::Outcome::Failure(failure) = outcome else { panic!("{outcome:?}") };
        assert_eq!(failure.kind(), FailureKind::Bug);
        assert!(failure.message.contains(said), "{}", failure.message);
    }
}
