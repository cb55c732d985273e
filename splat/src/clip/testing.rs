//! A small synthetic clip for tests, written in any of the layouts.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use glam::{DMat3, DQuat, DVec3};
use npyz::WriterBuilder;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::{Clip, ClipError, ClipOptions, Split, View};
use crate::{
    cameras::Camera,
    image::{Image, Mask},
    static_model::SfmPoint,
};

/// A clip in a temporary folder.
pub(super) struct Synthetic {
    pub(super) folder: TempDir,
    pub(super) views: Vec<View>,
    pub(super) frames: Vec<u32>,
    pub(super) points: Vec<SfmPoint>,
}

impl Synthetic {
    /// `cam00`, `cam01`, `cam02` for training and `test00` held out, frames 1 to 3, with images on disk and no layout.
    ///
    /// `cam01` has a size of its own and a principal point off the centre.
    pub(super) fn new() -> Self {
        let names = [
            ("cam00", Split::Train),
            ("cam01", Split::Train),
            ("cam02", Split::Train),
            ("test00", Split::Test),
        ];
        let views = names.into_iter().enumerate().map(|(index, (name, split))| {
            let mut camera = look_at_origin(0.3 * index as f64, 16, 12);
            if index == 1 {
                camera = Camera { width: 20, height: 10, cx: 7.25, cy: 6.5, fy: 21.0, ..camera };
            }
            View { name: name.to_owned(), camera, split }
        });
        let points = (0..5).map(|i| SfmPoint {
            position: DVec3::new(0.5 * f64::from(i), -1.25, 2.0),
            colour: [f32::from(i as u8) / 255.0, 1.0, 0.2],
        });
        let clip = Self {
            folder: tempfile::tempdir().unwrap(),
            views: views.collect(),
            frames: vec![1, 2, 3],
            points: points.collect(),
        };
        clip.write_images();
        clip
    }

    /// The same with principal points in the centre and square pixels, all that LLFF can state.
    pub(super) fn centred() -> Self {
        let mut clip = Self::new();
        for view in &mut clip.views {
            let Camera { width, height, fx, .. } = view.camera;
            view.camera.cx = f64::from(width) / 2.0;
            view.camera.cy = f64::from(height) / 2.0;
            view.camera.fy = fx;
        }
        clip
    }

    pub(super) fn root(&self) -> &Path {
        self.folder.path()
    }

    pub(super) fn path(&self, relative: &str) -> PathBuf {
        self.root().join(relative)
    }

    pub(super) fn open(&self) -> Result<Clip, ClipError> {
        Clip::open(self.root(), &ClipOptions::default())
    }

    /// The error of opening, which must contain every one of `parts`.
    pub(super) fn error(&self, parts: &[&str]) -> ClipError {
        let error = self.open().expect_err("this clip is broken");
        let message = error.to_string();
        for part in parts {
            assert!(message.contains(part), "no `{part}` in: {message}");
        }
        error
    }

    pub(super) fn write(&self, relative: &str, content: impl AsRef<[u8]>) {
        let path = self.path(relative);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    /// Replaces text in a file, which must be there.
    pub(super) fn edit(&self, relative: &str, from: &str, to: &str) {
        let text = fs::read_to_string(self.path(relative)).unwrap();
        assert!(text.contains(from), "no `{from}` in {relative}");
        self.write(relative, text.replace(from, to));
    }

    pub(super) fn image_file(view: &str, frame: u32) -> String {
        format!("images/{view}/frame_{frame:04}.png")
    }

    /// What the image of a view and frame shows; different for each.
    pub(super) fn image(&self, view: usize, frame: u32) -> Image {
        let Camera { width, height, .. } = self.views[view].camera;
        let mut image = Image::filled(width, height, [view as f32 * 0.2, frame as f32 * 0.2, 0.0]);
        for (index, value) in image.pixels.iter_mut().skip(2).step_by(3).enumerate() {
            *value = (index % 50) as f32 / 51.0;
        }
        Image { pixels: image.to_rgb8().into_iter().map(|value| f32::from(value) / 255.0).collect(), ..image }
    }

    fn write_images(&self) {
        for (index, view) in self.views.iter().enumerate() {
            for &frame in &self.frames {
                self.write(&Self::image_file(&view.name, frame), self.image(index, frame).encode_png());
            }
        }
    }

    /// What the mask of a view and frame shows.
    pub(super) fn mask(&self, view: usize, frame: u32) -> Mask {
        let Camera { width, height, .. } = self.views[view].camera;
        let inside = (0..width * height).map(|i| i % (frame + 2) == 0).collect();
        Mask { width, height, inside }
    }

    pub(super) fn write_masks(&self) {
        for (index, view) in self.views.iter().enumerate() {
            for &frame in &self.frames {
                let file = format!("masks/{}/frame_{frame:04}.png", view.name);
                self.write(&file, super::decode::mask_png(&self.mask(index, frame)));
            }
        }
    }

    /// `sparse/0/*.txt` for the training views and `sparse_test/0/*.txt` for the others.
    pub(super) fn write_colmap(&self) {
        for (folder, split) in [("sparse/0", Split::Train), ("sparse_test/0", Split::Test)] {
            let mut cameras = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
            let mut images =
                "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[]\n".to_owned();
            for (index, view) in self.views.iter().enumerate().filter(|(_, view)| view.split == split) {
                let Camera { width, height, fx, fy, cx, cy, rotation, translation } = view.camera;
                writeln!(cameras, "{} PINHOLE {width} {height} {fx} {fy} {cx} {cy}", index + 1).unwrap();
                let q = DQuat::from_mat3(&rotation);
                let t = translation;
                let (id, name, frame) = (index + 1, &view.name, self.frames[0]);
                writeln!(
                    images,
                    "{id} {} {} {} {} {} {} {} {id} {name}/frame_{frame:04}.png",
                    q.w, q.x, q.y, q.z, t.x, t.y, t.z
                )
                .unwrap();
                // Alternate between images with and without 2D points: an empty line is still a line.
                images.push_str(if index % 2 == 0 { "1.5 2.5 1 3.5 4.5 -1\n" } else { "\n" });
            }
            self.write(&format!("{folder}/cameras.txt"), cameras);
            self.write(&format!("{folder}/images.txt"), images);
        }
        let mut points = String::new();
        for (index, SfmPoint { position, colour }) in self.points.iter().enumerate() {
            let [r, g, b] = colour.map(|channel| (channel * 255.0).round());
            writeln!(
                points,
                "{} {} {} {} {r} {g} {b} 0.5 1 0 2 0",
                index + 1,
                position.x,
                position.y,
                position.z
            )
            .unwrap();
        }
        self.write("sparse/0/points3D.txt", points);
    }

    /// A nerfstudio entry.
    pub(super) fn entry(&self, view: usize, frame: u32) -> Value {
        let View { name, camera, split } = &self.views[view];
        let to_world = camera.rotation.transpose();
        let axes = [to_world.x_axis, -to_world.y_axis, -to_world.z_axis, camera.centre()];
        let row = |i: usize| axes.iter().map(|axis| axis[i]).collect::<Vec<_>>();
        json!({
            "file_path": format!("images/{name}/frame_{frame:04}.png"),
            "camera": name,
            "split": if *split == Split::Train { "train" } else { "test" },
            "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
            "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        })
    }

    /// `transforms/frame_0001.json` and on, with the points beside them.
    pub(super) fn write_transforms(&self) {
        self.write_points_ply();
        for &frame in &self.frames {
            let mut entries: Vec<Value> = (0..self.views.len()).map(|view| self.entry(view, frame)).collect();
            for entry in &mut entries {
                entry["file_path"] = format!("../{}", entry["file_path"].as_str().unwrap()).into();
            }
            let file = json!({ "camera_model": "OPENCV", "k1": 0, "ply_file_path": "../points3D.ply", "frames": entries });
            self.write(&format!("transforms/frame_{frame:04}.json"), file.to_string());
        }
    }

    /// `transforms_train.json` and `transforms_test.json`, frames told apart by `time`.
    pub(super) fn write_transforms_pair(&self) {
        self.write_points_ply();
        for (name, split) in [("train", Split::Train), ("test", Split::Test)] {
            let mut entries = Vec::new();
            for (index, &frame) in self.frames.iter().enumerate() {
                for view in (0..self.views.len()).filter(|&view| self.views[view].split == split) {
                    let mut entry = self.entry(view, frame);
                    entry["time"] = (index as f64 / (self.frames.len() - 1) as f64).into();
                    entries.push(entry);
                }
            }
            self.write(&format!("transforms_{name}.json"), json!({ "frames": entries }).to_string());
        }
    }

    fn write_points_ply(&self) {
        let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", self.points.len());
        for axis in ["x", "y", "z"] {
            writeln!(text, "property double {axis}").unwrap();
        }
        for channel in ["red", "green", "blue"] {
            writeln!(text, "property uchar {channel}").unwrap();
        }
        text.push_str("end_header\n");
        for SfmPoint { position, colour } in &self.points {
            let [r, g, b] = colour.map(|channel| (channel * 255.0).round());
            writeln!(text, "{} {} {} {r} {g} {b}", position.x, position.y, position.z).unwrap();
        }
        self.write("points3D.ply", text);
    }

    /// Rows of `poses_bounds.npy`.
    pub(super) fn llff_rows(&self) -> Vec<f64> {
        let row = |view: &View| {
            let Camera { width, height, fx, rotation, .. } = view.camera;
            let to_world = rotation.transpose();
            let hwf = DVec3::new(f64::from(height), f64::from(width), fx);
            let columns = [to_world.y_axis, to_world.x_axis, -to_world.z_axis, view.camera.centre(), hwf];
            let matrix = (0..3).flat_map(move |i| columns.map(|column| column[i]));
            matrix.chain([0.1, 100.0]).collect::<Vec<_>>()
        };
        self.views.iter().flat_map(row).collect()
    }

    pub(super) fn write_llff(&self) {
        write_npy(&self.path("poses_bounds.npy"), &self.llff_rows(), &[self.views.len() as u64, 17]);
    }
}

/// Says why a test that needs more than this machine has ends here.
#[allow(clippy::print_stderr, reason = "a skipped test must not look like a passed one")]
pub(super) fn skip(reason: &str) {
    eprintln!("skipped: {reason}");
}

/// Writes an array in C order.
pub(super) fn write_npy<T: npyz::AutoSerialize + Copy>(path: &Path, values: &[T], shape: &[u64]) {
    let mut bytes = Vec::new();
    let mut writer =
        npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd().unwrap();
    writer.extend(values.iter().copied()).unwrap();
    writer.finish().unwrap();
    fs::write(path, bytes).unwrap();
}

/// A camera on a circle around the origin, looking at it, a little from above.
pub(super) fn look_at_origin(angle: f64, width: u32, height: u32) -> Camera {
    let centre = DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 1.0);
    let forward = -centre.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let down = forward.cross(right);
    let rotation = DMat3::from_cols(right, down, forward).transpose();
    let translation = -(rotation * centre);
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { width, height, fx: 20.0, fy: 20.0, cx, cy, rotation, translation }
}

/// Whether two cameras agree up to the rounding of a pose's conversion there and back, a few units in the 15th digit.
pub(super) fn same_camera(a: &Camera, b: &Camera) -> bool {
    let rotation = (a.rotation - b.rotation).to_cols_array().iter().all(|entry| entry.abs() < 1e-12);
    let translation = (a.translation - b.translation).length() < 1e-12;
    let rest = |c: &Camera| (c.width, c.height, c.fx, c.fy, c.cx, c.cy);
    rotation && translation && rest(a) == rest(b)
}

/// Panics unless `clip` is what `expected` wrote.
pub(super) fn assert_same_content(clip: &Clip, expected: &Synthetic) {
    assert_eq!(clip.frames(), expected.frames);
    assert_eq!(clip.views().len(), expected.views.len());
    for (index, (view, wanted)) in clip.views().iter().zip(&expected.views).enumerate() {
        assert_eq!((&view.name, view.split), (&wanted.name, wanted.split));
        assert!(same_camera(&view.camera, &wanted.camera), "{:?}\n{:?}", view.camera, wanted.camera);
        for (frame_index, &frame) in expected.frames.iter().enumerate() {
            assert_eq!(*clip.image(index, frame_index).unwrap(), expected.image(index, frame));
        }
    }
}
