//! What motion compensation is worth before and during refinement, on clips with exact ground truth.
//! `cargo xtask bench compensation` runs it.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command line prints")]

mod clip;
#[path = "../machine/mod.rs"]
mod machine;
mod measure;
mod report;
mod sightings;
mod sightings_report;

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use clap::{Parser, ValueEnum};
use serde::Serialize;
use splat::settings::{Quality, Settings};

use self::{
    clip::ClipInput,
    machine::MachineLine,
    measure::Method,
    report::Report,
    sightings_report::{Line, SightingsReport},
};

/// PSNR of the moving region in held-out views after so many steps of refinement, from the static model as it is, from
/// the released code's compensation, and from the robust one.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Folder of the clips [default: the checkout's ../shared/clips].
    #[arg(long, value_name = "DIR")]
    clips: Option<PathBuf>,
    /// Clips, by the names of their folders.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "dev-slide,dev-deform")]
    clip: Vec<String>,
    /// Frame numbers; the key frame is 1.
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', default_value = "4,7,10",
          value_parser = clap::value_parser!(u32).range(2..))]
    frames: Vec<u32>,
    /// Steps of refinement, each from the start and on its own schedule.
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', default_value = "0,30,100,300,1000")]
    iterations: Vec<u32>,
    /// Where tracks come from.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "exact,own")]
    tracks: Vec<Tracks>,
    /// Quality level of the static model, the tracks and the compensation: draft, balanced or best.
    #[arg(long, value_parser = quality, default_value = "balanced")]
    quality: Quality,
    /// Folder that keeps the static models from run to run, one PLY per clip and quality; without it they are
    /// reconstructed every time.
    #[arg(long, value_name = "DIR")]
    static_models: Option<PathBuf>,
    /// Instead: how often own tracks mislead a view about a Gaussian, and how much of that the lift, which sees all views,
    /// leaves out.
    #[arg(long)]
    sightings: bool,
    /// Print JSON, with every frame.
    #[arg(long)]
    json: bool,
    /// What `cargo bench` passes to every benchmark.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Where tracks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Tracks {
    /// The clip's exact flow.
    Exact,
    /// The project's tracker.
    Own,
}

impl Tracks {
    fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Own => "own",
        }
    }
}

fn quality(name: &str) -> Result<Quality, String> {
    serde_json::from_value(name.into()).map_err(|error| error.to_string())
}

fn main() -> Result<()> {
    let mut arguments = Arguments::parse();
    let machine = MachineLine::read();
    let folder = arguments
        .clips
        .clone()
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/clips"));
    ensure!(
        folder.is_dir(),
        "{}: no such folder; name the folder of the clips with --clips",
        folder.display()
    );
    let settings = Settings::preset(arguments.quality);
    if arguments.sightings {
        arguments.tracks = vec![Tracks::Exact, Tracks::Own];
        return judge_sightings(&folder, arguments, &settings, machine);
    }
    let mut runs = Vec::new();
    for name in &arguments.clip {
        let input = ClipInput::open(&folder.join(name), name, &arguments, &settings)?;
        for &frame in &arguments.frames {
            runs.push(input.measure(frame, Method::None, None, &arguments.iterations, &settings)?);
            for &tracks in &arguments.tracks {
                for method in [Method::Reference, Method::Robust] {
                    runs.push(input.measure(
                        frame,
                        method,
                        Some(tracks),
                        &arguments.iterations,
                        &settings,
                    )?);
                }
            }
            eprintln!("{name}: frame {frame} is measured");
        }
    }
    let report = Report { machine, frames: arguments.frames, iterations: arguments.iterations, runs };
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!("{}", report.table());
    Ok(())
}

fn judge_sightings(
    folder: &Path,
    arguments: Arguments,
    settings: &Settings,
    machine: MachineLine,
) -> Result<()> {
    let (mut lines, mut psnr) = (Vec::new(), Vec::new());
    for name in &arguments.clip {
        let input = ClipInput::open(&folder.join(name), name, &arguments, settings)?;
        let (mut records, mut by_frame) = (Vec::new(), Vec::new());
        for &frame in &arguments.frames {
            let judged = input.sightings(frame, settings)?;
            records.extend(judged.records);
            by_frame.extend(judged.psnr);
            eprintln!("{name}: frame {frame} is judged: {:.2?} dB without and with the oracle", judged.psnr);
        }
        lines.extend(Line::all(name, &records));
        // Of a clip in which nothing moves there is none.
        let mean = |way: usize| by_frame.iter().map(|psnr| psnr[way]).sum::<f64>() / by_frame.len() as f64;
        if !by_frame.is_empty() {
            psnr.push((name.clone(), [mean(0), mean(1)]));
        }
    }
    let report = SightingsReport { machine, frames: arguments.frames, psnr, lines };
    match arguments.json {
        true => println!("{}", serde_json::to_string_pretty(&report)?),
        false => println!("{}", report.tables()),
    }
    Ok(())
}
