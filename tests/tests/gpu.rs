//! The GPU engine from end to end: as good as the CPU engine, the same bytes for the same device, and what a run survives in
//! which both compute.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::OnceLock,
};

use serde_json::Value;
use tempfile::TempDir;
use trackersplat_tests::{
    clips,
    gpu::{TestDevice, device, listed},
    program::{self, Running},
};

/// Short enough for software that behaves like a GPU.
const SETTINGS: [&str; 10] = [
    "--set",
    "static_model.max_steps=30",
    "--set",
    "static_model.densify_until=0.0",
    "--set",
    "refine.iterations=20",
    "--set",
    "refine.plateau_window=0",
    "--set",
    "motion.field_rounds=1",
];

fn sequence(output: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(output.join("sequence.json")).unwrap()).unwrap()
}

fn frame_file(output: &Path, number: u64) -> Vec<u8> {
    std::fs::read(output.join(format!("frames/frame_{number:04}.ply"))).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A finished run with an embedded coordinator.
fn reconstructed(clip: &Path, device: &str) -> TempDir {
    let output = tempfile::tempdir().unwrap();
    let fixed = ["reconstruct", text(clip), "--out", text(output.path()), "--quiet", "--device", device];
    let (code, said) = program::run(fixed.iter().chain(&["--workers", "1"]).chain(&SETTINGS));
    assert_eq!(code, 0, "{said}");
    output
}

fn held_out_psnr(sequence: &Value) -> Vec<f64> {
    let frames = sequence["frames"].as_array().unwrap().iter();
    let mean = |frame: &Value| {
        let views = frame["report"]["after"].as_array().unwrap();
        views.iter().find(|view| view["view"] == "mean").unwrap()["psnr"].as_f64().unwrap()
    };
    frames.map(mean).collect()
}

#[test]
fn software_is_listed_and_never_chosen_unless_named() {
    let devices = listed();
    assert_eq!(devices[0]["device"], "cpu");
    let taken: Vec<_> = devices.iter().filter(|device| device["auto"] == true).collect();
    assert_eq!(taken.len(), 1, "{devices:?}");
    assert_ne!(taken[0]["kind"], "software");
    let has_gpu = taken[0]["engine"] == "gpu";
    let render = |device: &str| {
        program::run(["render", "x", "--view", "v", "--frame", "1", "--out", "y", "--device", device])
    };
    let (code, said) = render("no such card");
    assert_eq!(code, 3, "{said}");
    for device in &devices[1..] {
        assert!(said.contains(device["name"].as_str().unwrap()), "{said}");
    }
    let (_, said) = render("gpu");
    assert_eq!(said.contains("no GPU fits"), !has_gpu, "{said}");
}

#[test]
fn the_gpu_engine_is_as_good_as_the_cpu_engine_and_gives_the_same_bytes_twice() {
    let Some(TestDevice { argument, name }) = device() else { return };
    let clip = clips::halved(2, 4);
    let cpu = reconstructed(clip.path(), "cpu");
    let runs = [&argument, &name].map(|device| reconstructed(clip.path(), device));
    let [first, second] = runs.each_ref().map(TempDir::path);
    for (path, device) in [(cpu.path(), "cpu"), (first, name.as_str())] {
        let sequence = sequence(path);
        let computed_by = |report: &Value| report["device"].as_str().unwrap().contains(device);
        assert!(computed_by(&sequence["static_model"]["report"]), "{sequence:#}");
        assert!(sequence["frames"].as_array().unwrap().iter().all(|frame| computed_by(&frame["report"])));
    }
    for file in ["static.ply", "frames/frame_0001.ply", "frames/frame_0002.ply", "deltas/frame_0002.delta"] {
        let read = |folder: &Path| {
            std::fs::read(folder.join(file)).unwrap_or_else(|error| panic!("{file}: {error}"))
        };
        assert!(read(first) == read(second), "{file} has the same bytes");
    }
    let psnr = [cpu.path(), first].map(|path| held_out_psnr(&sequence(path)));
    assert_eq!(psnr[0].len(), 2);
    for (cpu, gpu) in psnr[0].iter().zip(&psnr[1]) {
        assert!(*cpu > 15.0 && (cpu - gpu).abs() < 0.1, "{psnr:?} dB");
    }
}

/// A coordinator on the processor, and what is said to it.
struct Fleet {
    folder: TempDir,
    coordinator: Running,
    address: String,
}

/// Frames of the clip that fleets work on.
const FRAMES: u64 = 5;
const GPU_WORKER: &str = "on-gpu";
const CPU_WORKER: &str = "on-cpu";

impl Fleet {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (coordinator, address) = coordinator(folder.path(), "127.0.0.1:0");
        Self { folder, coordinator, address }
    }

    /// SIGKILL, and a new one on the same folder and address.
    fn restart_coordinator(&mut self) {
        self.coordinator.kill();
        let listen = self.address.strip_prefix("http://").unwrap().to_owned();
        (self.coordinator, _) = coordinator(self.folder.path(), &listen);
    }

    fn output(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn submit(&self) -> String {
        static CLIP: OnceLock<TempDir> = OnceLock::new();
        let clip = CLIP.get_or_init(|| clips::halved(FRAMES as u32, 3));
        let output = self.output();
        let fixed = ["submit", text(clip.path()), "--out", text(&output), "--coordinator", &self.address];
        let (code, said) = program::run(fixed.iter().chain(&["--quiet"]).chain(&SETTINGS));
        assert_eq!(code, 0, "{said}");
        said.trim().to_owned()
    }

    fn worker(&self, id: &str, device: &str) -> Running {
        let fixed = ["worker", "--coordinator", &self.address, "--threads", "1", "-v"];
        program::start(fixed.iter().chain(&["--id", id, "--device", device]))
    }

    fn watch(&self, job: &str) -> Running {
        program::start(["watch", job, "--coordinator", &self.address, "-v"])
    }

    /// The files of the frames when all are done by one worker.
    fn undisturbed(id: &str, device: &str) -> Vec<Vec<u8>> {
        let fleet = Self::start();
        let job = fleet.submit();
        let _worker = fleet.worker(id, device);
        let mut watch = fleet.watch(&job);
        assert!(watch.wait().success(), "{}", watch.log());
        (1..=FRAMES).map(|frame| frame_file(&fleet.output(), frame)).collect()
    }
}

fn coordinator(root: &Path, listen: &str) -> (Running, String) {
    let root = root.join("root");
    let mut running = program::start(
        ["coordinator", "--root", text(&root), "--listen", listen, "--device", "cpu", "--quiet"]
            .iter()
            .chain(&["--heartbeat-interval", "0.1", "--lease-duration", "5", "--reconnect-grace", "1"]),
    );
    let address = running.wait_for(&["http://127.0.0.1:"]).trim().to_owned();
    (running, address)
}

#[test]
fn a_killed_gpu_worker_and_a_killed_coordinator_change_nothing_while_a_cpu_worker_computes_too() {
    let Some(TestDevice { argument, name }) = device() else { return };
    let mut fleet = Fleet::start();
    let job = fleet.submit();
    let mut watch = fleet.watch(&job);
    let mut on_gpu = fleet.worker(GPU_WORKER, &name);
    watch.wait_for(&["frame=2", "state=\"done\"", GPU_WORKER]);
    watch.wait_for(&["progress", "stage=\"refine\"", "frame=3"]);
    fleet.restart_coordinator();
    on_gpu.wait_for(&["frame started", "attempt=2", "frame=3"]);
    let mut on_cpu = fleet.worker(CPU_WORKER, "cpu");
    on_cpu.wait_for(&["frame started"]);
    on_gpu.kill();
    assert!(watch.wait().success(), "{}", watch.log());

    let sequence = sequence(&fleet.output());
    let frames = sequence["frames"].as_array().unwrap();
    assert_eq!(frames.len() as u64, FRAMES);
    let attempts = |frame: u64| frames[frame as usize - 1]["attempts"].as_u64().unwrap();
    assert_eq!(attempts(2), 1, "what was done stayed done");
    // One attempt of each that was killed, and the last; a fast device may have ended it before its worker was.
    assert!((2..=3).contains(&attempts(3)), "{frames:#?}");
    let expected: BTreeMap<&str, Vec<Vec<u8>>> = [(CPU_WORKER, "cpu"), (GPU_WORKER, argument.as_str())]
        .map(|(worker, device)| (worker, Fleet::undisturbed(worker, device)))
        .into();
    for (number, frame) in (1..).zip(frames) {
        let worker = frame["worker"].as_str().unwrap();
        let is_on_gpu = frame["report"]["device"].as_str().unwrap().contains(&name);
        assert_eq!(is_on_gpu, worker == GPU_WORKER, "{frame:#}");
        let same = frame_file(&fleet.output(), number) == expected[worker][number as usize - 1];
        assert!(same, "frame {number} has the bytes that {worker} computes undisturbed");
    }
    let by_worker = |id: &str| frames.iter().any(|frame| frame["worker"] == id);
    assert!(by_worker(GPU_WORKER) && by_worker(CPU_WORKER), "both computed: {frames:#?}");
}
