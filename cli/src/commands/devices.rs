//! `devices`: what a worker can run on here.

use clap::Args;
use serde::Serialize;
use splat::{engine::Engine, raster::CpuEngine, simd::Instructions};

use super::{cores, print_json};
use crate::{error::CliError, stdout};

/// Arguments of `devices`.
#[derive(Args, Debug)]
pub(crate) struct DevicesArgs {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A device and the engine that drives it.
#[derive(Debug, Serialize)]
struct Device {
    engine: String,
    name: String,
    threads: usize,
    features: Vec<String>,
}

pub(super) fn run(args: DevicesArgs) -> Result<(), CliError> {
    let devices = [cpu()];
    if args.json {
        return print_json(&devices);
    }
    for Device { engine, name, threads, features } in &devices {
        stdout::line(format_args!("{engine}  {name}, {threads} threads ({})", features.join(", ")));
    }
    Ok(())
}

fn cpu() -> Device {
    // Linux only; elsewhere the architecture has to do.
    let processors = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = model_name(&processors).unwrap_or(std::env::consts::ARCH).to_owned();
    let features = Instructions::available().map(|instructions| instructions.set().to_string()).collect();
    Device { engine: CpuEngine::default().name().to_owned(), name, threads: cores(), features }
}

fn model_name(processors: &str) -> Option<&str> {
    let line = processors.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_has_a_name_where_the_system_tells() {
        let told = "processor\t: 0\nmodel name\t: Fast One @ 3 GHz\nflags\t: a b\n";
        assert_eq!(model_name(told), Some("Fast One @ 3 GHz"));
        assert_eq!(model_name(""), None);
        assert!(cpu().threads >= 1 && !cpu().name.is_empty());
    }
}
