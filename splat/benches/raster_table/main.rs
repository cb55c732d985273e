//! One table of what a step costs, stage by stage, and how far that is from the floor. `cargo xtask bench raster` runs it.
#![allow(clippy::print_stdout, reason = "a command line prints")]

mod floor;
#[path = "../machine/mod.rs"]
mod machine;
mod measure;
mod peers;
mod report;
#[path = "../scene/mod.rs"]
mod scene;
#[path = "../step/mod.rs"]
mod step;

use std::path::PathBuf;

use anyhow::Result;
use clap::Parser;

use self::{
    floor::Floor,
    machine::MachineLine,
    measure::Row,
    report::Report,
    scene::{Scene, SceneSize},
};

/// Times every stage of an optimisation step on scenes of growing size.
#[derive(Parser)]
struct Arguments {
    /// A scene file (npz) instead of generated scenes; may be given several times.
    #[arg(long, value_name = "FILE.npz")]
    scene: Vec<PathBuf>,
    /// Two scenes with few repeats.
    #[arg(long)]
    quick: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Timed steps per row [default: 7, with --quick 3].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    repeat: Option<u32>,
    /// Show the fastest beside the median.
    #[arg(short, long)]
    verbose: bool,
    /// What `cargo bench` passes to every benchmark.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let repeat = arguments.repeat.unwrap_or(if arguments.quick { 3 } else { 7 }) as usize;
    let machine = MachineLine::read();
    let best = floor::Machine::best();
    let mut floor = Floor::default();
    let mut rows = Vec::new();
    for source in sources(&arguments) {
        let (scene, file) = source.load()?;
        floor.measure(best, repeat);
        for threads in [1, 2] {
            rows.push(Row::measure(&scene, file.as_deref(), threads, repeat, best)?);
        }
    }
    let report = Report::new(machine, best, &floor, &rows);
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!("{}", report.table(arguments.verbose));
    Ok(())
}

/// Where a scene comes from.
enum Source {
    File(PathBuf),
    Size(SceneSize),
}

impl Source {
    fn load(self) -> Result<(Scene, Option<String>)> {
        match self {
            Self::File(path) => Ok((scene::read(&path)?, Some(path.display().to_string()))),
            Self::Size(size) => Ok((scene::generate(size), None)),
        }
    }
}

fn sources(arguments: &Arguments) -> Vec<Source> {
    if !arguments.scene.is_empty() {
        return arguments.scene.iter().cloned().map(Source::File).collect();
    }
    let size = |gaussians, (width, height), sh_degree| {
        Source::Size(SceneSize { gaussians, width, height, sh_degree })
    };
    if arguments.quick {
        return vec![size(10_000, (320, 180), 3), size(100_000, (640, 360), 3)];
    }
    let mut sources = Vec::new();
    for sh_degree in [0, 3] {
        for image in [(320, 180), (640, 360), (1280, 720)] {
            for gaussians in [10_000, 50_000, 100_000] {
                sources.push(size(gaussians, image, sh_degree));
            }
        }
    }
    sources
}
