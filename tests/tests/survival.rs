//! What a run survives, with real processes and SIGKILL: the result has the same bytes whatever happens.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    sync::OnceLock,
    time::Duration,
};

use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};
use splat::simd::{InstructionSet, Instructions};
use tempfile::TempDir;
use trackersplat_tests::{
    clips,
    program::{self, Running},
};

/// Short enough for a gate, long enough to be killed in the middle of a frame.
const SETTINGS: [&str; 15] = [
    "-v",
    "--device",
    "cpu",
    "--tracks",
    "exact",
    "--set",
    "static_model.max_steps=120",
    "--set",
    "static_model.densify_until=0.0",
    "--set",
    "refine.iterations=150",
    "--set",
    "refine.plateau_window=0",
    "--set",
    "motion.field_rounds=1",
];

/// The views are tracked, and little else happens.
const TRACKED: [&str; 11] = [
    "-v",
    "--device",
    "cpu",
    "--set",
    "static_model.max_steps=30",
    "--set",
    "static_model.densify_until=0.0",
    "--set",
    "refine.iterations=10",
    "--set",
    "motion.field_rounds=1",
];

fn clip() -> &'static Path {
    static CLIP: OnceLock<TempDir> = OnceLock::new();
    CLIP.get_or_init(|| clips::scratch(4, 4)).path()
}

fn small_clip() -> &'static Path {
    static CLIP: OnceLock<TempDir> = OnceLock::new();
    CLIP.get_or_init(|| clips::halved(4, 4)).path()
}

fn command(clip: &Path, output: &Path, workers: usize, settings: &[&str]) -> Vec<String> {
    let fixed = ["reconstruct", clip.to_str().unwrap(), "--out", output.to_str().unwrap(), "--workers"];
    fixed.iter().chain([&workers.to_string().as_str()]).chain(settings).map(|&a| a.to_owned()).collect()
}

fn arguments(output: &Path, workers: usize) -> Vec<String> {
    command(clip(), output, workers, &SETTINGS)
}

/// A run that tracks by itself.
fn tracking(output: &Path, workers: usize) -> Vec<String> {
    command(small_clip(), output, workers, &TRACKED)
}

fn results(output: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for folder in ["frames", "deltas"] {
        for entry in std::fs::read_dir(output.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(output).unwrap().to_owned();
            files.insert(name, std::fs::read(path).unwrap());
        }
    }
    files.insert("static.ply".into(), std::fs::read(output.join("static.ply")).unwrap());
    files
}

type Files = BTreeMap<PathBuf, Vec<u8>>;

fn files_of(arguments: impl Fn(&Path, usize) -> Vec<String>) -> Files {
    let output = tempfile::tempdir().unwrap();
    let (code, log) = program::run(arguments(output.path(), 2));
    assert_eq!(code, 0, "{log}");
    results(output.path())
}

/// The files of an undisturbed run with two workers.
fn undisturbed() -> &'static Files {
    static FILES: OnceLock<Files> = OnceLock::new();
    FILES.get_or_init(|| files_of(arguments))
}

/// The same of a run that tracks by itself.
fn undisturbed_tracking() -> &'static Files {
    static FILES: OnceLock<Files> = OnceLock::new();
    FILES.get_or_init(|| files_of(tracking))
}

fn assert_same(output: &Path, expected: &Files) {
    let files = results(output);
    let (found, names): (Vec<_>, Vec<_>) = (files.keys().collect(), expected.keys().collect());
    assert_eq!(found, names, "the same files");
    for (name, bytes) in &files {
        assert!(bytes == &expected[name], "{} has the same bytes", name.display());
    }
}

fn assert_undisturbed(output: &Path) {
    assert_same(output, undisturbed());
}

fn signal(process: i32, signal: Signal) {
    kill(Pid::from_raw(process), signal).unwrap();
}

fn attempts(output: &Path) -> BTreeMap<u64, u64> {
    let text = std::fs::read_to_string(output.join("sequence.json")).unwrap();
    let sequence: serde_json::Value = serde_json::from_str(&text).unwrap();
    let frames = sequence["frames"].as_array().unwrap();
    frames.iter().map(|f| (f["number"].as_u64().unwrap(), f["attempts"].as_u64().unwrap())).collect()
}

/// The workers that hold leases of tracks, as the coordinator's log has it so far.
fn tracking_workers(run: &Running) -> BTreeSet<String> {
    let mut tracking = BTreeSet::new();
    for line in run.log().lines() {
        let name = line.split_once("worker_id=\"").and_then(|(_, rest)| rest.split_once('"'));
        let Some((worker, _)) = name else { continue };
        if line.contains(" leased ") && line.contains("kind=\"tracks\"") {
            tracking.insert(worker.to_owned());
        } else if ["window tracked", "view tracked", "attempt failed"].iter().any(|end| line.contains(end)) {
            tracking.remove(worker);
        }
    }
    tracking
}

fn process_of(run: &Running, worker: &str) -> i32 {
    let is_called = |process: &i32| {
        let arguments = std::fs::read(format!("/proc/{process}/cmdline")).unwrap_or_default();
        arguments.split(|&byte| byte == 0).any(|argument| argument == worker.as_bytes())
    };
    run.children().into_iter().find(is_called).unwrap()
}

/// A process that holds the lease of a window, stopped in the middle of it.
fn stopped_in_a_window(run: &mut Running) -> i32 {
    loop {
        run.wait_for(&[" leased ", "kind=\"tracks\""]);
        for worker in tracking_workers(run) {
            let process = process_of(run, &worker);
            signal(process, Signal::SIGSTOP);
            // What it said before is heard meanwhile; it may have been its report.
            std::thread::sleep(Duration::from_millis(500));
            if tracking_workers(run).contains(&worker) {
                return process;
            }
            signal(process, Signal::SIGCONT);
        }
        let is_over = |line: &str| line.contains("job state") && line.contains("state=\"frames\"");
        assert!(!run.log().lines().any(is_over), "all is tracked:\n{}", run.log());
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn wait_for_work(run: &mut Running) {
    run.wait_for(&["frame=2", "state=\"leased\""]);
    run.wait_for(&["frame=3", "state=\"leased\""]);
    for frame in ["frame=2", "frame=3"] {
        run.wait_for(&["progress", "stage=\"refine\"", frame]);
    }
}

#[test]
fn one_worker_and_two_and_a_second_run_give_the_same_bytes() {
    for workers in [1, 2] {
        let output = tempfile::tempdir().unwrap();
        let (code, log) = program::run(arguments(output.path(), workers));
        assert_eq!(code, 0, "{log}");
        assert_undisturbed(output.path());
    }
}

#[test]
fn fused_instruction_sets_give_the_same_bytes_whatever_their_width() {
    let sets = Instructions::available().map(Instructions::set);
    for set in sets.filter(|&set| set != InstructionSet::Baseline) {
        let output = tempfile::tempdir().unwrap();
        let mut arguments = arguments(output.path(), 2);
        arguments.push(format!("--instructions={set}"));
        let (code, log) = program::run(arguments);
        assert_eq!(code, 0, "{log}");
        assert_undisturbed(output.path());
    }
}

#[test]
fn a_worker_killed_in_the_middle_of_a_frame_changes_nothing() {
    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(arguments(output.path(), 2));
    wait_for_work(&mut run);
    signal(run.children()[0], Signal::SIGKILL);
    let status = run.wait();
    assert!(status.success(), "{}", run.log());
    assert_undisturbed(output.path());
    let attempts = attempts(output.path());
    assert!(attempts.values().any(|&count| count == 2), "a lost attempt was repeated: {attempts:?}");
}

#[test]
fn without_workers_the_run_waits_says_so_and_goes_on_when_one_joins() {
    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(arguments(output.path(), 2));
    let line = run.wait_for(&["started; coordinator at http://"]);
    let address = line.split_once("coordinator at ").unwrap().1.split_once(',').unwrap().0.to_owned();
    wait_for_work(&mut run);
    for worker in run.children() {
        signal(worker, Signal::SIGKILL);
    }
    let said = run.wait_for(&["no worker connected"]);
    assert!(said.contains(&format!("trackersplat worker --coordinator {address}")), "{said}");
    let state = tempfile::tempdir().unwrap();
    let mut worker = program::start([
        "worker",
        "--coordinator",
        &address,
        "--device",
        "cpu",
        "--threads",
        "1",
        "--state-dir",
        state.path().to_str().unwrap(),
    ]);
    let status = run.wait();
    assert!(status.success(), "{}", run.log());
    assert!(worker.wait().success(), "dismissed: {}", worker.log());
    assert_undisturbed(output.path());
}

#[test]
fn a_killed_coordinator_goes_on_without_computing_a_frame_twice() {
    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(arguments(output.path(), 2));
    run.wait_for(&["frame=2", "state=\"done\""]);
    run.kill();
    let mut again = program::start(arguments(output.path(), 2));
    assert!(again.wait().success(), "{}", again.log());
    let log = again.log();
    assert!(log.contains("resumed=true"), "{log}");
    for frame in [1, 2] {
        let leased = format!("frame={frame} state=\"leased\" attempt=2");
        assert!(!log.contains(&leased), "frame {frame} was finished:\n{log}");
    }
    assert_undisturbed(output.path());
}

#[test]
fn an_interrupted_run_is_resumed_by_the_same_command() {
    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(arguments(output.path(), 2));
    run.wait_for(&["frame=2", "state=\"done\""]);
    signal(run.id() as i32, Signal::SIGINT);
    assert_eq!(run.wait().code(), Some(130), "{}", run.log());
    let (code, log) = program::run(arguments(output.path(), 2));
    assert_eq!(code, 0, "{log}");
    assert!(log.contains("resumed=true"), "{log}");
    assert_undisturbed(output.path());
}

#[test]
fn one_worker_and_the_coordinator_alone_track_the_same_bytes_as_two_workers() {
    let output = tempfile::tempdir().unwrap();
    let (code, log) = program::run(tracking(output.path(), 1));
    assert_eq!(code, 0, "{log}");
    assert_same(output.path(), undisturbed_tracking());

    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(tracking(output.path(), 0));
    let line = run.wait_for(&["started; coordinator at http://"]);
    let address = line.split_once("coordinator at ").unwrap().1.split_once(',').unwrap().0.to_owned();
    run.wait_for(&["job", "state=\"frames\""]);
    run.wait_for(&["tracks", "state=\"done\"", "worker=\"(coordinator)\""]);
    let fixed = ["worker", "--coordinator", &address, "--device", "cpu", "--threads", "1"];
    let _worker = program::start(fixed);
    let status = run.wait();
    assert!(status.success(), "{}", run.log());
    assert_same(output.path(), undisturbed_tracking());
}

#[test]
fn a_worker_killed_while_it_tracks_a_view_in_windows_changes_nothing() {
    let output = tempfile::tempdir().unwrap();
    // Three frames in two windows; the bytes are those of views that are tracked whole.
    let cut = ["--set", "tracking.window=2"].map(str::to_owned);
    let mut run = program::start(tracking(output.path(), 2).into_iter().chain(cut));
    let process = stopped_in_a_window(&mut run);
    signal(process, Signal::SIGKILL);
    let status = run.wait();
    assert!(status.success(), "{}", run.log());
    assert_same(output.path(), undisturbed_tracking());
    let is_again = |line: &str| line.contains("tracks") && line.contains("attempt=3");
    assert!(run.log().lines().any(is_again), "a window was leased again:\n{}", run.log());
    assert!(run.log().contains("window tracked"), "views were cut:\n{}", run.log());
}

#[test]
fn a_coordinator_killed_while_views_are_tracked_keeps_the_fields_that_exist() {
    let output = tempfile::tempdir().unwrap();
    let mut run = program::start(tracking(output.path(), 2));
    run.wait_for(&["progress", "stage=\"tracking\"", "done=3 "]);
    run.kill();
    let mut again = program::start(tracking(output.path(), 2));
    assert!(again.wait().success(), "{}", again.log());
    let log = again.log();
    assert!(log.contains("resumed=true"), "{log}");
    let done = |line: &str| line.split_once("done=")?.1.split_whitespace().next()?.parse::<u32>().ok();
    let least = log.lines().filter(|line| line.contains("stage=\"tracking\"")).filter_map(done).min();
    assert!(least.is_some_and(|least| least >= 3), "three fields existed:\n{log}");
    assert_same(output.path(), undisturbed_tracking());
}
