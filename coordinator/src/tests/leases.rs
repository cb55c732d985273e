#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Duration;

use tonic::Code;
use trackersplat_proto::v1::{
    Blob, FailureKind, GoingAway, Heartbeat, JobState, Register, Report, Success, TaskState,
    coordinator_message, job_event::Event, report::Outcome, worker_message,
};

use super::harness::*;

#[tokio::test]
async fn a_worker_of_another_version_or_without_a_name_is_refused() {
    let bench = Bench::start().await;
    let refusal = async |first| {
        let channel = bench.channel.clone().unwrap();
        match Worker::say(channel, first).await {
            Ok(_) => panic!("not refused"),
            Err(status) => status,
        }
    };
    let old = Register { version: "0.0.1".into(), ..register("w") };
    let status = refusal(worker_message::Message::Register(old)).await;
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(
        status.message().contains("0.0.1") && status.message().contains(env!("CARGO_PKG_VERSION")),
        "{status}"
    );
    let status = refusal(worker_message::Message::Register(register("../w"))).await;
    assert_eq!(status.code(), Code::InvalidArgument);
    let status = refusal(worker_message::Message::Heartbeat(Heartbeat::default())).await;
    assert_eq!(status.code(), Code::InvalidArgument);
}

#[tokio::test]
async fn a_lease_request_waits_until_there_is_work() {
    let bench = Bench::start().await;
    let mut worker = bench.worker("w").await;
    worker.ask().await;
    assert_eq!(worker.welcome.heartbeat_interval_ms, 20);
    let job = bench.submitted().await;
    assert_eq!(frame_job(&worker.leased().await).job_id, job);
}

#[tokio::test]
async fn stale_reports_are_refused_and_harm_nothing() {
    let bench = Bench::start().await;
    bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let success = bench.result(&lease).await;

    let other_attempt = trackersplat_proto::v1::Lease { attempt: 2, ..lease.clone() };
    let receipt = worker.report(&other_attempt, Outcome::Success(success.clone())).await;
    assert!(!receipt.accepted && receipt.reason.contains("attempt"), "{receipt:?}");
    let unknown = trackersplat_proto::v1::Lease { lease_id: "made-up".into(), ..lease.clone() };
    assert!(!worker.report(&unknown, Outcome::Success(success.clone())).await.accepted);
    assert!(!worker.fail(&unknown, FailureKind::BadInput).await.accepted);
    let mut thief = bench.worker("v").await;
    let receipt = thief.report(&lease, Outcome::Success(success.clone())).await;
    assert!(!receipt.accepted && receipt.reason.contains("another worker"), "{receipt:?}");

    assert!(worker.report(&lease, Outcome::Success(success.clone())).await.accepted);
    let repeated = worker.report(&lease, Outcome::Success(success)).await;
    assert!(repeated.accepted, "its receipt may have been lost");
    assert!(!worker.fail(&lease, FailureKind::Bug).await.accepted, "a committed frame does not fail");
}

#[tokio::test]
async fn a_silent_workers_lease_expires_and_its_report_is_refused() {
    let bench = Bench::start_with(|options| {
        options.heartbeat_interval = Duration::from_millis(20);
        options.lease_duration = Duration::from_millis(200);
    })
    .await;
    let job = bench.submitted().await;
    let mut silent = bench.worker("silent").await;
    let lease = silent.lease().await;
    let mut watch = bench.watch(&job, 0).await;
    let failure = watch.frame(1, TaskState::Ready).await.unwrap();
    assert_eq!(failure.kind(), FailureKind::LostWorker);
    assert!(failure.message.contains("silent"), "{}", failure.message);
    match silent.receive().await.unwrap() {
        coordinator_message::Message::CancelLease(cancel) => assert_eq!(cancel.lease_id, lease.lease_id),
        other => panic!("{other:?}"),
    }
    let success = bench.result(&lease).await;
    let late = silent.report(&lease, Outcome::Success(success)).await;
    assert!(!late.accepted && late.reason.contains("not held"), "{late:?}");
}

#[tokio::test]
async fn heartbeats_are_progress_and_a_stale_one_is_answered_with_cancel() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let mut watch = bench.watch(&job, 0).await;
    let heartbeat = |lease_id: &str| {
        let lease_id = lease_id.to_owned();
        worker_message::Message::Heartbeat(Heartbeat {
            lease_id,
            attempt: 1,
            stage: "refine".into(),
            done: 3,
            total: 9,
        })
    };
    // Workers send one again and again; one alone may be dropped before the watch has begun.
    watch.until(|event| matches!(event, Event::Workers(_))).await;
    worker.send(heartbeat(&lease.lease_id)).await;
    let seen = watch.until(|event| matches!(event, Event::Progress(p) if p.stage == "refine")).await;
    let Some(Event::Progress(progress)) = seen.event else { panic!("{seen:?}") };
    assert_eq!((progress.frame, progress.done, progress.total, progress.worker_id.as_str()), (1, 3, 9, "w"));
    worker.send(heartbeat("made-up")).await;
    match worker.receive().await.unwrap() {
        coordinator_message::Message::CancelLease(cancel) => assert_eq!(cancel.lease_id, "made-up"),
        other => panic!("{other:?}"),
    }
    let success = bench.result(&lease).await;
    assert!(
        worker.report(&lease, Outcome::Success(success)).await.accepted,
        "the stale heartbeat did no harm"
    );
}

#[tokio::test]
async fn a_broken_stream_gives_the_frame_to_another_worker_after_the_grace() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut lost = bench.worker("lost").await;
    assert_eq!(lost.lease().await.attempt, 1);
    let mut other = bench.worker("other").await;
    drop(lost);
    let mut watch = bench.watch(&job, 0).await;
    let failure = watch.frame(1, TaskState::Ready).await.unwrap();
    assert_eq!(failure.kind(), FailureKind::LostWorker);
    assert!(failure.message.contains("lost broke"), "{}", failure.message);
    let lease = other.lease().await;
    assert_eq!((frame_job(&lease).frame, lease.attempt), (1, 2));
}

#[tokio::test]
async fn a_worker_that_comes_back_keeps_its_lease_and_its_result_counts() {
    let bench = Bench::start_with(|options| options.reconnect_grace = Duration::from_secs(60)).await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let success = bench.result(&lease).await;
    drop(worker);
    let held = Register { held_lease_id: lease.lease_id.clone(), ..register("w") };
    let again = worker_message::Message::Register(held);
    let mut worker = Worker::say(bench.channel.clone().unwrap(), again).await.unwrap();
    assert!(worker.report(&lease, Outcome::Success(success)).await.accepted);
    let mut watch = bench.watch(&job, 0).await;
    let done = |event: &Event| matches!(event, Event::FrameState(f) if f.state() == TaskState::Done);
    let Some(Event::FrameState(done)) = watch.until(done).await.event else { panic!("not a frame") };
    assert_eq!((done.frame, done.attempt), (1, 1));
}

#[tokio::test]
async fn bad_results_are_refused_and_three_of_them_fail_the_frame_and_the_job() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let garbage = bench.put(b"no delta at all".to_vec()).await;
    let absent = Blob { digest: "ab".repeat(32), size: 3 };
    for (attempt, delta) in [(1, Some(garbage)), (2, Some(absent)), (3, None)] {
        let lease = worker.lease().await;
        assert_eq!((lease.attempt, frame_job(&lease).frame), (attempt, 1));
        let honest = bench.result(&lease).await;
        let receipt = worker.report(&lease, Outcome::Success(Success { delta, ..honest })).await;
        assert!(!receipt.accepted && !receipt.reason.is_empty(), "{receipt:?}");
    }
    assert_eq!([worker.work_once(&bench).await, worker.work_once(&bench).await], [2, 3], "the others go on");
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!(state, JobState::Failed);
    assert!(failure.message.contains("1 of 3 frames failed: [1]"), "{}", failure.message);
}

#[tokio::test]
async fn an_output_folder_that_takes_no_file_fails_the_job_and_costs_no_result() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let success = bench.result(&lease).await;
    // Nothing can be made below a file, not even by root.
    let blocked = bench.folder.path().join("out/deltas");
    std::fs::write(&blocked, b"").unwrap();
    let report =
        Report { lease_id: lease.lease_id, attempt: lease.attempt, outcome: Some(Outcome::Success(success)) };
    worker.send(worker_message::Message::Report(report)).await;
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::Transient));
    assert!(
        failure.message.contains("out/deltas") && failure.message.contains("same command"),
        "{failure:?}"
    );
    assert!(matches!(worker.receive().await.unwrap(), coordinator_message::Message::CancelLease(_)));
    match worker.receive().await.unwrap() {
        coordinator_message::Message::Receipt(receipt) => assert!(!receipt.accepted),
        other => panic!("{other:?}"),
    }

    std::fs::remove_file(&blocked).unwrap();
    assert!(bench.submit(bench.request()).await.unwrap().resumed);
    assert_eq!([worker.work_once(&bench).await, worker.work_once(&bench).await], [2, 3], "frame 1 is kept");
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn a_delta_of_another_static_model_or_with_nan_is_refused() {
    use splat::gaussians::delta;
    let bench = Bench::start().await;
    bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let honest = bench.result(&lease).await;
    let foreign = delta::encode(&model(0.0), &digest_bytes(&"cd".repeat(32)), &model(1.0));
    let success = Success { delta: Some(bench.put(foreign).await), ..honest.clone() };
    assert!(!worker.report(&lease, Outcome::Success(success)).await.accepted);

    let lease = worker.lease().await;
    let success = Success { report_json: r#"{"before": 3}"#.into(), ..honest };
    let receipt = worker.report(&lease, Outcome::Success(success)).await;
    assert!(!receipt.accepted && receipt.reason.contains("report"), "{receipt:?}");
}

#[tokio::test]
async fn a_failed_attempt_is_tried_again_bad_input_is_not() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    assert!(worker.fail(&lease, FailureKind::Transient).await.accepted);
    let lease = worker.lease().await;
    assert_eq!((frame_job(&lease).frame, lease.attempt), (1, 2));
    assert!(worker.fail(&lease, FailureKind::BadInput).await.accepted);
    assert_eq!(worker.work_once(&bench).await, 2);
    assert_eq!(worker.work_once(&bench).await, 3);
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::BadInput));
}

#[tokio::test]
async fn out_of_resources_goes_to_another_worker_only() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut small = bench.worker("small").await;
    let lease = small.lease().await;
    small.fail(&lease, FailureKind::OutOfResources).await;
    assert_eq!(frame_job(&small.lease().await).frame, 2);
    let mut watch = bench.watch(&job, 0).await;
    watch
        .until(|event| matches!(event, Event::Workers(w) if w.connected == 1 && w.waiting_frames == 1))
        .await;
    let mut large = bench.worker("large").await;
    assert_eq!(frame_job(&large.lease().await).frame, 1);
}

#[tokio::test]
async fn an_embedded_coordinator_gives_up_on_a_frame_that_no_worker_has_memory_for() {
    let bench = Bench::start_with(|options| options.dismiss_workers_when_idle = true).await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        let lease = worker.lease().await;
        worker.fail(&lease, FailureKind::OutOfResources).await;
    }
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::OutOfResources));
}

#[tokio::test]
async fn a_draining_worker_gives_its_frame_back_without_a_failure() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut draining = bench.worker("draining").await;
    draining.lease().await;
    draining.send(worker_message::Message::GoingAway(GoingAway { reason: "SIGTERM".into() })).await;
    let mut watch = bench.watch(&job, 0).await;
    assert_eq!(watch.frame(1, TaskState::Ready).await, None);
    assert_eq!(draining.end().await.map(|status| status.code()), None);
    let lease = bench.worker("other").await.lease().await;
    assert_eq!((frame_job(&lease).frame, lease.attempt), (1, 2));
}

#[tokio::test]
async fn without_workers_the_job_says_that_it_waits() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut watch = bench.watch(&job, 0).await;
    watch
        .until(|event| matches!(event, Event::Workers(w) if w.connected == 0 && w.waiting_frames == 3))
        .await;
    let worker = bench.worker("w").await;
    watch
        .until(|event| matches!(event, Event::Workers(w) if w.connected == 1 && w.waiting_frames == 0))
        .await;
    drop(worker);
    watch
        .until(|event| matches!(event, Event::Workers(w) if w.connected == 0 && w.waiting_frames == 3))
        .await;
    // Who begins to watch now is told as well.
    let mut late = bench.watch(&job, 0).await;
    late.until(|event| matches!(event, Event::Workers(w) if w.waiting_frames == 3)).await;
}

#[tokio::test]
async fn a_second_process_with_the_same_name_replaces_the_first() {
    let bench = Bench::start().await;
    bench.submitted().await;
    let mut first = bench.worker("w").await;
    first.lease().await;
    let mut second = bench.worker("w").await;
    assert_eq!(first.end().await.unwrap().code(), Code::FailedPrecondition);
    let lease = second.lease().await;
    assert_eq!((frame_job(&lease).frame, lease.attempt), (1, 2));
}

#[tokio::test]
async fn embedded_workers_are_dismissed_after_the_last_job() {
    let bench = Bench::start_with(|options| options.dismiss_workers_when_idle = true).await;
    let mut early = bench.worker("early").await;
    early.ask().await;
    let job = bench.submitted().await;
    let lease = early.leased().await;
    let success = bench.result(&lease).await;
    assert!(early.report(&lease, Outcome::Success(success)).await.accepted);
    let mut worker = bench.worker("w").await;
    worker.work_once(&bench).await;
    worker.work_once(&bench).await;
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    for mut worker in [early, worker] {
        match worker.receive().await.unwrap() {
            coordinator_message::Message::Dismiss(_) => {}
            other => panic!("{other:?}"),
        }
    }
}
