#![allow(clippy::unwrap_used, reason = "tests")]

use std::{path::Path, sync::Arc, time::Duration};

use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    formats::ply,
    frame::FrameReport,
    gaussians::{Gaussians, delta},
    image::Image,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};
use tokio::sync::mpsc;
use tokio_stream::{StreamExt, wrappers::ReceiverStream};
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming, transport::Channel};
use trackersplat_proto::v1::{
    Blob, CoordinatorMessage, Failure, FailureKind, FrameJob, GetBlobRequest, JobEvent, JobState, Lease,
    LeaseRequest, PutBlobChunk, Register, Report, ReportReceipt, SubmitRequest, SubmitResponse, Success,
    TaskState, TrackJob, WatchRequest, Welcome, WorkerMessage, blobs_client::BlobsClient,
    coordinator_message, job_event::Event, jobs_client::JobsClient, lease, report::Outcome, worker_message,
    workers_client::WorkersClient,
};

use crate::{Running, ServeError, ServeOptions, hub::Hub, serve};

/// Longest wait for anything; reached only when a test fails.
const PATIENCE: Duration = Duration::from_secs(15);

pub(super) async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("nothing happened for 15 s")
}

/// Renders nothing but background; jobs in these tests import their static model.
pub(super) struct BackgroundEngine;

impl Engine for BackgroundEngine {
    fn name(&self) -> &str {
        "cpu"
    }

    fn render(
        &self,
        _gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        let image = Image::filled(camera.width, camera.height, background);
        Ok(Rendering { alpha: vec![0.0; image.pixel_count()], image })
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        _camera: &Camera,
        _tracks: &TrackField,
        _reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        Ok(vec![FootprintMoments::default(); gaussians.len()])
    }

    fn session(&self, _input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::DeviceLost("no device in this test".into()))
    }
}

/// A coordinator, a clip of three training views, a test view and three frames, and a static model.
pub(super) struct Bench {
    pub(super) folder: tempfile::TempDir,
    pub(super) options: ServeOptions,
    engine: Arc<dyn Engine>,
    running: Option<(Running, CancellationToken)>,
    pub(super) channel: Option<Channel>,
}

impl Bench {
    pub(super) async fn start() -> Self {
        Self::start_with(|_| {}).await
    }

    pub(super) async fn start_with(adjust: impl FnOnce(&mut ServeOptions)) -> Self {
        Self::start_on(Arc::new(BackgroundEngine), adjust).await
    }

    pub(super) async fn start_on(engine: Arc<dyn Engine>, adjust: impl FnOnce(&mut ServeOptions)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_clip(&folder.path().join("clip"), 0);
        std::fs::write(folder.path().join("static.ply"), ply::write_ply(&model(0.0))).unwrap();
        let mut options = ServeOptions {
            root: folder.path().join("root"),
            listen: ([127, 0, 0, 1], 0).into(),
            compute_threads: 1,
            // Long enough that no lease expires unless a test wants it to.
            heartbeat_interval: Duration::from_millis(20),
            lease_duration: Duration::from_secs(60),
            reconnect_grace: Duration::from_millis(100),
            ..ServeOptions::default()
        };
        adjust(&mut options);
        let mut bench = Self { folder, options, engine, running: None, channel: None };
        bench.restart().await;
        bench
    }

    /// Starts the coordinator, after it was stopped or killed.
    pub(super) async fn restart(&mut self) {
        let shutdown = CancellationToken::new();
        let running = serve(self.options.clone(), self.engine.clone(), shutdown.clone()).await.unwrap();
        let endpoint =
            tonic::transport::Endpoint::from_shared(format!("http://{}", running.address)).unwrap();
        self.channel = Some(endpoint.connect().await.unwrap());
        self.running = Some((running, shutdown));
    }

    /// Starts another coordinator on the same folder.
    pub(super) async fn try_second(&self) -> Result<Running, ServeError> {
        serve(self.options.clone(), self.engine.clone(), CancellationToken::new()).await
    }

    pub(super) async fn stop(&mut self) {
        let (running, shutdown) = self.running.take().unwrap();
        shutdown.cancel();
        within(running.finished()).await.unwrap();
    }

    pub(super) fn hub(&self) -> Arc<Hub> {
        self.running.as_ref().and_then(|(running, _)| running.hub.upgrade()).expect("it runs")
    }

    pub(super) fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    pub(super) fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel.clone().unwrap())
    }

    pub(super) fn blobs(&self) -> BlobsClient<Channel> {
        BlobsClient::new(self.channel.clone().unwrap())
    }

    /// A submission that needs neither the reconstruction nor the tracker.
    pub(super) fn request(&self) -> SubmitRequest {
        SubmitRequest {
            clip: self.path("clip"),
            output: self.path("out"),
            settings_json: r#"{"motion_source": "none"}"#.into(),
            static_model: self.path("static.ply"),
            ..SubmitRequest::default()
        }
    }

    pub(super) async fn submit(&self, request: SubmitRequest) -> Result<SubmitResponse, Status> {
        within(self.jobs().submit(request)).await.map(tonic::Response::into_inner)
    }

    pub(super) async fn submitted(&self) -> String {
        self.submit(self.request()).await.unwrap().job_id
    }

    pub(super) async fn watch(&self, job_id: &str, after_sequence: u64) -> Watch {
        let request = WatchRequest { job_id: job_id.to_owned(), after_sequence };
        let events = within(self.jobs().watch(request)).await.unwrap().into_inner();
        Watch { events }
    }

    /// Watches from the beginning until the job has ended; its last state and why.
    pub(super) async fn ended(&self, job_id: &str) -> (JobState, Option<Failure>) {
        let mut last = (JobState::Unspecified, None);
        for event in self.watch(job_id, 0).await.rest().await {
            if let Some(Event::JobState(changed)) = event.event {
                last = (changed.state(), changed.failure);
            }
        }
        last
    }

    pub(super) async fn worker(&self, id: &str) -> Worker {
        Worker::connect(self.channel.clone().unwrap(), id).await
    }

    pub(super) async fn put(&self, bytes: Vec<u8>) -> Blob {
        let blob = crate::blobs::name(&bytes);
        let chunk = PutBlobChunk { blob: Some(blob.clone()), data: bytes };
        within(self.blobs().put(tokio_stream::iter([chunk]))).await.unwrap();
        blob
    }

    pub(super) async fn get(&self, digest: &str) -> Result<Vec<u8>, Status> {
        let request = GetBlobRequest { digest: digest.to_owned() };
        let mut chunks = within(self.blobs().get(request)).await?.into_inner();
        let mut bytes = Vec::new();
        while let Some(chunk) = within(chunks.message()).await? {
            bytes.extend(chunk.data);
        }
        Ok(bytes)
    }

    /// What an honest worker reports: the static model, moved.
    pub(super) async fn result(&self, lease: &Lease) -> Success {
        let static_blob = frame_job(lease).static_model.unwrap();
        let static_model = ply::parse_ply(&self.get(&static_blob.digest).await.unwrap()).unwrap();
        let moved = model(frame_job(lease).frame as f32);
        let delta = delta::encode(&static_model, &digest_bytes(&static_blob.digest), &moved);
        Success {
            delta: Some(self.put(delta).await),
            report_json: serde_json::to_string(&FrameReport::default()).unwrap(),
            seconds: vec![],
        }
    }
}

/// The frame that a lease is for.
pub(super) fn frame_job(lease: &Lease) -> FrameJob {
    match lease.task.clone() {
        Some(lease::Task::Frame(job)) => job,
        other => panic!("no frame: {other:?}"),
    }
}

/// The tracks that a lease is for.
pub(super) fn track_job(lease: &Lease) -> TrackJob {
    match lease.task.clone() {
        Some(lease::Task::Tracks(job)) => job,
        other => panic!("no tracks: {other:?}"),
    }
}

/// A client that watches a job.
pub(super) struct Watch {
    events: Streaming<JobEvent>,
}

impl Watch {
    pub(super) async fn next(&mut self) -> Option<JobEvent> {
        within(self.events.message()).await.unwrap()
    }

    /// Every event until the job ends.
    pub(super) async fn rest(mut self) -> Vec<JobEvent> {
        let mut events = Vec::new();
        while let Some(event) = self.next().await {
            events.push(event);
        }
        events
    }

    /// The first event that satisfies a condition.
    pub(super) async fn until(&mut self, mut wanted: impl FnMut(&Event) -> bool) -> JobEvent {
        loop {
            let event = self.next().await.expect("the job ended first");
            if event.event.as_ref().is_some_and(&mut wanted) {
                return event;
            }
        }
    }

    /// Waits for a frame to reach a state; the failure that came with it.
    pub(super) async fn frame(&mut self, frame: u32, state: TaskState) -> Option<Failure> {
        let event = self
            .until(|event| matches!(event, Event::FrameState(f) if f.frame == frame && f.state() == state && f.attempt > 0))
            .await;
        let Some(Event::FrameState(changed)) = event.event else { return None };
        changed.failure
    }
}

/// Stored events only: those that are replayed.
pub(super) fn stored(events: &[JobEvent]) -> Vec<JobEvent> {
    let is_stored = |event: &&JobEvent| {
        matches!(event.event, Some(Event::JobState(_) | Event::FrameState(_) | Event::TracksState(_)))
    };
    events.iter().filter(is_stored).cloned().collect()
}

/// A worker by hand.
pub(super) struct Worker {
    outgoing: mpsc::Sender<WorkerMessage>,
    incoming: Streaming<CoordinatorMessage>,
    pub(super) welcome: Welcome,
}

pub(super) fn register(id: &str) -> Register {
    Register {
        worker_id: id.into(),
        incarnation: "1".into(),
        engine: "cpu".into(),
        device: "test".into(),
        threads: 1,
        version: env!("CARGO_PKG_VERSION").into(),
        held_lease_id: String::new(),
    }
}

impl Worker {
    pub(super) async fn connect(channel: Channel, id: &str) -> Self {
        Self::say(channel, worker_message::Message::Register(register(id))).await.unwrap()
    }

    /// Opens a stream with any first message.
    pub(super) async fn say(channel: Channel, first: worker_message::Message) -> Result<Self, Status> {
        let (outgoing, queue) = mpsc::channel(16);
        outgoing.send(WorkerMessage { message: Some(first) }).await.unwrap();
        let response = within(WorkersClient::new(channel).work(ReceiverStream::new(queue))).await?;
        let mut incoming = response.into_inner();
        let first = within(incoming.message()).await?.and_then(|message| message.message);
        let Some(coordinator_message::Message::Welcome(welcome)) = first else { panic!("{first:?}") };
        Ok(Self { outgoing, incoming, welcome })
    }

    pub(super) async fn send(&self, message: worker_message::Message) {
        self.outgoing.send(WorkerMessage { message: Some(message) }).await.unwrap();
    }

    pub(super) async fn receive(&mut self) -> Result<coordinator_message::Message, Status> {
        let message = within(self.incoming.message()).await?;
        message.and_then(|message| message.message).ok_or_else(|| Status::aborted("the stream ended"))
    }

    pub(super) async fn ask(&self) {
        self.send(worker_message::Message::LeaseRequest(LeaseRequest {})).await;
    }

    pub(super) async fn lease(&mut self) -> Lease {
        self.ask().await;
        self.leased().await
    }

    pub(super) async fn leased(&mut self) -> Lease {
        match self.receive().await.unwrap() {
            coordinator_message::Message::Lease(lease) => lease,
            other => panic!("{other:?}"),
        }
    }

    pub(super) async fn report(&mut self, lease: &Lease, outcome: Outcome) -> ReportReceipt {
        let report =
            Report { lease_id: lease.lease_id.clone(), attempt: lease.attempt, outcome: Some(outcome) };
        self.send(worker_message::Message::Report(report)).await;
        match self.receive().await.unwrap() {
            coordinator_message::Message::Receipt(receipt) => receipt,
            other => panic!("{other:?}"),
        }
    }

    pub(super) async fn fail(&mut self, lease: &Lease, kind: FailureKind) -> ReportReceipt {
        let failure = Failure { kind: kind.into(), message: format!("{} in a test", kind.label()) };
        self.report(lease, Outcome::Failure(failure)).await
    }

    /// Leases one frame and reports an honest result.
    pub(super) async fn work_once(&mut self, bench: &Bench) -> u32 {
        let lease = self.lease().await;
        let success = bench.result(&lease).await;
        let receipt = self.report(&lease, Outcome::Success(success)).await;
        assert!(receipt.accepted, "{receipt:?}");
        frame_job(&lease).frame
    }

    /// Whether the stream is closed from the other side.
    pub(super) async fn end(mut self) -> Option<Status> {
        loop {
            match within(self.incoming.next()).await {
                Some(Ok(_)) => {}
                Some(Err(status)) => return Some(status),
                None => return None,
            }
        }
    }
}

/// Two Gaussians, moved along x.
pub(super) fn model(x: f32) -> Gaussians {
    Gaussians {
        means: vec![[x, 0.0, 0.0], [x + 1.0, 0.5, 0.25]],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        log_scales: vec![[-2.0, -2.0, -2.0]; 2],
        logit_opacities: vec![0.5; 2],
        sh: vec![0.1; 6],
        sh_degree: 0,
    }
}

/// A clip of three frames in the nerfstudio layout with one file per frame.
pub(super) fn write_clip(root: &Path, shade: u8) {
    write_clip_of(3, root, shade);
}

/// [`write_clip`] of any number of frames.
pub(super) fn write_clip_of(frames: u32, root: &Path, shade: u8) {
    std::fs::create_dir_all(root.join("transforms")).unwrap();
    for frame in 1..=frames {
        let mut views = Vec::new();
        for (index, name) in ["cam00", "cam01", "cam02", "test00"].into_iter().enumerate() {
            let folder = root.join("images").join(name);
            std::fs::create_dir_all(&folder).unwrap();
            let level = (f32::from(shade) + 10.0 * index as f32 + frame as f32) / 255.0;
            let png = Image::filled(8, 6, [level; 3]).encode_png();
            std::fs::write(folder.join(format!("frame_{frame:04}.png")), png).unwrap();
            views.push(serde_json::json!({
                "file_path": format!("../images/{name}/frame_{frame:04}.png"),
                "camera": name, "split": if name == "test00" { "test" } else { "train" },
                "frame": frame, "time": f64::from(frame - 1) / 2.0,
                "fl_x": 10.0, "fl_y": 10.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6,
                "transform_matrix": [[1.0, 0.0, 0.0, 0.2 * index as f64], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]],
            }));
        }
        let json = serde_json::json!({ "camera_model": "OPENCV", "w": 8, "h": 6, "frames": views });
        std::fs::write(root.join(format!("transforms/frame_{frame:04}.json")), json.to_string()).unwrap();
    }
}

pub(super) fn digest_bytes(hex: &str) -> [u8; 32] {
    *blake3::Hash::from_hex(hex).unwrap().as_bytes()
}
