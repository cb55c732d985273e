#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;

use super::*;
use crate::clip::{
    Clip, ClipOptions,
    testing::{Synthetic, assert_same_content},
};

/// A model of everything that the formats can hold.
fn sample() -> Model {
    let camera = |model: &str, parameters: &[f64]| ModelCamera {
        model: model.to_owned(),
        width: 640,
        height: 480,
        parameters: parameters.to_vec(),
    };
    let image = |name: &str, camera_id| ModelImage {
        quaternion: [0.1, -0.25, 1e-17, 0.9],
        translation: [1.0 / 3.0, -1e300, 0.0],
        camera_id,
        name: name.to_owned(),
    };
    Model {
        cameras: BTreeMap::from([
            (1, camera("SIMPLE_PINHOLE", &[500.5, 320.0, 240.0])),
            (2, camera("PINHOLE", &[1.0 / 3.0, 2.0, 3.0, 4.0])),
            (9, camera("OPENCV", &[1.0, 2.0, 3.0, 4.0, 0.1, -0.01, 1e-4, -1e-5])),
            (4294967295, camera("FULL_OPENCV", &[0.5; 12])),
        ]),
        images: vec![image("cam00/frame_0001.png", 1), image("a view/of it.jpg", 9)],
        points: [[0, 51, 255], [7, 8, 9]]
            .map(|rgb: [u8; 3]| SfmPoint {
                position: glam::DVec3::new(0.1, -2.5e10, 3.0),
                colour: rgb.map(|value| f32::from(value) / 255.0),
            })
            .to_vec(),
    }
}

const MODEL_IDS: [(&str, u32); 4] =
    [("SIMPLE_PINHOLE", 0), ("PINHOLE", 1), ("OPENCV", 4), ("FULL_OPENCV", 6)];

fn floats(bytes: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
}

fn cameras_bin(model: &Model) -> Vec<u8> {
    let mut bytes = (model.cameras.len() as u64).to_le_bytes().to_vec();
    for (id, camera) in &model.cameras {
        let model_id = MODEL_IDS.iter().find(|(name, _)| *name == camera.model).unwrap().1;
        bytes.extend(id.to_le_bytes());
        bytes.extend(model_id.to_le_bytes());
        bytes.extend(camera.width.to_le_bytes());
        bytes.extend(camera.height.to_le_bytes());
        floats(&mut bytes, &camera.parameters);
    }
    bytes
}

fn images_bin(model: &Model) -> Vec<u8> {
    let mut bytes = (model.images.len() as u64).to_le_bytes().to_vec();
    for (index, image) in model.images.iter().enumerate() {
        bytes.extend((index as u32 + 1).to_le_bytes());
        floats(&mut bytes, &image.quaternion);
        floats(&mut bytes, &image.translation);
        bytes.extend(image.camera_id.to_le_bytes());
        bytes.extend(image.name.as_bytes());
        bytes.push(0);
        bytes.extend((index as u64).to_le_bytes());
        for point in 0..index {
            floats(&mut bytes, &[1.5, 2.5]);
            bytes.extend((point as u64).to_le_bytes());
        }
    }
    bytes
}

fn points_bin(model: &Model) -> Vec<u8> {
    let mut bytes = (model.points.len() as u64).to_le_bytes().to_vec();
    for (index, point) in model.points.iter().enumerate() {
        bytes.extend((index as u64 + 1).to_le_bytes());
        floats(&mut bytes, &point.position.to_array());
        bytes.extend(point.colour.map(|channel| (channel * 255.0).round() as u8));
        floats(&mut bytes, &[0.25]);
        bytes.extend(2_u64.to_le_bytes());
        bytes.extend([0; 16]);
    }
    bytes
}

fn write_binary(model: &Model, folder: &Path) {
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("cameras.bin"), cameras_bin(model)).unwrap();
    fs::write(folder.join("images.bin"), images_bin(model)).unwrap();
    fs::write(folder.join("points3D.bin"), points_bin(model)).unwrap();
}

fn write_text(model: &Model, folder: &Path) {
    let joined = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let cameras = model
        .cameras
        .iter()
        .map(|(id, c)| format!("{id} {} {} {} {}\n", c.model, c.width, c.height, joined(&c.parameters)));
    let images = model.images.iter().enumerate().map(|(index, i)| {
        let (q, t) = (joined(&i.quaternion), joined(&i.translation));
        format!("{} {q} {t} {} {}\n{}\n", index + 1, i.camera_id, i.name, "1.5 2.5 7 ".repeat(index))
    });
    let points = model.points.iter().enumerate().map(|(index, p)| {
        let [r, g, b] = p.colour.map(|channel| (channel * 255.0).round());
        format!("{} {} {r} {g} {b} 0.25 1 0 2 0\n", index + 1, joined(&p.position.to_array()))
    });
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("cameras.txt"), format!("# comment\n\n{}", cameras.collect::<String>())).unwrap();
    fs::write(folder.join("images.txt"), format!("# comment\n{}", images.collect::<String>())).unwrap();
    fs::write(folder.join("points3D.txt"), points.collect::<String>()).unwrap();
}

fn read_written(root: &Path) -> Model {
    read_model(&model_files(root, "sparse").unwrap()).unwrap()
}

#[test]
fn binary_and_text_hold_the_same() {
    let model = sample();
    let (text, binary) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write_text(&model, &text.path().join("sparse/0"));
    write_binary(&model, &binary.path().join("sparse"));
    assert_eq!(read_written(text.path()), model);
    assert_eq!(read_written(binary.path()), model);
}

#[test]
fn a_text_model_made_binary_opens_as_the_same_clip() {
    let clip = Synthetic::new();
    clip.write_colmap();
    let text = clip.open().unwrap();
    for folder in ["sparse", "sparse_test"] {
        let model = read_model(&model_files(clip.root(), folder).unwrap()).unwrap();
        fs::remove_dir_all(clip.path(folder)).unwrap();
        write_binary(&model, &clip.path(folder).join("0"));
    }
    let binary = clip.open().unwrap();
    assert_eq!(binary.layout(), Layout::Colmap);
    assert_eq!(binary.views(), text.views());
    assert_eq!(binary.points(), text.points());
    assert_eq!(binary.digest().unwrap(), text.digest().unwrap());
    assert_same_content(&binary, &clip);
}

#[test]
fn binary_files_cut_anywhere_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("part.bin");
    let model = sample();
    let whole = [cameras_bin(&model), images_bin(&model), points_bin(&model)];
    for (index, bytes) in whole.iter().enumerate() {
        for length in 0..bytes.len() {
            fs::write(&path, &bytes[..length]).unwrap();
            let error = match index {
                0 => cameras(&path).err(),
                1 => images(&path).err(),
                _ => points(&path).err(),
            };
            let message =
                error.unwrap_or_else(|| panic!("{length} bytes of file {index} were accepted")).to_string();
            assert!(message.contains("part.bin"), "{message}");
        }
    }
    fs::write(&path, u64::MAX.to_le_bytes()).unwrap();
    assert!(points(&path).is_err(), "a count of 2^64 neither loops nor allocates");
}

use binary::{cameras, images, points};

#[test]
fn unknown_binary_models_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cameras.bin");
    let mut bytes = cameras_bin(&sample());
    bytes[12..16].copy_from_slice(&77_u32.to_le_bytes());
    fs::write(&path, bytes).unwrap();
    let error = cameras(&path).unwrap_err();
    assert!(matches!(&error, ClipError::UnsupportedLens { model, .. } if model.contains("77")), "{error}");
}

fn colmap() -> Synthetic {
    let clip = Synthetic::new();
    clip.write_colmap();
    clip
}

#[test]
fn unsupported_lenses_are_named_with_the_remedy() {
    let clip = colmap();
    clip.edit(
        "sparse/0/cameras.txt",
        "2 PINHOLE 20 10 20 21 7.25 6.5",
        "2 OPENCV_FISHEYE 20 10 20 21 7.25 6.5 0 0 0 0",
    );
    let error = clip.error(&["cameras.txt", "camera 2", "OPENCV_FISHEYE", "image_undistorter"]);
    assert!(matches!(error, ClipError::UnsupportedLens { .. }));
}

#[test]
fn every_supported_lens_is_read() {
    for (line, expected) in [
        ("SIMPLE_PINHOLE 20 10 20 7.25 6.5", Distortion::default()),
        ("SIMPLE_RADIAL 20 10 20 7.25 6.5 0.01", Distortion { k1: 0.01, ..Distortion::default() }),
        ("RADIAL 20 10 20 7.25 6.5 0.01 0.02", Distortion { k1: 0.01, k2: 0.02, ..Distortion::default() }),
        (
            "OPENCV 20 10 20 20 7.25 6.5 0.01 0.02 0.003 0.004",
            Distortion { k1: 0.01, k2: 0.02, p1: 0.003, p2: 0.004 },
        ),
    ] {
        let clip = colmap();
        clip.edit("sparse/0/cameras.txt", "PINHOLE 20 10 20 21 7.25 6.5", line);
        let found = read(clip.root()).unwrap().unwrap();
        let view = found.views.iter().find(|view| view.name == "cam01").unwrap();
        assert_eq!(view.distortion, expected, "{line}");
        let Camera { fx, fy, cx, cy, .. } = view.camera;
        assert_eq!([fx, fy, cx, cy], [20.0, 20.0, 7.25, 6.5]);
        assert!(clip.open().is_ok());
    }
}

use crate::cameras::{Camera, distortion::Distortion};

#[test]
fn an_empty_model_is_refused() {
    for file in ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse_test/0/images.txt"] {
        let clip = colmap();
        clip.write(file, "# nothing\n");
        let error = clip.error(&[file, "empty"]);
        assert!(matches!(error, ClipError::EmptyModel { .. }));
    }
}

#[test]
fn half_a_model_is_refused() {
    let clip = colmap();
    fs::remove_file(clip.path("sparse/0/images.txt")).unwrap();
    let error = clip.error(&["sparse/0/images.txt"]);
    assert!(matches!(error, ClipError::Io { .. }));
}

#[test]
fn a_model_without_points_is_a_calibrated_rig() {
    let clip = colmap();
    fs::remove_file(clip.path("sparse/0/points3D.txt")).unwrap();
    assert!(clip.open().unwrap().points().is_empty());
    clip.write("sparse/0/points3D.txt", "");
    assert!(clip.open().unwrap().points().is_empty());
}

#[test]
fn broken_lines_are_named() {
    for (file, from, to, parts) in [
        ("cameras.txt", "PINHOLE 16 12", "PINHOLE sixteen 12", vec!["line 2, WIDTH", "`sixteen`"]),
        ("cameras.txt", "PINHOLE 16 12 20", "PINHOLE 16 12 20 1", vec!["5 parameters", "4 for PINHOLE"]),
        ("cameras.txt", "1 PINHOLE 16", "2 PINHOLE 16", vec!["line 3", "camera 2 again"]),
        ("cameras.txt", "PINHOLE 20 10", "PINHOLE 99999999999 10", vec!["width of camera 2", "99999999999"]),
        (
            "images.txt",
            " 1 cam00/frame_0001.png",
            " 7 cam00/frame_0001.png",
            vec!["cam00/frame_0001.png", "found 7"],
        ),
        ("images.txt", " 1 cam00/frame_0001.png", " 1", vec!["line 3", "NAME"]),
        ("images.txt", "cam00/frame_0001.png", "frame_0001.png", vec!["frame_0001.png", "<camera>/<frame>"]),
        ("points3D.txt", "1 0 -1.25", "1 nan -1.25", vec!["line 1", "finite"]),
        ("points3D.txt", "0 255 51", "0 256 51", vec!["line 1, G", "`256`"]),
    ] {
        let clip = colmap();
        clip.edit(&format!("sparse/0/{file}"), from, to);
        let error = clip.error(&parts);
        assert!(matches!(&error, ClipError::Malformed { path, .. } if path.ends_with(file)), "{error}");
    }
}

#[test]
fn impossible_poses_are_refused() {
    let clip = colmap();
    let text = fs::read_to_string(clip.path("sparse/0/images.txt")).unwrap();
    let line = text.lines().find(|line| line.contains("cam01/")).unwrap();
    for (quaternion, part) in
        [("nan 0 0 1", "not finite"), ("0 0 0 0", "quaternion 0"), ("1 inf 0 0", "not finite")]
    {
        clip.write(
            "sparse/0/images.txt",
            text.replace(line, &format!("2 {quaternion} 0 0 0 2 cam01/frame_0001.png")),
        );
        let error = clip.error(&["images.txt", "cam01", part]);
        assert!(matches!(error, ClipError::Pose { .. }));
    }
}

#[test]
fn cameras_may_be_registered_in_several_frames_if_they_stand_still() {
    let clip = colmap();
    let text = fs::read_to_string(clip.path("sparse/0/images.txt")).unwrap();
    let line = text.lines().find(|line| line.contains("cam01/")).unwrap();
    let again = line.replace("frame_0001", "frame_0003");
    clip.write("sparse/0/images.txt", format!("{text}{again}\n\n"));
    assert_same_content(&clip.open().unwrap(), &clip);

    let moved = again.replace("2 cam01", "1 cam01");
    clip.write("sparse/0/images.txt", format!("{text}{moved}\n\n"));
    let error = clip.error(&["cam01", "frame 3", "frame 1", "static"]);
    assert!(matches!(error, ClipError::MovingCamera { .. }));

    clip.write("sparse/0/images.txt", format!("{text}{line}\n\n"));
    let error = clip.error(&["cam01", "twice"]);
    assert!(matches!(error, ClipError::DuplicateView { .. }));
}

#[test]
fn folders_of_images_are_names_whatever_way_leads_to_them() {
    for (name, folder) in [
        ("./cam0/1.png", "cam0"),
        ("rig//left/./cam0/1.png", "rig/left/cam0"),
        ("/data/cam0/1.png", "data/cam0"),
        ("./1.png", ""),
        // Such a name is refused.
        ("../cam0/1.png", "../cam0"),
    ] {
        assert_eq!(folder_of(name), folder);
    }
    let clip = colmap();
    let here = format!("{}/images/cam02/frame", clip.root().display());
    for (from, to) in [(" cam01/frame", " .//cam01/frame"), (" cam02/frame", &format!(" {here}"))] {
        clip.edit("sparse/0/images.txt", from, to);
    }
    let opened = clip.open().unwrap();
    assert_eq!(opened.frames(), [1, 2, 3]);
    let names: Vec<String> = opened.views().iter().map(|view| view.name.clone()).collect();
    assert!(names.contains(&"cam01".to_owned()), "{names:?}");
    assert!(names.iter().any(|name| name.ends_with("images/cam02")), "{names:?}");
    let moved = names.iter().position(|name| name.ends_with("cam02")).unwrap();
    assert_eq!(*opened.image(moved, 2).unwrap(), clip.image(2, 3));
}

#[test]
fn flat_images_are_views_of_one_frame() {
    let clip = colmap();
    for (index, view) in clip.views.iter().enumerate() {
        clip.write(&format!("images/{}.png", view.name), clip.image(index, 1).encode_png());
        fs::remove_dir_all(clip.path(&format!("images/{}", view.name))).unwrap();
        clip.write(&format!("masks/{}.png", view.name), crate::clip::decode::mask_png(&clip.mask(index, 1)));
    }
    for folder in ["sparse", "sparse_test"] {
        clip.edit(&format!("{folder}/0/images.txt"), "/frame_0001.png", ".png");
    }
    let opened = clip.open().unwrap();
    assert_eq!(opened.frames(), [1]);
    let names: Vec<&str> = opened.views().iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["cam00", "cam01", "cam02", "test00"]);
    assert_eq!(*opened.image(1, 0).unwrap(), clip.image(1, 1));
    assert_eq!(*opened.mask(1, 0).unwrap().unwrap(), clip.mask(1, 1));
    assert_eq!(opened.points(), clip.points);

    fs::remove_file(clip.path("images/cam02.png")).unwrap();
    let error = clip.error(&["cam02", "images/cam02.png"]);
    assert!(matches!(error, ClipError::NoImages { .. }));
}

#[test]
fn a_held_out_camera_may_not_train_too() {
    let clip = colmap();
    clip.edit("sparse_test/0/images.txt", "test00/frame_0001.png", "cam02/frame_0001.png");
    let error = clip.error(&["cam02", "twice", "images.txt"]);
    assert!(matches!(error, ClipError::DuplicateView { .. }));
    // Every opening with a training subset of the options still names the views it knows.
    let options = ClipOptions { test_views: vec!["cam02".to_owned()], ..ClipOptions::default() };
    assert!(Clip::open(clip.root(), &options).is_err());
}
