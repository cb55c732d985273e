//! Bad input: a non-zero exit, an error that names file, value and remedy, and no frame marked done.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use npyz::WriterBuilder;
use splat::{formats::ply::write_ply, gaussians::Gaussians, image::Image};
use tempfile::TempDir;
use trackersplat_tests::{clips, program};

/// Few steps: what is refused only after the static model must not take long to get there.
const QUICK: [&str; 6] =
    ["--set", "static_model.max_steps=20", "--set", "refine.iterations=5", "--workers", "1"];

struct Scratch {
    folder: TempDir,
}

impl Scratch {
    /// A clip of two frames and three training views.
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        clips::copy(&folder.path().join("clip"), 2, 3);
        Self { folder }
    }

    fn clip(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join("clip").join(name)
    }

    fn edit(&self, name: &str, change: impl Fn(String) -> String) {
        let text = std::fs::read_to_string(self.clip(name)).unwrap();
        std::fs::write(self.clip(name), change(text)).unwrap();
    }

    /// Runs on the clip; the error must hold every one of `said`.
    fn refuses(&self, more: &[&str], said: &[&str]) {
        self.refuses_into(&self.folder.path().join("out"), more, said);
    }

    fn refuses_into(&self, output: &Path, more: &[&str], said: &[&str]) {
        let clip = self.folder.path().join("clip");
        let fixed = ["reconstruct", clip.to_str().unwrap(), "--out", output.to_str().unwrap()];
        let (code, log) = program::run(fixed.iter().chain(&QUICK).chain(more));
        assert!(code == 1 || code == 3, "exit {code}:\n{log}");
        for part in said {
            assert!(log.contains(part), "no {part:?} in:\n{log}");
        }
        assert!(!log.contains("state=\"done\""), "a frame was marked done:\n{log}");
        let frames = std::fs::read_dir(output.join("frames")).map_or(0, Iterator::count);
        assert_eq!(frames, 0, "a frame was written:\n{log}");
    }
}

#[test]
fn a_folder_of_no_known_layout() {
    let scratch = Scratch::new();
    std::fs::remove_dir_all(scratch.clip("transforms")).unwrap();
    scratch.refuses(&[], &["clip", "transforms", "sparse", "poses_bounds.npy"]);
}

#[test]
fn a_missing_frame_in_one_view() {
    let scratch = Scratch::new();
    std::fs::remove_file(scratch.clip("images/cam01/frame_0002.webp")).unwrap();
    scratch.refuses(&[], &["cam01", "frame_0002"]);
}

#[test]
fn a_truncated_image() {
    let scratch = Scratch::new();
    let file = scratch.clip("images/cam01/frame_0002.webp");
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    scratch.refuses(&["--tracks", "exact"], &["frame_0002.webp"]);

    // The same command, once the image is repaired.
    std::fs::write(&file, bytes).unwrap();
    let (clip, output) = (scratch.folder.path().join("clip"), scratch.folder.path().join("out"));
    let fixed =
        ["reconstruct", clip.to_str().unwrap(), "--out", output.to_str().unwrap(), "--tracks", "exact"];
    for _ in 0..2 {
        let (code, log) = program::run(fixed.iter().chain(&QUICK));
        assert_eq!(code, 0, "{log}");
    }
    assert!(output.join("frames/frame_0002.ply").exists());
}

#[test]
fn an_image_of_another_size_than_its_camera() {
    let scratch = Scratch::new();
    let file = scratch.clip("images/cam01/frame_0002.webp");
    std::fs::write(file, Image::filled(100, 50, [0.5; 3]).encode_png()).unwrap();
    scratch.refuses(&[], &["frame_0002.webp", "100", "320"]);
}

#[test]
fn a_camera_without_images() {
    let scratch = Scratch::new();
    std::fs::remove_dir_all(scratch.clip("images/cam02")).unwrap();
    scratch.refuses(&[], &["cam02"]);
}

#[test]
fn a_mirrored_pose() {
    let scratch = Scratch::new();
    for frame in ["transforms/frame_0001.json", "transforms/frame_0002.json"] {
        scratch.edit(frame, |text| {
            let mut document: serde_json::Value = serde_json::from_str(&text).unwrap();
            for row in 0..3 {
                let entry = &mut document["frames"][0]["transform_matrix"][row][0];
                *entry = (-entry.as_f64().unwrap()).into();
            }
            document.to_string()
        });
    }
    scratch.refuses(&[], &["cam00", "mirror"]);
}

#[test]
fn a_pose_that_is_no_number() {
    let scratch = Scratch::new();
    scratch.edit("transforms/frame_0001.json", |text| {
        text.replacen("\"transform_matrix\":[[", "\"transform_matrix\":[[NaN,", 1)
    });
    scratch.refuses(&[], &["frame_0001.json"]);
}

#[test]
fn fewer_than_two_training_views() {
    Scratch::new().refuses(&["--test-views", "cam00,cam01,cam02"], &["views are for training, at least two"]);
}

#[test]
fn a_held_out_view_that_does_not_exist() {
    Scratch::new().refuses(&["--test-views", "cam77"], &["cam77", "cam00"]);
}

#[test]
fn an_empty_sparse_model() {
    let scratch = Scratch::new();
    std::fs::remove_dir_all(scratch.clip("transforms")).unwrap();
    let model = scratch.clip("sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::write(model.join("cameras.txt"), "1 PINHOLE 320 180 352 352 160 90\n").unwrap();
    for empty in ["images.txt", "points3D.txt"] {
        std::fs::write(model.join(empty), "# nothing\n").unwrap();
    }
    scratch.refuses(&[], &["images.txt"]);
}

#[test]
fn a_nan_in_an_imported_ply() {
    let scratch = Scratch::new();
    let mut gaussians = Gaussians::empty(0);
    for x in [0.0, 0.5, 1.0] {
        gaussians.means.push([x, 0.0, 0.0]);
        gaussians.rotations.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.log_scales.push([-3.0; 3]);
        gaussians.logit_opacities.push(0.0);
        gaussians.sh.extend([0.0; 3]);
    }
    gaussians.means[1][0] = f32::NAN;
    let file = scratch.folder.path().join("broken.ply");
    std::fs::write(&file, write_ply(&gaussians)).unwrap();
    scratch.refuses(&["--static-model", file.to_str().unwrap()], &["broken.ply", "1", "x"]);
}

#[test]
fn tracks_of_another_size() {
    let scratch = Scratch::new();
    let mut files = vec!["--tracks".to_owned()];
    for view in 0..3 {
        let file = scratch.folder.path().join(format!("tracks{view}.npz"));
        let mut archive = npyz::npz::NpzWriter::create(&file).unwrap();
        let mut array = archive
            .array::<f32>("tracks", Default::default())
            .unwrap()
            .default_dtype()
            .shape(&[2, 4, 6, 2])
            .begin_nd()
            .unwrap();
        array.extend(std::iter::repeat_n(1.0f32, 2 * 4 * 6 * 2)).unwrap();
        array.finish().unwrap();
        let mut visible = archive
            .array::<bool>("visible", Default::default())
            .unwrap()
            .default_dtype()
            .shape(&[2, 4, 6])
            .begin_nd()
            .unwrap();
        visible.extend(std::iter::repeat_n(true, 2 * 4 * 6)).unwrap();
        visible.finish().unwrap();
        files.push(file.to_str().unwrap().to_owned());
    }
    let files: Vec<&str> = files.iter().map(String::as_str).collect();
    scratch.refuses(&files, &["tracks0.npz", "320", "6"]);
}

#[test]
fn an_output_that_cannot_be_written() {
    let scratch = Scratch::new();
    let file = scratch.folder.path().join("a-file");
    std::fs::write(&file, "in the way").unwrap();
    scratch.refuses_into(&file.join("out"), &[], &["a-file", "output"]);
}

#[test]
fn the_output_folder_of_another_clip() {
    let (scratch, other) = (Scratch::new(), Scratch::new());
    std::fs::remove_file(other.clip("points3D.ply")).unwrap();
    for frame in ["transforms/frame_0001.json", "transforms/frame_0002.json"] {
        other.edit(frame, |text| text.replace("\"ply_file_path\":\"../points3D.ply\",", ""));
    }
    let output = scratch.folder.path().join("out");
    let clip = scratch.folder.path().join("clip");
    let fixed =
        ["reconstruct", clip.to_str().unwrap(), "--out", output.to_str().unwrap(), "--tracks", "exact"];
    let (code, log) = program::run(fixed.iter().chain(&QUICK));
    assert_eq!(code, 0, "{log}");
    let before = std::fs::read(output.join("sequence.json")).unwrap();
    let other_clip = other.folder.path().join("clip");
    let again = ["reconstruct", other_clip.to_str().unwrap(), "--out", output.to_str().unwrap()];
    let (code, log) = program::run(again.iter().chain(&QUICK));
    assert!(code == 1 || code == 3, "exit {code}:\n{log}");
    assert!(log.contains("another clip"), "{log}");
    assert_eq!(std::fs::read(output.join("sequence.json")).unwrap(), before, "nothing was touched");
}
