//! `devices`: what a worker can run on here.

use clap::Args;
use serde::Serialize;
use splat::{engine::Engine, raster::CpuEngine};

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
    features: Vec<&'static str>,
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
    Device { engine: CpuEngine::default().name().to_owned(), name, threads: cores(), features: simd() }
}

fn model_name(processors: &str) -> Option<&str> {
    let line = processors.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim())
}

#[cfg(target_arch = "x86_64")]
fn simd() -> Vec<&'static str> {
    let known = [
        ("avx2", std::arch::is_x86_feature_detected!("avx2")),
        ("fma", std::arch::is_x86_feature_detected!("fma")),
        ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
    ];
    known.into_iter().filter(|(_, is_there)| *is_there).map(|(name, _)| name).collect()
}

#[cfg(not(target_arch = "x86_64"))]
fn simd() -> Vec<&'static str> {
    vec![std::env::consts::ARCH]
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
