#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::BTreeSet,
    time::{Duration, Instant},
};

use trackersplat_proto::v1::{Blob, Failure, FailureKind, FrameJob, Register, job_event::Event};

use super::*;
use crate::queue::{Lease, Queue, QueuePolicy, SessionId, Task, TaskKey, job::JobState, task::TaskState};

async fn open(folder: &tempfile::TempDir) -> Store {
    Store::open(&folder.path().join("state.sqlite")).await.unwrap()
}

fn new_job(id: &str) -> NewJob {
    NewJob {
        id: id.into(),
        clip: "/clip".into(),
        clip_digest: "c".into(),
        output: format!("/out/{id}"),
        output_request: id.into(),
        settings: "{}".into(),
        settings_digest: "s".into(),
        request: "{}".into(),
        frame_numbers: "[1,2,3]".into(),
    }
}

/// Leases as the queue makes them.
fn lease(job: &str, frame: u32, attempts: u32) -> Lease {
    let lease_duration = Duration::from_secs(1);
    let policy = QueuePolicy { max_attempts: 3, lease_duration, reconnect_grace: Duration::ZERO };
    let mut queue = Queue::new(policy, Instant::now());
    let history = crate::queue::TaskHistory { attempts, ..Default::default() };
    queue.add(TaskKey { job: job.into(), task: Task::Frame(frame) }, history);
    let worker = Register { worker_id: "w".into(), ..Register::default() };
    queue.connect(SessionId(1), &worker, Instant::now());
    queue.park(SessionId(1));
    queue.assign(Instant::now(), || format!("lease-{job}-{frame}-{attempts}")).remove(0)
}

/// A job with three ready frames.
async fn publish(store: &Store, id: &str) {
    let mut change = store.change().await.unwrap();
    change.insert_job(&new_job(id)).await.unwrap();
    for frame in 1..=3 {
        let request = FrameJob { job_id: id.into(), frame, ..FrameJob::default() };
        change.publish_frame(&request, &format!("key-{frame}")).await.unwrap();
        change.append_ready_event(id, Task::Frame(frame)).await.unwrap();
    }
    change.commit().await.unwrap();
}

#[tokio::test]
async fn a_reopened_file_holds_what_was_committed_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let delta = Blob { digest: "d".into(), size: 7 };
    {
        let store = open(&folder).await;
        publish(&store, "a").await;
        let mut change = store.change().await.unwrap();
        change.grant(&lease("a", 1, 0)).await.unwrap();
        let stage_seconds = [("refine".to_owned(), 0.5)].into();
        let result = CommittedFrame {
            delta: &delta,
            report: "{}",
            worker: "w",
            seconds: 1.5,
            stage_seconds: &stage_seconds,
        };
        change.commit_frame("a", 1, &result).await.unwrap();
        change.end_attempt("lease-a-1-0", AttemptOutcome::Done).await.unwrap();
        change.set_job_state("a", JobState::Frames, None).await.unwrap();
        change.commit().await.unwrap();
        let mut dropped = store.change().await.unwrap();
        dropped.set_job_state("a", JobState::Done, None).await.unwrap();
        drop(dropped);
        store.close().await;
    }
    let store = open(&folder).await;
    let job = store.job("a").await.unwrap().unwrap();
    assert_eq!(job.state().unwrap(), JobState::Frames);
    assert_eq!(job.frame_numbers().unwrap(), [1, 2, 3]);
    let frames = store.frames("a").await.unwrap();
    let states: Vec<TaskState> = frames.iter().map(|frame| frame.state().unwrap()).collect();
    assert_eq!(states, [TaskState::Done, TaskState::Ready, TaskState::Ready]);
    assert_eq!(frames[0].delta(), Some(delta));
    assert_eq!((frames[0].task.seconds, frames[0].stage_seconds()["refine"]), (1.5, 0.5));
    assert_eq!(frames[1].request().unwrap().frame, 2);
    assert!(store.was_committed("lease-a-1-0", 1).await.unwrap());
    assert!(!store.was_committed("lease-a-1-0", 2).await.unwrap());
}

#[tokio::test]
async fn a_change_that_comes_after_the_end_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(&folder).await;
    store.close().await;
    let error = store.change().await.err().unwrap();
    assert!(error.is_closed(), "{error}");
}

#[tokio::test]
async fn events_count_up_from_one_per_job_without_gaps() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(&folder).await;
    publish(&store, "a").await;
    publish(&store, "b").await;
    // A change that is given up leaves no gap.
    let mut dropped = store.change().await.unwrap();
    dropped.append_job_event("a", JobState::Done, None).await.unwrap();
    drop(dropped);
    let failure = Failure { kind: FailureKind::BadInput.into(), message: "cam00 is truncated".into() };
    let mut change = store.change().await.unwrap();
    change.append_job_event("a", JobState::Failed, Some(&failure)).await.unwrap();
    change.commit().await.unwrap();

    let events = store.events_after("a", 0, 100).await.unwrap();
    let sequences: Vec<u64> = events.iter().map(|event| event.sequence).collect();
    assert_eq!(sequences, [1, 2, 3, 4]);
    let Some(Event::JobState(last)) = &events[3].event else { panic!("{events:?}") };
    assert_eq!(last.failure, Some(failure));
    let later = store.events_after("a", 2, 1).await.unwrap();
    assert_eq!(later, events[2..3]);
    assert_eq!(store.job("a").await.unwrap().unwrap().last_sequence(), 4);
    assert_eq!(store.events_after("b", 3, 100).await.unwrap(), []);
}

#[tokio::test]
async fn leases_of_a_coordinator_that_is_gone_are_found_and_void() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(&folder).await;
    publish(&store, "a").await;
    let mut change = store.change().await.unwrap();
    change.grant(&lease("a", 2, 0)).await.unwrap();
    change.commit().await.unwrap();
    store.close().await;

    let store = open(&folder).await;
    let mut change = store.change().await.unwrap();
    let orphans = change.orphaned_leases().await.unwrap();
    let key = TaskKey { job: "a".into(), task: Task::Frame(2) };
    let orphan = OrphanedLease { id: "lease-a-2-0".into(), key: key.clone(), attempt: 1, worker: "w".into() };
    assert_eq!(orphans, [orphan]);
    change.end_attempt("lease-a-2-0", AttemptOutcome::Released("restart")).await.unwrap();
    change.release_task(&key, 1, "w").await.unwrap();
    assert_eq!(change.orphaned_leases().await.unwrap(), []);
    change.commit().await.unwrap();
    let frame = store.frame("a", 2).await.unwrap().unwrap();
    assert_eq!(frame.state().unwrap(), TaskState::Ready);
    let history = frame.history().unwrap();
    assert_eq!((history.attempts, history.failures), (1, 0), "a restart is not the frame's fault");
}

#[tokio::test]
async fn failures_and_excluded_workers_are_kept_until_the_job_is_submitted_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(&folder).await;
    publish(&store, "a").await;
    let mut change = store.change().await.unwrap();
    for (attempt, worker) in [(0, "it's \"small\""), (1, "tiny")] {
        let lease = lease("a", 1, attempt);
        change.grant(&lease).await.unwrap();
        let outcome = AttemptOutcome::Failed(FailureKind::OutOfResources, "1 GiB");
        change.end_attempt(&lease.id, outcome).await.unwrap();
        change.count_failure("a", Task::Frame(1), Some(worker)).await.unwrap();
    }
    change.count_failure("a", Task::Frame(1), None).await.unwrap();
    change.set_task_state("a", Task::Frame(1), TaskState::Failed).await.unwrap();
    change.commit().await.unwrap();
    let history = store.frame("a", 1).await.unwrap().unwrap().history().unwrap();
    let excluded = BTreeSet::from(["it's \"small\"".to_owned(), "tiny".to_owned()]);
    assert_eq!((history.attempts, history.failures, history.excluded), (2, 3, excluded));
    let last = store.last_failure("a", Task::Frame(1)).await.unwrap();
    assert_eq!(last, Some((FailureKind::OutOfResources, "1 GiB".to_owned())));

    let mut change = store.change().await.unwrap();
    change.reopen_tasks("a").await.unwrap();
    change.commit().await.unwrap();
    let history = store.frame("a", 1).await.unwrap().unwrap().history().unwrap();
    assert_eq!((history.attempts, history.failures, history.excluded.len()), (2, 0, 0));
}

#[tokio::test]
async fn artifacts_workers_and_counts_are_remembered() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(&folder).await;
    publish(&store, "a").await;
    let artifact = Artifact { blob: Blob { digest: "x".into(), size: 5 }, note: "{}".into() };
    let register = Register { worker_id: "w".into(), device: "2 threads".into(), ..Register::default() };
    let mut change = store.change().await.unwrap();
    change.put_artifact("k", "tracks", &artifact).await.unwrap();
    change.worker_connected(&register).await.unwrap();
    change.set_task_state("a", Task::Frame(3), TaskState::Failed).await.unwrap();
    change.add_stage_seconds("a", "tracking", 1.0).await.unwrap();
    change.add_stage_seconds("a", "tracking", 0.5).await.unwrap();
    change.commit().await.unwrap();
    assert_eq!(store.artifact("k").await.unwrap(), Some(artifact));
    assert_eq!(store.artifact("none").await.unwrap(), None);
    assert!(store.workers().await.unwrap()[0].connected);
    let summaries = store.summaries().await.unwrap();
    assert_eq!((summaries[0].done, summaries[0].failed), (0, 1));
    assert_eq!(store.stage_seconds("a").await.unwrap()["tracking"], 1.5);
    assert!(summaries[0].job.submitted_at.ends_with('Z') && summaries[0].job.submitted_at.contains('T'));
    let same = store.same_job("c", "s", "a").await.unwrap().map(|job| job.id);
    assert_eq!(same.as_deref(), Some("a"));
}
