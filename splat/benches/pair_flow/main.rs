//! Time and error of the flow between two frames, per preset. `cargo bench -p splat --bench pair_flow` runs it.
#![allow(clippy::print_stdout, reason = "a command line prints")]

mod clip;
#[path = "../motion_table/clock.rs"]
mod clock;
#[path = "../machine/mod.rs"]
mod machine;
mod measure;
mod report;

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Parser;
use splat::{settings::Quality, tracking::TrackingSettings};

use self::{clip::Clip, machine::MachineLine, measure::Frames, report::Report};

/// That of the program.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Milliseconds per one-way flow, and end-point errors on clips with exact flow.
#[derive(Parser)]
struct Arguments {
    /// Folder of clips with exact flow; without it, only times of synthetic frames.
    #[arg(long, value_name = "DIR")]
    clips: Option<PathBuf>,
    /// Clips in that folder.
    #[arg(long, value_name = "NAME", default_values = ["dev-slide", "dev-deform"], num_args = 1..)]
    clip: Vec<String>,
    /// Cameras of the clips.
    #[arg(long, value_name = "NAME", default_values = ["cam00", "cam03", "cam06"], num_args = 1..)]
    cameras: Vec<String>,
    /// Enlarge the clips' frames by this factor before errors are measured; errors stay in pixels of the clips.
    #[arg(long, value_name = "FACTOR", default_value_t = 1)]
    enlarge: u32,
    /// Presets.
    #[arg(long, value_name = "NAME", default_values = ["draft", "balanced", "best"], num_args = 1..)]
    quality: Vec<String>,
    /// One setting over the presets, as in `--set patch_stride=4`; may be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// How often each pair is timed; the fastest counts. 0: no times.
    #[arg(long, default_value_t = 5)]
    repeats: usize,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// What `cargo bench` passes to every benchmark.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Columns and rows of timed frames.
const SIZES: [(u32, u32); 2] = [(640, 360), (1280, 720)];

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    // The pool of one: times are those of one core.
    let _pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build()?;
    let machine = MachineLine::read();
    let clips = match &arguments.clips {
        Some(folder) => {
            let read = |name: &String| Clip::read(&folder.join(name), &arguments.cameras);
            arguments.clip.iter().map(read).collect::<Result<Vec<_>>>()?
        }
        None => Vec::new(),
    };
    let frames = match clips.first().and_then(|clip| clip.views.first()) {
        Some(view) => Frames::of(view)?,
        None => Frames::synthetic(),
    };
    let mut presets = Vec::new();
    for name in &arguments.quality {
        let settings = settings(name, &arguments.set)?;
        presets.push(measure::preset(
            name,
            &settings,
            &frames,
            &SIZES,
            arguments.repeats,
            &clips,
            arguments.enlarge,
        )?);
    }
    let report = Report { machine, presets };
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        println!("{}", report.table());
    }
    Ok(())
}

fn settings(name: &str, assignments: &[String]) -> Result<TrackingSettings> {
    let quality: Quality =
        serde_json::from_value(name.into()).context("--quality draft, balanced or best")?;
    let mut settings = serde_json::to_value(TrackingSettings::preset(quality))?;
    for assignment in assignments {
        let (key, value) = assignment.split_once('=').context("write --set KEY=VALUE")?;
        settings[key] = serde_json::from_str(value).with_context(|| format!("--set {assignment}"))?;
    }
    serde_json::from_value(settings).context("--set")
}
