#![allow(clippy::unwrap_used, reason = "tests")]
//! Jobs whose tracks come from a neural network: a small one, written here.

use prost::Message;
use splat::{formats::track_blob, tracking::TrackField};
use tonic::Code;
use trackersplat_proto::v1::{
    CancelRequest, JobState, SubmitRequest, job_event::Event, submit_request::Tracks,
};

use super::harness::{Bench, frame_job, track_job};

#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(message, required, tag = "7")]
    graph: Graph,
    #[prost(message, required, tag = "8")]
    operators: OperatorSet,
}

#[derive(Clone, PartialEq, Message)]
struct OperatorSet {
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Clone, PartialEq, Message)]
struct Graph {
    #[prost(message, repeated, tag = "1")]
    nodes: Vec<Node>,
    #[prost(message, repeated, tag = "5")]
    constants: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    inputs: Vec<Port>,
    #[prost(message, repeated, tag = "12")]
    outputs: Vec<Port>,
}

#[derive(Clone, PartialEq, Message)]
struct Node {
    #[prost(string, repeated, tag = "1")]
    inputs: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    outputs: Vec<String>,
    #[prost(string, tag = "4")]
    operator: String,
}

#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int64, repeated, packed = "false", tag = "1")]
    shape: Vec<i64>,
    #[prost(int32, tag = "2")]
    kind: i32,
    #[prost(string, tag = "8")]
    name: String,
    #[prost(bytes = "vec", tag = "9")]
    values: Vec<u8>,
}

/// An input or output by its name; the type is left out where anything goes.
#[derive(Clone, PartialEq, Message)]
struct Port {
    #[prost(string, tag = "1")]
    name: String,
}

/// A network for images of 8 × 6 that sees everything move alike.
fn network(motion: [f32; 2]) -> Vec<u8> {
    let constant = |name: &str, channels: i64, values: Vec<f32>| Tensor {
        shape: vec![1, channels, 6, 8],
        kind: 1,
        name: format!("constant_{name}"),
        values: values.into_iter().flat_map(f32::to_le_bytes).collect(),
    };
    let identity = |name: &str| Node {
        inputs: vec![format!("constant_{name}")],
        outputs: vec![name.into()],
        operator: "Identity".into(),
    };
    let port = |name: &str| Port { name: name.into() };
    let flow = motion.into_iter().flat_map(|step| [step; 48]).collect();
    let graph = Graph {
        nodes: vec![identity("flow"), identity("visibility")],
        constants: vec![constant("flow", 2, flow), constant("visibility", 1, vec![1.0; 48])],
        inputs: vec![port("image1"), port("image2")],
        outputs: vec![port("flow"), port("visibility")],
    };
    Model { ir_version: 8, graph, operators: OperatorSet { version: 17 } }.encode_to_vec()
}

/// A submission with the network in `file`.
fn submission(bench: &Bench, file: &str) -> SubmitRequest {
    submission_in(bench, file, 16)
}

/// [`submission`] in windows of so many frames.
fn submission_in(bench: &Bench, file: &str, window: u32) -> SubmitRequest {
    SubmitRequest {
        settings_json: format!(r#"{{"tracking": {{"window": {window}, "onnx": {{"multiple": 1}}}}}}"#),
        tracks: Some(Tracks::TrackerModel(bench.path(file))),
        ..bench.request()
    }
}

/// The fields that a network finds for the second frame, of every training view.
async fn tracked_by(file: &str, network: &[u8]) -> Vec<TrackField> {
    let bench = Bench::start().await;
    std::fs::write(bench.path(file), network).unwrap();
    let job = bench.submit(submission(&bench, file)).await.unwrap().job_id;
    let tracked = |event: &Event| matches!(event, Event::JobState(s) if s.state() == JobState::Frames);
    bench.watch(&job, 0).await.until(tracked).await;
    let (mut first, mut second) = (bench.worker("a").await, bench.worker("b").await);
    assert!(frame_job(&first.lease().await).key_frame);
    let frame = frame_job(&second.lease().await);
    let mut fields = Vec::new();
    for view in &frame.training_views {
        let tracks = bench.get(&view.tracks.as_ref().unwrap().digest).await.unwrap();
        fields.push(track_blob::decode(&tracks).unwrap());
    }
    fields
}

#[tokio::test]
async fn a_network_tracks_in_place_of_the_built_in_tracker() {
    for (file, motion) in [("a.onnx", [1.5, -0.5]), ("b.onnx", [-1.0, 0.25])] {
        let fields = tracked_by(file, &network(motion)).await;
        assert_eq!(fields.len(), 3, "one per training view");
        for field in fields {
            let index = 3 * 8 + 4;
            assert!(field.visible[index]);
            // Multiples of a 64th of a pixel are stored exactly.
            assert_eq!(field.positions[index], [4.5 + motion[0], 3.5 + motion[1]], "{file}");
        }
    }
}

#[tokio::test]
async fn a_network_tracks_in_windows_to_the_same_fields() {
    let mut found = Vec::new();
    for (window, leases) in [(16, 1), (1, 2)] {
        let bench = Bench::start().await;
        std::fs::write(bench.path("net.onnx"), network([1.5, -0.5])).unwrap();
        let job = bench.submit(submission_in(&bench, "net.onnx", window)).await.unwrap().job_id;
        let mut attempts = 0;
        let mut watch = bench.watch(&job, 0).await;
        watch
            .until(|event| {
                if let Event::TracksState(tracks) = event {
                    assert!(tracks.failure.is_none(), "{tracks:?}");
                    attempts = attempts.max(tracks.attempt);
                }
                matches!(event, Event::JobState(s) if s.state() == JobState::Frames)
            })
            .await;
        assert_eq!(attempts, leases, "what remembers nothing is a state as well");
        let fields = |ledger: &crate::ledger::TrackLedger| (ledger.at(2), ledger.at(3));
        found.push(bench.hub().tracks(&job.as_str().into(), fields).await.unwrap());
    }
    assert!(found[0] == found[1] && found[0].1.is_some());
}

#[tokio::test]
async fn workers_get_the_network_by_its_digest() {
    let bench = Bench::start().await;
    let bytes = network([1.0, 0.0]);
    std::fs::write(bench.path("net.onnx"), &bytes).unwrap();
    let mut worker = bench.worker("w").await;
    bench.submit(submission(&bench, "net.onnx")).await.unwrap();
    let tracker = track_job(&worker.lease().await).tracker.unwrap();
    assert_eq!(tracker.model_name, "net.onnx");
    let model = tracker.model.unwrap();
    assert_eq!(model.digest, blake3::hash(&bytes).to_hex().as_str());
    assert_eq!(bench.get(&model.digest).await.unwrap(), bytes);
}

#[tokio::test]
async fn a_file_that_is_no_tracker_is_refused_before_anything_is_computed() {
    let bench = Bench::start().await;
    let refusal = async |file: &str| {
        let status = bench.submit(submission(&bench, file)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument);
        assert!(status.message().contains(file), "{status}");
        status.message().to_owned()
    };
    assert!(refusal("missing.onnx").await.contains("may be read"));
    let whole = network([0.0, 0.0]);
    std::fs::write(bench.path("cut.onnx"), &whole[..whole.len() - 9]).unwrap();
    assert!(refusal("cut.onnx").await.contains("docs/trackers.md"));
    let mut other = Model::decode(whole.as_slice()).unwrap();
    other.graph.outputs.remove(0);
    std::fs::write(bench.path("other.onnx"), other.encode_to_vec()).unwrap();
    assert!(refusal("other.onnx").await.contains("no output flow"));
}

#[tokio::test]
async fn a_job_needs_its_network_no_more_once_it_is_submitted() {
    let bench = Bench::start().await;
    let bytes = network([1.0, 0.0]);
    let digest = blake3::hash(&bytes).to_hex();
    std::fs::write(bench.path("net.onnx"), &bytes).unwrap();
    let mut worker = bench.worker("w").await;
    let job = bench.submit(submission(&bench, "net.onnx")).await.unwrap().job_id;
    std::fs::rename(bench.path("net.onnx"), bench.path("moved.onnx")).unwrap();
    assert_eq!(bench.get(&digest).await.unwrap(), bytes);
    assert_eq!(track_job(&worker.lease().await).tracker.unwrap().model.unwrap().digest, digest.as_str());

    // Submitted again from its new place it is the same job, which knows the file by that place.
    let request = CancelRequest { job_id: job.clone() };
    bench.jobs().cancel(request).await.unwrap();
    let again = bench.submit(submission(&bench, "moved.onnx")).await.unwrap();
    assert_eq!((again.job_id.as_str(), again.resumed), (job.as_str(), true));
    let stored = bench.hub().store.job(&job).await.unwrap().unwrap().request;
    assert!(stored.contains("moved.onnx") && !stored.contains("net.onnx"), "{stored}");
}
