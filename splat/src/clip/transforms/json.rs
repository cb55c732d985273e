//! One nerfstudio `transforms` file: its fields, and the camera each of its entries states.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use glam::{DMat3, DVec3};
use serde::Deserialize;

use super::super::{
    ClipError, Split,
    decode::image_size,
    found::{FoundView, camera},
    frame_files::IMAGE_EXTENSIONS,
    lens::Lens,
    pose::Pose,
};
use crate::cameras::distortion::Distortion;

/// Calibration fields, which an entry may state itself or leave to the file.
#[derive(Clone, Debug, Default, Deserialize)]
struct Calibration {
    camera_model: Option<String>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    camera_angle_x: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct File {
    #[serde(flatten)]
    calibration: Calibration,
    ply_file_path: Option<String>,
    #[serde(default)]
    test_filenames: Vec<String>,
    #[serde(default)]
    val_filenames: Vec<String>,
    frames: Vec<Entry>,
}

/// One image of a `transforms` file.
#[derive(Clone, Debug, Deserialize)]
pub(super) struct Entry {
    pub(super) file_path: String,
    pub(super) camera: Option<String>,
    pub(super) split: Option<String>,
    pub(super) time: Option<f64>,
    pub(super) frame: Option<u32>,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    calibration: Calibration,
}

/// A parsed `transforms` file.
#[derive(Debug)]
pub(super) struct Transforms {
    pub(super) path: PathBuf,
    root: PathBuf,
    file: File,
}

impl Transforms {
    pub(super) fn read(root: &Path, path: &Path) -> Result<Self, ClipError> {
        let text = fs::read(path).map_err(ClipError::io(path))?;
        let file: File = serde_json::from_slice(&text).map_err(|error| {
            ClipError::malformed(path, "JSON", error, "a nerfstudio transforms file (finite numbers only)")
        })?;
        Ok(Self { path: path.to_owned(), root: root.to_owned(), file })
    }

    pub(super) fn entries(&self) -> &[Entry] {
        &self.file.frames
    }

    /// The file of initial points, if one is named.
    pub(super) fn points(&self) -> Option<PathBuf> {
        self.file.ply_file_path.as_ref().map(|name| self.resolve(name))
    }

    /// A path of the file: relative to it, as nerfstudio says, or to the data set's folder.
    fn resolve(&self, name: &str) -> PathBuf {
        let beside = self.path.parent().unwrap_or(&self.root).join(name);
        let in_root = self.root.join(name);
        if !beside.exists() && in_root.exists() { in_root } else { beside }
    }

    /// The image of an entry; Blender's files leave the extension out.
    pub(super) fn image(&self, entry: &Entry) -> PathBuf {
        let stated = self.resolve(&entry.file_path);
        if stated.is_file() {
            return stated;
        }
        let with_extension = |extension: &&str| self.resolve(&format!("{}.{extension}", entry.file_path));
        IMAGE_EXTENSIONS.iter().map(with_extension).find(|path| path.is_file()).unwrap_or(stated)
    }

    /// The split an entry states, by itself or in the file's lists; validation views are held out too.
    pub(super) fn split(&self, entry: &Entry) -> Result<Split, ClipError> {
        match entry.split.as_deref() {
            Some("train") => Ok(Split::Train),
            Some("test" | "val" | "eval") => Ok(Split::Test),
            Some(other) => {
                let place = format!("split of {}", entry.file_path);
                Err(ClipError::malformed(&self.path, place, format!("`{other}`"), "train, test or val"))
            }
            None => {
                let held_out = self.file.test_filenames.iter().chain(&self.file.val_filenames);
                let is_held_out = held_out.into_iter().any(|name| *name == entry.file_path);
                Ok(if is_held_out { Split::Test } else { Split::Train })
            }
        }
    }

    /// The view of an entry, holding the entry's image as `frame`.
    pub(super) fn view(
        &self,
        entry: &Entry,
        name: String,
        split: Split,
        frame: u32,
    ) -> Result<FoundView, ClipError> {
        let image = self.image(entry);
        let calibration = Merged { own: &entry.calibration, shared: &self.file.calibration };
        calibration.refuse_other_models(&self.path, &name)?;
        let size = self.size(&calibration, &image, &name)?;
        let lens = calibration.lens(size).ok_or_else(|| {
            let place = format!("intrinsics of {name}");
            ClipError::malformed(&self.path, place, "no fl_x and no camera_angle_x", "a focal length")
        })?;
        let pose = self.pose(entry, &name)?;
        Ok(FoundView {
            name,
            camera: camera(&lens, pose, size),
            distortion: lens.distortion,
            split,
            looked_for: image.clone(),
            images: BTreeMap::from([(frame, image)]),
            declared_in: self.path.clone(),
        })
    }

    /// Stated image size, or that of the image itself.
    fn size(&self, calibration: &Merged, image: &Path, view: &str) -> Result<[u32; 2], ClipError> {
        let (Some(width), Some(height)) = (calibration.get(|c| c.w), calibration.get(|c| c.h)) else {
            if !image.is_file() {
                return Err(ClipError::NoImages { view: view.to_owned(), looked_for: image.to_owned() });
            }
            return image_size(image);
        };
        let whole = |axis: &str, pixels: f64| {
            let valid = pixels.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&pixels);
            let error = || {
                ClipError::malformed(&self.path, format!("{axis} of {view}"), pixels, "a number of pixels")
            };
            // The range check makes the conversion exact.
            if valid { Ok(pixels as u32) } else { Err(error()) }
        };
        Ok([whole("w", width)?, whole("h", height)?])
    }

    /// Camera to world, three or four rows of four, in OpenGL axes.
    fn pose(&self, entry: &Entry, view: &str) -> Result<Pose, ClipError> {
        let rows = &entry.transform_matrix;
        let complete = matches!(rows.len(), 3 | 4) && rows.iter().all(|row| row.len() == 4);
        if !complete {
            let lengths: Vec<usize> = rows.iter().map(Vec::len).collect();
            let place = format!("transform_matrix of {view}");
            return Err(ClipError::malformed(
                &self.path,
                place,
                format!("rows of {lengths:?}"),
                "4x4 or 3x4 numbers",
            ));
        }
        let column = |index: usize| DVec3::new(rows[0][index], rows[1][index], rows[2][index]);
        let axes = DMat3::from_cols(column(0), column(1), column(2));
        Pose::from_opengl(axes, column(3)).map_err(|problem| ClipError::Pose {
            path: self.path.clone(),
            view: view.to_owned(),
            problem,
        })
    }
}

/// An entry's calibration over its file's.
struct Merged<'a> {
    own: &'a Calibration,
    shared: &'a Calibration,
}

impl Merged<'_> {
    fn get<T>(&self, field: impl Fn(&Calibration) -> Option<T>) -> Option<T> {
        field(self.own).or_else(|| field(self.shared))
    }

    /// The coefficients are those of OpenCV's model; files without a model name are pinholes with these.
    fn refuse_other_models(&self, path: &Path, view: &str) -> Result<(), ClipError> {
        let refuse = |model: &str| {
            Err(ClipError::UnsupportedLens {
                path: path.to_owned(),
                camera: view.to_owned(),
                model: model.to_owned(),
            })
        };
        let model = self.get(|c| c.camera_model.clone()).unwrap_or_else(|| "OPENCV".to_owned());
        if !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"].contains(&model.as_str()) {
            return refuse(&model);
        }
        let higher = [self.get(|c| c.k3), self.get(|c| c.k4)];
        if higher.into_iter().flatten().any(|coefficient| coefficient != 0.0) {
            return refuse(&format!("{model} with k3 or k4"));
        }
        Ok(())
    }

    /// Intrinsics for an image size; `None` without a focal length.
    fn lens(&self, [width, height]: [u32; 2]) -> Option<Lens> {
        let (width, height) = (f64::from(width), f64::from(height));
        let from_angle = || self.get(|c| c.camera_angle_x).map(|angle| 0.5 * width / (0.5 * angle).tan());
        let fx = self.get(|c| c.fl_x).or_else(from_angle)?;
        let coefficient = |field: fn(&Calibration) -> Option<f64>| self.get(field).unwrap_or(0.0);
        Some(Lens {
            fx,
            fy: self.get(|c| c.fl_y).unwrap_or(fx),
            cx: self.get(|c| c.cx).unwrap_or(width / 2.0),
            cy: self.get(|c| c.cy).unwrap_or(height / 2.0),
            distortion: Distortion {
                k1: coefficient(|c| c.k1),
                k2: coefficient(|c| c.k2),
                p1: coefficient(|c| c.p1),
                p2: coefficient(|c| c.p2),
            },
        })
    }
}
