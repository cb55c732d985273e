//! The identity of a clip.

use std::{fs::File, path::Path};

use blake3::{Hash, Hasher};
use rayon::prelude::*;

use super::{ClipError, Split, View, open::Source};
use crate::static_model::SfmPoint;

/// Changes whenever the same files would give other images, cameras or points.
const FORMAT: &str = "trackersplat clip 1";

/// BLAKE3 of cameras, splits, frame numbers, points and file contents, each preceded by its length or count.
pub(super) fn clip(
    views: &[View],
    sources: &[Source],
    frames: &[u32],
    points: &[SfmPoint],
) -> Result<Hash, ClipError> {
    let mut hasher = Hasher::new();
    text(&mut hasher, FORMAT);
    count(&mut hasher, frames.len());
    frames.iter().for_each(|frame| {
        hasher.update(&frame.to_le_bytes());
    });
    count(&mut hasher, points.len());
    points.iter().for_each(|point| self::point(&mut hasher, point));
    count(&mut hasher, views.len());
    for (view, source) in views.iter().zip(sources) {
        camera(&mut hasher, view, source);
    }
    for content in contents(sources)? {
        match content {
            Some(hash) => hasher.update(&[1]).update(hash.as_bytes()),
            None => hasher.update(&[0]),
        };
    }
    Ok(hasher.finalize())
}

/// BLAKE3 of a file, streamed.
pub(super) fn file(path: &Path) -> Result<Hash, ClipError> {
    let read = || {
        let mut hasher = Hasher::new();
        hasher.update_reader(File::open(path)?)?;
        Ok(hasher.finalize())
    };
    read().map_err(ClipError::io(path))
}

/// Hash of each view's images, then of its masks where there are any.
fn contents(sources: &[Source]) -> Result<Vec<Option<Hash>>, ClipError> {
    let files: Vec<Option<&Path>> = sources
        .iter()
        .flat_map(|source| {
            let images = source.images.iter().map(|path| Some(path.as_path()));
            images.chain(source.masks.iter().map(Option::as_deref))
        })
        .collect();
    let hashes: Vec<Result<Option<Hash>, ClipError>> =
        files.par_iter().map(|path| path.map(file).transpose()).collect();
    // Collected in order first, so that the first unreadable file is reported whatever the threads did.
    hashes.into_iter().collect()
}

fn camera(hasher: &mut Hasher, view: &View, source: &Source) {
    text(hasher, &view.name);
    hasher.update(&[u8::from(view.split == Split::Test)]);
    let camera = &view.camera;
    hasher.update(&camera.width.to_le_bytes());
    hasher.update(&camera.height.to_le_bytes());
    numbers(hasher, &[camera.fx, camera.fy, camera.cx, camera.cy]);
    numbers(hasher, &camera.rotation.to_cols_array());
    numbers(hasher, &camera.translation.to_array());
    let lens = source.lens.distortion;
    numbers(hasher, &[lens.k1, lens.k2, lens.p1, lens.p2]);
}

fn point(hasher: &mut Hasher, point: &SfmPoint) {
    numbers(hasher, &point.position.to_array());
    point.colour.iter().for_each(|channel| {
        hasher.update(&channel.to_le_bytes());
    });
}

fn numbers(hasher: &mut Hasher, values: &[f64]) {
    values.iter().for_each(|value| {
        hasher.update(&value.to_le_bytes());
    });
}

fn count(hasher: &mut Hasher, length: usize) {
    hasher.update(&(length as u64).to_le_bytes());
}

fn text(hasher: &mut Hasher, value: &str) {
    count(hasher, value.len());
    hasher.update(value.as_bytes());
}
