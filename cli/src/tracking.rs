//! What `track` and `eval-tracks` share: which views and frames of a clip, and how they are tracked.

use std::{cell::RefCell, fs::File, io::Read, path::PathBuf, sync::Arc};

use clap::Args;
use splat::{
    clip::{Clip, ClipOptions, Split},
    formats::track_npz::files_by_view,
    image::Image,
    tracking::{
        TrackField, Tracker, TrackingSettings,
        learned::{LearnedError, MAX_MODEL_BYTES},
    },
};
use tokio_util::sync::CancellationToken;

use crate::{
    args::{QualityArg, TrackerArg},
    error::CliError,
    frame_range::FrameRange,
    layers::SettingsLayers,
    scratch::{self, OpenedClip},
};

/// Views and frames of a clip.
#[derive(Args, Clone, Debug)]
pub(crate) struct ViewsArgs {
    /// Folder of the clip (COLMAP, nerfstudio transforms, or LLFF/N3DV).
    pub(crate) clip: PathBuf,

    /// Frames to track, first and last; the first is the key frame [default: all].
    #[arg(long, value_name = "1..10", help_heading = "Input")]
    pub(crate) frames: Option<FrameRange>,

    /// Views to track [default: the training views].
    #[arg(long, value_name = "NAMES", value_delimiter = ',', help_heading = "Input")]
    pub(crate) views: Vec<String>,
}

/// What tracks, and how it is set.
#[derive(Args, Clone, Debug)]
pub(crate) struct TrackerArgs {
    /// A neural network in place of the built-in tracker: an ONNX file, as docs/trackers.md describes it.
    #[arg(long, value_name = "onnx:FILE", help_heading = "Tracking")]
    pub(crate) tracker: Option<TrackerArg>,

    /// How much time to trade for accuracy.
    #[arg(long, value_enum, default_value_t, help_heading = "Tracking")]
    pub(crate) quality: QualityArg,

    /// TOML file of settings, over the preset of --quality; its [tracking] section counts.
    #[arg(long, value_name = "FILE", help_heading = "Tracking")]
    pub(crate) settings: Option<PathBuf>,

    /// One setting by its dotted key, over --settings, as tracking.gaps=[1,2,4]; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Tracking")]
    pub(crate) set: Vec<String>,
}

impl TrackerArgs {
    /// The settings that all layers together make.
    pub(crate) fn settings(&self) -> Result<TrackingSettings, CliError> {
        if let Some(other) = self.set.iter().find(|assignment| !assignment.trim().starts_with("tracking.")) {
            let why = "tracking has no such setting; its keys begin with 'tracking.'";
            return Err(CliError::bad_input(format!("--set {other}"), why));
        }
        let layers = SettingsLayers {
            quality: self.quality.into(),
            file: self.settings.as_deref(),
            assignments: &self.set,
            ..SettingsLayers::default()
        };
        Ok(layers.resolve()?.tracking)
    }

    /// The tracker that was asked for.
    pub(crate) fn load(&self, settings: &TrackingSettings) -> Result<Tracker, CliError> {
        let model = match &self.tracker {
            Some(TrackerArg { file }) => Some((read_model(file)?, file.as_str())),
            None => None,
        };
        Tracker::new(model, settings).map_err(|error| CliError::BadInput(error.to_string()))
    }
}

fn read_model(file: &str) -> Result<Vec<u8>, CliError> {
    let bad = |why: String| CliError::bad_input(format!("--tracker onnx:{file}"), why);
    let mut bytes = Vec::new();
    // One byte more than may be: the tracker refuses it by its own words.
    let opened =
        File::open(file).and_then(|file| file.take(MAX_MODEL_BYTES as u64 + 1).read_to_end(&mut bytes));
    opened.map_err(|error| bad(format!("{error}; check that the file is there and may be read")))?;
    Ok(bytes)
}

/// What ends the tracking of a view early.
struct Stop(CliError);

impl From<CliError> for Stop {
    fn from(error: CliError) -> Self {
        Self(error)
    }
}

impl From<LearnedError> for Stop {
    fn from(error: LearnedError) -> Self {
        Self(CliError::BadInput(error.to_string()))
    }
}

/// Images by index as `read` gives them; the last one is there for whoever asks for it again.
struct KeepsLast<F> {
    read: F,
    last: RefCell<Option<(usize, Arc<Image>)>>,
}

impl<F: Fn(usize) -> Result<Arc<Image>, CliError>> KeepsLast<F> {
    fn new(read: F) -> Self {
        Self { read, last: RefCell::new(None) }
    }

    fn get(&self, index: usize) -> Result<Arc<Image>, CliError> {
        if let Some((held, image)) = &*self.last.borrow()
            && *held == index
        {
            return Ok(Arc::clone(image));
        }
        let image = (self.read)(index)?;
        self.last.replace(Some((index, Arc::clone(&image))));
        Ok(image)
    }
}

/// A clip and those of its views that are meant.
#[derive(Debug)]
pub(crate) struct ChosenViews {
    opened: OpenedClip,
    interrupted: CancellationToken,
    /// Positions among the clip's views.
    pub(crate) positions: Vec<usize>,
}

impl ChosenViews {
    pub(crate) fn open(args: &ViewsArgs) -> Result<Self, CliError> {
        let options = ClipOptions {
            frames: args.frames.map(|range| (range.first, range.last)),
            // Every image is looked at while it is the latest, which `KeepsLast` holds.
            cache_bytes: 0,
            ..ClipOptions::default()
        };
        let opened = scratch::open(&args.clip, &options, None)
            .map_err(|error| CliError::BadInput(error.to_string()))?;
        let positions = positions(&opened.clip, &args.views)?;
        if opened.clip.frames().len() < 2 {
            let why = format!("tracks need two frames, there are {}", opened.clip.frames().len());
            return Err(CliError::bad_input(args.clip.display(), format!("{why}; --frames takes more")));
        }
        Ok(Self { opened, interrupted: CancellationToken::new(), positions })
    }

    /// The same, to be tracked until `interrupted` is cancelled.
    pub(crate) fn until(self, interrupted: CancellationToken) -> Self {
        Self { interrupted, ..self }
    }

    pub(crate) fn clip(&self) -> &Clip {
        &self.opened.clip
    }

    /// Refuses to go on once Ctrl-C was pressed.
    pub(crate) fn go_on(&self) -> Result<(), CliError> {
        if self.interrupted.is_cancelled() {
            return Err(CliError::Interrupted(
                "interrupted; no npz is kept of what was unfinished".to_owned(),
            ));
        }
        Ok(())
    }

    pub(crate) fn name(&self, position: usize) -> &str {
        &self.clip().views()[position].name
    }

    /// Tracks of one view, given frame by frame: `take(i, image, field)`, from index 1.
    pub(crate) fn track(
        &self,
        position: usize,
        tracker: &Tracker,
        settings: &TrackingSettings,
        take: &mut dyn FnMut(usize, &Image, TrackField) -> Result<(), CliError>,
    ) -> Result<(), CliError> {
        let clip = self.clip();
        let images = KeepsLast::new(|index| {
            clip.image(position, index).map_err(|error| CliError::BadInput(error.to_string()))
        });
        let mut load = |index: usize| {
            self.go_on()?;
            Ok::<_, Stop>(images.get(index)?)
        };
        // A tracker gives the field of a frame before it asks for the next image.
        let mut emit = |index: usize, field: TrackField| {
            let image = images.get(index)?;
            Ok(take(index, &image, field)?)
        };
        let ended = tracker.track_view(clip.frames().len(), &mut load, settings, &mut emit);
        ended.map_err(|Stop(error)| error)
    }

    /// The file of each chosen view.
    pub(crate) fn files<'a>(&self, files: &'a [PathBuf]) -> Result<Vec<&'a PathBuf>, CliError> {
        let chosen: Vec<&str> = self.positions.iter().map(|&position| self.name(position)).collect();
        let all: Vec<&str> = self.clip().views().iter().map(|view| view.name.as_str()).collect();
        files_by_view(files, &chosen, &all)
            .map_err(|error| CliError::bad_input("--tracks", format!("{error}; --views chooses views")))
    }
}

fn positions(clip: &Clip, names: &[String]) -> Result<Vec<usize>, CliError> {
    let views = clip.views();
    if names.is_empty() {
        let training = (0..views.len()).filter(|&position| views[position].split == Split::Train);
        return Ok(training.collect());
    }
    let mut found = Vec::new();
    for name in names {
        let position = views.iter().position(|view| view.name == *name).ok_or_else(|| {
            let known: Vec<&str> = views.iter().map(|view| view.name.as_str()).collect();
            CliError::bad_input(format!("view '{name}'"), format!("the views are {}", known.join(", ")))
        })?;
        if !found.contains(&position) {
            found.push(position);
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_settings_of_the_tracker_are_taken() {
        let args = |set: &str| TrackerArgs {
            tracker: None,
            quality: QualityArg::Draft,
            settings: None,
            set: vec![set.to_owned()],
        };
        let settings = args("tracking.gaps=[1, 4]").settings();
        assert!(settings.is_ok_and(|settings| settings.gaps == [1, 4]));
        for wrong in ["refine.iterations=3", "tracking.no_such=3", "seed=1"] {
            let error = args(wrong).settings().expect_err(wrong);
            assert_eq!(error.exit_code(), 3);
            assert!(error.to_string().contains(wrong), "{error}");
        }
    }

    #[test]
    fn an_image_that_is_asked_for_again_is_not_read_again() {
        let read = RefCell::new(Vec::new());
        let images = KeepsLast::new(|index| {
            read.borrow_mut().push(index);
            match index {
                9 => Err(CliError::failed("frame 9", "it is broken")),
                _ => Ok(Arc::new(Image::filled(1, 1, [index as f32; 3]))),
            }
        });
        for index in [0, 1, 1, 2, 2, 1] {
            let image = images.get(index).expect("it can be read");
            assert_eq!(image.pixels[0], index as f32);
        }
        assert_eq!(*read.borrow(), [0, 1, 2, 1]);
        assert!(images.get(9).is_err() && images.get(9).is_err(), "a failure is no image");
        assert!(images.get(1).is_ok());
        assert_eq!(*read.borrow(), [0, 1, 2, 1, 9, 9]);
    }

    #[test]
    fn a_file_that_is_no_network_is_refused_by_its_name() {
        let folder = tempfile::tempdir().expect("a folder for tests");
        let path = folder.path().join("net.onnx");
        let file = path.display().to_string();
        let args = TrackerArgs {
            tracker: Some(TrackerArg { file: file.clone() }),
            quality: QualityArg::Draft,
            settings: None,
            set: Vec::new(),
        };
        let refusal = || args.load(&TrackingSettings::default()).expect_err("no network").to_string();
        assert!(refusal().contains(&file) && refusal().contains("may be read"), "{}", refusal());
        std::fs::write(&path, b"no network").expect("a file for tests");
        assert!(refusal().contains(&file) && refusal().contains("docs/trackers.md"), "{}", refusal());
        let built_in = TrackerArgs { tracker: None, ..args.clone() };
        assert!(matches!(built_in.load(&TrackingSettings::default()), Ok(Tracker::BuiltIn)));
    }
}
