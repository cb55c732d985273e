//! What a reader finds in a data set, before it is checked as a whole.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use glam::DVec3;

use super::{ClipError, Layout, Split, lens::Lens, pose::Pose};
use crate::{
    cameras::{Camera, distortion::Distortion},
    static_model::SfmPoint,
};

/// Change between frames that passes as rounding, of every entry of the rotation, of the translation relative to
/// its length (to 1 if shorter), and of the intrinsics relative to the image width: at most a fifth of a pixel at
/// a focal length of 2000 pixels.
const STATIC_TOLERANCE: f64 = 1e-4;

/// A data set as its files state it.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) layout: Layout,
    pub(super) views: Vec<FoundView>,
    pub(super) points: Vec<SfmPoint>,
}

/// A camera and its images as the files state them.
#[derive(Clone, Debug)]
pub(super) struct FoundView {
    pub(super) name: String,
    /// Intrinsics before and after undistortion.
    pub(super) camera: Camera,
    pub(super) distortion: Distortion,
    pub(super) split: Split,
    /// Image by frame number; they may be absent on disk.
    pub(super) images: BTreeMap<u32, PathBuf>,
    /// Where an image that is not in `images` was looked for.
    pub(super) looked_for: PathBuf,
    /// The file that states the camera.
    pub(super) declared_in: PathBuf,
}

/// The camera that a lens, a pose and an image size make.
pub(super) fn camera(lens: &Lens, pose: Pose, [width, height]: [u32; 2]) -> Camera {
    Camera {
        width,
        height,
        fx: lens.fx,
        fy: lens.fy,
        cx: lens.cx,
        cy: lens.cy,
        rotation: pose.rotation,
        translation: pose.translation,
    }
}

/// One view per name from views that hold one frame each; the first sighting gives the camera, the others must agree.
pub(super) fn merge_frames(sightings: Vec<FoundView>) -> Result<Vec<FoundView>, ClipError> {
    let mut views: Vec<FoundView> = Vec::new();
    let mut index_of: BTreeMap<String, usize> = BTreeMap::new();
    for sighting in sightings {
        let Some(&index) = index_of.get(&sighting.name) else {
            index_of.insert(sighting.name.clone(), views.len());
            views.push(sighting);
            continue;
        };
        absorb(&mut views[index], sighting)?;
    }
    Ok(views)
}

fn absorb(view: &mut FoundView, sighting: FoundView) -> Result<(), ClipError> {
    let first = view.images.keys().next().copied().unwrap_or_default();
    for (frame, image) in sighting.images {
        refuse_motion(view, &sighting.camera, &sighting.distortion, &sighting.declared_in, frame, first)?;
        if view.images.insert(frame, image).is_some() {
            return Err(ClipError::DuplicateView { path: sighting.declared_in, view: view.name.clone() });
        }
    }
    if view.split != sighting.split {
        return Err(ClipError::MixedSplit { path: sighting.declared_in, view: view.name.clone() });
    }
    Ok(())
}

fn refuse_motion(
    view: &FoundView,
    camera: &Camera,
    distortion: &Distortion,
    path: &Path,
    frame: u32,
    first: u32,
) -> Result<(), ClipError> {
    let known = &view.camera;
    let rotation = (known.rotation - camera.rotation).to_cols_array();
    let largest = |entries: &[f64]| entries.iter().fold(0.0, |worst: f64, entry| worst.max(entry.abs()));
    let width = f64::from(known.width);
    let intrinsics = [known.fx - camera.fx, known.fy - camera.fy, known.cx - camera.cx, known.cy - camera.cy]
        .map(|change| change / width);
    let size =
        [f64::from(known.width.abs_diff(camera.width)), f64::from(known.height.abs_diff(camera.height))];
    let coefficients = |d: &Distortion| [d.k1, d.k2, d.p1, d.p2];
    let (was, is) = (coefficients(&view.distortion), coefficients(distortion));
    let distortion_change: [f64; 4] = std::array::from_fn(|i| was[i] - is[i]);
    let translation: DVec3 = known.translation - camera.translation;
    let changes = [
        ("the rotation", largest(&rotation)),
        ("the translation", translation.length() / known.translation.length().max(1.0)),
        ("the intrinsics relative to the image width", largest(&intrinsics)),
        ("the image size in pixels", largest(&size)),
        ("the distortion", largest(&distortion_change)),
    ];
    let Some((what, change)) = changes.into_iter().find(|(_, change)| *change > STATIC_TOLERANCE) else {
        return Ok(());
    };
    Err(ClipError::MovingCamera {
        path: path.to_owned(),
        view: view.name.clone(),
        frame,
        first,
        what,
        change,
        tolerance: STATIC_TOLERANCE,
    })
}
