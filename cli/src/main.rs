//! `trackersplat`: moving 3D Gaussians from synchronized multi-view video.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command line prints")]

mod args;
mod client;
mod commands;
mod device;
mod display;
mod embedded;
mod environment;
mod error;
mod follow;
mod frame_range;
mod interrupt;
mod layers;
mod logs;
mod outcome;
mod output_owner;
mod pictures;
mod scratch;
mod stdout;
mod table;
mod tracking;
mod worker_processes;

use std::process::ExitCode;

use clap::Parser;

/// Keeps the megabytes that come and go with every image (docs/decisions/0010).
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let cli = commands::Cli::parse();
    logs::start(&cli.logs, cli.command.embeds_coordinator());
    match commands::run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(error.exit_code())
        }
    }
}
