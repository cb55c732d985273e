//! A coordinator for tests: holds blobs in memory, and lets the test speak its lines by hand.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::HashMap,
    pin::Pin,
    sync::{Arc, Mutex},
    time::Duration,
};

use futures::Stream;
use splat::{formats::ply, gaussians::Gaussians, image::Image, settings::Settings};
use tokio::{net::TcpListener, sync::mpsc};
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tonic::{
    Request, Response, Status, Streaming,
    transport::{Channel, Endpoint, Server},
};
use trackersplat_proto::v1::{
    self, Blob, BlobChunk, CoordinatorMessage, FrameJob, FrameView, GetBlobRequest, Lease, PutBlobChunk,
    PutBlobResponse, Register, Report, Welcome, WorkerMessage, blobs_server, coordinator_message,
    worker_message, workers_server,
};

use crate::blobs::digest_of;

type Outgoing = mpsc::Sender<Result<CoordinatorMessage, Status>>;

#[derive(Clone, Default)]
struct Store(Arc<Mutex<HashMap<String, Vec<u8>>>>);

/// One worker's stream, as the coordinator sees it.
pub(crate) struct Session {
    pub(crate) register: Register,
    from_worker: Streaming<WorkerMessage>,
    to_worker: Outgoing,
}

pub(crate) struct TestCoordinator {
    pub(crate) address: String,
    store: Store,
    sessions: tokio::sync::Mutex<mpsc::Receiver<(Streaming<WorkerMessage>, Outgoing)>>,
}

impl TestCoordinator {
    pub(crate) async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let store = Store::default();
        let (sender, sessions) = mpsc::channel(8);
        let server = Server::builder()
            .add_service(workers_server::WorkersServer::new(Sessions(sender)))
            .add_service(blobs_server::BlobsServer::new(store.clone()));
        tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
        Self { address, store, sessions: sessions.into() }
    }

    pub(crate) fn channel(&self) -> Channel {
        Endpoint::from_shared(self.address.clone()).unwrap().connect_lazy()
    }

    /// Stores bytes as the coordinator does.
    pub(crate) fn store(&self, bytes: &[u8]) -> Blob {
        let digest = digest_of(bytes);
        self.store.0.lock().unwrap().insert(digest.clone(), bytes.to_vec());
        Blob { digest, size: bytes.len() as u64 }
    }

    /// Bytes of a stored blob.
    pub(crate) fn stored(&self, digest: &str) -> Vec<u8> {
        self.store.0.lock().unwrap()[digest].clone()
    }

    /// Flips a bit of a stored blob.
    pub(crate) fn damage(&self, digest: &str) {
        self.store.0.lock().unwrap().get_mut(digest).unwrap()[0] ^= 1;
    }

    /// A complete frame job: two training views, one test view, two Gaussians, 6 × 4 pixels.
    pub(crate) fn frame_job(&self, frame: u32) -> FrameJob {
        let view = |name: &str, grey| FrameView {
            name: name.into(),
            camera: Some(wire_camera(6, 4)),
            image: Some(self.store(&Image::filled(6, 4, [grey; 3]).encode_png())),
            ..FrameView::default()
        };
        FrameJob {
            job_id: "job".into(),
            frame,
            key_frame: frame == 1,
            settings_json: serde_json::to_string(&Settings::default()).unwrap(),
            static_model: Some(self.store(&ply::write_ply(&two_gaussians()))),
            training_views: vec![view("cam00", 0.2), view("cam01", 0.4)],
            test_views: vec![view("test00", 0.6)],
        }
    }

    /// Waits for a worker's stream and welcomes it.
    pub(crate) async fn welcome(&self) -> Session {
        let (mut from_worker, to_worker) = self.sessions.lock().await.recv().await.unwrap();
        let first = from_worker.message().await.unwrap().unwrap().message.unwrap();
        let worker_message::Message::Register(register) = first else {
            panic!("registers first, not {first:?}")
        };
        let session = Session { register, from_worker, to_worker };
        let welcome = Welcome { heartbeat_interval_ms: 20, lease_duration_ms: 1000, ..Welcome::default() };
        session.send(coordinator_message::Message::Welcome(welcome)).await;
        session
    }

    /// Waits for a worker's stream and ends it with a status.
    pub(crate) async fn refuse(&self, status: Status) {
        let (_, to_worker) = self.sessions.lock().await.recv().await.unwrap();
        to_worker.send(Err(status)).await.unwrap();
    }
}

impl Session {
    pub(crate) async fn send(&self, message: coordinator_message::Message) {
        self.to_worker.send(Ok(CoordinatorMessage { message: Some(message) })).await.unwrap();
    }

    pub(crate) async fn lease(&self, lease_id: &str, job: FrameJob) {
        let task = Some(v1::lease::Task::Frame(job));
        let lease = Lease { lease_id: lease_id.into(), attempt: 1, task, likely_next: None };
        self.send(coordinator_message::Message::Lease(lease)).await;
    }

    pub(crate) async fn acknowledge(&self, report: &Report) {
        self.send_receipt(report, true, "").await;
    }

    pub(crate) async fn refuse(&self, report: &Report, reason: &str) {
        self.send_receipt(report, false, reason).await;
    }

    async fn send_receipt(&self, report: &Report, accepted: bool, reason: &str) {
        let receipt =
            v1::ReportReceipt { lease_id: report.lease_id.clone(), accepted, reason: reason.to_owned() };
        self.send(coordinator_message::Message::Receipt(receipt)).await;
    }

    /// The next message for which `pick` gives something.
    pub(crate) async fn wait_for<T>(
        &mut self,
        mut pick: impl FnMut(worker_message::Message) -> Option<T>,
    ) -> T {
        let search = async {
            loop {
                let message = self.from_worker.message().await.unwrap().expect("the worker's stream goes on");
                if let Some(found) = message.message.and_then(&mut pick) {
                    return found;
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(15), search).await.expect("the message comes")
    }

    pub(crate) async fn wait_for_lease_request(&mut self) {
        self.wait_for(|message| matches!(message, worker_message::Message::LeaseRequest(_)).then_some(()))
            .await;
    }

    pub(crate) async fn wait_for_report(&mut self) -> Report {
        self.wait_for(
            |message| {
                if let worker_message::Message::Report(report) = message { Some(report) } else { None }
            },
        )
        .await
    }
}

/// Two small Gaussians of degree 0.
pub(crate) fn two_gaussians() -> Gaussians {
    Gaussians {
        means: vec![[0.0, 0.0, 2.0], [0.1, 0.0, 2.5]],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        log_scales: vec![[-2.0; 3]; 2],
        logit_opacities: vec![0.5; 2],
        sh: vec![0.1; 6],
        sh_degree: 0,
    }
}

/// A camera at the origin.
pub(crate) fn wire_camera(width: u32, height: u32) -> v1::Camera {
    v1::Camera {
        width,
        height,
        fx: 5.0,
        fy: 5.0,
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
        rotation: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        translation: vec![0.0; 3],
    }
}

struct Sessions(mpsc::Sender<(Streaming<WorkerMessage>, Outgoing)>);

#[tonic::async_trait]
impl workers_server::Workers for Sessions {
    type WorkStream = ReceiverStream<Result<CoordinatorMessage, Status>>;

    async fn work(
        &self,
        request: Request<Streaming<WorkerMessage>>,
    ) -> Result<Response<Self::WorkStream>, Status> {
        let (to_worker, outgoing) = mpsc::channel(8);
        self.0.send((request.into_inner(), to_worker)).await.unwrap();
        Ok(Response::new(ReceiverStream::new(outgoing)))
    }
}

#[tonic::async_trait]
impl blobs_server::Blobs for Store {
    type GetStream = Pin<Box<dyn Stream<Item = Result<BlobChunk, Status>> + Send>>;

    async fn get(&self, request: Request<GetBlobRequest>) -> Result<Response<Self::GetStream>, Status> {
        let digest = request.into_inner().digest;
        let bytes = self.0.lock().unwrap().get(&digest).cloned().ok_or_else(|| Status::not_found(digest))?;
        let chunks: Vec<_> =
            bytes.chunks(1 << 16).map(|data| Ok(BlobChunk { data: data.to_vec() })).collect();
        Ok(Response::new(Box::pin(futures::stream::iter(chunks))))
    }

    async fn put(
        &self,
        request: Request<Streaming<PutBlobChunk>>,
    ) -> Result<Response<PutBlobResponse>, Status> {
        let mut chunks = request.into_inner();
        let (mut blob, mut bytes) = (None, Vec::new());
        while let Some(chunk) = chunks.message().await? {
            blob = blob.or(chunk.blob);
            bytes.extend(chunk.data);
        }
        assert_eq!(blob.unwrap().digest, digest_of(&bytes));
        self.0.lock().unwrap().insert(digest_of(&bytes), bytes);
        Ok(Response::new(PutBlobResponse {}))
    }
}
