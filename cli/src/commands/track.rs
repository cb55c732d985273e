//! `track`: dense tracks of a clip as npz files, and pictures of them.

use std::path::{Path, PathBuf};

use clap::Args;
use indicatif::ProgressBar;
use rayon::prelude::*;
use splat::{
    clip::file_stem,
    formats::track_npz::TrackNpzWriter,
    image::Image,
    tracking::{TrackField, Tracker, TrackingSettings},
};

use super::compute;
use crate::{
    error::CliError,
    logs::LogArgs,
    pictures::{self, PictureFolder, Trails},
    stdout,
    tracking::{ChosenViews, TrackerArgs, ViewsArgs},
};

/// Arguments of `track`.
#[derive(Args, Debug)]
pub(crate) struct TrackArgs {
    #[command(flatten)]
    views: ViewsArgs,

    #[command(flatten)]
    tracker: TrackerArgs,

    /// Where the tracks go: a file ending in .npz for one view, else a folder, which gets <view>.npz of each, with _ for
    /// each / of its name.
    ///
    /// `reconstruct --tracks` reads them, given all of them.
    #[arg(short, long, value_name = "FILE|DIR", help_heading = "Output")]
    out: PathBuf,

    /// Folder for pictures of every frame: <view>/flow_0002.png (direction as hue), tracks_0002.png (a sparse grid of
    /// tracks over the frame), uncertainty_0002.png (standard deviation, 0.008 to 16 px from dark to bright).
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pictures: Option<PathBuf>,
}

pub(super) fn run(args: TrackArgs, logs: &LogArgs) -> Result<(), CliError> {
    let settings = args.tracker.settings()?;
    let tracker = args.tracker.load(&settings)?;
    let views = ChosenViews::open(&args.views)?;
    let files = files(&args.out, &views)?;
    let later_frames = views.clip().frames().len() - 1;
    let bar = progress(logs, later_frames * views.positions.len());
    compute(move |interrupted| {
        let views = views.until(interrupted);
        let track = |(&position, file): (&usize, &PathBuf)| {
            let pictures = args.pictures.as_deref();
            let run = ViewRun { views: &views, position, tracker: &tracker, settings: &settings, pictures };
            run.write(file, &bar)
        };
        views.positions.par_iter().zip(&files).try_for_each(track)?;
        bar.finish_and_clear();
        files.iter().for_each(|file| {
            stdout::line(file.display());
        });
        Ok(())
    })
}

/// A bar on a terminal; nothing elsewhere.
pub(super) fn progress(logs: &LogArgs, total: usize) -> ProgressBar {
    if logs.quiet { ProgressBar::hidden() } else { ProgressBar::new(total as u64) }
}

/// The output file of each view.
fn files(out: &Path, views: &ChosenViews) -> Result<Vec<PathBuf>, CliError> {
    let is_file = out.extension().is_some_and(|extension| extension == "npz") && !out.is_dir();
    if is_file {
        let count = views.positions.len();
        if count != 1 {
            let why =
                format!("one file, but there are {count} views; name a folder, or one view with --views");
            return Err(CliError::bad_input(out.display(), why));
        }
        return Ok(vec![out.to_owned()]);
    }
    std::fs::create_dir_all(out).map_err(|error| {
        CliError::bad_input(out.display(), format!("{error}; --out names a folder that can be made"))
    })?;
    let file = |&position: &usize| out.join(format!("{}.npz", file_stem(views.name(position))));
    Ok(views.positions.iter().map(file).collect())
}

/// One view that is tracked.
struct ViewRun<'a> {
    views: &'a ChosenViews,
    position: usize,
    tracker: &'a Tracker,
    settings: &'a TrackingSettings,
    pictures: Option<&'a Path>,
}

impl ViewRun<'_> {
    fn write(&self, file: &Path, bar: &ProgressBar) -> Result<(), CliError> {
        let clip = self.views.clip();
        let camera = &clip.views()[self.position].camera;
        let failed =
            |error| CliError::failed(file.display(), format!("{error}; run again with room to write"));
        let frames = clip.frames().len();
        let mut writer =
            TrackNpzWriter::create(file, frames, camera.width, camera.height).map_err(|error| {
                let why = format!("{error}; --out names a file or folder that can be written");
                CliError::bad_input(file.display(), why)
            })?;
        let mut album = match self.pictures {
            Some(folder) => Some((
                PictureFolder::create(folder, self.views.name(self.position))?,
                Trails::new(camera.width, camera.height),
            )),
            None => None,
        };
        self.views.track(self.position, self.tracker, self.settings, &mut |index, frame, field| {
            writer.push(&field).map_err(failed)?;
            if let Some((folder, trails)) = &mut album {
                self.draw(folder, trails, index, frame, &field)?;
            }
            bar.inc(1);
            Ok(())
        })?;
        writer.finish().map_err(failed)?;
        tracing::info!(view = self.views.name(self.position), file = %file.display(), "tracked");
        Ok(())
    }

    fn draw(
        &self,
        folder: &PictureFolder,
        trails: &mut Trails,
        index: usize,
        frame: &Image,
        field: &TrackField,
    ) -> Result<(), CliError> {
        let number = self.views.clip().frames()[index];
        folder.write("flow", number, &pictures::flow(field))?;
        folder.write("tracks", number, &trails.draw(frame, field))?;
        folder.write("uncertainty", number, &pictures::uncertainty(field))
    }
}
