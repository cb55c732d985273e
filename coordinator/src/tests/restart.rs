#![allow(clippy::unwrap_used, reason = "tests")]

use trackersplat_proto::v1::{FailureKind, JobState, TaskState, job_event::Event, report::Outcome};

use super::harness::*;

#[tokio::test]
async fn a_restarted_coordinator_goes_on_and_computes_no_finished_frame_twice() {
    let mut bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    assert_eq!(worker.work_once(&bench).await, 1);
    let lease = worker.lease().await;
    assert_eq!(frame_job(&lease).frame, 2);
    let success = bench.result(&lease).await;
    let mut watch = bench.watch(&job, 0).await;
    let seen = watch
        .until(
            |event| matches!(event, Event::FrameState(f) if f.frame == 2 && f.state() == TaskState::Leased),
        )
        .await;
    bench.stop().await;
    bench.restart().await;

    let mut worker = bench.worker("w").await;
    let stale = worker.report(&lease, Outcome::Success(success)).await;
    assert!(!stale.accepted, "leases of a coordinator that is gone are void");
    let again = worker.lease().await;
    assert_eq!((frame_job(&again).frame, again.attempt), (2, 2));
    let success = bench.result(&again).await;
    assert!(worker.report(&again, Outcome::Success(success)).await.accepted);
    assert_eq!(worker.work_once(&bench).await, 3);
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    let rest = bench.watch(&job, seen.sequence).await.rest().await;
    let sequences: Vec<u64> = stored(&rest).iter().map(|event| event.sequence).collect();
    let expected: Vec<u64> = (seen.sequence + 1..).take(sequences.len()).collect();
    assert_eq!(sequences, expected, "the numbers go on across the restart");
    let all = bench.watch(&job, 0).await.rest().await;
    let done_twice = |frame| {
        let done = |event: &&trackersplat_proto::v1::JobEvent| matches!(&event.event, Some(Event::FrameState(f)) if f.frame == frame && f.state() == TaskState::Done);
        all.iter().filter(done).count() != 1
    };
    assert!(![1, 2, 3].into_iter().any(done_twice));
}

#[tokio::test]
async fn an_ended_job_stays_ended_and_a_removed_result_is_put_together_again() {
    let mut bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    bench.stop().await;
    bench.restart().await;
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    std::fs::remove_dir_all(bench.folder.path().join("out")).unwrap();
    let again = bench.submit(bench.request()).await.unwrap();
    assert_eq!((again.job_id.as_str(), again.resumed), (job.as_str(), true));
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    assert!(bench.folder.path().join("out/trackersplat.json").exists());
}

#[tokio::test]
async fn a_watching_client_is_told_that_the_coordinator_shuts_down() {
    let mut bench = Bench::start().await;
    let job = bench.submitted().await;
    let request = trackersplat_proto::v1::WatchRequest { job_id: job, after_sequence: 0 };
    let mut events = bench.jobs().watch(request).await.unwrap().into_inner();
    let drain = tokio::spawn(async move {
        loop {
            match events.message().await {
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(status) => return Some(status.code()),
            }
        }
    });
    bench.stop().await;
    assert_eq!(within(drain).await.unwrap(), Some(tonic::Code::Unavailable));
}

#[tokio::test]
async fn a_second_coordinator_on_the_same_folder_is_refused_until_the_first_has_ended() {
    let mut bench = Bench::start().await;
    let refused = bench.try_second().await.unwrap_err();
    assert!(matches!(refused, crate::ServeError::InUse { .. }), "{refused}");
    bench.stop().await;
    bench.restart().await;
}

#[tokio::test]
async fn a_job_with_unreadable_settings_fails_alone() {
    let mut bench = Bench::start().await;
    bench.stop().await;
    let store = crate::store::Store::open(&bench.options.root.join("state.sqlite")).await.unwrap();
    let job = crate::store::NewJob {
        id: "a".into(),
        clip: bench.path("clip"),
        clip_digest: "c".into(),
        output: bench.path("unreadable"),
        output_request: bench.path("unreadable"),
        settings: r#"{"of another version": 1}"#.into(),
        settings_digest: "s".into(),
        request: "{}".into(),
        frame_numbers: "[1]".into(),
    };
    let mut change = store.change().await.unwrap();
    change.insert_job(&job).await.unwrap();
    change.commit().await.unwrap();
    store.close().await;

    bench.restart().await;
    let (state, failure) = bench.ended("a").await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("jobs.settings"), "{}", failure.message);
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done, "the coordinator goes on");
}

#[tokio::test]
async fn a_result_that_is_gone_from_the_store_is_computed_again() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    let success = bench.result(&lease).await;
    let lost = success.delta.clone().unwrap().digest;
    assert!(worker.report(&lease, Outcome::Success(success)).await.accepted);
    for _ in 0..2 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    std::fs::remove_file(bench.options.root.join("blobs").join(&lost[..2]).join(&lost)).unwrap();
    std::fs::remove_dir_all(bench.folder.path().join("out")).unwrap();
    assert!(bench.submit(bench.request()).await.unwrap().resumed);
    assert_eq!(worker.work_once(&bench).await, 1);
    assert_eq!(bench.ended(&job).await.0, JobState::Done, "the other frames stayed done");
    assert!(bench.folder.path().join("out/frames/frame_0001.ply").exists());
}
