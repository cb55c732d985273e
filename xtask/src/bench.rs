//! Benchmarks: the CPU engine, and motion compensation.

use std::{
    path::PathBuf,
    process::{Command, Stdio},
};

use anyhow::{Context, Result, bail};
use clap::Subcommand;
use serde_json::Value;

use crate::{cargo, instructions};

/// What to measure.
#[derive(Subcommand)]
pub(crate) enum Bench {
    /// One table of what a step costs, stage by stage, against the floor of this machine; `--help` has its options.
    #[command(disable_help_flag = true)]
    Raster {
        /// Passed on: --scene FILE.npz, --quick, --json, --repeat N, --verbose.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Errors of position and rotation of the robust lift and of the released code's, on synthetic motion; `--help` has
    /// its options.
    #[command(disable_help_flag = true)]
    Lift {
        /// Passed on: --gaussians N, --seed N, --set KEY=VALUE, --json, --verbose.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// What motion compensation costs, stage by stage, on one core; `--help` has its options.
    #[command(disable_help_flag = true)]
    Motion {
        /// Passed on: --gaussians N, --views N, --repeat N, --json.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// What compensation is worth before and during refinement, on clips with ground truth: without it, the released
    /// code's, the robust one; `--help` has its options.
    #[command(disable_help_flag = true)]
    Compensation {
        /// Passed on: --clips DIR, --clip NAMES, --frames, --iterations, --tracks, --quality, --static-models DIR, --sightings, --json.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Instructions of one fixed step, stage by stage, against those on record; needs valgrind.
    Instructions {
        /// Put the new counts on record.
        #[arg(long)]
        record: bool,
    },
}

impl Bench {
    /// Measures.
    pub(crate) fn run(self) -> Result<()> {
        match self {
            Self::Raster { arguments } => table("raster_table", &arguments),
            Self::Lift { arguments } => table("lift_table", &arguments),
            Self::Motion { arguments } => table("motion_table", &arguments),
            Self::Compensation { arguments } => table("compensation_table", &arguments),
            Self::Instructions { record } => instructions::run(record),
        }
    }
}

fn table(name: &str, arguments: &[String]) -> Result<()> {
    let program = build(name)?;
    let status = Command::new(&program).args(arguments).status().context("cannot start the benchmark")?;
    if !status.success() {
        bail!("the benchmark failed ({status})");
    }
    Ok(())
}

/// Builds a benchmark of `splat` and says where it is. What cargo has to say goes to standard error, so that standard
/// output is the benchmark's alone.
pub(crate) fn build(name: &str) -> Result<PathBuf> {
    let arguments = [
        "bench",
        "--package",
        "splat",
        "--bench",
        name,
        "--no-run",
        "--message-format",
        "json-render-diagnostics",
    ];
    let output =
        cargo::cargo().args(arguments).stderr(Stdio::inherit()).output().context("cannot start cargo")?;
    if !output.status.success() {
        bail!("`cargo {}` failed ({})", arguments.join(" "), output.status);
    }
    executable(&String::from_utf8_lossy(&output.stdout), name)
        .with_context(|| format!("cargo built no benchmark `{name}`"))
}

/// The executable of target `name` among cargo's messages, one JSON object per line.
pub(crate) fn executable(messages: &str, name: &str) -> Option<PathBuf> {
    messages.lines().find_map(|line| {
        let message: Value = serde_json::from_str(line).ok()?;
        if message["target"]["name"] != name {
            return None;
        }
        message["executable"].as_str().map(PathBuf::from)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_executable_of_the_target_is_found() {
        let messages = r#"
            {"reason":"compiler-artifact","target":{"name":"splat"},"executable":null}
            not json
            {"reason":"compiler-artifact","target":{"name":"other"},"executable":"/t/other-1"}
            {"reason":"compiler-artifact","target":{"name":"one_step"},"executable":"/t/one_step-1"}
            {"reason":"build-finished","success":true}"#;
        assert_eq!(executable(messages, "one_step"), Some(PathBuf::from("/t/one_step-1")));
        assert_eq!(executable(messages, "splat"), None);
    }
}
