//! `track` and `eval-tracks` as commands.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{path::Path, time::Duration};

use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};
use serde_json::Value;
use trackersplat_tests::{clips, program};

/// The cheapest tracks: what is said of them matters here, not how good they are.
const QUICK: [&str; 2] = ["--quality", "draft"];

/// The images as they are: standard deviations are smallest where nothing is scaled.
const WHOLE: [&str; 4] = ["--quality", "draft", "--set", "tracking.full_side=800"];

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Runs a command that must succeed; what it said on standard output and error.
fn succeeds(arguments: &[&str]) -> String {
    let (code, said) = program::run(arguments);
    assert_eq!(code, 0, "{arguments:?}:\n{said}");
    said
}

/// Runs a command that must find its input bad, and say all of `parts`.
fn is_refused(arguments: &[&str], parts: &[&str]) {
    let (code, said) = program::run(arguments);
    assert_eq!(code, 3, "{arguments:?}:\n{said}");
    for part in parts {
        assert!(said.contains(part), "{part} in:\n{said}");
    }
}

#[test]
fn tracks_are_written_pictured_and_measure_the_same_from_the_file() {
    let clip = clips::scratch(2, 2);
    let clip = text(clip.path());
    let folder = tempfile::tempdir().unwrap();
    let (out, pictures) = (folder.path().join("tracks"), folder.path().join("pictures"));
    let line = [&["track", clip, "--out", text(&out), "--pictures", text(&pictures), "--quiet"], &WHOLE[..]];
    let said = succeeds(&line.concat());
    let files = ["cam00", "cam01"].map(|view| out.join(format!("{view}.npz")));
    for (view, file) in ["cam00", "cam01"].iter().zip(&files) {
        assert!(said.contains(text(file)) && file.exists(), "{said}");
        for kind in ["flow", "tracks", "uncertainty"] {
            let picture = image::open(pictures.join(view).join(format!("{kind}_0002.png"))).unwrap();
            assert_eq!((picture.width(), picture.height()), (320, 180));
        }
    }

    let errors = folder.path().join("errors");
    let own = [&["eval-tracks", clip, "--json", "--quiet", "--pictures", text(&errors)], &WHOLE[..]].concat();
    let own: Value = serde_json::from_str(&succeeds(&own)).unwrap();
    // The second view's file first: names decide, not the order.
    let from_files = ["eval-tracks", clip, "--json", "--quiet", "--tracks", text(&files[1]), text(&files[0])];
    let from_files: Value = serde_json::from_str(&succeeds(&from_files)).unwrap();
    assert_eq!(own, from_files);
    assert!(errors.join("cam01/error_0002.png").exists());

    assert_eq!(own["views"], serde_json::json!(["cam00", "cam01"]));
    let moving = &own["pixels"]["moving"]["endpoint"];
    // Objects of the clip move by 40 px and more.
    assert!(moving["pixels"].as_u64().unwrap() > 1000 && moving["median"].as_f64().unwrap() < 2.0, "{own}");
    // What rests, rests; and standard deviations mean what they say (those of `balanced` are within 10 points of a Gaussian's).
    let all = &own["pixels"]["all"];
    let within = [0, 1].map(|sigmas| all["within"][sigmas].as_f64().unwrap());
    assert!((0.5..0.8).contains(&within[0]) && (0.8..0.99).contains(&within[1]), "{within:?}");
    let (median, iou) = (&all["endpoint"]["median"], &all["visibility"]["iou"]);
    assert!(median.as_f64().unwrap() < 0.1 && iou.as_f64().unwrap() > 0.9, "{median} px, {iou}");
    let deciles = own["pixels"]["all"]["deciles"].as_array().unwrap();
    assert_eq!(deciles.len(), 10);
    // Small enough that any floor of what is read would show.
    assert!(deciles[0]["from"].as_f64().unwrap() < 0.05, "{own}");
    assert_eq!(own["points"], Value::Null);
    // There is one later frame: its errors are those of the clip.
    let [frame] = own["by_frame"].as_array().unwrap().as_slice() else { panic!("{own}") };
    assert_eq!(frame["frame"], 2);
    for group in ["all", "moving"] {
        let whole = &own["pixels"][group]["endpoint"];
        assert_eq!(frame[group]["pixels"], whole["pixels"]);
        let means = [&frame[group]["mean"], &whole["mean"]].map(|mean| mean.as_f64().unwrap());
        // Sums of doubles, added by view and in one go.
        assert!((means[0] - means[1]).abs() < 1e-9 * means[1], "{means:?}");
    }
}

#[test]
fn one_view_goes_to_one_file_and_a_table_is_printed() {
    let clip = clips::scratch(2, 2);
    let clip = text(clip.path());
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("any.npz");
    let one_view = ["--views", "cam00", "--quiet"];
    succeeds(&[&["track", clip, "--out", text(&file)], &one_view[..], &QUICK[..]].concat());
    let table = succeeds(&[&["eval-tracks", clip, "--tracks", text(&file)], &one_view[..]].concat());
    for word in ["EPE px", "moving", "precision", "68.3 %", "decile"] {
        assert!(table.contains(word), "{word} in:\n{table}");
    }
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(left.len(), 1, "{left:?}");
}

#[test]
fn wrong_input_names_what_is_wrong_and_the_remedy() {
    let folder = clips::scratch(2, 2);
    let clip = text(folder.path());
    let out = tempfile::tempdir().unwrap();
    let file = out.path().join("one.npz");
    is_refused(&["track", clip, "--out", text(&file)], &["one.npz", "2 views", "--views"]);
    let line = ["track", clip, "--out", text(&file), "--views", "cam07"];
    is_refused(&line, &["'cam07'", "cam00, cam01, test00"]);
    let line = ["track", clip, "--out", text(&file), "--views", "cam00", "--frames", "2..2"];
    is_refused(&line, &["two frames", "--frames"]);
    let line = ["track", clip, "--out", text(&file), "--set", "refine.iterations=3"];
    is_refused(&line, &["refine.iterations=3", "tracking."]);
    is_refused(&["eval-tracks", clip, "--views", "test00"], &["flow/test00.npz", "--views"]);
    is_refused(
        &["eval-tracks", clip, "--tracks", text(&file)],
        &["cam00, cam01", "one npz per view", "--views"],
    );
    let line = ["eval-tracks", clip, "--views", "cam01", "--tracks", "cam00.npz"];
    is_refused(&line, &["cam00.npz", "'cam01'", "named after the views"]);
    is_refused(&["eval-tracks", clip, "--views", "cam00", "--tracks", text(&file)], &["one.npz"]);
    let (code, said) = program::run(["eval-tracks", clip, "--tracks", text(&file), "--quality", "best"]);
    assert_eq!(code, 2, "{said}");
}

#[test]
fn ctrl_c_ends_it_and_leaves_nothing_half_written() {
    let out = tempfile::tempdir().unwrap();
    let clip = program::demo_clip();
    // Slow enough that it cannot end before the signal comes.
    let line =
        ["track", text(&clip), "--out", text(out.path()), "--views", "cam00,cam01", "--quality", "best"];
    let mut run = program::start(line);
    let files = || std::fs::read_dir(out.path()).unwrap().count();
    while files() == 0 {
        assert!(run.is_running(), "{}", run.log());
        std::thread::sleep(Duration::from_millis(5));
    }
    kill(Pid::from_raw(run.id() as i32), Signal::SIGINT).unwrap();
    assert_eq!(run.wait().code(), Some(130), "{}", run.log());
    assert!(run.log().contains("error: interrupted"), "{}", run.log());
    assert_eq!(files(), 0);
}
