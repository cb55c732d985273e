//! The pieces run by hand: coordinator, worker and clients as processes of their own over loopback.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::BTreeMap,
    ffi::OsString,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::OnceLock,
};

use serde_json::Value;
use tempfile::TempDir;
use trackersplat_tests::{
    clips,
    program::{self, Running},
};

/// Few steps: what is computed does not matter here, that it arrives does.
const QUICK: [&str; 6] =
    ["--set", "static_model.max_steps=20", "--set", "refine.iterations=5", "--tracks", "exact"];
/// The first frame is done at once, because nothing moves in it; the second is still busy when it is cancelled.
const SLOW: [&str; 8] = [
    "--set",
    "static_model.max_steps=20",
    "--set",
    "refine.iterations=20000",
    "--set",
    "refine.plateau_window=0",
    "--tracks",
    "exact",
];

fn clip() -> &'static Path {
    static CLIP: OnceLock<TempDir> = OnceLock::new();
    CLIP.get_or_init(|| clips::scratch(2, 3)).path()
}

/// A coordinator with an empty state, and what is said to it.
struct Service {
    _coordinator: Running,
    address: String,
    folder: TempDir,
}

impl Service {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("root");
        let root = root.to_str().unwrap();
        let mut coordinator = program::start([
            "coordinator",
            "--root",
            root,
            "--listen",
            "127.0.0.1:0",
            "--device",
            "cpu",
            "--quiet",
        ]);
        let address = coordinator.wait_for(&["http://127.0.0.1:"]).trim().to_owned();
        Self { _coordinator: coordinator, address, folder }
    }

    fn output(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn arguments(&self, arguments: &[&str]) -> Vec<OsString> {
        let address = ["--coordinator", self.address.as_str()];
        arguments.iter().chain(&address).map(OsString::from).collect()
    }

    fn worker(&self, more: &[&str]) -> Running {
        program::start(self.arguments(&[&["worker", "--threads", "1", "--device", "cpu"], more].concat()))
    }

    fn run(&self, arguments: &[&str]) -> (i32, String) {
        program::run(self.arguments(&[arguments, &["--quiet"]].concat()))
    }

    fn succeeds(&self, arguments: &[&str]) -> String {
        let (code, said) = self.run(arguments);
        assert_eq!(code, 0, "{arguments:?}:\n{said}");
        said.trim().to_owned()
    }

    /// The id of a new job on the clip.
    fn submit(&self, settings: &[&str]) -> String {
        let output = self.output();
        let fixed = ["submit", clip().to_str().unwrap(), "--out", output.to_str().unwrap()];
        self.succeeds(&[&fixed, settings].concat())
    }

    fn only_job(&self) -> Value {
        let jobs: Vec<Value> = serde_json::from_str(&self.succeeds(&["list", "--json"])).unwrap();
        assert_eq!(jobs.len(), 1, "{jobs:?}");
        jobs.into_iter().next().unwrap()
    }

    fn fetch(&self, job: &str) -> PathBuf {
        let folder = self.folder.path().join("fetched");
        self.succeeds(&["fetch", job, "--out", folder.to_str().unwrap()]);
        folder
    }
}

/// Files of the frames by path relative to the result's folder.
fn frames(output: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for folder in ["frames", "deltas"] {
        for entry in std::fs::read_dir(output.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(output).unwrap().to_owned();
            files.insert(name, std::fs::read(path).unwrap());
        }
    }
    files
}

fn assert_same_frames(left: &Path, right: &Path) {
    let (left, right) = (frames(left), frames(right));
    assert!(left.keys().eq(right.keys()), "{:?} and {:?}", left.keys(), right.keys());
    for (name, bytes) in &left {
        assert!(bytes == &right[name], "{} has the same bytes", name.display());
    }
}

fn sequence(folder: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join("sequence.json")).unwrap()).unwrap()
}

/// A finished job of an ordinary worker, its id, and the folder that it was fetched to.
fn finished() -> (Service, String, PathBuf) {
    let service = Service::start();
    let job = service.submit(&QUICK);
    let _worker = service.worker(&[]);
    service.succeeds(&["watch", &job]);
    let fetched = service.fetch(&job);
    (service, job, fetched)
}

#[test]
fn what_is_fetched_is_what_the_coordinator_wrote() {
    let (service, job, fetched) = finished();
    let listed = service.only_job();
    assert_eq!(listed["job_id"], job.as_str());
    assert_eq!((&listed["state"], &listed["frames_done"]), (&"done".into(), &2.into()), "{listed}");
    assert_eq!(frames(&fetched).len(), 4, "a PLY and a delta per frame");
    assert_same_frames(&fetched, &service.output());
    assert_eq!(sequence(&fetched), sequence(&service.output()));
}

#[test]
fn a_worker_without_the_stores_directory_gives_the_same_bytes() {
    let (local, _, _) = finished();
    let service = Service::start();
    let job = service.submit(&QUICK);
    let mut worker = service.worker(&["--remote-blobs"]);
    worker.wait_for(&["bulk goes through the coordinator"]);
    service.succeeds(&["watch", &job]);
    assert_same_frames(&service.output(), &local.output());
}

#[test]
fn cancelling_leaves_finished_frames_and_may_be_repeated() {
    let service = Service::start();
    let job = service.submit(&SLOW);
    let mut watch = program::start(service.arguments(&["watch", &job, "--json", "--quiet"]));
    let _worker = service.worker(&[]);
    watch.wait_for(&["frame_state", "\"frame\":1,", "\"state\":\"done\""]);
    let before = std::fs::read(service.output().join("frames/frame_0001.ply")).unwrap();
    for _ in 0..2 {
        assert_eq!(service.succeeds(&["cancel", &job]), "cancelled");
    }
    assert_eq!(watch.wait().code(), Some(1), "a cancelled job is no success:\n{}", watch.log());
    let listed = service.only_job();
    assert_eq!((&listed["state"], &listed["frames_done"]), (&"cancelled".into(), &1.into()), "{listed}");
    assert!(!service.output().join("frames/frame_0002.ply").exists());
    let fetched = service.fetch(&job);
    assert_eq!(std::fs::read(fetched.join("frames/frame_0001.ply")).unwrap(), before);
}

#[test]
fn a_fetched_folder_can_be_inspected_rendered_and_measured() {
    let (service, _, fetched) = finished();
    let sequence = sequence(&fetched);
    let frame = &sequence["frames"][1];
    let plain = |arguments: &[&str]| {
        let (code, said) = program::run(arguments.iter().chain(&["--quiet"]));
        assert_eq!(code, 0, "{arguments:?}:\n{said}");
        said
    };

    let ply = fetched.join(frame["ply"]["path"].as_str().unwrap());
    let summary: Value = serde_json::from_str(&plain(&["inspect", ply.to_str().unwrap(), "--json"])).unwrap();
    assert_eq!(summary["count"], sequence["static_model"]["gaussians"]);

    let png = service.folder.path().join("view.png");
    let folder = fetched.to_str().unwrap();
    plain(&["render", folder, "--view", "test00", "--frame", "2", "--out", png.to_str().unwrap()]);
    let view = sequence["views"].as_array().unwrap().iter().find(|view| view["name"] == "test00").unwrap();
    let (width, height) = image::image_dimensions(&png).unwrap();
    assert_eq!((&view["camera"]["width"], &view["camera"]["height"]), (&width.into(), &height.into()));

    let measured: Vec<Value> =
        serde_json::from_str(&plain(&["eval", folder, "--json", "--device", "cpu"])).unwrap();
    assert_eq!(measured.len(), 2);
    for (now, then) in measured.iter().zip(sequence["frames"].as_array().unwrap()) {
        let psnr = |views: &Value| {
            let views = views.as_array().unwrap();
            views.iter().find(|view| view["view"] == "test00").unwrap()["psnr"].as_f64().unwrap()
        };
        let (now, then) = (psnr(&now["views"]), psnr(&then["report"]["after"]));
        // The file holds the exact Gaussians that were measured; 1e-6 dB is rounding in the last digits.
        assert!((now - then).abs() < 1e-6, "{now} and {then} dB");
    }
}

#[test]
fn a_reader_that_leaves_is_no_failure() {
    let (service, job, _) = finished();
    let mut watch = Command::new(program::path())
        .args(service.arguments(&["watch", &job, "--json"]))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(watch.stdout.take());
    let ended = watch.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(0), "{}", String::from_utf8_lossy(&ended.stderr));
}

#[test]
fn a_finished_run_that_is_repeated_starts_no_worker() {
    let output = tempfile::tempdir().unwrap();
    let fixed = ["reconstruct", clip().to_str().unwrap(), "--out", output.path().to_str().unwrap()];
    let arguments = [&fixed[..], &["--workers", "1"], &QUICK].concat();
    let log = output.path().join(".trackersplat/worker-1.log");
    for is_first in [true, false] {
        let (code, said) = program::run(&arguments);
        assert_eq!(code, 0, "{said}");
        assert_eq!(log.exists(), is_first, "a worker leaves its log:\n{said}");
        if is_first {
            std::fs::remove_file(&log).unwrap();
        }
    }
}
