//! `eval-tracks`: tracks against the exact flow of a rendered clip.

use std::path::{Path, PathBuf};

use clap::Args;
use indicatif::ProgressBar;
use rayon::prelude::*;
use serde::Serialize;
use splat::{
    formats::track_npz::{self, ImportedTracks, PointTracks},
    metrics::tracks::{
        ErrorSum, FieldReport, FieldScores, FrameErrors, GroupReport, PointReport, PointScores,
    },
    tracking::{TrackField, Tracker, TrackingSettings},
};

use super::{compute, print_json, track::progress};
use crate::{
    error::CliError,
    logs::LogArgs,
    pictures::{self, PictureFolder},
    stdout, table,
    tracking::{ChosenViews, TrackerArgs, ViewsArgs},
};

/// Points of a rendered clip.
const POINTS: &str = "tracks.npz";

/// Arguments of `eval-tracks`.
#[derive(Args, Debug)]
pub(crate) struct EvalTracksArgs {
    #[command(flatten)]
    views: ViewsArgs,

    /// Tracks to measure, an npz per view, named after the views or in their order, in any convention of
    /// docs/trackers.md [default: the tracker's].
    #[arg(long, value_name = "FILE", num_args = 1.., help_heading = "Input",
          conflicts_with_all = ["tracker", "quality", "settings", "set"])]
    tracks: Vec<PathBuf>,

    #[command(flatten)]
    tracker: TrackerArgs,

    /// Folder for pictures of the errors, <view>/error_0002.png. Grey: rightly called visible, white at 4 px of error.
    /// Red: called visible, but hidden. Blue: called hidden, but visible. Black: rightly called hidden.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pictures: Option<PathBuf>,

    /// Print JSON.
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// What is printed.
#[derive(Debug, Serialize)]
struct Report {
    clip: PathBuf,
    views: Vec<String>,
    frames: Vec<u32>,
    /// Dense tracks against the exact flow.
    pixels: FieldReport,
    /// TAP-Vid scores, the mean over views; none if the clip has no points.
    points: Option<Points>,
    by_frame: Vec<FrameMeans>,
}

#[derive(Debug, Serialize)]
struct Points {
    all: Option<PointReport>,
    moving: Option<PointReport>,
}

/// Mean end-point errors of one frame, pixels.
#[derive(Debug, Serialize)]
struct FrameMeans {
    frame: u32,
    all: Mean,
    moving: Mean,
}

#[derive(Debug, Serialize)]
struct Mean {
    pixels: u64,
    mean: Option<f64>,
}

pub(super) fn run(args: EvalTracksArgs, logs: &LogArgs) -> Result<(), CliError> {
    let settings = args.tracker.settings()?;
    let tracker = args.tracker.load(&settings)?;
    let views = ChosenViews::open(&args.views)?;
    if views.clip().frames()[0] != 1 {
        let why = format!("exact flow starts at frame 1, not at {}", views.clip().frames()[0]);
        return Err(CliError::bad_input("--frames", format!("{why}; begin with frame 1")));
    }
    let files: Option<Vec<PathBuf>> = match args.tracks.as_slice() {
        [] => None,
        files => Some(views.files(files)?.into_iter().cloned().collect()),
    };
    let points = views.clip().root().join(POINTS);
    let points = points.exists().then(|| PointTracks::read(&points)).transpose();
    let points = points.map_err(|error| CliError::BadInput(error.to_string()))?;
    let bar = progress(logs, (views.clip().frames().len() - 1) * views.positions.len());
    compute(move |interrupted| {
        let views = views.until(interrupted);
        let measure = |rank: usize| {
            let source = match &files {
                Some(files) => TrackSource::File(&files[rank]),
                None => TrackSource::Tracker(&tracker, &settings),
            };
            let position = views.positions[rank];
            ViewScores::measure(&views, position, source, points.as_ref(), args.pictures.as_deref(), &bar)
        };
        let ranks = 0..views.positions.len();
        let measured: Vec<ViewScores> = ranks.into_par_iter().map(measure).collect::<Result<_, _>>()?;
        bar.finish_and_clear();
        let report = Report::new(&views, points.is_some(), &measured);
        if args.json {
            return print_json(&report);
        }
        report.print();
        Ok(())
    })
}

/// Where the tracks of a view come from.
#[derive(Clone, Copy)]
enum TrackSource<'a> {
    Tracker(&'a Tracker, &'a TrackingSettings),
    File(&'a Path),
}

/// Exact tracks of one view. Fields are made as they are needed: all of them take three times what the file holds.
struct Truth {
    fields: ImportedTracks,
    valid: Vec<bool>,
    moving: Vec<bool>,
}

impl Truth {
    fn read(views: &ChosenViews, position: usize) -> Result<Self, CliError> {
        let clip = views.clip();
        let path = clip.exact_flow_path(position);
        let bad = |why: String| CliError::bad_input(path.display(), why);
        if !path.exists() {
            let why = "there is no exact flow to measure against; choose views that have it with --views, or a rendered clip";
            return Err(bad(why.to_owned()));
        }
        let fields =
            track_npz::open_exact_flow(&path).map_err(|error| CliError::BadInput(error.to_string()))?;
        let camera = &clip.views()[position].camera;
        let size = (camera.width, camera.height);
        if fields.size() != size {
            let found = format!("it is for {}x{} pixels", fields.size().0, fields.size().1);
            return Err(bad(format!("{found}, the view has {}x{}; render the flow again", size.0, size.1)));
        }
        let last = clip.frames().last().map_or(0, |&frame| frame as usize);
        if fields.count() + 1 < last {
            let reach = fields.count() + 1;
            return Err(bad(format!(
                "it reaches frame {reach}, the clip frame {last}; measure --frames 1..{reach}"
            )));
        }
        let valid = track_npz::read_exact_validity(&path, size.0, size.1)
            .map_err(|error| CliError::BadInput(error.to_string()))?;
        let mask = clip.mask(position, 0).map_err(|error| CliError::BadInput(error.to_string()))?;
        let moving = mask.map_or_else(|| vec![false; valid.len()], |mask| mask.inside.clone());
        Ok(Self { fields, valid, moving })
    }

    /// The exact field of a frame of the clip, by its number.
    fn at(&self, frame: u32) -> Result<TrackField, CliError> {
        // The clip begins with frame 1, and `read` made sure that the flow reaches its last one.
        let field = frame.checked_sub(2).and_then(|index| self.fields.field(index as usize));
        field.ok_or_else(|| CliError::failed(format!("frame {frame}"), "it has no exact flow"))
    }
}

/// Counts of one view.
struct ViewScores {
    fields: FieldScores,
    frames: Vec<FrameErrors>,
    points: [PointScores; 2],
}

impl ViewScores {
    fn measure(
        views: &ChosenViews,
        position: usize,
        source: TrackSource<'_>,
        points: Option<&PointTracks>,
        pictures: Option<&Path>,
        bar: &ProgressBar,
    ) -> Result<Self, CliError> {
        let truth = Truth::read(views, position)?;
        let view = &views.clip().views()[position];
        let folder = pictures.map(|folder| PictureFolder::create(folder, &view.name)).transpose()?;
        let mut scores =
            Self { fields: FieldScores::default(), frames: Vec::new(), points: Default::default() };
        let mut take = |index: usize, field: TrackField| {
            let frame = views.clip().frames()[index];
            let exact = truth.at(frame)?;
            scores.frames.push(scores.fields.add(&field, &exact, &truth.valid, &truth.moving));
            for (scores, moving) in scores.points.iter_mut().zip([false, true]) {
                let queries = points
                    .and_then(|points| points.queries(&view.name, &view.camera, frame as usize - 1, moving));
                scores.add(&field, queries.unwrap_or_default());
            }
            if let Some(folder) = &folder {
                folder.write("error", frame, &pictures::error(&field, &exact))?;
            }
            bar.inc(1);
            Ok(())
        };
        match source {
            TrackSource::Tracker(tracker, settings) => {
                views.track(position, tracker, settings, &mut |index, _, field| take(index, field))?;
            }
            TrackSource::File(file) => {
                for (index, field) in (1..).zip(open_tracks(views, position, file)?.fields()) {
                    views.go_on()?;
                    take(index, field)?;
                }
            }
        }
        Ok(scores)
    }
}

fn open_tracks(views: &ChosenViews, position: usize, file: &Path) -> Result<ImportedTracks, CliError> {
    let clip = views.clip();
    let camera = &clip.views()[position].camera;
    let size = (camera.width, camera.height);
    let tracks = track_npz::open_tracks(file, size).map_err(|error| CliError::BadInput(error.to_string()))?;
    let (held, frames) = (tracks.count() + 1, clip.frames().len());
    if held != frames {
        let why = format!("it has {held} frames, {frames} are to be measured; choose them with --frames");
        return Err(CliError::bad_input(file.display(), why));
    }
    if tracks.size() != size {
        let found = format!("it is for {}x{} pixels", tracks.size().0, tracks.size().1);
        let why = format!("{found}, view '{}' has {}x{}", views.name(position), size.0, size.1);
        return Err(CliError::bad_input(file.display(), format!("{why}; track the images as they are")));
    }
    Ok(tracks)
}

impl From<ErrorSum> for Mean {
    fn from(errors: ErrorSum) -> Self {
        Self { pixels: errors.count, mean: errors.mean() }
    }
}

impl Report {
    fn new(views: &ChosenViews, has_points: bool, measured: &[ViewScores]) -> Self {
        let mut pixels = FieldScores::default();
        let frames = views.clip().frames();
        let mut by_frame = vec![FrameErrors::default(); frames.len() - 1];
        for view in measured {
            pixels.merge(&view.fields);
            for (sum, errors) in by_frame.iter_mut().zip(&view.frames) {
                sum.merge(*errors);
            }
        }
        let means = |(&frame, errors): (&u32, FrameErrors)| FrameMeans {
            frame,
            all: errors.all.into(),
            moving: errors.moving.into(),
        };
        Self {
            clip: views.clip().root().to_owned(),
            views: views.positions.iter().map(|&position| views.name(position).to_owned()).collect(),
            frames: frames.to_vec(),
            pixels: pixels.report(),
            points: has_points.then(|| Points::new(measured)),
            by_frame: frames[1..].iter().zip(by_frame).map(means).collect(),
        }
    }

    fn print(&self) {
        self.print_groups();
        if let Some(points) = &self.points {
            stdout::line("");
            points.print();
        }
        stdout::line("");
        self.print_frames();
        stdout::line("");
        print_deciles(&self.pixels.all);
    }

    fn print_groups(&self) {
        let header =
            ["pixels", "counted", "EPE px", "median", "90 %", "precision", "recall", "IoU", "in 1σ", "in 2σ"];
        let mut table = table::empty(&header);
        for (name, group) in
            [("all", &self.pixels.all), ("moving", &self.pixels.moving), ("still", &self.pixels.still)]
        {
            let error = group.endpoint;
            let seen = group.visibility;
            table.add_row([
                name.to_owned(),
                error.map(|error| error.pixels.to_string()).unwrap_or_default(),
                figure(error.map(|error| error.mean)),
                figure(error.map(|error| error.median)),
                figure(error.map(|error| error.p90)),
                percent(seen.precision),
                percent(seen.recall),
                percent(seen.iou),
                percent(group.within.map(|within| within[0])),
                percent(group.within.map(|within| within[1])),
            ]);
        }
        table::align(&mut table);
        stdout::line(&table);
    }

    fn print_frames(&self) {
        let mut table = table::empty(&["frame", "", "EPE px", "moving EPE px"]);
        for frame in &self.by_frame {
            let cells =
                [frame.frame.to_string(), String::new(), figure(frame.all.mean), figure(frame.moving.mean)];
            table.add_row(cells);
        }
        table::align(&mut table);
        stdout::line(&table);
    }
}

impl Points {
    fn new(measured: &[ViewScores]) -> Self {
        let both = |view: &ViewScores| {
            let mut all = view.points[0].clone();
            all.merge(&view.points[1]);
            all.report()
        };
        let all: Vec<PointReport> = measured.iter().map(both).collect();
        let moving: Vec<PointReport> = measured.iter().map(|view| view.points[1].report()).collect();
        Self { all: PointReport::mean(&all), moving: PointReport::mean(&moving) }
    }

    fn print(&self) {
        let mut table = table::empty(&["points", "counted", "δ_avg", "AJ", "OA"]);
        for (name, points) in [("all", &self.all), ("moving", &self.moving)] {
            let Some(points) = points else { continue };
            table.add_row([
                name.to_owned(),
                points.points.to_string(),
                percent(points.delta_average),
                percent(points.average_jaccard),
                percent(points.occlusion_accuracy),
            ]);
        }
        table::align(&mut table);
        stdout::line(&table);
    }
}

fn print_deciles(group: &GroupReport) {
    let mut table = table::empty(&["decile", "", "σ from px", "σ to px", "in 1σ (68.3 %)", "in 2σ (95.4 %)"]);
    for (rank, decile) in (1..).zip(&group.deciles) {
        table.add_row([
            rank.to_string(),
            String::new(),
            figure(Some(decile.from)),
            figure(Some(decile.to)),
            percent(Some(decile.within_1)),
            percent(Some(decile.within_2)),
        ]);
    }
    table::align(&mut table);
    stdout::line(&table);
}

fn figure(value: Option<f64>) -> String {
    value.map(|value| format!("{value:.3}")).unwrap_or_default()
}

fn percent(share: Option<f64>) -> String {
    share.map(|share| format!("{:.1} %", 100.0 * share)).unwrap_or_default()
}
