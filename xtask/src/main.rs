//! Developer commands: `cargo xtask test`, `cargo xtask lint`, `cargo xtask bench`, `cargo xtask numerics`,
//! `cargo xtask gpu-check`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a command line prints")]

mod bench;
mod cargo;
mod gpu_check;
mod instructions;
mod numerics;
mod prerequisites;

use clap::{Parser, Subcommand};

/// Developer commands.
#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Install what the tests need, then run formatting, lints and all tests.
    Test,
    /// Formatting and lints only.
    Lint,
    /// Tables of speed and of accuracy, and instruction counts that noise cannot change.
    #[command(subcommand)]
    Bench(bench::Bench),
    /// Every stage at its extremes: runs the suite and renews the tables of docs/numerics.md.
    Numerics,
    /// Pack one folder that checks and times the GPU engine on a machine without Rust.
    GpuCheck(gpu_check::GpuCheck),
}

fn main() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Test => {
            prerequisites::provide()?;
            lint()?;
            cargo::test()
        }
        Command::Lint => lint(),
        Command::Bench(bench) => bench.run(),
        Command::Numerics => numerics::run(),
        Command::GpuCheck(check) => check.run(),
    }
}

fn lint() -> anyhow::Result<()> {
    cargo::run(&["fmt", "--all", "--check"])?;
    cargo::run(&["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"])?;
    // As they are shipped: tests lend their dependencies features that they may lack alone.
    cargo::run(&["check", "--package", "trackersplat"])?;
    cargo::run(&["check", "--package", "trackersplat-worker"])
}
