//! What a coordinator sees of a worker, message by message.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    ops::ControlFlow,
    sync::mpsc::{Receiver, Sender, channel},
};

use splat::{
    cameras::Camera,
    engine::{EngineError, Rendering, SessionInput},
    frame::{FrameError, FrameReport, FrameResult},
    gaussians::{Gaussians, delta},
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    raster::CpuEngine,
    tracking::TrackField,
};
use tonic::Status;
use trackersplat_proto::v1::{CancelLease, Dismiss, report};

use super::*;
use crate::test_coordinator::{Session, TestCoordinator};

type Running = JoinHandle<Result<Exit, WorkerError>>;

fn start(coordinator: &TestCoordinator, reconstruct: Reconstruct) -> (Running, CancellationToken) {
    start_with(options(coordinator), reconstruct)
}

fn options(coordinator: &TestCoordinator) -> WorkerOptions {
    WorkerOptions {
        coordinator: coordinator.address.clone(),
        threads: 1,
        worker_id: Some("worker-a".into()),
        state_dir: None,
        reconnect_for: Duration::from_secs(15),
        remote_blobs: false,
    }
}

fn start_with(options: WorkerOptions, reconstruct: Reconstruct) -> (Running, CancellationToken) {
    let shutdown = CancellationToken::new();
    let engine = Arc::new(CpuEngine::default());
    let task = tokio::spawn(run_with(options, engine, reconstruct, shutdown.clone()));
    (task, shutdown)
}

/// Moves every Gaussian by one unit of x.
fn shift() -> Reconstruct {
    Arc::new(|input, progress| {
        for stage in ["motion", "refine"] {
            let _ = progress(FrameProgress { stage, done: 1, total: 1 });
        }
        let mut gaussians = (*input.static_model).clone();
        gaussians.means.iter_mut().for_each(|mean| mean[0] += 1.0);
        Ok(FrameResult { gaussians, report: FrameReport { refine_steps: 7, ..FrameReport::default() } })
    })
}

fn fails(error: impl Fn() -> FrameError + Send + Sync + 'static) -> Reconstruct {
    Arc::new(move |_, _| Err(error()))
}

/// Says when it has started, then steps until it is let go or stopped.
fn steps_until_released() -> (Reconstruct, Receiver<()>, Sender<()>) {
    let (started, on_start) = channel();
    let (release, released) = channel::<()>();
    let channels = std::sync::Mutex::new((started, released));
    let reconstruct: Reconstruct = Arc::new(move |input, progress| {
        let channels = channels.lock().unwrap();
        channels.0.send(()).unwrap();
        let mut done = 0;
        while channels.1.try_recv().is_err() {
            done += 1;
            if progress(FrameProgress { stage: "refine", done, total: 0 }) == ControlFlow::Break(()) {
                return Err(FrameError::Cancelled);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(FrameResult { gaussians: (*input.static_model).clone(), report: FrameReport::default() })
    });
    (reconstruct, on_start, release)
}

async fn wait_on(receiver: Receiver<()>) {
    let wait = tokio::task::spawn_blocking(move || receiver.recv_timeout(Duration::from_secs(15)));
    wait.await.unwrap().expect("the frame starts");
}

fn failure(report: Report) -> (FailureKind, String) {
    match report.outcome.unwrap() {
        report::Outcome::Failure(failure) => (failure.kind(), failure.message),
        other => panic!("a failure, not {other:?}"),
    }
}

async fn dismiss(session: &Session) {
    session.send(coordinator_message::Message::Dismiss(Dismiss { reason: "done".into() })).await;
}

#[tokio::test]
async fn fields_wait_for_room_and_none_is_lost() {
    use futures::FutureExt;
    let room = Arc::new(Semaphore::new(1));
    let (sender, mut fields) = mpsc::unbounded_channel();
    for frame in [2, 3] {
        sender.send(TrackedField { frame, tracks: None }).unwrap();
    }
    let (first, taken) = next_field(&mut fields, &room).await.unwrap();
    assert_eq!(first.frame, 2);
    assert!(next_field(&mut fields, &room).now_or_never().is_none(), "no room");
    drop(taken);
    let (second, _taken) = next_field(&mut fields, &room).now_or_never().unwrap().unwrap();
    assert_eq!(second.frame, 3, "a field that waits stays in line");
}

#[tokio::test]
async fn a_lease_becomes_a_stored_delta_and_a_report() {
    let coordinator = TestCoordinator::start().await;
    let (worker, _shutdown) = start(&coordinator, shift());
    let mut session = coordinator.welcome().await;
    assert_eq!(session.register.worker_id, "worker-a");
    assert_eq!(session.register.engine, "cpu");
    assert_eq!(session.register.version, env!("CARGO_PKG_VERSION"));

    session.wait_for_lease_request().await;
    let job = coordinator.frame_job(2);
    session.lease("lease-1", job.clone()).await;
    let report = session.wait_for_report().await;
    assert_eq!((report.lease_id.as_str(), report.attempt), ("lease-1", 1));
    let Some(report::Outcome::Success(success)) = report.outcome.clone() else { panic!("{report:?}") };
    let stages: Vec<_> = success.seconds.iter().map(|entry| entry.stage.as_str()).collect();
    assert_eq!(stages, ["fetch", "motion", "refine", "store"]);
    let frame_report: FrameReport = serde_json::from_str(&success.report_json).unwrap();
    assert_eq!(frame_report.refine_steps, 7);

    let static_model = crate::test_coordinator::two_gaussians();
    let stored = coordinator.stored(&success.delta.unwrap().digest);
    let static_digest = blake3::Hash::from_hex(job.static_model.unwrap().digest).unwrap();
    let moved = delta::apply(&static_model, static_digest.as_bytes(), &stored).unwrap();
    assert_eq!(moved.len(), 2);
    assert!((moved.means[0][0] - 1.0).abs() < 1e-3, "{:?}", moved.means);

    session.acknowledge(&report).await;
    session.wait_for_lease_request().await;
    dismiss(&session).await;
    assert_eq!(worker.await.unwrap().unwrap(), Exit::Dismissed);
}

#[tokio::test]
async fn a_report_is_repeated_until_it_is_acknowledged() {
    let coordinator = TestCoordinator::start().await;
    let (worker, _shutdown) = start(&coordinator, shift());
    let mut session = coordinator.welcome().await;
    session.lease("lease-1", coordinator.frame_job(2)).await;
    let first = session.wait_for_report().await;
    assert_eq!(session.wait_for_report().await, first);

    // Over a new stream too: the coordinator may have died before it wrote the result down.
    drop(session);
    let mut session = coordinator.welcome().await;
    assert_eq!(session.register.held_lease_id, "lease-1", "its lease goes on until there is a receipt");
    assert_eq!(session.wait_for_report().await, first);
    session.acknowledge(&first).await;
    session.wait_for_lease_request().await;
    dismiss(&session).await;
    assert_eq!(worker.await.unwrap().unwrap(), Exit::Dismissed);
}

#[tokio::test]
async fn a_running_frame_goes_on_over_a_lost_stream_until_the_coordinator_decides() {
    let coordinator = TestCoordinator::start().await;
    let (reconstruct, started, release) = steps_until_released();
    let (worker, _shutdown) = start(&coordinator, reconstruct);
    let session = coordinator.welcome().await;
    let incarnation = session.register.incarnation.clone();
    session.lease("lease-1", coordinator.frame_job(2)).await;
    wait_on(started).await;
    drop(session);

    let mut session = coordinator.welcome().await;
    assert_eq!(session.register.incarnation, incarnation, "the same process is the same incarnation");
    assert_eq!(session.register.held_lease_id, "lease-1");
    let heartbeat = session
        .wait_for(|message| {
            if let worker_message::Message::Heartbeat(heartbeat) = message { Some(heartbeat) } else { None }
        })
        .await;
    assert_eq!((heartbeat.lease_id.as_str(), heartbeat.stage.as_str()), ("lease-1", "refine"));
    release.send(()).unwrap();
    let report = session.wait_for_report().await;
    assert_eq!(report.lease_id, "lease-1");
    // As a coordinator does that was restarted: it knows no lease of before.
    session.refuse(&report, "stale").await;
    session.wait_for_lease_request().await;
    dismiss(&session).await;
    assert_eq!(worker.await.unwrap().unwrap(), Exit::Dismissed);
}

#[tokio::test]
async fn heartbeats_go_on_while_a_frame_keeps_the_pool_busy() {
    let coordinator = TestCoordinator::start().await;
    let (reconstruct, started, release) = steps_until_released();
    let (worker, _shutdown) = start(&coordinator, reconstruct);
    let mut session = coordinator.welcome().await;
    session.lease("lease-1", coordinator.frame_job(2)).await;
    wait_on(started).await;
    let mut last = 0;
    for _ in 0..3 {
        let done = session
            .wait_for(|message| match message {
                worker_message::Message::Heartbeat(heartbeat) if heartbeat.done > last => {
                    Some(heartbeat.done)
                }
                _ => None,
            })
            .await;
        last = done;
    }
    release.send(()).unwrap();
    session.wait_for_report().await;
    dismiss(&session).await;
    worker.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_cancelled_lease_is_not_reported_and_the_worker_asks_for_the_next() {
    let coordinator = TestCoordinator::start().await;
    let (reconstruct, started, release) = steps_until_released();
    let (worker, _shutdown) = start(&coordinator, reconstruct);
    let mut session = coordinator.welcome().await;
    session.wait_for_lease_request().await;
    session.lease("lease-1", coordinator.frame_job(2)).await;
    wait_on(started).await;
    let cancel = |lease_id: &str| {
        let reason = "cancelled by the user".into();
        coordinator_message::Message::CancelLease(CancelLease { lease_id: lease_id.into(), reason })
    };
    session.send(cancel("another lease")).await;
    session.send(cancel("lease-1")).await;
    let next = session
        .wait_for(|message| match message {
            worker_message::Message::Heartbeat(_) => None,
            other => Some(other),
        })
        .await;
    assert!(matches!(next, worker_message::Message::LeaseRequest(_)), "{next:?}");

    release.send(()).unwrap();
    session.lease("lease-2", coordinator.frame_job(3)).await;
    assert_eq!(session.wait_for_report().await.lease_id, "lease-2");
    dismiss(&session).await;
    worker.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_panic_is_a_bug_report_and_the_worker_lives_on() {
    let coordinator = TestCoordinator::start().await;
    let panics: Reconstruct = Arc::new(|_, _| panic!("index 7 out of range"));
    let (worker, _shutdown) = start(&coordinator, panics);
    let mut session = coordinator.welcome().await;
    for lease in ["lease-1", "lease-2"] {
        session.lease(lease, coordinator.frame_job(2)).await;
        let report = session.wait_for(|message| match message {
            worker_message::Message::Report(report) if report.lease_id == lease => Some(report),
            _ => None,
        });
        let report = report.await;
        session.acknowledge(&report).await;
        let (kind, message) = failure(report);
        assert_eq!(kind, FailureKind::Bug);
        assert!(message.contains("index 7 out of range"), "{message}");
    }
    dismiss(&session).await;
    assert_eq!(worker.await.unwrap().unwrap(), Exit::Dismissed);
}

#[tokio::test]
async fn failures_carry_their_kind_and_figures() {
    let coordinator = TestCoordinator::start().await;
    let memory =
        fails(|| EngineError::OutOfResources { needed: 5_000_000_000, available: 4_000_000_000 }.into());
    let (worker, shutdown) = start(&coordinator, memory);
    let mut session = coordinator.welcome().await;
    session.lease("lease-1", coordinator.frame_job(2)).await;
    let (kind, message) = failure(session.wait_for_report().await);
    assert_eq!(kind, FailureKind::OutOfResources);
    assert!(message.contains("5000000000") && message.contains("4000000000"), "{message}");
    shutdown.cancel();
    drop(session);
    worker.await.unwrap().unwrap();

    let (worker, shutdown) = start(&coordinator, shift());
    let mut session = coordinator.welcome().await;
    let mut job = coordinator.frame_job(2);
    job.training_views[0].camera = None;
    session.lease("lease-2", job).await;
    let (kind, message) = failure(session.wait_for_report().await);
    assert_eq!(kind, FailureKind::BadInput);
    assert!(message.contains("cam00"), "{message}");
    shutdown.cancel();
    drop(session);
    worker.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_worker_that_is_stopped_says_goodbye_and_stops_its_frame() {
    let coordinator = TestCoordinator::start().await;
    let (reconstruct, started, _release) = steps_until_released();
    let (worker, shutdown) = start(&coordinator, reconstruct);
    let mut session = coordinator.welcome().await;
    session.lease("lease-1", coordinator.frame_job(2)).await;
    wait_on(started).await;
    shutdown.cancel();
    let goodbye = session.wait_for(|message| match message {
        worker_message::Message::GoingAway(goodbye) => Some(goodbye.reason),
        worker_message::Message::Report(report) => panic!("nothing to report, not {report:?}"),
        _ => None,
    });
    assert!(goodbye.await.contains("asked to stop"));
    drop(session);
    assert_eq!(worker.await.unwrap().unwrap(), Exit::ShutDown);
}

#[tokio::test]
async fn a_refused_worker_gives_up_at_once() {
    let coordinator = TestCoordinator::start().await;
    let (worker, _shutdown) = start(&coordinator, shift());
    coordinator.refuse(Status::failed_precondition("version 0.2.0 needed")).await;
    let error = worker.await.unwrap().unwrap_err();
    assert!(matches!(&error, WorkerError::Refused { .. }), "{error}");
    assert!(error.to_string().contains("version 0.2.0 needed"), "{error}");
}

#[tokio::test]
async fn a_worker_without_a_coordinator_gives_up_after_its_patience() {
    // A port that was free a moment ago and that nobody listens on.
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let options = WorkerOptions {
        coordinator: format!("http://{address}"),
        threads: 1,
        worker_id: None,
        state_dir: None,
        reconnect_for: Duration::from_millis(300),
        remote_blobs: false,
    };
    let (worker, _shutdown) = start_with(options, shift());
    let error = worker.await.unwrap().unwrap_err();
    assert!(matches!(&error, WorkerError::Unreachable { .. }), "{error}");
    assert!(error.to_string().contains(&address.to_string()), "{error}");
}

#[tokio::test]
async fn a_worker_keeps_its_name_across_restarts() {
    let coordinator = TestCoordinator::start().await;
    let state = tempfile::tempdir().unwrap();
    let options =
        WorkerOptions { worker_id: None, state_dir: Some(state.path().join("new")), ..options(&coordinator) };
    let mut names = Vec::new();
    let mut incarnations = Vec::new();
    for _ in 0..2 {
        let (worker, shutdown) = start_with(options.clone(), shift());
        let session = coordinator.welcome().await;
        names.push(session.register.worker_id.clone());
        incarnations.push(session.register.incarnation.clone());
        shutdown.cancel();
        drop(session);
        worker.await.unwrap().unwrap();
    }
    assert_eq!(names[0], names[1]);
    assert_ne!(incarnations[0], incarnations[1]);
}

#[tokio::test]
async fn a_worker_without_threads_is_refused() {
    let coordinator = TestCoordinator::start().await;
    let (worker, _shutdown) = start_with(WorkerOptions { threads: 0, ..options(&coordinator) }, shift());
    assert!(matches!(worker.await.unwrap(), Err(WorkerError::Threads { threads: 0, .. })));
}

#[tokio::test]
async fn a_name_that_cannot_be_sent_is_refused_before_anything_starts() {
    let coordinator = TestCoordinator::start().await;
    let options = WorkerOptions { worker_id: Some("a name/with a path".into()), ..options(&coordinator) };
    let (worker, _shutdown) = start_with(options, shift());
    assert!(matches!(worker.await.unwrap(), Err(WorkerError::BadName(_))));
}

/// A device that is lost in every frame, and that comes back so many times.
struct FailingEngine {
    returns: std::sync::Mutex<u32>,
}

const GONE: &str = "it fell off the bus";

impl Engine for FailingEngine {
    fn name(&self) -> &str {
        "gpu"
    }

    fn device_name(&self) -> Option<&str> {
        Some("Card A (vulkan)")
    }

    fn check(&self) -> Result<(), EngineError> {
        let mut returns = self.returns.lock().unwrap();
        *returns = returns.checked_sub(1).ok_or_else(|| EngineError::DeviceLost(GONE.into()))?;
        Ok(())
    }

    fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        Err(EngineError::DeviceLost(GONE.into()))
    }

    fn footprint_moments(
        &self,
        _: &Gaussians,
        _: &Camera,
        _: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        Err(EngineError::DeviceLost(GONE.into()))
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn splat::engine::Session>, EngineError> {
        Err(EngineError::DeviceLost(GONE.into()))
    }
}

#[tokio::test]
async fn a_lost_device_fails_its_frame_as_transient_and_the_worker_goes_on_only_if_it_comes_back() {
    let coordinator = TestCoordinator::start().await;
    let engine = Arc::new(FailingEngine { returns: 1.into() });
    let worker = tokio::spawn(run(options(&coordinator), engine, CancellationToken::new()));
    let mut session = coordinator.welcome().await;
    assert_eq!((&*session.register.engine, &*session.register.device), ("gpu", "Card A (vulkan)"));
    session.wait_for_lease_request().await;
    for (lease, comes_back) in [("lease-1", true), ("lease-2", false)] {
        // The key frame is only rendered.
        session.lease(lease, coordinator.frame_job(1)).await;
        let report = session.wait_for_report().await;
        assert_eq!(report.lease_id, lease);
        session.acknowledge(&report).await;
        let (kind, message) = failure(report);
        assert_eq!(kind, FailureKind::Transient);
        assert!(message.contains(GONE), "{message}");
        let next = session.wait_for(|message| match message {
            worker_message::Message::LeaseRequest(_) => Some(None),
            worker_message::Message::GoingAway(goodbye) => Some(Some(goodbye.reason)),
            _ => None,
        });
        match next.await {
            None => assert!(comes_back, "a worker without a device asks for no frame"),
            Some(reason) => assert!(!comes_back && reason.contains(GONE), "{reason}"),
        }
    }
    drop(session);
    let error = worker.await.unwrap().unwrap_err();
    assert!(matches!(&error, WorkerError::Device { reason } if reason.contains(GONE)), "{error}");
}
