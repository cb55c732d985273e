//! nerfstudio layouts: `transforms/*.json` with one file per frame, `transforms_train.json` with
//! `transforms_test.json`, or one `transforms.json`.

mod json;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use super::{
    ClipError, Layout, Split,
    found::{Found, FoundView, merge_frames},
    frame_files::{files_with, name_of, numbered, stem_of},
    points_ply,
};
use crate::static_model::SfmPoint;
use json::{Entry, Transforms};

/// Times closer than this are the same frame.
const TIME_TOLERANCE: f64 = 1e-6;

/// An entry with the file that states it and its split.
type Stated<'a> = (&'a Transforms, &'a Entry, Split);

/// Reads the nerfstudio data set in `root`; `None` if there is none.
pub(super) fn read(root: &Path) -> Option<Result<Found, ClipError>> {
    let per_frame = match files_with(&root.join("transforms"), &["json"]) {
        Ok(files) => files,
        Err(error) => return Some(Err(error)),
    };
    if !per_frame.is_empty() {
        return Some(read_per_frame(root, per_frame));
    }
    let [train, test, single] =
        ["transforms_train.json", "transforms_test.json", "transforms.json"].map(|name| root.join(name));
    if train.is_file() || test.is_file() {
        return Some(read_pair(root, &train, &test));
    }
    single.is_file().then(|| read_single(root, &single))
}

fn read_per_frame(root: &Path, paths: Vec<PathBuf>) -> Result<Found, ClipError> {
    let mut sightings = Vec::new();
    let mut first = None;
    for (frame, path) in numbered(paths)? {
        let transforms = Transforms::read(root, &path)?;
        for entry in transforms.entries() {
            let name = camera_name(entry, &transforms.image(entry));
            sightings.push(transforms.view(entry, name, transforms.split(entry)?, frame)?);
        }
        first.get_or_insert(transforms);
    }
    found(root, sightings, first.as_slice())
}

fn read_pair(root: &Path, train: &Path, test: &Path) -> Result<Found, ClipError> {
    let mut files = vec![(Transforms::read(root, train)?, Split::Train)];
    if test.is_file() {
        files.push((Transforms::read(root, test)?, Split::Test));
    }
    // The file an entry is in decides its split.
    let stated = files
        .iter()
        .flat_map(|(file, split)| file.entries().iter().map(move |entry| (file, entry, *split)))
        .collect::<Vec<Stated>>();
    let sightings = sightings(&stated)?;
    let files: Vec<Transforms> = files.into_iter().map(|(file, _)| file).collect();
    found(root, sightings, &files)
}

fn read_single(root: &Path, path: &Path) -> Result<Found, ClipError> {
    let file = Transforms::read(root, path)?;
    let stated = file
        .entries()
        .iter()
        .map(|entry| Ok((&file, entry, file.split(entry)?)))
        .collect::<Result<Vec<Stated>, ClipError>>()?;
    let sightings = sightings(&stated)?;
    found(root, sightings, std::slice::from_ref(&file))
}

fn found(root: &Path, sightings: Vec<FoundView>, files: &[Transforms]) -> Result<Found, ClipError> {
    if sightings.is_empty() {
        let path = files.first().map_or_else(|| root.to_owned(), |file| file.path.clone());
        return Err(ClipError::EmptyModel { path, cameras: 0, images: 0 });
    }
    let points = initial_points(root, files)?;
    Ok(Found { layout: Layout::Transforms, views: merge_frames(sightings)?, points })
}

/// The points a file names, or those that lie beside the files under a usual name.
fn initial_points(root: &Path, files: &[Transforms]) -> Result<Vec<SfmPoint>, ClipError> {
    let named = files.iter().find_map(Transforms::points);
    let usual = || {
        ["points3D.ply", "sparse_pc.ply"].map(|name| root.join(name)).into_iter().find(|path| path.is_file())
    };
    named.or_else(usual).map_or_else(|| Ok(Vec::new()), |path| points_ply::read(&path))
}

/// One view per entry, numbered by time where entries have one.
fn sightings(stated: &[Stated]) -> Result<Vec<FoundView>, ClipError> {
    let untimed = stated.iter().find(|(_, entry, _)| entry.time.is_none());
    let timed = stated.iter().any(|(_, entry, _)| entry.time.is_some());
    if let (Some((file, entry, _)), true) = (untimed, timed) {
        let place = format!("time of {}", entry.file_path);
        return Err(ClipError::malformed(&file.path, place, "none", "a time for every image, or for none"));
    }
    if !timed {
        return one_frame(stated);
    }
    let frames = frame_numbers(stated)?;
    stated
        .iter()
        .zip(frames)
        .map(|(&(file, entry, split), frame)| {
            file.view(entry, camera_name(entry, &file.image(entry)), split, frame)
        })
        .collect()
}

/// The stated frame numbers if every entry has one, else the rank of the time, from 1.
fn frame_numbers(stated: &[Stated]) -> Result<Vec<u32>, ClipError> {
    let numbers: Option<Vec<u32>> = stated.iter().map(|(_, entry, _)| entry.frame).collect();
    if let Some(numbers) = numbers {
        return Ok(numbers);
    }
    let mut times: Vec<f64> = stated.iter().filter_map(|(_, entry, _)| entry.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup_by(|later, earlier| *later - *earlier < TIME_TOLERANCE);
    let rank_of = |(file, entry, _): &Stated| {
        // Each kept time starts a group, so the group is the last one that starts at or before the entry's time.
        let rank = times.partition_point(|&start| entry.time.is_some_and(|time| start <= time));
        u32::try_from(rank).map_err(|_| ClipError::malformed(&file.path, "frames", rank, "fewer frames"))
    };
    stated.iter().map(rank_of).collect()
}

/// A clip of one frame in which every image is a view.
fn one_frame(stated: &[Stated]) -> Result<Vec<FoundView>, ClipError> {
    let images: Vec<PathBuf> = stated.iter().map(|(file, entry, _)| file.image(entry)).collect();
    let names = image_names(&images);
    stated
        .iter()
        .zip(names)
        .map(|(&(file, entry, split), name)| file.view(entry, entry.camera.clone().unwrap_or(name), split, 1))
        .collect()
}

/// Names that tell images apart: their folder, else their stem, else both.
fn image_names(images: &[PathBuf]) -> Vec<String> {
    let both = |path: &PathBuf| format!("{}_{}", folder_name(path), stem_of(path));
    let by_folder: Vec<String> = images.iter().map(|path| folder_name(path)).collect();
    let by_stem: Vec<String> = images.iter().map(|path| stem_of(path)).collect();
    let distinct = |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    if distinct(&by_folder) {
        return by_folder;
    }
    if distinct(&by_stem) { by_stem } else { images.iter().map(both).collect() }
}

/// The camera an entry names, else the folder of its image.
fn camera_name(entry: &Entry, image: &Path) -> String {
    entry.camera.clone().unwrap_or_else(|| folder_name(image))
}

fn folder_name(image: &Path) -> String {
    image.parent().map(name_of).unwrap_or_default()
}

#[cfg(test)]
mod tests;
