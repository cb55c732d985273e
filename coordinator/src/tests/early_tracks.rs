#![allow(clippy::unwrap_used, reason = "tests")]
//! Tracks that workers make while the coordinator makes the static model.

use std::sync::{Arc, Condvar, Mutex};

use splat::{
    cameras::Camera,
    engine::{DensityStatistics, Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    optim::LearningRates,
    tracking::TrackField,
};
use trackersplat_proto::v1::{
    CancelRequest, FailureKind, JobState, SubmitRequest, TaskState, job_event::Event,
};

use super::{
    harness::*,
    tracks::{track_honestly, tracked_request},
};

/// Its device opens as often as the test says: until then the static model is not made.
#[derive(Default)]
struct Gate {
    passes: Mutex<usize>,
    opened: Condvar,
}

impl Gate {
    /// Lets this many runs of the job through.
    fn let_through(&self, passes: usize) {
        *self.passes.lock().unwrap() = passes;
        self.opened.notify_all();
    }
}

impl Engine for Gate {
    fn name(&self) -> &str {
        "cpu"
    }

    fn check(&self) -> Result<(), EngineError> {
        let mut passes = self.opened.wait_while(self.passes.lock().unwrap(), |passes| *passes == 0).unwrap();
        *passes -= 1;
        Ok(())
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        BackgroundEngine.render(gaussians, camera, background)
    }

    fn footprint_moments(
        &self,
        _: &Gaussians,
        _: &Camera,
        _: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        unreachable!("frames are for workers")
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Ok(Box::new(Unmoved))
    }
}

/// What is reconstructed without a step.
struct Unmoved;

impl Session for Unmoved {
    fn step(&mut self, _: usize, _: &LearningRates) -> Result<(), EngineError> {
        unreachable!("no step is asked for")
    }

    fn take_losses(&mut self) -> Result<Vec<f32>, EngineError> {
        Ok(Vec::new())
    }

    fn gaussians(&mut self) -> Result<Gaussians, EngineError> {
        Ok(model(0.0))
    }

    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError> {
        unreachable!("no step is asked for")
    }

    fn replace(&mut self, _: Gaussians, _: &[Option<usize>]) -> Result<(), EngineError> {
        unreachable!("no step is asked for")
    }
}

/// A coordinator whose static models wait for the gate, which opens at the end of the test at the latest.
struct Gated {
    bench: Bench,
    gate: Arc<Gate>,
}

impl Drop for Gated {
    fn drop(&mut self) {
        self.gate.let_through(usize::MAX);
    }
}

impl Gated {
    async fn start() -> Self {
        let gate = Arc::new(Gate::default());
        Self { bench: Bench::start_on(gate.clone(), |_| {}).await, gate }
    }

    fn request(&self) -> SubmitRequest {
        let settings_json = r#"{"static_model": {"max_steps": 0}}"#.into();
        SubmitRequest { settings_json, static_model: String::new(), ..tracked_request(&self.bench) }
    }

    async fn state(&self) -> JobState {
        let listed = self.bench.jobs().list(trackersplat_proto::v1::ListRequest {}).await.unwrap();
        listed.into_inner().jobs[0].state()
    }
}

#[tokio::test]
async fn workers_track_while_the_static_model_is_made_and_frames_wait_for_it() {
    let gated = Gated::start().await;
    let bench = &gated.bench;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(gated.request()).await.unwrap().job_id;
    for view in ["cam00", "cam01", "cam02"] {
        let lease = worker.lease().await;
        assert_eq!(track_job(&lease).view, view);
        track_honestly(bench, &mut worker, &lease).await;
    }
    assert_eq!(gated.state().await, JobState::StaticModel);
    worker.ask().await;
    gated.gate.let_through(usize::MAX);
    for frame in 1..=3 {
        let lease = worker.leased().await;
        assert_eq!(frame_job(&lease).frame, frame);
        let success = bench.result(&lease).await;
        let outcome = trackersplat_proto::v1::report::Outcome::Success(success);
        assert!(worker.report(&lease, outcome).await.accepted);
        worker.ask().await;
    }
    let events = bench.watch(&job, 0).await.rest().await;
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    let model_made = |event: &Event| matches!(event, Event::JobState(j) if j.state() == JobState::Tracking);
    let tracked = |event: &Event| matches!(event, Event::TracksState(t) if t.state() == TaskState::Done);
    let place =
        |is: &dyn Fn(&Event) -> bool| stored(&events).iter().rposition(|e| is(e.event.as_ref().unwrap()));
    assert!(place(&tracked).unwrap() < place(&model_made).unwrap());
}

#[tokio::test]
async fn a_view_that_cannot_be_tracked_fails_the_job_before_its_static_model_is_there() {
    let gated = Gated::start().await;
    let bench = &gated.bench;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(gated.request()).await.unwrap().job_id;
    let lease = worker.lease().await;
    assert!(worker.fail(&lease, FailureKind::BadInput).await.accepted);
    // The model's threads end at their next step, and the run with them.
    gated.gate.let_through(1);
    let (state, failure) = bench.ended(&job).await;
    let failure = failure.unwrap();
    assert_eq!((state, failure.kind()), (JobState::Failed, FailureKind::BadInput));
    assert!(failure.message.contains("tracks of view 'cam00': bad input in a test"), "{}", failure.message);

    gated.gate.let_through(usize::MAX);
    assert!(bench.submit(gated.request()).await.unwrap().resumed);
    let mut done = Vec::new();
    for _ in 0..6 {
        let lease = worker.lease().await;
        if let Some(trackersplat_proto::v1::lease::Task::Tracks(request)) = &lease.task {
            done.push(request.view.clone());
            track_honestly(bench, &mut worker, &lease).await;
        } else {
            let outcome = trackersplat_proto::v1::report::Outcome::Success(bench.result(&lease).await);
            assert!(worker.report(&lease, outcome).await.accepted);
        }
    }
    assert_eq!(done, ["cam00", "cam01", "cam02"]);
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
}

#[tokio::test]
async fn a_job_that_is_cancelled_or_restarted_meanwhile_keeps_its_tracks() {
    let mut gated = Gated::start().await;
    let mut worker = gated.bench.worker("w").await;
    let job = gated.bench.submit(gated.request()).await.unwrap().job_id;
    let lease = worker.lease().await;
    track_honestly(&gated.bench, &mut worker, &lease).await;
    let held = worker.lease().await;
    assert_eq!(track_job(&held).view, "cam01");

    within(gated.bench.jobs().cancel(CancelRequest { job_id: job.clone() })).await.unwrap();
    assert_eq!(gated.bench.ended(&job).await.0, JobState::Cancelled);
    // The stopped run has the only compute thread.
    gated.gate.let_through(1);
    let is_told = worker.receive().await.unwrap();
    assert!(matches!(is_told, trackersplat_proto::v1::coordinator_message::Message::CancelLease(_)));
    assert!(gated.bench.submit(gated.request()).await.unwrap().resumed);
    let again = worker.lease().await;
    assert_eq!((track_job(&again).view.as_str(), again.attempt), ("cam01", 2), "cam00 is tracked");
    assert_eq!(gated.state().await, JobState::StaticModel);

    gated.gate.let_through(1);
    gated.bench.stop().await;
    gated.bench.restart().await;
    let mut worker = gated.bench.worker("w").await;
    for view in ["cam01", "cam02"] {
        let lease = worker.lease().await;
        assert_eq!(track_job(&lease).view, view);
        track_honestly(&gated.bench, &mut worker, &lease).await;
    }
    gated.gate.let_through(1);
    for frame in 1..=3 {
        assert_eq!(worker.work_once(&gated.bench).await, frame);
    }
    assert_eq!(gated.bench.ended(&job).await.0, JobState::Done);
}
