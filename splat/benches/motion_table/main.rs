//! What motion compensation costs, stage by stage, on one core. `cargo xtask bench motion` runs it.
#![allow(clippy::print_stdout, reason = "a command line prints")]

mod clock;
#[path = "../corner/mod.rs"]
mod corner;
#[path = "../machine/mod.rs"]
mod machine;
mod measure;
mod report;

use anyhow::{Context, Result};
use clap::Parser;

use self::{machine::MachineLine, measure::Row, report::Report};

/// Times every stage of motion compensation on scenes of growing size.
#[derive(Parser)]
struct Arguments {
    /// Number of Gaussians; may be given several times [default: 10000, 50000 and 100000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(100..))]
    gaussians: Vec<u32>,
    /// Number of views.
    #[arg(long, value_name = "N", default_value_t = 13, value_parser = clap::value_parser!(u32).range(2..=64))]
    views: u32,
    /// Timed runs per row; the fastest of each stage counts.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    repeat: u32,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// What `cargo bench` passes to every benchmark.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let machine = MachineLine::read();
    let counts = match arguments.gaussians.as_slice() {
        [] => vec![10_000, 50_000, 100_000],
        given => given.to_vec(),
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().context("a pool of one thread")?;
    let (views, repeat) = (arguments.views as usize, arguments.repeat as usize);
    let rows = counts
        .iter()
        .map(|&count| pool.install(|| Row::measure(count as usize, views, repeat)))
        .collect::<Result<Vec<Row>>>()?;
    let report = Report::new(machine, rows);
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!("{}", report.table());
    Ok(())
}
