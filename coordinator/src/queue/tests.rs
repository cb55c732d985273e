mod tracks;

use super::*;

const LEASE: Duration = Duration::from_secs(10);
const GRACE: Duration = Duration::from_secs(3);

/// A queue with its own clock and lease names, so that no test sleeps.
struct Bench {
    queue: Queue,
    now: Instant,
    leases: u32,
}

impl Bench {
    fn new(frames: impl IntoIterator<Item = u32>) -> Self {
        let policy = QueuePolicy { max_attempts: 3, lease_duration: LEASE, reconnect_grace: GRACE };
        let now = Instant::now();
        let mut queue = Queue::new(policy, now);
        for frame in frames {
            queue.add(key(frame), TaskHistory::default());
        }
        Self { queue, now, leases: 0 }
    }

    fn connect(&mut self, session: u64, worker: &str) -> SessionId {
        let session = SessionId(session);
        self.queue.connect(session, &register(worker, "", ""), self.now);
        self.queue.park(session);
        session
    }

    /// The worker's stream breaks, and it does not come back.
    fn lose(&mut self, session: SessionId) -> Vec<FailedLease> {
        self.queue.disconnect(session, self.now);
        self.queue.expire(self.now + GRACE)
    }

    fn assign(&mut self) -> Vec<Lease> {
        let leases = &mut self.leases;
        self.queue.assign(self.now, || {
            *leases += 1;
            format!("lease-{leases}")
        })
    }

    fn assign_one(&mut self) -> Lease {
        let mut leases = self.assign();
        assert_eq!(leases.len(), 1, "{leases:?}");
        leases.remove(0)
    }

    fn fail(&mut self, lease: &Lease, kind: FailureKind) -> FailedLease {
        let failed = self.queue.fail(&lease.id, lease.attempt, kind).expect("the lease is held");
        self.queue.park(lease.session);
        failed
    }
}

fn register(worker: &str, incarnation: &str, held_lease_id: &str) -> Register {
    Register {
        worker_id: worker.into(),
        incarnation: incarnation.into(),
        held_lease_id: held_lease_id.into(),
        ..Register::default()
    }
}

fn key(frame: u32) -> TaskKey {
    TaskKey { job: "job".into(), task: Task::Frame(frame) }
}

#[test]
fn those_who_began_earlier_will_ask_earlier() {
    let mut bench = Bench::new(1..=5);
    let next = |bench: &Bench, lease: &Lease| bench.queue.likely_next(lease).map(|key| key.task.number());
    bench.connect(1, "one");
    let lease = bench.assign_one();
    assert_eq!(next(&bench, &lease), Some(2), "nobody else works");
    bench.now += Duration::from_secs(1);
    bench.connect(2, "two");
    let lease = bench.assign_one();
    assert_eq!(next(&bench, &lease), Some(4), "worker one takes frame 3 before");
    bench.now += Duration::from_secs(1);
    bench.connect(3, "three");
    let lease = bench.assign_one();
    assert_eq!(next(&bench, &lease), None, "the others take what is left");
}

#[test]
fn workers_that_begin_together_expect_different_frames() {
    let mut bench = Bench::new(1..=5);
    for (session, worker) in [(1, "one"), (2, "two"), (3, "three")] {
        bench.connect(session, worker);
    }
    let leases = bench.assign();
    let next = leases.iter().map(|lease| bench.queue.likely_next(lease).map(|key| key.task.number()));
    assert_eq!(next.collect::<Vec<_>>(), [Some(4), Some(5), None]);
}

#[test]
fn frames_go_out_in_order_to_the_worker_that_asked_first() {
    let mut bench = Bench::new([3, 1, 2]);
    let late = SessionId(1);
    bench.queue.connect(late, &register("late", "", ""), bench.now);
    bench.connect(2, "early");
    bench.queue.park(late);
    let leases = bench.assign();
    let given: Vec<_> =
        leases.iter().map(|lease| (lease.worker_id.as_str(), lease.key.task.number())).collect();
    assert_eq!(given, [("early", 1), ("late", 2)]);
    assert_eq!(bench.assign(), [], "both are busy");
}

#[test]
fn an_earlier_job_goes_first() {
    let mut bench = Bench::new([]);
    bench.queue.add(TaskKey { job: "b".into(), task: Task::Frame(1) }, TaskHistory::default());
    bench.queue.add(TaskKey { job: "a".into(), task: Task::Frame(9) }, TaskHistory::default());
    bench.connect(1, "w");
    assert_eq!(&*bench.assign_one().key.job, "a");
}

#[test]
fn a_worker_holds_one_lease_however_often_it_asks() {
    let mut bench = Bench::new([1, 2]);
    let session = bench.connect(1, "w");
    bench.assign_one();
    bench.queue.park(session);
    assert_eq!(bench.assign(), []);
}

#[test]
fn a_committed_frame_is_closed_and_its_lease_dead() {
    let mut bench = Bench::new([1]);
    bench.connect(1, "w");
    let lease = bench.assign_one();
    assert_eq!(bench.queue.commit(&lease.id, 1).expect("held").key, key(1));
    assert_eq!(bench.queue.open_tasks("job"), 0);
    assert_eq!(bench.queue.commit(&lease.id, 1), Err(Stale::NotHeld(lease.id)));
}

#[test]
fn stale_messages_are_told_apart() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let other = bench.connect(2, "v");
    let lease = bench.assign_one();
    let wrong_attempt = Stale::OtherAttempt { lease_id: lease.id.clone(), held: 1, given: 2 };
    assert_eq!(bench.queue.heartbeat(session, &lease.id, 2, bench.now), Err(wrong_attempt.clone()));
    assert_eq!(bench.queue.begin_report(session, &lease.id, 2), Err(wrong_attempt.clone()));
    assert_eq!(bench.queue.commit(&lease.id, 2), Err(wrong_attempt.clone()));
    assert_eq!(bench.queue.fail(&lease.id, 2, FailureKind::Bug), Err(wrong_attempt));
    let stolen = Stale::OtherWorker(lease.id.clone());
    assert_eq!(bench.queue.heartbeat(other, &lease.id, 1, bench.now), Err(stolen.clone()));
    assert_eq!(bench.queue.begin_report(other, &lease.id, 1), Err(stolen));
    assert_eq!(bench.queue.commit("lease-9", 1), Err(Stale::NotHeld("lease-9".into())));
    assert!(bench.queue.commit(&lease.id, 1).is_ok(), "none of them harmed the lease");
}

#[test]
fn a_silent_lease_expires_at_its_deadline_and_a_heartbeat_moves_it() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    let start = bench.now;
    let almost = LEASE - Duration::from_millis(1);
    assert_eq!(bench.queue.expire(start + almost), []);
    assert!(bench.queue.heartbeat(session, &lease.id, 1, start + almost).is_ok());
    assert_eq!(bench.queue.expire(start + LEASE), []);
    let expired = bench.queue.expire(start + almost + LEASE);
    assert!(expired.len() == 1 && expired[0].retried && expired[0].lease.id == lease.id);
    let late = bench.queue.commit(&lease.id, 1);
    assert_eq!(late, Err(Stale::NotHeld(lease.id)), "its report is refused");
}

#[test]
fn a_lease_does_not_expire_while_its_result_is_verified() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    bench.queue.begin_report(session, &lease.id, 1).expect("held");
    assert_eq!(bench.queue.expire(bench.now + 10 * LEASE), []);
    assert!(bench.queue.commit(&lease.id, 1).is_ok());
}

#[test]
fn a_lease_does_not_expire_while_a_field_of_it_is_verified_nor_before_a_heartbeat_can_be_read() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    let (begun, ended) = (bench.now, bench.now + 10 * LEASE);
    assert!(bench.queue.begin_field(session, &lease.id, 1, begun).is_ok());
    assert_eq!(bench.queue.expire(ended), []);
    bench.queue.end_field(session, &lease.id, ended);
    assert_eq!(bench.queue.expire(ended + LEASE - Duration::from_millis(1)), []);
    assert_eq!(bench.queue.expire(ended + LEASE).len(), 1);
    assert!(bench.queue.begin_field(session, &lease.id, 1, ended).is_err());
}

#[test]
fn a_field_that_nobody_verifies_any_more_is_a_failed_attempt() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    assert!(bench.queue.begin_field(session, &lease.id, 1, bench.now).is_ok());
    let failed = bench.queue.abandon_report(session).expect("its field was being verified");
    assert!(failed.retried && failed.lease.id == lease.id);
}

#[test]
fn who_was_lost_with_a_task_is_as_welcome_as_others_once_it_gets_on() {
    let mut bench = Bench::new([1]);
    let lost = bench.connect(1, "a");
    bench.assign_one();
    bench.lose(lost);
    let heir = bench.connect(2, "b");
    let lease = bench.assign_one();
    bench.queue.progressed(&lease.key);
    bench.queue.go_on(&lease.id, lease.attempt, 0).expect("held");
    bench.connect(3, "a");
    bench.queue.park(heir);
    assert_eq!(bench.assign_one().worker_id, "a", "it asked first");
}

#[test]
fn a_frame_fails_for_good_after_three_failed_attempts() {
    let mut bench = Bench::new([1]);
    bench.connect(1, "w");
    for (attempt, retried) in [(1, true), (2, true), (3, false)] {
        let lease = bench.assign_one();
        assert_eq!(lease.attempt, attempt);
        assert_eq!(bench.fail(&lease, FailureKind::Transient).retried, retried);
    }
    assert_eq!(bench.queue.open_tasks("job"), 0);
    assert_eq!(bench.assign(), []);
}

#[test]
fn bad_input_is_not_tried_again() {
    let mut bench = Bench::new([1]);
    bench.connect(1, "w");
    let lease = bench.assign_one();
    assert!(!bench.fail(&lease, FailureKind::BadInput).retried);
    assert_eq!(bench.queue.open_tasks("job"), 0);
}

#[test]
fn out_of_resources_waits_for_another_worker() {
    let mut bench = Bench::new([1]);
    bench.connect(1, "small");
    let lease = bench.assign_one();
    assert!(bench.fail(&lease, FailureKind::OutOfResources).retried);
    assert_eq!(bench.assign(), [], "the same worker does not get it again");
    assert_eq!(bench.queue.waiting_tasks("job"), 1);
    assert_eq!(bench.queue.frames_beyond_all_workers(), [key(1)]);
    bench.connect(2, "large");
    assert_eq!(bench.queue.frames_beyond_all_workers(), []);
    assert_eq!(bench.assign_one().worker_id, "large");
}

#[test]
fn a_lost_frame_prefers_another_worker_and_takes_the_same_if_it_is_alone() {
    let mut bench = Bench::new([1]);
    let lost = bench.connect(1, "a");
    bench.assign_one();
    assert!(bench.lose(lost)[0].retried);
    bench.connect(2, "a");
    bench.queue.connect(SessionId(3), &register("b", "", ""), bench.now);
    assert_eq!(bench.assign(), [], "b is connected and will ask");
    assert_eq!(bench.lose(SessionId(3)), []);
    let lease = bench.assign_one();
    assert_eq!((lease.worker_id.as_str(), lease.attempt), ("a", 2));
}

#[test]
fn a_draining_worker_gives_its_frame_back_without_a_failure() {
    let mut bench = Bench::new([1]);
    for attempt in 1..=5 {
        let session = bench.connect(attempt.into(), "w");
        assert_eq!(bench.assign_one().attempt, attempt);
        let given_back = bench.queue.drain(session, bench.now).expect("a lease");
        assert_eq!(given_back.attempt, attempt, "attempts count up, so that stale reports are told apart");
    }
    assert_eq!((bench.queue.open_tasks("job"), bench.queue.connected()), (1, 0));
}

#[test]
fn a_cancelled_job_loses_its_leases_and_frames_and_no_other() {
    let mut bench = Bench::new([1, 2]);
    bench.queue.add(TaskKey { job: "other".into(), task: Task::Frame(1) }, TaskHistory::default());
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    let cancelled = bench.queue.cancel_job("job");
    assert_eq!(cancelled.as_slice(), std::slice::from_ref(&lease));
    assert_eq!(bench.queue.cancel_job("job"), []);
    assert_eq!((bench.queue.open_tasks("job"), bench.queue.open_tasks("other")), (0, 1));
    assert!(bench.queue.commit(&lease.id, 1).is_err());
    bench.queue.park(session);
    assert_eq!(&*bench.assign_one().key.job, "other");
}

#[test]
fn a_lease_goes_on_when_its_holder_comes_back_in_time() {
    let mut bench = Bench::new([1]);
    let broken = SessionId(1);
    bench.queue.connect(broken, &register("w", "process", ""), bench.now);
    bench.queue.park(broken);
    let lease = bench.assign_one();
    bench.queue.disconnect(broken, bench.now);
    let back = SessionId(2);
    let soon = bench.now + GRACE - Duration::from_millis(1);
    assert_eq!(bench.queue.expire(soon), []);
    let again = register("w", "process", &lease.id);
    assert_eq!(bench.queue.connect(back, &again, soon), Connected::default());
    assert_eq!(bench.queue.expire(soon + LEASE - Duration::from_millis(1)), [], "a full lease again");
    bench.queue.park(back);
    assert_eq!(bench.assign(), [], "it is busy");
    assert!(bench.queue.heartbeat(broken, &lease.id, 1, soon).is_err(), "the old stream is dead");
    assert!(bench.queue.begin_report(back, &lease.id, 1).is_ok());
    assert!(bench.queue.commit(&lease.id, 1).is_ok());
}

#[test]
fn a_lease_is_lost_when_its_holder_does_not_come_back_or_forgot_it() {
    let returns = [register("w", "process", ""), register("w", "another process", "lease-1")];
    for again in returns {
        let mut bench = Bench::new([1]);
        bench.queue.connect(SessionId(1), &register("w", "process", ""), bench.now);
        bench.queue.park(SessionId(1));
        bench.assign_one();
        let Connected { replaced, lost } = bench.queue.connect(SessionId(2), &again, bench.now);
        assert_eq!(replaced, [SessionId(1)], "its older stream had not been noticed to be broken");
        assert!(lost.len() == 1 && lost[0].retried, "{again:?}");
        assert_eq!(bench.queue.connected(), 1);
    }
    let mut bench = Bench::new([1]);
    let broken = bench.connect(1, "w");
    let lease = bench.assign_one();
    let lost = bench.lose(broken);
    assert!(lost.len() == 1 && lost[0].retried && lost[0].lease.id == lease.id);
}

#[test]
fn a_result_that_is_verified_counts_though_its_stream_broke() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    bench.queue.begin_report(session, &lease.id, 1).expect("held");
    assert_eq!(bench.lose(session), []);
    assert_eq!(bench.queue.connect(SessionId(2), &register("w", "new", ""), bench.now).lost, []);
    assert!(bench.queue.commit(&lease.id, 1).is_ok());
}

#[test]
fn a_report_that_comes_again_while_it_is_verified_is_left_alone() {
    let mut bench = Bench::new([1]);
    let broken = SessionId(1);
    bench.queue.connect(broken, &register("w", "process", ""), bench.now);
    bench.queue.park(broken);
    let lease = bench.assign_one();
    assert!(bench.queue.begin_report(broken, &lease.id, 1).expect("held").is_some());
    assert_eq!(bench.queue.begin_report(broken, &lease.id, 1), Ok(None));
    bench.queue.disconnect(broken, bench.now);
    let back = SessionId(2);
    bench.queue.connect(back, &register("w", "process", &lease.id), bench.now);
    assert_eq!(bench.queue.begin_report(back, &lease.id, 1), Ok(None), "over a new stream too");
    let repeated = Stale::OtherAttempt { lease_id: lease.id.clone(), held: 1, given: 2 };
    assert_eq!(bench.queue.begin_report(back, &lease.id, 2), Err(repeated));
    assert!(bench.queue.commit(&lease.id, 1).is_ok());
}

#[test]
fn a_worker_that_drains_while_its_result_is_verified_keeps_it() {
    let mut bench = Bench::new([1]);
    let session = bench.connect(1, "w");
    let lease = bench.assign_one();
    bench.queue.begin_report(session, &lease.id, 1).expect("held");
    assert_eq!(bench.queue.drain(session, bench.now), None);
    bench.connect(2, "v");
    assert_eq!(bench.assign(), [], "the frame is not given out beside its verification");
    assert!(bench.queue.commit(&lease.id, 1).is_ok());
}

#[test]
fn a_report_that_nobody_verifies_any_more_is_a_failed_attempt() {
    let mut bench = Bench::new([1]);
    let broken = SessionId(1);
    bench.queue.connect(broken, &register("w", "process", ""), bench.now);
    bench.queue.park(broken);
    let lease = bench.assign_one();
    assert_eq!(bench.queue.abandon_report(broken), None, "a lease without a report goes on");
    bench.queue.begin_report(broken, &lease.id, 1).expect("held");
    let back = SessionId(2);
    bench.queue.connect(back, &register("w", "process", &lease.id), bench.now);
    let failed = bench.queue.abandon_report(broken).expect("its report was being verified");
    assert!(failed.retried && failed.lease.id == lease.id);
    bench.queue.park(back);
    assert_eq!(bench.assign_one().attempt, 2);
}

#[test]
fn no_frame_is_beyond_all_workers_while_one_may_come_back() {
    let mut bench = Bench::new([1, 2]);
    bench.connect(1, "small");
    let lease = bench.assign_one();
    let large = bench.connect(2, "large");
    bench.assign_one();
    bench.fail(&lease, FailureKind::OutOfResources);
    bench.queue.disconnect(large, bench.now);
    assert_eq!(bench.queue.frames_beyond_all_workers(), []);
    bench.queue.expire(bench.now + GRACE);
    assert_eq!(bench.queue.frames_beyond_all_workers(), [key(1)]);
}

#[test]
fn attempts_go_on_from_the_history() {
    let mut bench = Bench::new([]);
    let excluded = BTreeSet::from(["small".to_owned()]);
    bench.queue.add(key(1), TaskHistory { attempts: 4, failures: 2, excluded, before: 0 });
    bench.connect(1, "small");
    assert_eq!(bench.assign(), []);
    bench.connect(2, "w");
    let lease = bench.assign_one();
    assert_eq!(lease.attempt, 5);
    assert!(!bench.fail(&lease, FailureKind::Bug).retried, "its third failure");
}

#[test]
fn with_no_worker_every_ready_frame_waits() {
    let mut bench = Bench::new([1, 2, 3]);
    assert_eq!((bench.queue.connected(), bench.queue.waiting_tasks("job")), (0, 3));
    assert_eq!(bench.queue.frames_beyond_all_workers(), [], "a worker may still join");
    bench.connect(1, "w");
    assert_eq!(bench.queue.waiting_tasks("job"), 0);
    assert!(bench.queue.close_ready(&key(3)) && !bench.queue.close_ready(&key(3)));
}
