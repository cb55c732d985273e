//! The robust lift against the released code's, on synthetic motion whose truth is known. `cargo xtask bench lift`
//! runs it.
#![allow(clippy::print_stdout, reason = "a command line prints")]

#[path = "../corner/mod.rs"]
mod corner;
mod fits;
mod measure;
mod report;

use anyhow::{Context, Result};
use clap::Parser;
use splat::motion::MotionSettings;

use self::{
    corner::Motion,
    measure::{Cell, Rig},
    report::Report,
};

/// Errors of position and rotation of both paths from the same noisy fits.
#[derive(Parser)]
struct Arguments {
    /// Gaussians on the corner.
    #[arg(long, value_name = "N", default_value_t = 1500)]
    gaussians: usize,
    /// Seed of scene and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One setting of the robust path, over the defaults, as in `--set neighbours=24`; may be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Show nine tenths beside the medians, and rotations up to the Gaussians' own symmetry.
    #[arg(short, long)]
    verbose: bool,
    /// What `cargo bench` passes to every benchmark.
    #[arg(long, hide = true)]
    bench: bool,
}

const RIGS: [Rig; 3] = [
    Rig { name: "3 ±5°", views: 3, half_angle: 5.0 },
    Rig { name: "3 ±20°", views: 3, half_angle: 20.0 },
    Rig { name: "12 ±40°", views: 12, half_angle: 40.0 },
];
/// Standard deviations of the entries of the affine fits.
const NOISE: [f64; 3] = [0.0, 0.02, 0.1];

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let settings = settings(&arguments.set)?;
    let mut cells = Vec::new();
    for motion in [Motion::Rigid, Motion::Bend] {
        for rig in RIGS {
            for noise in NOISE {
                let (count, seed) = (arguments.gaussians, arguments.seed);
                cells.push(Cell::measure(motion, rig, noise, count, seed, &settings)?);
            }
        }
    }
    let report = Report { gaussians: arguments.gaussians, seed: arguments.seed, cells };
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!("{}", report.table(arguments.verbose));
    Ok(())
}

fn settings(assignments: &[String]) -> Result<MotionSettings> {
    let mut settings = serde_json::to_value(MotionSettings::default())?;
    for assignment in assignments {
        let (key, value) = assignment.split_once('=').context("write --set KEY=VALUE")?;
        settings[key] = serde_json::from_str(value).with_context(|| format!("--set {assignment}"))?;
    }
    serde_json::from_value(settings).context("--set")
}
