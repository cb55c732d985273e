//! `render`: a frame of a result from one of its views.

use std::path::PathBuf;

use clap::Args;
use trackersplat_coordinator::assembly::sequence::Sequence;

use super::eval::{read_frame, read_sequence};
use crate::{args::EngineArgs, error::CliError, stdout};

/// Arguments of `render`.
#[derive(Args, Debug)]
pub(crate) struct RenderArgs {
    /// Output folder of a finished job.
    dir: PathBuf,

    /// View whose camera to use.
    #[arg(long, value_name = "NAME")]
    view: String,

    /// Frame number.
    #[arg(long, value_name = "T")]
    frame: u32,

    /// PNG to write.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,

    #[command(flatten)]
    engine: EngineArgs,
}

pub(super) fn run(args: RenderArgs) -> Result<(), CliError> {
    let engine = args.engine.engine()?;
    let sequence = read_sequence(&args.dir)?;
    let view = sequence.views.iter().find(|view| view.name == args.view).ok_or_else(|| {
        CliError::bad_input(
            format!("view '{}'", args.view),
            format!("the views are {}", view_names(&sequence)),
        )
    })?;
    let frame = sequence.frames.iter().find(|frame| frame.number == args.frame).ok_or_else(|| {
        CliError::bad_input(
            format!("frame {}", args.frame),
            format!("the frames are {}", frame_numbers(&sequence)),
        )
    })?;
    let gaussians = read_frame(&args.dir, frame)?;
    let rendering = engine.render(&gaussians, &view.camera, sequence.settings.background);
    let image = rendering.map_err(|error| CliError::failed("rendering", error))?.image;
    std::fs::write(&args.out, image.encode_png())
        .map_err(|error| CliError::bad_input(args.out.display(), error))?;
    stdout::line(args.out.display());
    Ok(())
}

fn view_names(sequence: &Sequence) -> String {
    sequence.views.iter().map(|view| view.name.as_str()).collect::<Vec<_>>().join(", ")
}

fn frame_numbers(sequence: &Sequence) -> String {
    match (sequence.frames.first(), sequence.frames.last()) {
        (Some(first), Some(last)) => format!("{} to {}", first.number, last.number),
        _ => "none".to_owned(),
    }
}
