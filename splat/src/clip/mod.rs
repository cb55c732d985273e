//! A clip on disk: synchronized, calibrated views of the same frames.
//!
//! The layout is detected by what a folder holds, never by a flag. Each reader answers "not mine", "mine, but
//! broken" or "mine", and the first that knows the folder reads it:
//!
//! 1. **nerfstudio, one file per frame** (`transforms/frame_0001.json` …): states the camera, split and image of
//!    every view in every frame, so nothing is left to conventions.
//! 2. **nerfstudio pair or single file** (`transforms_train.json` with `transforms_test.json`, `transforms.json`):
//!    the same, with frames told apart by `time`; without times it is a clip of one frame.
//! 3. **COLMAP**, text or binary (`sparse/0` or `sparse`, held-out cameras in `sparse_test`): states the cameras of
//!    one frame; the others are found by listing `images/<camera>/`. A model whose images lie in no folder is a
//!    clip of one frame.
//! 4. **LLFF and N3DV** (`poses_bounds.npy` with one video per camera): knows neither points, principal points nor
//!    splits, and videos are lossy and need ffmpeg; so it comes last.
//!
//! Folders often hold several of these; the order is by how much each leaves to convention.
//!
//! Masks are `masks/<camera>/<frame>.png`, with the image's stem. Lens distortion is removed when an image is read;
//! intrinsics stay as they are, and positions outside the photograph take its border colour.

mod cache;
mod colmap;
mod decode;
mod digest;
mod error;
mod found;
mod frame_files;
mod lens;
mod llff;
mod open;
mod points_ply;
mod pose;
mod transforms;
mod video;

use std::{
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use serde::{Deserialize, Serialize};

pub use error::{ClipError, PoseProblem};

use crate::{
    cameras::Camera,
    image::{Image, Mask},
    static_model::SfmPoint,
};
use cache::Cache;
use open::{Opened, Source, expect_size};

/// Which layout a data set has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// COLMAP text or binary.
    Colmap,
    /// nerfstudio's `transforms` files.
    Transforms,
    /// `poses_bounds.npy`.
    Llff,
}

/// What a view is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    /// The reconstruction sees its images.
    Train,
    /// Held out: its images only measure the result.
    Test,
}

/// A static camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Unique in the clip: the camera's name, or the folder of its images, with `/` between nested ones.
    pub name: String,
    /// Pinhole camera that holds for the undistorted images of every frame.
    pub camera: Camera,
    /// What the view is for.
    pub split: Split,
}

/// Name of a view's files, without an ending: the view's name with `_` for `/`. Unique in a clip that was opened, and a
/// single part of a path.
pub fn file_stem(view: &str) -> String {
    view.replace('/', "_")
}

/// How a clip is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClipOptions {
    /// Views to hold out, by name; the data set's own choice if empty.
    pub test_views: Vec<String>,
    /// First and last frame number to take; all if `None`. The first is the key frame.
    pub frames: Option<(u32, u32)>,
    /// Bytes of decoded images and masks to keep in memory; 0 keeps none.
    pub cache_bytes: u64,
    /// Folder for frames decoded from videos; needed for data sets that have nothing else.
    pub scratch: Option<PathBuf>,
}

impl Default for ClipOptions {
    fn default() -> Self {
        Self { test_views: Vec::new(), frames: None, cache_bytes: 1 << 30, scratch: None }
    }
}

/// An opened clip; clones share one cache.
#[derive(Clone, Debug)]
pub struct Clip {
    content: Arc<Content>,
}

#[derive(Debug)]
struct Content {
    layout: Layout,
    root: PathBuf,
    opened: Opened,
    points: Vec<SfmPoint>,
    cache: Cache,
}

impl Clip {
    /// Opens the data set in the folder `path` and checks all that can be checked without decoding images: cameras,
    /// splits, that every view has every frame, and the size in every image's header.
    pub fn open(path: &Path, options: &ClipOptions) -> Result<Self, ClipError> {
        let found = open::detect(path, options)?;
        let opened = open::check(path, found.views, options)?;
        let content = Content {
            layout: found.layout,
            root: path.to_owned(),
            opened,
            points: found.points,
            cache: Cache::new(options.cache_bytes),
        };
        Ok(Self { content: Arc::new(content) })
    }

    /// The layout that was read.
    pub fn layout(&self) -> Layout {
        self.content.layout
    }

    /// The data set's folder, as it was given.
    pub fn root(&self) -> &Path {
        &self.content.root
    }

    /// Training and held-out views, sorted by name.
    pub fn views(&self) -> &[View] {
        &self.content.opened.views
    }

    /// Frame numbers in order; the first is the key frame.
    pub fn frames(&self) -> &[u32] {
        &self.content.opened.frames
    }

    /// Structure-from-motion points in the data set's order; empty if it has none.
    pub fn points(&self) -> &[SfmPoint] {
        &self.content.points
    }

    /// The undistorted image of a view and frame, by index, of the size of the view's camera.
    pub fn image(&self, view: usize, frame: usize) -> Result<Arc<Image>, ClipError> {
        if let Some(image) = self.content.cache.image((view, frame)) {
            return Ok(image);
        }
        let path = &self.source(view, frame)?.images[frame];
        let photograph = self.decode_image(view, path, &read(path)?)?;
        let image = Arc::new(self.undistort(view, photograph));
        self.content.cache.keep_image((view, frame), &image);
        Ok(image)
    }

    /// The undistorted mask of a view and frame, by index; `None` if the data set has none there.
    pub fn mask(&self, view: usize, frame: usize) -> Result<Option<Arc<Mask>>, ClipError> {
        if let Some(mask) = self.content.cache.mask((view, frame)) {
            return Ok(Some(mask));
        }
        let source = self.source(view, frame)?;
        let Some(path) = &source.masks[frame] else {
            return Ok(None);
        };
        let stored = self.decode_mask(view, path, &read(path)?)?;
        let mask = Arc::new(match source.lens.map() {
            Some(map) => map.mask(&stored),
            None => stored,
        });
        self.content.cache.keep_mask((view, frame), &mask);
        Ok(Some(mask))
    }

    /// An image file that decodes to [`Self::image`]: the data set's own where the lens is a pinhole, else a PNG.
    pub fn encoded_image(&self, view: usize, frame: usize) -> Result<Vec<u8>, ClipError> {
        let source = self.source(view, frame)?;
        if source.lens.map().is_some() {
            return Ok(self.image(view, frame)?.encode_png());
        }
        let path = &source.images[frame];
        let bytes = read(path)?;
        self.decode_image(view, path, &bytes)?;
        Ok(bytes)
    }

    /// A mask file that decodes to [`Self::mask`], as [`Self::encoded_image`] does for images.
    pub fn encoded_mask(&self, view: usize, frame: usize) -> Result<Option<Vec<u8>>, ClipError> {
        let source = self.source(view, frame)?;
        if source.lens.map().is_some() {
            return Ok(self.mask(view, frame)?.map(|mask| decode::mask_png(&mask)));
        }
        let Some(path) = &source.masks[frame] else {
            return Ok(None);
        };
        let bytes = read(path)?;
        self.decode_mask(view, path, &bytes)?;
        Ok(Some(bytes))
    }

    /// Where exact flow of a view would be, existing or not; the name of no view for an index past the end.
    pub fn exact_flow_path(&self, view: usize) -> PathBuf {
        let name = self.views().get(view).map_or("", |view| view.name.as_str());
        self.root().join("flow").join(format!("{name}.npz"))
    }

    /// BLAKE3 in hexadecimal of what was opened: cameras, view names, splits, frame numbers, points and the bytes
    /// of every image and mask. Equal for equal content, wherever the folder is and whatever its files are called.
    ///
    /// Reads every file once.
    pub fn digest(&self) -> Result<String, ClipError> {
        let Opened { views, sources, frames } = &self.content.opened;
        Ok(digest::clip(views, sources, frames, &self.content.points)?.to_hex().to_string())
    }

    fn source(&self, view: usize, frame: usize) -> Result<&Source, ClipError> {
        let Opened { views, sources, frames } = &self.content.opened;
        let error = ClipError::OutOfRange { view, frame, views: views.len(), frames: frames.len() };
        sources.get(view).filter(|_| frame < frames.len()).ok_or(error)
    }

    fn decode_image(&self, view: usize, path: &Path, bytes: &[u8]) -> Result<Image, ClipError> {
        let View { name, camera, .. } = &self.views()[view];
        let image = decode::image(path, bytes)?;
        expect_size(path, [image.width, image.height], name, camera)?;
        Ok(image)
    }

    fn decode_mask(&self, view: usize, path: &Path, bytes: &[u8]) -> Result<Mask, ClipError> {
        let View { name, camera, .. } = &self.views()[view];
        let mask = decode::mask(path, bytes)?;
        expect_size(path, [mask.width, mask.height], name, camera)?;
        Ok(mask)
    }

    fn undistort(&self, view: usize, photograph: Image) -> Image {
        let Some(map) = self.content.opened.sources[view].lens.map() else {
            return photograph;
        };
        let undistorted = map.image(&photograph);
        // To the 8 bits of the file that workers get, so that everyone sees the same values.
        let (width, height) = (undistorted.width, undistorted.height);
        let pixels = undistorted.to_rgb8().into_iter().map(|value| f32::from(value) / 255.0).collect();
        Image { width, height, pixels }
    }
}

fn read(path: &Path) -> Result<Vec<u8>, ClipError> {
    fs::read(path).map_err(ClipError::io(path))
}

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
