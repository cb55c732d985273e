//! The robust lift against the released code's, on synthetic motion whose truth is known. `cargo xtask bench lift`
//! runs it.
#![allow(clippy::print_stdout, reason = "a command line prints")]

#[path = "../corner/mod.rs"]
mod corner;
mod fits;
mod measure;
mod report;

use anyhow::Result;
use clap::Parser;

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
    let mut cells = Vec::new();
    for motion in [Motion::Rigid, Motion::Bend] {
        for rig in RIGS {
            for noise in NOISE {
                cells.push(Cell::measure(motion, rig, noise, arguments.gaussians, arguments.seed)?);
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
