//! `eval`: held-out metrics of a result, computed again from its files and its clip.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use splat::{
    clip::{Clip, ClipOptions, Split},
    engine::Engine,
    formats::ply,
    frame::{self, ViewMetrics},
};
use trackersplat_coordinator::assembly::sequence::{Sequence, SequenceFrame};

use super::print_json;
use crate::{
    args::EngineArgs,
    embedded::STATE_FOLDER,
    error::CliError,
    scratch::{self, OpenedClip},
    stdout, table,
};

/// Arguments of `eval`.
#[derive(Args, Debug)]
pub(crate) struct EvalArgs {
    /// Output folder of a finished job.
    dir: PathBuf,

    /// Folder of the clip [default: where it was].
    #[arg(long, value_name = "DIR")]
    clip: Option<PathBuf>,

    /// Print JSON.
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    engine: EngineArgs,
}

/// Metrics of one frame: as recorded when it was made, and as measured now.
#[derive(Debug, Serialize)]
struct Measured {
    frame: u32,
    views: Vec<ViewMetrics>,
    recorded: Vec<ViewMetrics>,
}

pub(super) fn run(args: EvalArgs) -> Result<(), CliError> {
    let engine = args.engine.engine()?;
    let sequence = read_sequence(&args.dir)?;
    let clip = open_clip(&args.dir, &sequence, args.clip.as_deref())?;
    let mut measured = Vec::new();
    for frame in sequence.frames.iter().filter(|frame| frame.is_done()) {
        measured.push(measure(engine.as_ref(), &args.dir, &sequence, frame, &clip.clip)?);
    }
    if args.json {
        return print_json(&measured);
    }
    print_table(&measured);
    Ok(())
}

/// The description in an output folder.
pub(super) fn read_sequence(folder: &Path) -> Result<Sequence, CliError> {
    Sequence::read(folder).map_err(|error| CliError::BadInput(error.to_string()))
}

/// The Gaussians of a finished frame.
pub(super) fn read_frame(
    folder: &Path,
    frame: &SequenceFrame,
) -> Result<splat::gaussians::Gaussians, CliError> {
    let Some(file) = &frame.ply else {
        return Err(CliError::bad_input(
            format!("frame {}", frame.number),
            format!("it is {}, not done", frame.state),
        ));
    };
    ply::read_ply(&folder.join(&file.path)).map_err(|error| CliError::BadInput(error.to_string()))
}

/// The clip that the sequence was made from, with the same held-out views.
///
/// Videos are decoded where `reconstruct` did it.
fn open_clip(folder: &Path, sequence: &Sequence, elsewhere: Option<&Path>) -> Result<OpenedClip, CliError> {
    let held_out = sequence.views.iter().filter(|view| view.split == Split::Test);
    let frames = (sequence.frames.first(), sequence.frames.last());
    let options = ClipOptions {
        test_views: held_out.map(|view| view.name.clone()).collect(),
        frames: match frames {
            (Some(first), Some(last)) => Some((first.number, last.number)),
            _ => None,
        },
        ..ClipOptions::default()
    };
    let path = elsewhere.unwrap_or(&sequence.clip.path);
    let decoded = folder.join(STATE_FOLDER).join("decoded");
    let opened = scratch::open(path, &options, Some(&decoded))
        .map_err(|error| CliError::BadInput(format!("{error}; --clip says where the clip is now")))?;
    let digest = opened.clip.digest().map_err(|error| CliError::BadInput(error.to_string()))?;
    if digest != sequence.clip.digest {
        let why =
            format!("it is not the clip of this result (digest {digest}, not {})", sequence.clip.digest);
        return Err(CliError::bad_input(path.display(), format!("{why}; --clip says where that one is now")));
    }
    Ok(opened)
}

fn measure(
    engine: &dyn Engine,
    folder: &Path,
    sequence: &Sequence,
    frame: &SequenceFrame,
    clip: &Clip,
) -> Result<Measured, CliError> {
    let gaussians = read_frame(folder, frame)?;
    let missing = || CliError::bad_input(format!("frame {}", frame.number), "the clip does not have it");
    let index = clip.frames().iter().position(|&number| number == frame.number).ok_or_else(missing)?;
    let bad_clip = |error: splat::clip::ClipError| CliError::BadInput(error.to_string());
    let mut views = Vec::new();
    for (position, view) in clip.views().iter().enumerate().filter(|(_, view)| view.split == Split::Test) {
        let truth = clip.image(position, index).map_err(bad_clip)?;
        let mask = clip.mask(position, index).map_err(bad_clip)?;
        let rendering = engine.render(&gaussians, &view.camera, sequence.settings.background);
        let mut image = rendering.map_err(|error| CliError::failed(&view.name, error))?.image;
        // What a viewer shows.
        image.pixels.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        views.push(frame::view_metrics(&view.name, &image, &truth, mask.as_deref()));
    }
    let recorded = frame.report.as_ref().map(|report| report.after.clone()).unwrap_or_default();
    Ok(Measured { frame: frame.number, views, recorded })
}

fn print_table(measured: &[Measured]) {
    let mut table = table::empty(&["frame", "view", "PSNR dB", "SSIM", "moving PSNR dB", "recorded PSNR dB"]);
    for Measured { frame, views, recorded } in measured {
        for view in views {
            let recorded = recorded.iter().find(|recorded| recorded.view == view.view);
            table.add_row([
                frame.to_string(),
                view.view.clone(),
                format!("{:.2}", view.psnr),
                format!("{:.3}", view.ssim),
                view.moving_psnr.map(|value| format!("{value:.2}")).unwrap_or_default(),
                recorded.map(|recorded| format!("{:.2}", recorded.psnr)).unwrap_or_default(),
            ]);
        }
    }
    let views = measured.iter().flat_map(|frame| &frame.views);
    if let Some(mean) = frame::mean(views) {
        table.add_row([
            "mean".to_owned(),
            String::new(),
            format!("{:.2}", mean.psnr),
            format!("{:.3}", mean.ssim),
            mean.moving_psnr.map(|value| format!("{value:.2}")).unwrap_or_default(),
            String::new(),
        ]);
    }
    table::align(&mut table);
    stdout::line(&table);
}
