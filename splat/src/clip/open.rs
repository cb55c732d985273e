//! From what a reader found to a clip that can be read: the checks that need no image decoded.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use rayon::prelude::*;

use super::{
    ClipError, ClipOptions, Split, View, colmap,
    decode::image_size,
    file_stem,
    found::{Found, FoundView},
    frame_files::stem_of,
    llff, transforms,
};
use crate::cameras::{
    Camera,
    distortion::{Distortion, UndistortMap},
};

/// Fewest training views that can be triangulated from.
const MIN_TRAINING_VIEWS: usize = 2;

/// Files of a view, one per frame, and what is to be done to them.
#[derive(Debug)]
pub(super) struct Source {
    pub(super) images: Vec<PathBuf>,
    pub(super) masks: Vec<Option<PathBuf>>,
    pub(super) lens: Arc<SharedLens>,
}

/// A lens and its remap table, shared by the views that were taken through it.
#[derive(Debug)]
pub(super) struct SharedLens {
    camera: Camera,
    pub(super) distortion: Distortion,
    map: OnceLock<UndistortMap>,
}

impl SharedLens {
    /// The remap table, `None` where nothing is to be undone; built when it is first needed.
    pub(super) fn map(&self) -> Option<&UndistortMap> {
        let needed = !self.distortion.is_identity();
        needed.then(|| self.map.get_or_init(|| UndistortMap::new(&self.camera, &self.distortion)))
    }

    fn is_of(&self, view: &FoundView) -> bool {
        let intrinsics = |c: &Camera| (c.width, c.height, c.fx, c.fy, c.cx, c.cy);
        self.distortion == view.distortion && intrinsics(&self.camera) == intrinsics(&view.camera)
    }
}

/// A checked data set.
#[derive(Debug)]
pub(super) struct Opened {
    pub(super) views: Vec<View>,
    pub(super) sources: Vec<Source>,
    pub(super) frames: Vec<u32>,
}

/// The data set in `root` by the first reader whose layout it has; the order is the module's.
pub(super) fn detect(root: &Path, options: &ClipOptions) -> Result<Found, ClipError> {
    if !root.is_dir() {
        return Err(ClipError::NoFolder { path: root.to_owned() });
    }
    transforms::read(root)
        .or_else(|| colmap::read(root))
        .or_else(|| llff::read(root, options))
        .unwrap_or_else(|| Err(ClipError::UnknownLayout { root: root.to_owned() }))
}

/// Checks the views as a whole and chooses the frames.
pub(super) fn check(
    root: &Path,
    mut found: Vec<FoundView>,
    options: &ClipOptions,
) -> Result<Opened, ClipError> {
    found.sort_by(|a, b| a.name.cmp(&b.name));
    found.iter().try_for_each(check_name)?;
    refuse_duplicates(&found)?;
    refuse_same_files(&found)?;
    hold_out(&mut found, &options.test_views)?;
    found.iter().try_for_each(check_camera)?;
    let training = found.iter().filter(|view| view.split == Split::Train).count();
    if training < MIN_TRAINING_VIEWS {
        return Err(ClipError::TooFewTrainingViews { root: root.to_owned(), training, views: found.len() });
    }
    let frames = choose_frames(root, &found, options.frames)?;
    let sources = sources(root, &found, &frames)?;
    check_sizes(&found, &sources)?;
    let views =
        found.into_iter().map(|view| View { name: view.name, camera: view.camera, split: view.split });
    Ok(Opened { views: views.collect(), sources, frames })
}

/// Names become parts of paths: those that lead elsewhere are refused.
fn check_name(view: &FoundView) -> Result<(), ClipError> {
    let is_file_name = |part: &str| {
        !matches!(part, "" | "." | "..")
            && !part.contains(|letter: char| letter == '\\' || letter.is_control())
    };
    if view.name.split('/').all(is_file_name) {
        return Ok(());
    }
    Err(ClipError::ViewName { path: view.declared_in.clone(), view: view.name.escape_debug().to_string() })
}

fn refuse_same_files(views: &[FoundView]) -> Result<(), ClipError> {
    let mut known = BTreeMap::new();
    for view in views {
        let file = file_stem(&view.name);
        if let Some(first) = known.insert(file.clone(), &view.name) {
            let (path, first, second) = (view.declared_in.clone(), first.clone(), view.name.clone());
            return Err(ClipError::SameFiles { path, first, second, file });
        }
    }
    Ok(())
}

fn refuse_duplicates(sorted: &[FoundView]) -> Result<(), ClipError> {
    let Some(pair) = sorted.windows(2).find(|pair| pair[0].name == pair[1].name) else {
        return Ok(());
    };
    Err(ClipError::DuplicateView { path: pair[1].declared_in.clone(), view: pair[1].name.clone() })
}

/// Views of these names are held out and no others; an empty list leaves the data set's own choice.
fn hold_out(views: &mut [FoundView], names: &[String]) -> Result<(), ClipError> {
    if names.is_empty() {
        return Ok(());
    }
    let known: BTreeSet<&str> = views.iter().map(|view| view.name.as_str()).collect();
    let unknown: Vec<&str> = names.iter().map(String::as_str).filter(|name| !known.contains(name)).collect();
    if !unknown.is_empty() {
        let known = known.into_iter().collect::<Vec<_>>().join(", ");
        return Err(ClipError::UnknownTestViews { unknown: unknown.join(", "), known });
    }
    for view in views {
        view.split = if names.contains(&view.name) { Split::Test } else { Split::Train };
    }
    Ok(())
}

fn check_camera(view: &FoundView) -> Result<(), ClipError> {
    let camera = &view.camera;
    let refuse = |name, value, expected| {
        Err(ClipError::Intrinsics {
            path: view.declared_in.clone(),
            view: view.name.clone(),
            name,
            value,
            expected,
        })
    };
    for (name, value) in [("focal length fx", camera.fx), ("focal length fy", camera.fy)] {
        if !(value > 0.0 && value.is_finite()) {
            return refuse(name, value, "a finite focal length in pixels, greater than 0");
        }
    }
    for (name, value) in [("principal point cx", camera.cx), ("principal point cy", camera.cy)] {
        if !value.is_finite() {
            return refuse(name, value, "a finite position in pixels");
        }
    }
    for (name, value) in [("image width", camera.width), ("image height", camera.height)] {
        if value == 0 {
            return refuse(name, 0.0, "a size in pixels, greater than 0");
        }
    }
    let Some(fold) = view.distortion.fold_within(camera) else {
        return Ok(());
    };
    Err(ClipError::FoldingLens {
        path: view.declared_in.clone(),
        view: view.name.clone(),
        x: fold.x,
        y: fold.y,
    })
}

/// Every frame number that any view has, within the range asked for.
fn choose_frames(root: &Path, views: &[FoundView], range: Option<(u32, u32)>) -> Result<Vec<u32>, ClipError> {
    for view in views {
        if !view.images.values().any(|path| path.is_file()) {
            return Err(ClipError::NoImages { view: view.name.clone(), looked_for: view.looked_for.clone() });
        }
    }
    let available: BTreeSet<u32> = views.iter().flat_map(|view| view.images.keys().copied()).collect();
    let (Some(&available_first), Some(&available_last)) = (available.first(), available.last()) else {
        // Every view has an image, so this is the case of no views.
        return Err(ClipError::EmptyModel { path: root.to_owned(), cameras: views.len(), images: 0 });
    };
    let (first, last) = range.unwrap_or((available_first, available_last));
    let chosen: Vec<u32> = available.into_iter().filter(|frame| (first..=last).contains(frame)).collect();
    let outside = first < available_first || last > available_last || chosen.is_empty();
    if outside {
        return Err(ClipError::FrameRange {
            root: root.to_owned(),
            first,
            last,
            available_first,
            available_last,
        });
    }
    Ok(chosen)
}

fn sources(root: &Path, views: &[FoundView], frames: &[u32]) -> Result<Vec<Source>, ClipError> {
    let masks = root.join("masks");
    let mut lenses: Vec<Arc<SharedLens>> = Vec::new();
    let mut sources = Vec::with_capacity(views.len());
    for view in views {
        let images = frames.iter().map(|&frame| image_of(view, frame)).collect::<Result<Vec<_>, _>>()?;
        let lens = lenses.iter().find(|lens| lens.is_of(view)).cloned().unwrap_or_else(|| {
            let (camera, distortion) = (view.camera.clone(), view.distortion);
            Arc::new(SharedLens { camera, distortion, map: OnceLock::new() })
        });
        if !lenses.iter().any(|known| Arc::ptr_eq(known, &lens)) {
            lenses.push(lens.clone());
        }
        let masks = images.iter().map(|image| mask_of(&masks, &view.name, image)).collect();
        sources.push(Source { images, masks, lens });
    }
    Ok(sources)
}

fn image_of(view: &FoundView, frame: u32) -> Result<PathBuf, ClipError> {
    match view.images.get(&frame) {
        Some(path) if path.is_file() => Ok(path.clone()),
        other => Err(ClipError::MissingFrame {
            view: view.name.clone(),
            frame,
            looked_for: other.unwrap_or(&view.looked_for).clone(),
        }),
    }
}

/// `masks/<view>/<stem>.png`, or `masks/<stem>.png` where every image is a view.
fn mask_of(masks: &Path, view: &str, image: &Path) -> Option<PathBuf> {
    let file = format!("{}.png", stem_of(image));
    let candidates =
        [Some(masks.join(view).join(&file)), (stem_of(image) == view).then(|| masks.join(&file))];
    candidates.into_iter().flatten().find(|path| path.is_file())
}

/// Reads the header of every image and mask.
fn check_sizes(views: &[FoundView], sources: &[Source]) -> Result<(), ClipError> {
    let files: Vec<(&FoundView, &PathBuf)> = views
        .iter()
        .zip(sources)
        .flat_map(|(view, source)| {
            source.images.iter().chain(source.masks.iter().flatten()).map(move |path| (view, path))
        })
        .collect();
    let checked: Vec<Result<(), ClipError>> = files
        .par_iter()
        .map(|(view, path)| expect_size(path, image_size(path)?, &view.name, &view.camera))
        .collect();
    // Collected in order first, so that the first bad file is reported whatever the threads did.
    checked.into_iter().collect()
}

/// Refuses an image or mask of another size than its camera.
pub(super) fn expect_size(
    path: &Path,
    [width, height]: [u32; 2],
    view: &str,
    camera: &Camera,
) -> Result<(), ClipError> {
    if [width, height] == [camera.width, camera.height] {
        return Ok(());
    }
    Err(ClipError::ImageSize {
        path: path.to_owned(),
        width,
        height,
        view: view.to_owned(),
        camera_width: camera.width,
        camera_height: camera.height,
    })
}
