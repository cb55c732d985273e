#![allow(clippy::unwrap_used, reason = "tests")]

use splat::formats::ply;
use tonic::Code;
use trackersplat_proto::v1::{
    CancelRequest, FailureKind, FetchRequest, JobState, ListRequest, SubmitRequest, TaskState, WatchRequest,
    coordinator_message, job_event::Event,
};

use super::harness::*;

#[tokio::test]
async fn a_job_goes_from_submission_to_done_and_its_events_have_no_gaps() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let mut frames = Vec::new();
    for _ in 0..3 {
        frames.push(worker.work_once(&bench).await);
    }
    assert_eq!(frames, [1, 2, 3], "the key frame is evaluated too");
    assert_eq!(bench.ended(&job).await, (JobState::Done, None));

    let events = stored(&bench.watch(&job, 0).await.rest().await);
    let sequences: Vec<u64> = events.iter().map(|event| event.sequence).collect();
    assert_eq!(sequences, (1..=events.len() as u64).collect::<Vec<_>>());
    let states: Vec<JobState> = events
        .iter()
        .filter_map(|event| match &event.event {
            Some(Event::JobState(changed)) => Some(changed.state()),
            _ => None,
        })
        .collect();
    use JobState::*;
    assert_eq!(states, [Ingesting, StaticModel, Tracking, Frames, Assembling, Done]);

    for after in [1, 4, events.len() as u64 - 1, events.len() as u64] {
        let rest = stored(&bench.watch(&job, after).await.rest().await);
        assert_eq!(rest, events[after as usize..], "resumed after {after}");
    }
    let beyond = WatchRequest { job_id: job.clone(), after_sequence: events.len() as u64 + 1 };
    assert_eq!(bench.jobs().watch(beyond).await.unwrap_err().code(), Code::OutOfRange);

    let listed = bench.jobs().list(ListRequest {}).await.unwrap().into_inner().jobs;
    assert_eq!(listed.len(), 1);
    assert_eq!((listed[0].frames, listed[0].frames_done, listed[0].state()), (3, 3, Done));
}

#[tokio::test]
async fn the_frame_job_says_everything_a_worker_needs() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let key = frame_job(&worker.lease().await);
    assert_eq!((key.job_id, key.frame, key.key_frame), (job, 1, true));
    let names = |views: &[trackersplat_proto::v1::FrameView]| {
        views.iter().map(|view| view.name.clone()).collect::<Vec<_>>()
    };
    assert_eq!(names(&key.training_views), ["cam00", "cam01", "cam02"]);
    assert_eq!(names(&key.test_views), ["test00"]);
    assert!(key.settings_json.contains(r#""motion_source":"none""#), "{}", key.settings_json);
    let view = &key.training_views[1];
    let image = bench.get(&view.image.as_ref().unwrap().digest).await.unwrap();
    assert_eq!(image, std::fs::read(bench.folder.path().join("clip/images/cam01/frame_0001.png")).unwrap());
    let camera = view.camera.as_ref().unwrap();
    // The clip's OpenGL axes look along -z, ours along +z.
    assert_eq!(camera.rotation, [1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0]);
    assert_eq!((camera.width, camera.height, camera.fx), (8, 6, 10.0));
    let mut second = bench.worker("v").await;
    assert!(!frame_job(&second.lease().await).key_frame);
}

#[tokio::test]
async fn the_same_submission_is_the_same_job_and_another_output_reuses_its_results() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let again = bench.submit(bench.request()).await.unwrap();
    assert_eq!((again.job_id.as_str(), again.resumed), (job.as_str(), true));
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    drop(worker);

    // No worker is connected any more.
    let elsewhere = SubmitRequest { output: bench.path("elsewhere"), ..bench.request() };
    let second = bench.submit(elsewhere).await.unwrap();
    assert!(!second.resumed && second.job_id != job);
    assert_eq!(bench.ended(&second.job_id).await.0, JobState::Done);
}

#[tokio::test]
async fn a_cancelled_job_stops_its_workers_and_goes_on_when_submitted_again() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    assert_eq!(worker.work_once(&bench).await, 1);
    let lease = worker.lease().await;
    for _ in 0..2 {
        let request = CancelRequest { job_id: job.clone() };
        let state = within(bench.jobs().cancel(request)).await.unwrap().into_inner().state();
        assert_eq!(state, JobState::Cancelled, "cancelling twice changes nothing");
    }
    match worker.receive().await.unwrap() {
        coordinator_message::Message::CancelLease(cancel) => assert_eq!(cancel.lease_id, lease.lease_id),
        other => panic!("{other:?}"),
    }
    let success = bench.result(&lease).await;
    let late = worker.report(&lease, trackersplat_proto::v1::report::Outcome::Success(success)).await;
    assert!(!late.accepted, "the lease is gone");
    assert_eq!(bench.ended(&job).await.0, JobState::Cancelled);

    assert!(bench.submit(bench.request()).await.unwrap().resumed);
    assert_eq!([worker.work_once(&bench).await, worker.work_once(&bench).await], [2, 3], "frame 1 is kept");
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn impossible_submissions_are_refused_and_touch_nothing() {
    let bench = Bench::start().await;
    let refusal = async |request: SubmitRequest| {
        let status = bench.submit(request).await.unwrap_err();
        (status.code(), status.message().to_owned())
    };
    let base = bench.request();

    let request = SubmitRequest { settings_json: r#"{"sede": 1}"#.into(), ..base.clone() };
    let (code, message) = refusal(request).await;
    assert!(code == Code::InvalidArgument && message.contains("sede"), "{message}");
    let (code, message) = refusal(SubmitRequest { clip: bench.path("no-clip"), ..base.clone() }).await;
    assert!(code == Code::InvalidArgument && message.contains("no-clip"), "{message}");
    let request = SubmitRequest { static_model: bench.path("no.ply"), ..base.clone() };
    let (code, message) = refusal(request).await;
    assert!(code == Code::InvalidArgument && message.contains("no.ply"), "{message}");
    let request = SubmitRequest { first_frame: 3, last_frame: 2, ..base.clone() };
    assert_eq!(refusal(request).await.0, Code::InvalidArgument);
    // A folder below a file cannot be made, not even by root.
    let (code, message) =
        refusal(SubmitRequest { output: bench.path("static.ply/out"), ..base.clone() }).await;
    assert!(code == Code::FailedPrecondition && message.contains("static.ply/out"), "{message}");
    assert_eq!(bench.jobs().list(ListRequest {}).await.unwrap().into_inner().jobs, []);
    assert!(!bench.folder.path().join("out").exists());

    for (code, status) in [
        (Code::NotFound, bench.jobs().cancel(CancelRequest { job_id: "none".into() }).await.unwrap_err()),
        (
            Code::NotFound,
            bench
                .jobs()
                .watch(WatchRequest { job_id: "none".into(), ..Default::default() })
                .await
                .unwrap_err(),
        ),
        (
            Code::NotFound,
            bench
                .jobs()
                .fetch(FetchRequest { job_id: "none".into(), ..Default::default() })
                .await
                .unwrap_err(),
        ),
    ] {
        assert_eq!(status.code(), code);
    }
}

#[tokio::test]
async fn the_output_folder_of_another_clip_is_refused_by_both_names() {
    let bench = Bench::start().await;
    bench.submitted().await;
    let marker = bench.folder.path().join("out/trackersplat.json");
    let before = std::fs::read(&marker).unwrap();
    write_clip(&bench.folder.path().join("other"), 100);
    let request = SubmitRequest { clip: bench.path("other"), ..bench.request() };
    let status = bench.submit(request).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    for name in ["clip", "other", "out"] {
        assert!(status.message().contains(&bench.path(name)), "{name}: {status}");
    }
    let seeded = r#"{"motion_source": "none", "seed": 1}"#.to_owned();
    let status = bench.submit(SubmitRequest { settings_json: seeded, ..bench.request() }).await.unwrap_err();
    assert!(
        status.code() == Code::FailedPrecondition && status.message().contains("other settings"),
        "{status}"
    );
    assert_eq!(std::fs::read(&marker).unwrap(), before);
}

#[tokio::test]
async fn bad_input_fails_the_job_before_any_frame_is_leased() {
    let bench = Bench::start().await;
    let image = bench.folder.path().join("clip/images/cam01/frame_0002.png");
    let whole = std::fs::read(&image).unwrap();
    std::fs::write(&image, &whole[..whole.len() / 2]).unwrap();
    let job = bench.submitted().await;
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("cam01"), "{}", failure.message);

    let small = splat::image::Image::filled(4, 3, [0.5; 3]).encode_png();
    std::fs::write(&image, small).unwrap();
    let request = SubmitRequest { output: bench.path("out2"), ..bench.request() };
    // Opening or reading the clip may find it first; either way it is named.
    let message = match bench.submit(request).await {
        Ok(response) => bench.ended(&response.job_id).await.1.unwrap().message,
        Err(status) => status.message().to_owned(),
    };
    assert!(message.contains("cam01") && message.contains('4') && message.contains('8'), "{message}");
}

#[tokio::test]
async fn a_static_model_with_nan_fails_the_job_and_names_the_file() {
    let bench = Bench::start().await;
    let mut model = model(0.0);
    model.means[1][2] = f32::NAN;
    std::fs::write(bench.folder.path().join("nan.ply"), ply::write_ply(&model)).unwrap();
    let request = SubmitRequest { static_model: bench.path("nan.ply"), ..bench.request() };
    let job = bench.submit(request).await.unwrap().job_id;
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("nan.ply"), "{}", failure.message);
    let events = bench.watch(&job, 0).await.rest().await;
    let frame_done = |event: &Event| matches!(event, Event::FrameState(f) if f.state() == TaskState::Done);
    assert!(!events.iter().filter_map(|event| event.event.as_ref()).any(frame_done));
}

#[tokio::test]
async fn tracks_lead_from_the_key_frame_to_every_other_frame_of_the_training_views() {
    let in_frames =
        |event: &Event| matches!(event, Event::JobState(changed) if changed.state() == JobState::Frames);
    let bench = Bench::start().await;
    let request = SubmitRequest { settings_json: String::new(), ..bench.request() };
    let job = bench.submit(request.clone()).await.unwrap().job_id;
    bench.watch(&job, 0).await.until(in_frames).await;
    let (mut first, mut second) = (bench.worker("a").await, bench.worker("b").await);
    let key = frame_job(&first.lease().await);
    assert!(key.key_frame && key.training_views.iter().all(|view| view.tracks.is_none()));
    let other = frame_job(&second.lease().await);
    assert!(other.test_views.iter().all(|view| view.tracks.is_none()));
    let mut digests = Vec::new();
    for view in &other.training_views {
        let digest = view.tracks.as_ref().unwrap().digest.clone();
        let field = splat::formats::track_blob::decode(&bench.get(&digest).await.unwrap()).unwrap();
        assert_eq!((field.width, field.height, field.positions.len()), (8, 6, 48));
        digests.push(digest);
    }
    drop((first, second));

    // The same clip with the same tracking settings uses the same tracks.
    let seeded =
        SubmitRequest { settings_json: r#"{"seed": 1}"#.into(), output: bench.path("out2"), ..request };
    let seeded = bench.submit(seeded).await.unwrap().job_id;
    let mut watch = bench.watch(&seeded, 0).await;
    watch
        .until(|event| {
            assert!(!matches!(event, Event::Progress(p) if p.stage == "tracking"), "tracked again");
            in_frames(event)
        })
        .await;
}

#[tokio::test]
async fn exact_tracks_that_the_clip_lacks_are_refused_by_file_name() {
    let bench = Bench::start().await;
    let tracks = trackersplat_proto::v1::submit_request::Tracks::ExactTracks(Default::default());
    let request = SubmitRequest { settings_json: String::new(), tracks: Some(tracks), ..bench.request() };
    let status = bench.submit(request.clone()).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().contains("flow/cam00.npz"), "{status}");
    let untracked = SubmitRequest { settings_json: bench.request().settings_json, ..request };
    bench.submit(untracked).await.expect("a job without motion needs no tracks");
}
