//! Tracks beside frames: who goes first, own leases, windows.

use super::*;

fn tracks(position: u32) -> TaskKey {
    TaskKey { job: "job".into(), task: Task::Tracks(position) }
}

fn lease_own(bench: &mut Bench) -> Option<Lease> {
    bench.leases += 1;
    bench.queue.lease_own("job", bench.now, format!("lease-{}", bench.leases))
}

#[test]
fn tracks_go_before_the_frames_of_their_job_and_after_those_of_earlier_jobs() {
    let mut bench = Bench::new([1, 2]);
    bench.queue.add(tracks(5), TaskHistory::default());
    bench.queue.add(tracks(3), TaskHistory::default());
    bench.queue.add(TaskKey { job: "earlier".into(), task: Task::Frame(9) }, TaskHistory::default());
    for session in 1..=6 {
        bench.connect(session, &format!("w{session}"));
    }
    let order: Vec<Task> = bench.assign().into_iter().map(|lease| lease.key.task).collect();
    let expected = [Task::Frame(9), Task::Tracks(3), Task::Tracks(5), Task::Frame(1), Task::Frame(2)];
    assert_eq!(order, expected, "the sixth worker waits");
}

#[test]
fn the_coordinator_tracks_itself_only_what_no_connected_worker_may() {
    let mut bench = Bench::new([1]);
    bench.queue.add(tracks(0), TaskHistory::default());
    bench.queue.add(tracks(1), TaskHistory::default());
    bench.queue.add(tracks(2), TaskHistory::default());
    assert_eq!(lease_own(&mut bench), None, "a worker may be about to come");
    bench.now += GRACE;
    let own = lease_own(&mut bench).expect("nobody is connected");
    assert_eq!((own.key.clone(), own.worker_id.as_str(), own.session), (tracks(0), OWN_NAME, SessionId::OWN));
    assert!(!bench.queue.has_own_work("another job", bench.now));

    let small = bench.connect(1, "small");
    assert_eq!(lease_own(&mut bench), None, "a worker is there");
    let lease = bench.assign_one();
    assert_eq!(lease.key, tracks(1), "what the coordinator has begun is not done twice");
    bench.fail(&lease, FailureKind::OutOfResources);
    assert_eq!(bench.assign_one().key, tracks(2));
    assert_eq!(lease_own(&mut bench).expect("no worker has the memory").key, tracks(1));
    assert_eq!(bench.queue.waiting_tasks("job"), 0);
    bench.lose(small);
    assert_eq!(lease_own(&mut bench), None, "it may come back");
    bench.now += GRACE;
    assert_eq!(lease_own(&mut bench).expect("the worker is gone").key, tracks(2));
    assert_eq!(lease_own(&mut bench), None, "frames are for workers");
    assert_eq!(bench.queue.waiting_tasks("job"), 1);
}

#[test]
fn own_leases_need_no_heartbeat_and_count_as_no_worker() {
    let mut bench = Bench::new([]);
    bench.queue.add(tracks(0), TaskHistory::default());
    bench.now += GRACE;
    let own = lease_own(&mut bench).expect("nobody is connected");
    assert_eq!(bench.queue.expire(bench.now + 100 * LEASE), []);
    assert_eq!((bench.queue.connected(), bench.queue.open_tasks("job")), (0, 1));
    let failed = bench.queue.fail(&own.id, own.attempt, FailureKind::OutOfResources).expect("held");
    assert!(failed.retried);
    assert_eq!(lease_own(&mut bench), None, "it lacks the memory and waits for a worker");
    assert_eq!(bench.queue.waiting_tasks("job"), 1);
    bench.connect(1, "large");
    let lease = bench.assign_one();
    assert_eq!((lease.worker_id.as_str(), lease.attempt), ("large", 2));
    assert!(bench.queue.commit(&lease.id, 2).is_ok());
    assert_eq!(bench.queue.open_tasks("job"), 0);
}

#[test]
fn a_hint_is_given_past_tracks_that_are_given_out_before() {
    let mut bench = Bench::new([1, 2]);
    bench.queue.add(tracks(0), TaskHistory::default());
    bench.queue.add(tracks(1), TaskHistory::default());
    bench.connect(1, "one");
    let lease = bench.assign_one();
    assert_eq!(bench.queue.likely_next(&lease), Some(&tracks(1)));
}

#[test]
fn a_task_that_gets_on_has_all_its_attempts_again() {
    let mut bench = Bench::new([]);
    bench.queue.add(tracks(0), TaskHistory::default());
    bench.connect(1, "w");
    for _ in 0..4 {
        let lease = bench.assign_one();
        bench.queue.progressed(&lease.key);
        assert!(bench.fail(&lease, FailureKind::Transient).retried);
    }
    for retried in [true, false] {
        let lease = bench.assign_one();
        assert_eq!(bench.fail(&lease, FailureKind::Transient).retried, retried);
    }
}

fn before(frame: u32) -> TaskHistory {
    TaskHistory { before: frame, ..TaskHistory::default() }
}

#[test]
fn windows_go_out_view_after_view_and_a_window_ahead_of_the_frames() {
    let mut bench = Bench::new([1, 2, 3, 4]);
    bench.queue.add(tracks(0), before(2));
    bench.queue.add(tracks(1), before(0));
    bench.connect(1, "w");
    let mut order = Vec::new();
    for next in [2, 4, 4, 5, 5, 5, 5, 5] {
        let lease = bench.assign_one();
        order.push(lease.key.task);
        let hint = bench.queue.likely_next(&lease).cloned();
        if let Task::Frame(_) = lease.key.task {
            bench.queue.commit(&lease.id, lease.attempt).expect("it is held");
        } else {
            bench.queue.go_on(&lease.id, lease.attempt, next).expect("it is held");
            assert_ne!(hint, Some(lease.key.clone()), "it is leased");
        }
        bench.queue.park(lease.session);
    }
    let expected = [
        Task::Tracks(1),
        Task::Frame(1),
        Task::Tracks(0),
        Task::Tracks(1),
        Task::Frame(2),
        Task::Frame(3),
        Task::Tracks(0),
        Task::Frame(4),
    ];
    assert_eq!(order, expected);
}

#[test]
fn a_window_that_is_done_is_no_failure_and_its_lease_is_dead() {
    let mut bench = Bench::new([]);
    bench.queue.add(tracks(0), TaskHistory::default());
    bench.connect(1, "w");
    for attempt in 1..=9 {
        let lease = bench.assign_one();
        assert_eq!(lease.attempt, attempt);
        bench.queue.go_on(&lease.id, attempt, attempt).expect("it is held");
        let stale = Err(Stale::NotHeld(lease.id.clone()));
        assert_eq!(bench.queue.go_on(&lease.id, attempt, 0), stale);
        bench.queue.park(lease.session);
    }
    for retried in [true, true, false] {
        let lease = bench.assign_one();
        assert_eq!(bench.fail(&lease, FailureKind::Transient).retried, retried);
    }
}
