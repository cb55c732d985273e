//! Whether the GPU engine is right on this machine's device, and how fast: `cargo xtask gpu-check` packs it for machines
//! without Rust.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command line prints")]

mod benchmark;
mod doubts;
mod parity;
mod report;
#[path = "../../../splat/benches/scene/mod.rs"]
mod scene;
mod tracks;

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::{Context, Result};
use clap::Parser;
use splat_shaders::{DeviceChoice, GpuDevice, GpuEngine, devices};

use self::{
    benchmark::{Row, Source},
    report::{Adapter, Report},
    scene::SceneSize,
};

/// Checks the GPU engine against the CPU engine on this machine's device, then times its stages. Exit code 1: a check
/// failed; 2: it could not run.
#[derive(Parser)]
struct Arguments {
    /// `auto`, `gpu:N`, or a part of a device's name; `auto` takes software where there is no GPU.
    #[arg(long, default_value = "auto")]
    device: String,
    /// 10 000 Gaussians in 640×360 only, few repeats.
    #[arg(long)]
    quick: bool,
    /// Leave larger scenes out.
    #[arg(long, value_name = "N", default_value_t = 1_000_000)]
    max_gaussians: usize,
    /// Checks only.
    #[arg(long)]
    no_benchmark: bool,
    /// Run stages in their form for subgroups, or not; without it, by what the device has.
    #[arg(long, value_name = "true|false")]
    subgroups: Option<bool>,
    /// Time this scene file (npz) instead of generated scenes; may be given several times.
    #[arg(long, value_name = "FILE.npz")]
    scene: Vec<PathBuf>,
    /// Also write everything as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::from(2)
        }
    }
}

/// Whether every check passed.
fn run(arguments: &Arguments) -> Result<bool> {
    let device = open(&arguments.device)?;
    let by_device = device.uses_subgroups();
    let device = device.with_subgroups(arguments.subgroups.unwrap_or(by_device));
    let other = open(&arguments.device)?.with_subgroups(!device.uses_subgroups());
    let has_other = other.uses_subgroups() != device.uses_subgroups();
    let engine = GpuEngine::new(device).context("the kernels")?;
    let other =
        has_other.then(|| GpuEngine::new(other)).transpose().context("the other form of the kernels")?;
    let adapter = Adapter::new(engine.device());
    println!("{adapter}\n");
    let checks = parity::run(&engine, other.as_ref())?;
    let mut report = Report {
        version: env!("CARGO_PKG_VERSION"),
        adapter,
        is_complete: false,
        checks,
        rows: Vec::new(),
        refinement: None,
    };
    save(&report, arguments.json.as_deref())?;
    println!();
    if !arguments.no_benchmark {
        for source in sources(arguments) {
            let row = Row::measure(&engine, source, arguments.quick)?;
            println!("{row}");
            report.rows.push(row);
            // A large scene may be the end of a device; what was found before it is worth having.
            save(&report, arguments.json.as_deref())?;
        }
        let refinement = benchmark::refinement(&engine, arguments.quick, arguments.max_gaussians)?;
        println!("\n{refinement}");
        report.checks.push(refinement.check());
        report.refinement = Some(refinement);
    }
    report.is_complete = true;
    save(&report, arguments.json.as_deref())?;
    let failed = report.checks.iter().filter(|check| !check.passed()).count();
    println!("\n{} checks, {failed} failed", report.checks.len());
    Ok(failed == 0)
}

fn save(report: &Report, path: Option<&Path>) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    let text = serde_json::to_string_pretty(report)?;
    fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}

fn open(device: &str) -> Result<GpuDevice> {
    let choice = match device {
        "auto" => match GpuDevice::open(&DeviceChoice::Auto) {
            Ok(device) => return Ok(device),
            // Software if there is any; else the error says what is there.
            Err(_) => devices().first().map_or(DeviceChoice::Auto, |first| DeviceChoice::Index(first.index)),
        },
        one => one.parse()?,
    };
    Ok(GpuDevice::open(&choice)?)
}

fn sources(arguments: &Arguments) -> Vec<Source> {
    if !arguments.scene.is_empty() {
        return arguments.scene.iter().cloned().map(Source::File).collect();
    }
    let all = [10_000, 100_000, 1_000_000].into_iter().flat_map(|gaussians| {
        [(640, 360), (1280, 720), (1920, 1080)].into_iter().flat_map(move |(width, height)| {
            [0, 3].map(|sh_degree| SceneSize { gaussians, width, height, sh_degree })
        })
    });
    let is_quick = |size: &SceneSize| size.gaussians == 10_000 && size.width == 640;
    all.filter(|size| size.gaussians <= arguments.max_gaussians && (!arguments.quick || is_quick(size)))
        .map(Source::Size)
        .collect()
}
