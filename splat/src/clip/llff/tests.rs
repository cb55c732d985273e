#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;
use crate::clip::{
    Clip,
    testing::{Synthetic, assert_same_content, skip, write_npy},
    video::tests::{has_ffmpeg, write_video},
};

/// Poses with the frames already in `images/`, and the splits named.
fn llff() -> Synthetic {
    let clip = Synthetic::centred();
    clip.write_llff();
    let cameras: Vec<_> =
        clip.views.iter().map(|view| serde_json::json!({ "name": view.name, "split": view.split })).collect();
    clip.write("cameras.json", serde_json::json!({ "width": 16, "cameras": cameras }).to_string());
    clip
}

#[test]
fn extracted_frames_need_no_video() {
    let clip = llff();
    let opened = clip.open().unwrap();
    assert_eq!(opened.layout(), Layout::Llff);
    assert!(opened.points().is_empty());
    assert_same_content(&opened, &clip);
}

#[test]
fn single_precision_is_read() {
    let clip = llff();
    let rows: Vec<f32> = clip.llff_rows().into_iter().map(|value| value as f32).collect();
    write_npy(&clip.path("poses_bounds.npy"), &rows, &[4, 17]);
    let opened = clip.open().unwrap();
    let drift = opened.views()[2].camera.centre() - clip.views[2].camera.centre();
    // Positions of a few units in f32.
    assert!(drift.length() < 1e-6);
}

#[test]
fn the_first_view_is_held_out_unless_someone_says_otherwise() {
    let clip = llff();
    std::fs::remove_file(clip.path("cameras.json")).unwrap();
    let splits = |opened: &Clip| opened.views().iter().map(|view| view.split).collect::<Vec<_>>();
    use Split::{Test, Train};
    assert_eq!(splits(&clip.open().unwrap()), [Test, Train, Train, Train]);
    let options = ClipOptions { test_views: vec!["cam02".to_owned()], ..ClipOptions::default() };
    assert_eq!(splits(&Clip::open(clip.root(), &options).unwrap()), [Train, Train, Test, Train]);
    clip.write("cameras.json", r#"{"cameras": [{"name": "cam00"}, {"name": "cam01"}]}"#);
    assert_eq!(
        splits(&clip.open().unwrap()),
        [Test, Train, Train, Train],
        "cameras without splits decide nothing"
    );
    clip.write("cameras.json", r#"{"cameras": [{"name": "cam00", "split": "train"}]}"#);
    clip.error(&["cameras.json", "no split for cam01"]);
    clip.write("cameras.json", r#"{"cameras": [{"name": "cam00", "split": "sometimes"}]}"#);
    clip.error(&["cameras.json", "sometimes"]);
}

#[test]
fn poses_and_cameras_must_match() {
    let clip = llff();
    let rows = clip.llff_rows();
    write_npy(&clip.path("poses_bounds.npy"), &rows[..17 * 3], &[3, 17]);
    std::fs::create_dir(clip.path("videos")).unwrap();
    for name in ["b.mp4", "a.MP4"] {
        clip.write(&format!("videos/{name}"), "");
    }
    let error = clip.error(&["poses_bounds.npy", "3 rows for 2 cameras", "videos"]);
    assert!(matches!(error, ClipError::RowCount { .. }));
}

#[test]
fn arrays_of_another_kind_are_refused() {
    let clip = llff();
    let path = clip.path("poses_bounds.npy");
    write_npy(&path, &[0.0_f64; 60], &[4, 15]);
    clip.error(&["poses_bounds.npy", "[4, 15]", "17"]);
    write_npy(&path, &[0_i32; 68], &[4, 17]);
    clip.error(&["poses_bounds.npy", "i4"]);
    write_npy::<f64>(&path, &[], &[0, 17]);
    assert!(matches!(clip.error(&["empty"]), ClipError::EmptyModel { .. }));
    std::fs::write(&path, b"no array").unwrap();
    clip.error(&["poses_bounds.npy"]);
    clip.write_llff();
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, &whole[..whole.len() - 1]).unwrap();
    clip.error(&["poses_bounds.npy"]);
}

#[test]
fn broken_rows_are_named() {
    let clip = llff();
    let edited = |column: usize, value: f64| {
        let mut rows = clip.llff_rows();
        rows[17 + column] = value;
        write_npy(&clip.path("poses_bounds.npy"), &rows, &[4, 17]);
    };
    edited(3, f64::NAN);
    assert!(matches!(clip.error(&["cam01", "not finite"]), ClipError::Pose { .. }));
    edited(0, 5.0);
    assert!(matches!(clip.error(&["cam01", "not a rotation"]), ClipError::Pose { .. }));
    edited(4, 10.5);
    clip.error(&["height of cam01", "10.5"]);
    edited(14, 0.0);
    assert!(matches!(clip.error(&["cam01", "focal length", "0"]), ClipError::Intrinsics { .. }));
    edited(14, f64::INFINITY);
    assert!(matches!(clip.error(&["cam01", "focal length", "inf"]), ClipError::Intrinsics { .. }));

    let mut mirrored = clip.llff_rows();
    for row in 0..3 {
        mirrored[17 + row * 5] *= -1.0;
    }
    write_npy(&clip.path("poses_bounds.npy"), &mirrored, &[4, 17]);
    assert!(matches!(clip.error(&["cam01", "mirrored"]), ClipError::Pose { .. }));
}

#[test]
fn videos_need_a_scratch_folder() {
    let clip = llff();
    std::fs::rename(clip.path("images"), clip.path("elsewhere")).unwrap();
    for view in &clip.views {
        clip.write(&format!("{}.mp4", view.name), "");
    }
    let error = clip.error(&["cam00.mp4", "scratch"]);
    assert!(matches!(error, ClipError::NoScratch { .. }));
}

#[test]
fn videos_become_frames() {
    if !has_ffmpeg() {
        skip("no ffmpeg on the PATH");
        return;
    }
    let clip = llff();
    std::fs::remove_dir_all(clip.path("images")).unwrap();
    let mut rows = clip.llff_rows();
    for row in rows.chunks_exact_mut(17) {
        (row[4], row[9]) = (48.0, 64.0);
    }
    write_npy(&clip.path("poses_bounds.npy"), &rows, &[4, 17]);
    std::fs::create_dir(clip.path("videos")).unwrap();
    for (index, view) in clip.views.iter().enumerate() {
        write_video(&clip.path(&format!("videos/{}.mp4", view.name)), 5 + u32::from(index == 2));
    }
    let options =
        |frames| ClipOptions { frames, scratch: Some(clip.path("scratch")), ..ClipOptions::default() };
    let opened = Clip::open(clip.root(), &options(Some((2, 4)))).unwrap();
    assert_eq!(opened.frames(), [2, 3, 4]);
    assert_eq!(opened.views()[3].split, Split::Test);
    for frame in 0..3 {
        let grey = opened.image(1, frame).unwrap().at(32, 24)[0] * 255.0;
        // The codec is lossy: half of the difference between frames is what tells them apart.
        assert!((grey - 20.0 * (frame as f32 + 2.0)).abs() < 10.0, "{grey}");
    }
    let error = Clip::open(clip.root(), &options(None)).unwrap_err();
    assert!(matches!(&error, ClipError::MissingFrame { frame: 6, view, .. } if view == "cam00"), "{error}");
    let error = Clip::open(clip.root(), &options(Some((2, 9)))).unwrap_err();
    assert!(matches!(error, ClipError::FrameRange { last: 9, available_last: 6, .. }), "{error}");
}
