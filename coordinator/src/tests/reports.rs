//! Reports that meet each other, brought about at the desk itself.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::time::Instant;

use tokio::sync::mpsc;
use tonic::Status;
use trackersplat_proto::v1::{
    CoordinatorMessage, FailureKind, FieldReport, Lease, Register, Report, TaskState, TrackedField,
    coordinator_message::Message, report::Outcome,
};

use super::{
    harness::*,
    tracks::{encoded, tracked_request},
};
use crate::hub::{Hub, OUTGOING_QUEUE, Registered};

/// A worker's stream without a network.
struct Stream {
    registered: Registered,
    messages: mpsc::Receiver<Result<CoordinatorMessage, Status>>,
}

impl Stream {
    async fn open(hub: &Hub, held_lease_id: &str) -> Self {
        let (outgoing, messages) = mpsc::channel(OUTGOING_QUEUE);
        let worker = Register { held_lease_id: held_lease_id.into(), ..register("w") };
        Self { registered: hub.register(&worker, outgoing).await.unwrap(), messages }
    }

    async fn receive(&mut self) -> Message {
        within(self.messages.recv()).await.unwrap().unwrap().message.unwrap()
    }

    async fn lease(&mut self, hub: &Hub) -> Lease {
        hub.lease_requested(self.registered.session).await.unwrap();
        match self.receive().await {
            Message::Lease(lease) => lease,
            other => panic!("{other:?}"),
        }
    }
}

async fn success(bench: &Bench, lease: &Lease) -> Report {
    let outcome = Some(Outcome::Success(bench.result(lease).await));
    Report { lease_id: lease.lease_id.clone(), attempt: lease.attempt, outcome }
}

/// With one thread for blocking calls, whoever has that thread holds every verification up.
fn one_blocking_thread(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(1).build();
    runtime.unwrap().block_on(test);
}

#[test]
fn a_report_sent_again_while_it_is_verified_is_verified_once_and_answered_when_it_comes_once_more() {
    one_blocking_thread(async {
        let bench = Bench::start().await;
        let job = bench.submitted().await;
        let hub = bench.hub();
        let mut broken = Stream::open(&hub, "").await;
        let lease = broken.lease(&hub).await;
        let report = success(&bench, &lease).await;

        let (release, released) = std::sync::mpsc::channel::<()>();
        let held_up = tokio::task::spawn_blocking(move || released.recv());
        let first = hub.report(broken.registered.session, report.clone());
        let again = async {
            let mut back = Stream::open(&hub, &lease.lease_id).await;
            // Comes back without having waited for the verification.
            within(hub.report(back.registered.session, report.clone())).await.unwrap();
            assert!(
                back.messages.try_recv().is_err(),
                "no receipt before it is known what becomes of the result"
            );
            release.send(()).unwrap();
            back
        };
        let (first, mut back) = tokio::join!(first, again);
        first.unwrap();
        held_up.await.unwrap().unwrap();

        hub.report(back.registered.session, report).await.unwrap();
        match back.receive().await {
            Message::Receipt(receipt) => assert!(receipt.accepted, "{receipt:?}"),
            other => panic!("{other:?}"),
        }
        assert_eq!(frame_job(&back.lease(&hub).await).frame, 2, "the job goes on");
        let frame = hub.store.frame(&job, 1).await.unwrap().unwrap();
        assert_eq!(frame.state().unwrap(), crate::queue::task::TaskState::Done);
    });
}

#[test]
fn a_lease_does_not_expire_while_a_field_of_it_is_verified() {
    one_blocking_thread(async {
        let bench = Bench::start().await;
        let hub = bench.hub();
        let mut stream = Stream::open(&hub, "").await;
        let job = bench.submit(tracked_request(&bench)).await.unwrap().job_id;
        let lease = stream.lease(&hub).await;
        assert_eq!(track_job(&lease).view, "cam00");
        let field = TrackedField { frame: 2, tracks: Some(bench.put(encoded(8, 2.0)).await) };
        let (lease_id, attempt) = (lease.lease_id.clone(), lease.attempt);
        let report = FieldReport { lease_id, attempt, field: Some(field.clone()) };

        let (release, released) = std::sync::mpsc::channel::<()>();
        let held_up = tokio::task::spawn_blocking(move || released.recv());
        let reported = hub.field_reported(stream.registered.session, report);
        let meanwhile = async {
            hub.tick(Instant::now() + 10 * bench.options.lease_duration).await.unwrap();
            release.send(()).unwrap();
        };
        let (reported, ()) = tokio::join!(reported, meanwhile);
        reported.unwrap();
        held_up.await.unwrap().unwrap();
        let kept = hub.tracks(&job.as_str().into(), |ledger| ledger.tracks(0, 2)).await.unwrap();
        assert_eq!(kept, field.tracks);
        // Heartbeats that came meanwhile are still to be read.
        hub.tick(Instant::now() + bench.options.lease_duration / 2).await.unwrap();
        assert!(stream.messages.try_recv().is_err(), "the lease is not taken away");
    });
}

#[test]
fn a_report_whose_verification_panicked_is_a_failed_attempt() {
    one_blocking_thread(async {
        let bench = Bench::start().await;
        let job = bench.submitted().await;
        let hub = bench.hub();
        let mut stream = Stream::open(&hub, "").await;
        let lease = stream.lease(&hub).await;
        let report = success(&bench, &lease).await;
        let session = stream.registered.session;
        let (release, released) = std::sync::mpsc::channel::<()>();
        let held_up = tokio::task::spawn_blocking(move || released.recv());
        // Dropped, it leaves the lease as a panic does. The desk's lock is fair: the report has begun before the
        // request for a lease is taken down.
        tokio::select! {
            biased;
            reported = hub.report(session, report) => panic!("{reported:?}"),
            requested = hub.lease_requested(session) => requested.unwrap(),
        }
        release.send(()).unwrap();
        held_up.await.unwrap().unwrap();
        hub.report_panicked(session).await.unwrap();
        let failure = bench.watch(&job, 0).await.frame(1, TaskState::Ready).await.unwrap();
        assert_eq!(failure.kind(), FailureKind::Bug);
        match stream.receive().await {
            Message::Lease(lease) => assert_eq!((frame_job(&lease).frame, lease.attempt), (1, 2)),
            other => panic!("{other:?}"),
        }
    });
}
