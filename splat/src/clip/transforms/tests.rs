#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;

use serde_json::{Value, json};

use super::*;
use crate::clip::testing::{Synthetic, assert_same_content, same_camera};

fn per_frame() -> Synthetic {
    let clip = Synthetic::new();
    clip.write_transforms();
    clip
}

/// Changes the JSON file `relative` by `change`.
fn edit(clip: &Synthetic, relative: &str, change: impl FnOnce(&mut Value)) {
    let mut file: Value = serde_json::from_slice(&fs::read(clip.path(relative)).unwrap()).unwrap();
    change(&mut file);
    clip.write(relative, file.to_string());
}

/// One `transforms.json` with the first frame of every view, each entry changed by `change`.
fn single(change: impl Fn(usize, &mut Value)) -> Synthetic {
    let clip = Synthetic::new();
    let mut entries: Vec<Value> = (0..4).map(|view| clip.entry(view, 1)).collect();
    entries.iter_mut().enumerate().for_each(|(index, entry)| change(index, entry));
    clip.write("transforms.json", json!({ "frames": entries }).to_string());
    clip
}

fn remove(entry: &mut Value, keys: &[&str]) {
    keys.iter().for_each(|key| drop(entry.as_object_mut().unwrap().remove(*key).unwrap()));
}

fn names(clip: &Synthetic) -> Vec<String> {
    clip.open().unwrap().views().iter().map(|view| view.name.clone()).collect()
}

#[test]
fn frames_per_file_and_by_time_hold_the_same() {
    let clip = per_frame();
    let opened = clip.open().unwrap();
    assert_same_content(&opened, &clip);
    assert_eq!(opened.points(), clip.points);

    let pair = Synthetic::new();
    pair.write_transforms_pair();
    let by_time = pair.open().unwrap();
    assert_same_content(&by_time, &pair);
    assert_eq!(by_time.points(), clip.points, "points3D.ply is found without being named");
    assert_eq!(by_time.layout(), Layout::Transforms);
    assert_eq!(by_time.digest().unwrap(), opened.digest().unwrap());
}

#[test]
fn the_folder_of_an_image_names_its_camera() {
    let clip = per_frame();
    for frame in 1..=3 {
        edit(&clip, &format!("transforms/frame_000{frame}.json"), |file| {
            file["frames"].as_array_mut().unwrap().iter_mut().for_each(|entry| remove(entry, &["camera"]));
        });
    }
    assert_same_content(&clip.open().unwrap(), &clip);
}

#[test]
fn stated_frame_numbers_win_over_ranks() {
    let clip = Synthetic::new();
    clip.write_transforms_pair();
    for file in ["transforms_train.json", "transforms_test.json"] {
        edit(&clip, file, |file| {
            for entry in file["frames"].as_array_mut().unwrap() {
                entry["frame"] = (10.0 + 4.0 * entry["time"].as_f64().unwrap()).round().into();
            }
        });
    }
    // Whole numbers in JSON may be written as floats, but frame numbers are integers.
    clip.error(&["transforms_train.json"]);
    for file in ["transforms_train.json", "transforms_test.json"] {
        edit(&clip, file, |file| {
            for entry in file["frames"].as_array_mut().unwrap() {
                entry["frame"] = (entry["frame"].as_f64().unwrap() as u32).into();
            }
        });
    }
    assert_eq!(clip.open().unwrap().frames(), [10, 12, 14]);
}

#[test]
fn times_that_round_apart_are_one_frame() {
    let clip = Synthetic::new();
    clip.write_transforms_pair();
    edit(&clip, "transforms_test.json", |file| {
        for entry in file["frames"].as_array_mut().unwrap() {
            entry["time"] = (entry["time"].as_f64().unwrap() + 3e-8).into();
        }
    });
    assert_same_content(&clip.open().unwrap(), &clip);
}

#[test]
fn a_time_for_some_images_only_is_refused() {
    let clip = Synthetic::new();
    clip.write_transforms_pair();
    edit(&clip, "transforms_test.json", |file| remove(&mut file["frames"][1], &["time"]));
    clip.error(&["transforms_test.json", "images/test00/frame_0002.png", "time"]);
}

#[test]
fn without_times_every_image_is_a_view() {
    let by_camera = single(|_, _| {});
    assert_eq!(names(&by_camera), ["cam00", "cam01", "cam02", "test00"]);
    assert_eq!(by_camera.open().unwrap().frames(), [1]);
    assert_eq!(by_camera.open().unwrap().views()[3].split, Split::Test);

    let by_folder = single(|_, entry| remove(entry, &["camera"]));
    assert_eq!(names(&by_folder), ["cam00", "cam01", "cam02", "test00"]);

    let by_stem = single(|_, entry| {
        let stem = entry["camera"].as_str().unwrap().to_owned();
        entry["file_path"] = format!("flat/{stem}.png").into();
        remove(entry, &["camera"]);
    });
    for (index, view) in by_stem.views.iter().enumerate() {
        by_stem.write(&format!("flat/{}.png", view.name), by_stem.image(index, 1).encode_png());
    }
    assert_eq!(names(&by_stem), ["cam00", "cam01", "cam02", "test00"]);

    // Blender's synthetic scenes: train/r_0, train/r_1, test/r_0 and so on, without extensions or image sizes.
    let blender = single(|index, entry| {
        entry["file_path"] = format!("./{}/r_{}", ["train", "test"][index / 2], index % 2).into();
        entry["camera_angle_x"] = (2.0 * (8.0_f64 / 20.0).atan()).into();
        remove(entry, &["camera", "w", "h", "fl_x", "fl_y", "cx", "cy"]);
    });
    for index in 0..4 {
        let name = format!("{}/r_{}.png", ["train", "test"][index / 2], index % 2);
        blender.write(&name, blender.image(index, 1).encode_png());
    }
    assert_eq!(names(&blender), ["test_r_0", "test_r_1", "train_r_0", "train_r_1"]);
    let opened = blender.open().unwrap();
    let view = &opened.views()[2];
    assert!((view.camera.fx - 20.0).abs() < 1e-12);
    let camera = crate::cameras::Camera { fx: 20.0, fy: 20.0, ..view.camera.clone() };
    assert!(same_camera(&camera, &blender.views[0].camera));
}

#[test]
fn calibration_of_the_file_holds_for_entries_without_their_own() {
    let clip = single(|index, entry| {
        if index != 1 {
            remove(entry, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
        }
    });
    edit(&clip, "transforms.json", |file| {
        for (key, value) in
            [("fl_x", 20.0), ("fl_y", 20.0), ("cx", 8.0), ("cy", 6.0), ("w", 16.0), ("h", 12.0)]
        {
            file[key] = value.into();
        }
        file["k1"] = 0.01.into();
        file["p2"] = (-0.002).into();
        file["frames"][1]["k1"] = 0.02.into();
    });
    let found = read(clip.root()).unwrap().unwrap();
    for (view, wanted) in found.views.iter().zip(&clip.views) {
        assert!(same_camera(&view.camera, &wanted.camera));
        assert_eq!(view.distortion.k1, if view.name == "cam01" { 0.02 } else { 0.01 });
        assert_eq!(view.distortion.p2, -0.002);
    }
}

#[test]
fn lists_of_held_out_files_are_obeyed() {
    let clip = single(|_, entry| remove(entry, &["split"]));
    assert!(clip.open().unwrap().views().iter().all(|view| view.split == Split::Train));
    edit(&clip, "transforms.json", |file| {
        file["test_filenames"] = json!(["images/cam01/frame_0001.png"]);
        file["val_filenames"] = json!(["images/test00/frame_0001.png"]);
    });
    let opened = clip.open().unwrap();
    let held_out: Vec<bool> = opened.views().iter().map(|view| view.split == Split::Test).collect();
    assert_eq!(held_out, [false, true, false, true]);
}

#[test]
fn moving_cameras_are_refused() {
    let clip = per_frame();
    let frame_2 = "transforms/frame_0002.json";
    edit(&clip, frame_2, |file| {
        let x = &mut file["frames"][1]["transform_matrix"][0][3];
        *x = (x.as_f64().unwrap() + 1e-6).into();
    });
    assert!(clip.open().is_ok(), "rounding passes");
    edit(&clip, frame_2, |file| {
        let x = &mut file["frames"][1]["transform_matrix"][0][3];
        *x = (x.as_f64().unwrap() + 0.01).into();
    });
    let error = clip.error(&["frame_0002.json", "cam01", "frame 2", "translation", "static"]);
    assert!(matches!(error, ClipError::MovingCamera { frame: 2, first: 1, .. }));
    clip.write_transforms();
    edit(&clip, frame_2, |file| file["frames"][0]["fl_x"] = 25.0.into());
    clip.error(&["frame_0002.json", "cam00", "intrinsics"]);
    clip.write_transforms();
    edit(&clip, frame_2, |file| file["k2"] = 0.1.into());
    clip.error(&["frame_0002.json", "cam00", "distortion"]);
    clip.write_transforms();
    edit(&clip, frame_2, |file| file["frames"][0]["h"] = 13.into());
    clip.error(&["frame_0002.json", "cam00", "size"]);
}

#[test]
fn a_camera_has_one_split() {
    let clip = per_frame();
    edit(&clip, "transforms/frame_0003.json", |file| file["frames"][0]["split"] = "test".into());
    assert!(matches!(clip.error(&["frame_0003.json", "cam00"]), ClipError::MixedSplit { .. }));
    edit(&clip, "transforms/frame_0003.json", |file| file["frames"][0]["split"] = "often".into());
    clip.error(&["frame_0003.json", "cam00", "`often`"]);
}

#[test]
fn duplicates_are_refused() {
    let clip = per_frame();
    edit(&clip, "transforms/frame_0001.json", |file| {
        let again = file["frames"][2].clone();
        file["frames"].as_array_mut().unwrap().push(again);
    });
    assert!(matches!(clip.error(&["frame_0001.json", "cam02", "twice"]), ClipError::DuplicateView { .. }));
    let still = single(|index, entry| {
        if index == 3 {
            entry["camera"] = "cam01".into();
            entry["file_path"] = "images/cam01/frame_0002.png".into();
        }
    });
    assert!(still.open().is_err());
}

#[test]
fn names_that_lead_elsewhere_are_refused() {
    let named = |name: &str| {
        let name = name.to_owned();
        single(move |index, entry| {
            let camera = if index == 1 { name.clone() } else { format!("rig/{index}") };
            entry["camera"] = camera.into();
        })
    };
    for name in ["../x", "/x", "a/../b", "a//b", ".", "", "a\\b", "a\nb", "a\0"] {
        let error = named(name).error(&["transforms.json", "no file can be given"]);
        assert!(matches!(error, ClipError::ViewName { .. }));
    }
    let clip = named("rig/a.b").open().unwrap();
    let files: Vec<String> = clip.views().iter().map(|view| crate::clip::file_stem(&view.name)).collect();
    assert_eq!(files, ["rig_0", "rig_2", "rig_3", "rig_a.b"]);
    let error = named("rig_2").error(&["rig/2", "rig_2", "rename"]);
    assert!(matches!(error, ClipError::SameFiles { .. }));
}

#[test]
fn missing_frames_are_named() {
    let clip = per_frame();
    edit(&clip, "transforms/frame_0002.json", |file| drop(file["frames"].as_array_mut().unwrap().remove(1)));
    let error = clip.error(&["cam01", "frame 2"]);
    assert!(matches!(error, ClipError::MissingFrame { frame: 2, .. }));
    clip.write_transforms();
    fs::remove_file(clip.path("images/cam02/frame_0003.png")).unwrap();
    let error = clip.error(&["cam02", "frame 3", "images/cam02/frame_0003.png"]);
    assert!(matches!(error, ClipError::MissingFrame { frame: 3, .. }));
    for frame in 1..=2 {
        fs::remove_file(clip.path(&format!("images/cam02/frame_000{frame}.png"))).unwrap();
    }
    assert!(matches!(clip.error(&["cam02"]), ClipError::NoImages { .. }));
}

#[test]
fn other_lens_models_are_refused() {
    for (key, value, part) in [
        ("camera_model", json!("OPENCV_FISHEYE"), "OPENCV_FISHEYE"),
        ("camera_model", json!("EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        ("k3", json!(0.1), "k3"),
    ] {
        let clip = single(|_, _| {});
        edit(&clip, "transforms.json", |file| file[key] = value);
        let error = clip.error(&["transforms.json", "cam00", part]);
        assert!(matches!(error, ClipError::UnsupportedLens { .. }));
    }
    let zero = single(|_, entry| entry["k3"] = 0.0.into());
    assert!(zero.open().is_ok());
}

#[test]
fn broken_entries_are_named() {
    type Change = fn(&mut Value);
    let cases: [(Change, &[&str]); 9] = [
        (|entry| entry["transform_matrix"] = json!([[1, 2, 3]]), &["transform_matrix of cam01", "4x4"]),
        (|entry| entry["transform_matrix"][0][0] = 9.0.into(), &["cam01", "not a rotation"]),
        (|entry| entry["transform_matrix"][1] = json!([1e300, 1e300, 1e300, 0]), &["cam01"]),
        (|entry| drop(entry.as_object_mut().unwrap().remove("fl_x")), &["intrinsics of cam01", "fl_x"]),
        (|entry| entry["fl_x"] = (-20.0).into(), &["cam01", "focal length fx -20"]),
        (|entry| entry["fl_y"] = 0.into(), &["cam01", "focal length fy 0"]),
        (|entry| entry["w"] = 20.5.into(), &["w of cam01", "20.5"]),
        (|entry| entry["h"] = 0.into(), &["h of cam01", "0"]),
        (|entry| entry["k1"] = (-9.0).into(), &["cam01", "folds"]),
    ];
    for (change, parts) in cases {
        let clip = single(|index, entry| {
            if index == 1 {
                change(entry);
            }
        });
        clip.error(&[&["transforms.json"], parts].concat());
    }
}

#[test]
fn mirrored_and_non_finite_poses_are_refused() {
    let mirrored = single(|index, entry| {
        if index == 1 {
            for row in 0..3 {
                let x = &mut entry["transform_matrix"][row][0];
                *x = (-x.as_f64().unwrap()).into();
            }
        }
    });
    let error = mirrored.error(&["transforms.json", "cam01", "mirrored", "-1"]);
    assert!(matches!(error, ClipError::Pose { .. }));
    // Python writes NaN, which is not JSON.
    let clip = single(|index, entry| {
        if index == 1 {
            entry["transform_matrix"][0][3] = 123456789.5.into();
        }
    });
    clip.edit("transforms.json", "123456789.5", "NaN");
    assert!(matches!(clip.error(&["transforms.json", "line 1", "finite"]), ClipError::Malformed { .. }));
    clip.edit("transforms.json", "NaN", "1e999");
    clip.error(&["transforms.json", "out of range"]);
}

#[test]
fn points_that_are_named_must_be_there() {
    let clip = per_frame();
    fs::remove_file(clip.path("points3D.ply")).unwrap();
    assert!(matches!(clip.error(&["points3D.ply"]), ClipError::Io { .. }));
}

#[test]
fn files_without_entries_are_empty_models() {
    let clip = Synthetic::new();
    clip.write("transforms.json", r#"{"frames": []}"#);
    assert!(matches!(clip.error(&["transforms.json", "empty"]), ClipError::EmptyModel { .. }));
    clip.write("transforms.json", r#"{"cameras": []}"#);
    assert!(matches!(clip.error(&["transforms.json", "frames"]), ClipError::Malformed { .. }));
    clip.write("transforms.json", "not JSON");
    assert!(matches!(clip.error(&["transforms.json", "line 1"]), ClipError::Malformed { .. }));
    clip.write("transforms_test.json", r#"{"frames": []}"#);
    assert!(matches!(clip.error(&["transforms_train.json"]), ClipError::Io { .. }));
}
