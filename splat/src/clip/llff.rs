//! LLFF and N3DV: `poses_bounds.npy` with one video per camera, or with their frames in `images/<camera>/`.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::BufReader,
    path::{Path, PathBuf},
};

use glam::{DMat3, DVec3};
use npyz::{NpyFile, Order};
use serde::Deserialize;

use super::{
    ClipError, ClipOptions, Layout, Split,
    found::{Found, FoundView, camera},
    frame_files::{entries, files_with, numbered_images, stem_of},
    lens::Lens,
    pose::Pose,
    video::Decoder,
};
use crate::cameras::distortion::Distortion;

/// Numbers per camera: a 3×5 matrix, row by row, then the near and far bounds.
const ROW: usize = 17;
const VIDEO_EXTENSIONS: [&str; 5] = ["mp4", "mov", "mkv", "avi", "webm"];

/// Reads the LLFF data set in `root`; `None` if there is none.
pub(super) fn read(root: &Path, options: &ClipOptions) -> Option<Result<Found, ClipError>> {
    let poses = root.join("poses_bounds.npy");
    poses.is_file().then(|| read_data_set(root, &poses, options))
}

fn read_data_set(root: &Path, poses: &Path, options: &ClipOptions) -> Result<Found, ClipError> {
    let rows = pose_rows(poses)?;
    let cameras = Cameras::find(root, rows.len())?;
    if cameras.sources.len() != rows.len() {
        return Err(ClipError::RowCount {
            path: poses.to_owned(),
            rows: rows.len(),
            cameras: cameras.sources.len(),
            folder: cameras.folder,
        });
    }
    let splits = Splits::read(root)?;
    let mut views = Vec::with_capacity(rows.len());
    for (index, (row, source)) in rows.iter().zip(&cameras.sources).enumerate() {
        let name = stem_of(source);
        let (lens, pose, size) = calibration(row, poses, &name)?;
        let images = if cameras.are_videos { decode(source, options)? } else { numbered_images(source)? };
        views.push(FoundView {
            camera: camera(&lens, pose, size),
            distortion: lens.distortion,
            split: splits.of(&name, index)?,
            images,
            looked_for: source.clone(),
            declared_in: poses.to_owned(),
            name,
        });
    }
    Ok(Found { layout: Layout::Llff, views, points: Vec::new() })
}

fn decode(video: &Path, options: &ClipOptions) -> Result<BTreeMap<u32, PathBuf>, ClipError> {
    let Some(scratch) = &options.scratch else {
        return Err(ClipError::NoScratch { video: video.to_owned() });
    };
    let decoder = Decoder { program: "ffmpeg", scratch, frames: options.frames };
    numbered_images(&decoder.decode(video)?)
}

/// Where the cameras' frames come from, in the order of the poses.
struct Cameras {
    folder: PathBuf,
    sources: Vec<PathBuf>,
    are_videos: bool,
}

impl Cameras {
    /// Frames that were extracted already, if there is a folder for every pose, else videos.
    fn find(root: &Path, poses: usize) -> Result<Self, ClipError> {
        let images = root.join("images");
        let folders: Vec<PathBuf> = entries(&images)?.into_iter().filter(|path| path.is_dir()).collect();
        if folders.len() == poses {
            return Ok(Self { folder: images, sources: folders, are_videos: false });
        }
        let beside = files_with(root, &VIDEO_EXTENSIONS)?;
        if !beside.is_empty() {
            return Ok(Self { folder: root.to_owned(), sources: beside, are_videos: true });
        }
        let folder = root.join("videos");
        Ok(Self { sources: files_with(&folder, &VIDEO_EXTENSIONS)?, folder, are_videos: true })
    }
}

fn pose_rows(path: &Path) -> Result<Vec<[f64; ROW]>, ClipError> {
    let file = File::open(path).map_err(ClipError::io(path))?;
    let malformed = |found: String| {
        ClipError::malformed(path, "array", found, "[cameras, 17] numbers of f64 or f32 in C order")
    };
    let npy = NpyFile::new(BufReader::new(file)).map_err(|error| malformed(error.to_string()))?;
    let (shape, order, dtype) = (npy.shape().to_vec(), npy.order(), npy.dtype());
    if !matches!(shape.as_slice(), &[_, columns] if columns == ROW as u64) || order != Order::C {
        return Err(malformed(format!("shape {shape:?}, {order:?} order")));
    }
    let numbers: Result<Vec<f64>, std::io::Error> = match npy.try_data::<f64>() {
        Ok(data) => data.collect(),
        Err(npy) => match npy.try_data::<f32>() {
            Ok(data) => data.map(|number| number.map(f64::from)).collect(),
            Err(_) => return Err(malformed(format!("type {}", dtype.descr()))),
        },
    };
    let numbers = numbers.map_err(|error| malformed(error.to_string()))?;
    if numbers.is_empty() {
        return Err(ClipError::EmptyModel { path: path.to_owned(), cameras: 0, images: 0 });
    }
    Ok(numbers.as_chunks::<ROW>().0.to_vec())
}

/// The camera of one row: columns down, right, back, position and `height, width, focal`, centred.
fn calibration(row: &[f64; ROW], path: &Path, view: &str) -> Result<(Lens, Pose, [u32; 2]), ClipError> {
    let column = |index: usize| DVec3::new(row[index], row[index + 5], row[index + 10]);
    let axes = DMat3::from_cols(column(0), column(1), column(2));
    let pose = Pose::from_llff(axes, column(3)).map_err(|problem| ClipError::Pose {
        path: path.to_owned(),
        view: view.to_owned(),
        problem,
    })?;
    let [height, width, focal] = column(4).to_array();
    let pixels = |axis: &str, value: f64| {
        let valid = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
        // The range check makes the conversion exact.
        if valid {
            Ok(value as u32)
        } else {
            Err(ClipError::malformed(path, format!("{axis} of {view}"), value, "a number of pixels"))
        }
    };
    let size = [pixels("width", width)?, pixels("height", height)?];
    let lens =
        Lens { fx: focal, fy: focal, cx: width / 2.0, cy: height / 2.0, distortion: Distortion::default() };
    Ok((lens, pose, size))
}

/// Which views are held out: as a `cameras.json` beside the poses says, else the first, as N3DV is evaluated.
struct Splits {
    stated: Option<(PathBuf, BTreeMap<String, Split>)>,
}

#[derive(Deserialize)]
struct CamerasFile {
    #[serde(default)]
    cameras: Vec<CameraEntry>,
}

#[derive(Deserialize)]
struct CameraEntry {
    name: String,
    split: Option<Split>,
}

impl Splits {
    fn read(root: &Path) -> Result<Self, ClipError> {
        let path = root.join("cameras.json");
        if !path.is_file() {
            return Ok(Self { stated: None });
        }
        let text = fs::read(&path).map_err(ClipError::io(&path))?;
        let file: CamerasFile = serde_json::from_slice(&text).map_err(|error| {
            ClipError::malformed(
                &path,
                "JSON",
                error,
                "cameras with a name and, if wanted, a split of train or test",
            )
        })?;
        let splits: BTreeMap<String, Split> =
            file.cameras.into_iter().filter_map(|camera| Some((camera.name, camera.split?))).collect();
        let names_splits = !splits.is_empty();
        Ok(Self { stated: names_splits.then_some((path, splits)) })
    }

    fn of(&self, name: &str, index: usize) -> Result<Split, ClipError> {
        let Some((path, splits)) = &self.stated else {
            return Ok(if index == 0 { Split::Test } else { Split::Train });
        };
        splits.get(name).copied().ok_or_else(|| {
            ClipError::malformed(path, "cameras", format!("no split for {name}"), "one for every camera")
        })
    }
}

#[cfg(test)]
mod tests;
