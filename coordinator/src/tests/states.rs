#![allow(clippy::unwrap_used, reason = "tests")]
//! The tracker's states between windows: lost, refused, discarded, and not mistaken for each other.

use std::time::Duration;

use splat::{formats::track_state, tracking::TrackState};
use trackersplat_proto::v1::{
    Failure, FailureKind, JobState, Lease, Report, ReportReceipt, SubmitRequest, Tracked,
    coordinator_message, report::Outcome, worker_message,
};

use super::{harness::*, windows::*};
use crate::queue::{Task, TaskKey};

/// What a worker says that gives a window up.
fn failed(lease: &Lease) -> worker_message::Message {
    let failure = Failure { kind: FailureKind::Transient.into(), message: "as the test wants it".into() };
    let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
    let report = Report { lease_id, attempt, outcome: Some(Outcome::Failure(failure)) };
    worker_message::Message::Report(report)
}

async fn receipt(worker: &mut Worker) -> ReportReceipt {
    match worker.receive().await.unwrap() {
        coordinator_message::Message::Receipt(receipt) => receipt,
        other => panic!("{other:?}"),
    }
}

/// Waits until a file is removed.
async fn until_removed(file: &std::path::Path) {
    let removed = async {
        while file.exists() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    within(removed).await;
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
    assert!(receipt.reason.contains("frames [2, 3], the next window needs [1, 2]"), "{}", receipt.reason);
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::Bug));
}

/// A state of a size that it only claims.
fn claiming(width: u32, height: u32, frames: u32) -> Vec<u8> {
    let content = [[width, height, frames].map(u32::to_le_bytes).concat(), vec![0; 20]].concat();
    [&b"TSSTATE"[..], &[track_state::VERSION], blake3::hash(&content).as_bytes(), &content].concat()
}

#[tokio::test]
async fn a_state_that_forgets_frames_or_is_of_another_size_is_refused() {
    let states = [
        (
            track_state::encode(&TrackState::default()),
            "remembers 0 frames of the view, the next window needs 2",
        ),
        (state_of_size((8, 6), "cam00", 2..3), "remembers 1 frames of the view"),
        (state_of_size((24, 16), "cam00", 1..3), "is of 24 x 16 pixels, the view's are of 8 x 6"),
        (claiming(8192, 8192, 2), "is of 8192 x 8192 pixels"),
    ];
    let bench = bench().await;
    let mut worker = bench.worker("w").await;
    bench.submit(request(&bench, 2)).await.unwrap();
    for (view, (state, said)) in ["cam00", "cam00", "cam01", "cam01"].into_iter().zip(states) {
        let mut lease = worker.window(&bench).await;
        while leased(&lease).0 != view {
            worker.finish(&bench, &lease).await;
            lease = worker.window(&bench).await;
        }
        let state = Some(bench.put(state).await);
        let tracked = Tracked { state, ..window(&bench, &lease).await };
        let receipt = worker.report(&lease, Outcome::Tracked(tracked)).await;
        assert!(!receipt.accepted && receipt.reason.contains(said), "{receipt:?}");
    }
}

#[tokio::test]
async fn a_store_that_cannot_be_asked_keeps_its_states() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    let file = state_file(&bench, "cam00", 2);
    let (inside, aside) = (file.parent().unwrap(), bench.folder.path().join("aside"));
    std::fs::rename(inside, &aside).unwrap();
    // A folder that is a file is no answer, as an input or output error is none.
    std::fs::write(inside, b"").unwrap();
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    assert_eq!(track_job(&lease).state, Some(crate::blobs::name(&state_of("cam00", 2))));
    std::fs::remove_file(inside).unwrap();
    std::fs::rename(&aside, inside).unwrap();
    worker.finish(&bench, &lease).await;
    assert_eq!(worker.finish_job(&bench, &job).await.len(), 5);
}

#[tokio::test]
async fn states_that_were_dropped_for_a_defect_are_not_counted_as_lost() {
    let bench = bench().await;
    let (mut worker, job) = after_first_windows(&bench).await;
    remove_state(&bench, "cam00", 2);
    for failures in 0..3 {
        let lease = worker.window(&bench).await;
        assert_eq!(leased(&lease), ("cam00".into(), vec![2, 3]));
        worker.finish(&bench, &lease).await;
        let lease = worker.window(&bench).await;
        assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
        match failures {
            2 => worker.finish(&bench, &lease).await,
            _ => assert!(worker.fail(&lease, FailureKind::Bug).await.accepted),
        }
    }
    assert_eq!(worker.finish_job(&bench, &job).await.len(), 5);
}

#[tokio::test]
async fn a_reported_state_that_is_gone_costs_the_window_and_no_attempt_and_not_for_ever() {
    let bench = bench().await;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    let key = TaskKey { job: job.as_str().into(), task: Task::Tracks(0) };
    for (attempt, failures) in [(1, 0), (2, 0), (3, 1), (4, 2), (5, 3)] {
        let lease = worker.window(&bench).await;
        assert_eq!((leased(&lease), lease.attempt), (("cam00".into(), vec![2, 3]), attempt));
        let tracked = window(&bench, &lease).await;
        // As another job discards the same state between its upload and its report.
        remove_state(&bench, "cam00", 2);
        let receipt = worker.report(&lease, Outcome::Tracked(tracked)).await;
        let said = if failures == 0 { "gone from the store" } else { "check its disk" };
        assert!(!receipt.accepted && receipt.reason.contains(said), "{receipt:?}");
        assert_eq!(bench.hub().store.task(&key).await.unwrap().unwrap().failures, failures);
    }
    let (state, failure) = bench.ended(&job).await;
    assert_eq!((state, failure.unwrap().kind()), (JobState::Failed, FailureKind::Transient));
}

#[tokio::test]
async fn a_discarded_state_is_removed_before_its_row() {
    let bench = bench().await;
    let (_worker, job) = after_first_windows(&bench).await;
    let hub = bench.hub();
    let next_state = |ledger: &crate::ledger::TrackLedger| ledger.next_state(0);
    let state = hub.tracks(&job.as_str().into(), next_state).await.unwrap().unwrap();
    // Nobody else writes to the database meanwhile.
    let change = hub.store.change().await.unwrap();
    let (forgetting, states) = (bench.hub(), [state.clone()]);
    let forgetting = tokio::spawn(async move { forgetting.forget_states(&states).await });
    until_removed(&state_file(&bench, "cam00", 2)).await;
    drop(change);
    within(forgetting).await.unwrap().unwrap();
    assert!(hub.store.artifact(&state.key).await.unwrap().is_none());
}

#[tokio::test]
async fn the_state_of_a_window_that_failed_is_read_in_turn() {
    let bench = bench().await;
    let (mut worker, _) = after_first_windows(&bench).await;
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    let hub = bench.hub();
    let turn = hub.turn_to_read_a_state().await;
    worker.send(failed(&lease)).await;
    // Who reads out of turn has ended by then.
    let early = tokio::time::timeout(Duration::from_millis(300), worker.receive()).await;
    assert!(early.is_err(), "{early:?}");
    drop(turn);
    assert!(receipt(&mut worker).await.accepted);
}

#[tokio::test]
async fn a_damaged_state_is_removed_before_its_row() {
    let bench = bench().await;
    let (mut worker, _) = after_first_windows(&bench).await;
    let lease = worker.window(&bench).await;
    assert_eq!(leased(&lease), ("cam00".into(), vec![4, 5]));
    let file = state_file(&bench, "cam00", 2);
    std::fs::write(&file, vec![7; std::fs::metadata(&file).unwrap().len() as usize]).unwrap();
    // Nobody else writes to the database meanwhile.
    let change = bench.hub().store.change().await.unwrap();
    worker.send(failed(&lease)).await;
    until_removed(&file).await;
    drop(change);
    assert!(receipt(&mut worker).await.accepted);
}
