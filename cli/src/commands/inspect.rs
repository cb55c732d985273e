//! `inspect`: what is in a Gaussian file.

use std::path::PathBuf;

use clap::Args;
use splat::formats::ply::{self, Percentiles, PlySummary};

use super::print_json;
use crate::{error::CliError, stdout};

/// Arguments of `inspect`.
#[derive(Args, Debug)]
pub(crate) struct InspectArgs {
    /// Gaussian PLY of any tool that writes the Inria layout.
    file: PathBuf,

    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: InspectArgs) -> Result<(), CliError> {
    let name = args.file.display();
    let bytes = std::fs::read(&args.file).map_err(|error| CliError::bad_input(&name, error))?;
    let summary = ply::inspect(&bytes).map_err(|error| CliError::bad_input(&name, error))?;
    if args.json {
        return print_json(&summary);
    }
    print(&summary, bytes.len());
    Ok(())
}

fn print(summary: &PlySummary, bytes: usize) {
    stdout::line(format_args!("Gaussians  {}", summary.count));
    stdout::line(format_args!("SH degree  {}", summary.sh_degree));
    stdout::line(format_args!("bytes      {bytes}"));
    if let Some([low, high]) = summary.bounds {
        stdout::line(format_args!("bounds     {low:?} to {high:?}"));
    }
    for (name, percentiles) in [("opacity", summary.opacity), ("scale", summary.scale)] {
        if let Some(Percentiles { min, p5, p50, p95, max }) = percentiles {
            stdout::line(format_args!(
                "{name:<10} min {min:.4}, 5 % {p5:.4}, median {p50:.4}, 95 % {p95:.4}, max {max:.4}"
            ));
        }
    }
}
