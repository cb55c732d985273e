//! COLMAP models: `sparse/0` or `sparse` with `images/<camera>/<frame>` or flat `images/`.

mod binary;
mod text;

use std::{
    collections::BTreeMap,
    path::{Component, Path, PathBuf},
};

use super::{
    ClipError, Layout, Split,
    found::{Found, FoundView, camera, merge_frames},
    frame_files::{frame_number, numbered_images, stem_of},
    lens::{Lens, LensProblem},
    pose::Pose,
};
use crate::static_model::SfmPoint;

/// A model as its files state it.
#[derive(Clone, Debug, Default, PartialEq)]
struct Model {
    cameras: BTreeMap<u32, ModelCamera>,
    images: Vec<ModelImage>,
    points: Vec<SfmPoint>,
}

#[derive(Clone, Debug, PartialEq)]
struct ModelCamera {
    model: String,
    width: u64,
    height: u64,
    parameters: Vec<f64>,
}

#[derive(Clone, Debug, PartialEq)]
struct ModelImage {
    /// World to camera, `w, x, y, z`.
    quaternion: [f64; 4],
    translation: [f64; 3],
    camera_id: u32,
    name: String,
}

/// The files of a model.
struct ModelFiles {
    cameras: PathBuf,
    images: PathBuf,
    points: PathBuf,
    binary: bool,
}

/// Reads the COLMAP data set in `root`; `None` if there is none.
pub(super) fn read(root: &Path) -> Option<Result<Found, ClipError>> {
    let training = model_files(root, "sparse")?;
    Some(read_data_set(root, &training, model_files(root, "sparse_test").as_ref()))
}

fn read_data_set(
    root: &Path,
    training: &ModelFiles,
    held_out: Option<&ModelFiles>,
) -> Result<Found, ClipError> {
    let model = read_model(training)?;
    let mut views = views_of(root, training, &model, Split::Train)?;
    if let Some(files) = held_out {
        views.extend(views_of(root, files, &read_model(files)?, Split::Test)?);
    }
    Ok(Found { layout: Layout::Colmap, views, points: model.points })
}

/// The model in `<folder>/0` or in `<folder>`, binary before text as COLMAP itself prefers.
fn model_files(root: &Path, folder: &str) -> Option<ModelFiles> {
    let folders = [root.join(folder).join("0"), root.join(folder)];
    folders.iter().flat_map(|folder| [(folder, "bin"), (folder, "txt")]).find_map(|(folder, extension)| {
        let file = |name: &str| folder.join(name).with_extension(extension);
        let files = ModelFiles {
            cameras: file("cameras"),
            images: file("images"),
            points: file("points3D"),
            binary: extension == "bin",
        };
        // Half a model is a broken one: the missing file is reported when it is read.
        (files.cameras.is_file() || files.images.is_file()).then_some(files)
    })
}

fn read_model(files: &ModelFiles) -> Result<Model, ClipError> {
    let (cameras, images) = if files.binary {
        (binary::cameras(&files.cameras)?, binary::images(&files.images)?)
    } else {
        (text::cameras(&files.cameras)?, text::images(&files.images)?)
    };
    // Calibrated rigs have cameras and no points, and may leave the file out.
    let points = match (files.points.is_file(), files.binary) {
        (false, _) => Vec::new(),
        (true, true) => binary::points(&files.points)?,
        (true, false) => text::points(&files.points)?,
    };
    if cameras.is_empty() || images.is_empty() {
        let path = if images.is_empty() { &files.images } else { &files.cameras };
        return Err(ClipError::EmptyModel {
            path: path.clone(),
            cameras: cameras.len(),
            images: images.len(),
        });
    }
    Ok(Model { cameras, images, points })
}

/// Views of a model: one per image folder with all frames in it, or one per image if no image lies in a folder.
fn views_of(
    root: &Path,
    files: &ModelFiles,
    model: &Model,
    split: Split,
) -> Result<Vec<FoundView>, ClipError> {
    let image_root = root.join("images");
    let in_folders = model.images.iter().filter(|image| !folder_of(&image.name).is_empty()).count();
    if in_folders == 0 {
        let flat = |image: &ModelImage| {
            let path = image_root.join(&image.name);
            sighting(files, model, image, split, stem_of(&path), 1, path)
        };
        return model.images.iter().map(flat).collect();
    }
    let in_folder = |image: &ModelImage| {
        let path = image_root.join(&image.name);
        let folder = folder_of(&image.name);
        if folder.is_empty() {
            let expected = "a name <camera>/<frame> as the model's other images have";
            return Err(ClipError::malformed(&files.images, "image name", &image.name, expected));
        }
        let frame = frame_number(&path).ok_or_else(|| ClipError::UnnumberedFrame { path: path.clone() })?;
        let looked_for = path.parent().unwrap_or(&image_root).to_owned();
        let found = sighting(files, model, image, split, folder, frame, path)?;
        Ok(FoundView { looked_for, ..found })
    };
    let sightings = model.images.iter().map(in_folder).collect::<Result<Vec<_>, _>>()?;
    let mut views = merge_frames(sightings)?;
    for view in &mut views {
        view.images.extend(numbered_images(&view.looked_for)?);
    }
    Ok(views)
}

fn sighting(
    files: &ModelFiles,
    model: &Model,
    image: &ModelImage,
    split: Split,
    name: String,
    frame: u32,
    path: PathBuf,
) -> Result<FoundView, ClipError> {
    let Some(stated) = model.cameras.get(&image.camera_id) else {
        let expected = format!("a camera of {}", files.cameras.display());
        let place = format!("camera of image {}", image.name);
        return Err(ClipError::malformed(&files.images, place, image.camera_id, expected));
    };
    let lens = Lens::from_colmap(&stated.model, &stated.parameters)
        .map_err(|problem| lens_error(files, image.camera_id, stated, problem))?;
    let size = [("width", stated.width), ("height", stated.height)].map(|(axis, pixels)| {
        u32::try_from(pixels).map_err(|_| {
            let place = format!("{axis} of camera {}", image.camera_id);
            ClipError::malformed(&files.cameras, place, pixels, "pixels")
        })
    });
    let [width, height] = size;
    let pose = Pose::from_colmap(image.quaternion, image.translation).map_err(|problem| ClipError::Pose {
        path: files.images.clone(),
        view: name.clone(),
        problem,
    })?;
    Ok(FoundView {
        name,
        camera: camera(&lens, pose, [width?, height?]),
        distortion: lens.distortion,
        split,
        looked_for: path.clone(),
        images: BTreeMap::from([(frame, path)]),
        declared_in: files.images.clone(),
    })
}

fn lens_error(files: &ModelFiles, id: u32, stated: &ModelCamera, problem: LensProblem) -> ClipError {
    match problem {
        LensProblem::Unsupported => ClipError::UnsupportedLens {
            path: files.cameras.clone(),
            camera: id.to_string(),
            model: stated.model.clone(),
        },
        LensProblem::ParameterCount(expected) => ClipError::malformed(
            &files.cameras,
            format!("camera {id}"),
            format!("{} parameters", stated.parameters.len()),
            format!("{expected} for {}", stated.model),
        ),
    }
}

/// The folder part of an image name, without what leads nowhere (`./`, a leading or a second `/`); empty if there is none.
fn folder_of(name: &str) -> String {
    let parts =
        Path::new(name).parent().into_iter().flat_map(Path::components).filter_map(|part| match part {
            Component::Normal(_) | Component::ParentDir => Some(part.as_os_str().to_string_lossy()),
            _ => None,
        });
    parts.collect::<Vec<_>>().join("/")
}

#[cfg(test)]
mod tests;
