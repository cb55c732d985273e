//! A clip with its static model and its tracks.

use std::{collections::BTreeMap, fs, ops::ControlFlow, path::Path, sync::Arc};

use anyhow::{Context, Result, ensure};
use rayon::prelude::*;
use splat::{
    clip::{Clip, ClipError, ClipOptions, Split},
    engine::TrainingView,
    formats::{ply, track_npz},
    gaussians::Gaussians,
    motion::MotionView,
    raster::CpuEngine,
    settings::{Quality, Settings},
    static_model::{self, StaticModelInput},
    tracking::{TrackField, track_view},
};

use super::{Arguments, Tracks};

/// Index of the key frame.
const KEY: usize = 0;

/// Tracks of each training view; the field of frame index `i + 1` is at `i`.
type FieldsByView = BTreeMap<usize, Vec<Arc<TrackField>>>;

/// Everything that the frames of a clip are measured from.
pub(crate) struct ClipInput {
    pub(crate) name: String,
    pub(crate) clip: Clip,
    pub(crate) static_model: Gaussians,
    tracks: Vec<(Tracks, FieldsByView)>,
}

impl ClipInput {
    /// Reads, or makes, what the measurements need.
    pub(crate) fn open(
        folder: &Path,
        name: &str,
        arguments: &Arguments,
        settings: &Settings,
    ) -> Result<Self> {
        let clip = Clip::open(folder, &ClipOptions::default())?;
        let last = arguments.frames.iter().copied().max().unwrap_or(1) as usize;
        ensure!(
            last <= clip.frames().len(),
            "{}: frame {last} of {}; name others with --frames",
            folder.display(),
            clip.frames().len()
        );
        let tracks = arguments
            .tracks
            .iter()
            .map(|&source| Ok((source, read_tracks(&clip, source, last, settings)?)))
            .collect::<Result<_>>()?;
        let static_model = match &arguments.static_models {
            Some(models) => kept_static_model(&clip, models, name, arguments.quality, settings)?,
            None => reconstruct(&clip, settings)?,
        };
        Ok(Self { name: name.to_owned(), clip, static_model, tracks })
    }

    /// Positions of the views of a split.
    pub(crate) fn views(&self, split: Split) -> impl Iterator<Item = usize> + '_ {
        views(&self.clip, split)
    }

    /// Training images of a frame, by index.
    pub(crate) fn training_views(&self, frame: usize) -> Result<Vec<TrainingView>> {
        training_views(&self.clip, frame)
    }

    /// Cameras and tracks to a frame, by index.
    pub(crate) fn motion_views(&self, source: Tracks, frame: usize) -> Result<Vec<MotionView>> {
        let (_, by_view) =
            self.tracks.iter().find(|(of, _)| *of == source).context("tracks that were read")?;
        by_view
            .iter()
            .map(|(&view, fields)| {
                let tracks = fields.get(frame - 1).cloned().context("tracks that end before the frame")?;
                Ok(MotionView { camera: self.clip.views()[view].camera.clone(), tracks })
            })
            .collect()
    }
}

fn views(clip: &Clip, split: Split) -> impl Iterator<Item = usize> + '_ {
    clip.views().iter().enumerate().filter(move |(_, view)| view.split == split).map(|(index, _)| index)
}

fn training_views(clip: &Clip, frame: usize) -> Result<Vec<TrainingView>> {
    views(clip, Split::Train)
        .map(|view| {
            let camera = clip.views()[view].camera.clone();
            Ok(TrainingView { camera, image: clip.image(view, frame)?, mask: None })
        })
        .collect()
}

fn kept_static_model(
    clip: &Clip,
    folder: &Path,
    name: &str,
    quality: Quality,
    settings: &Settings,
) -> Result<Gaussians> {
    let file = folder.join(format!("{name}-{quality:?}.ply").to_lowercase());
    if file.exists() {
        return Ok(ply::read_ply(&file)?);
    }
    let gaussians = reconstruct(clip, settings)?;
    let cannot = || format!("{}: cannot keep the static model", file.display());
    fs::create_dir_all(folder).with_context(cannot)?;
    fs::write(&file, ply::write_ply(&gaussians)).with_context(cannot)?;
    Ok(gaussians)
}

fn reconstruct(clip: &Clip, settings: &Settings) -> Result<Gaussians> {
    let input = StaticModelInput {
        views: training_views(clip, KEY)?,
        points: clip.points().to_vec(),
        background: settings.background,
        seed: settings.seed,
        settings: settings.static_model.clone(),
    };
    Ok(static_model::reconstruct(&CpuEngine::default(), &input, &mut |_| ControlFlow::Continue(()))?)
}

/// Tracks of every training view up to frame number `last`.
fn read_tracks(clip: &Clip, source: Tracks, last: usize, settings: &Settings) -> Result<FieldsByView> {
    let training: Vec<usize> = views(clip, Split::Train).collect();
    let of_view = |&view: &usize| -> Result<(usize, Vec<Arc<TrackField>>)> {
        let fields = match source {
            Tracks::Exact => track_npz::read_exact_flow(&clip.exact_flow_path(view))?,
            Tracks::Own => own_tracks(clip, view, last, settings)?,
        };
        Ok((view, fields.into_iter().map(Arc::new).collect()))
    };
    training.par_iter().map(of_view).collect()
}

fn own_tracks(
    clip: &Clip,
    view: usize,
    last: usize,
    settings: &Settings,
) -> Result<Vec<TrackField>, ClipError> {
    let mut fields = Vec::with_capacity(last);
    track_view(last, &mut |frame| clip.image(view, frame), &settings.tracking, &mut |_, field| {
        fields.push(field);
        Ok(())
    })?;
    Ok(fields)
}
