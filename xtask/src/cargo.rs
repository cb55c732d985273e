//! Running cargo.

use std::{
    io::{BufRead, BufReader},
    process::{Command, Stdio},
};

use anyhow::{Context, Result, bail};

/// Runs cargo with the given arguments; its output is shown as it comes.
pub(crate) fn run(arguments: &[&str]) -> Result<()> {
    announce(arguments);
    let status = cargo().args(arguments).status().context("cannot start cargo")?;
    if !status.success() {
        bail!("`cargo {}` failed ({status})", arguments.join(" "));
    }
    Ok(())
}

/// Runs every test of the workspace and closes with the sums.
pub(crate) fn test() -> Result<()> {
    // The end-to-end tests run the program itself. Built alone its dependencies would have other features than those of
    // the tests, and nearly everything would be compiled twice.
    run(&["build", "--workspace", "--tests", "--bin", "trackersplat"])?;
    // This program may have been built for release, beside the folder of the tests.
    let this = std::env::current_exe().context("the path of this program")?;
    let target = this.ancestors().nth(2).context("the folder of builds")?;
    let program = target.join("debug").join(format!("trackersplat{}", std::env::consts::EXE_SUFFIX));
    let arguments = ["test", "--workspace", "--no-fail-fast"];
    announce(&arguments);
    let mut tests = cargo();
    tests.args(arguments).env("TRACKERSPLAT_PROGRAM", program).stdout(Stdio::piped());
    let mut child = tests.spawn().context("cannot start cargo")?;
    let output = child.stdout.take().context("the output of cargo test")?;
    let mut sums = Sums::default();
    for line in BufReader::new(output).lines() {
        let line = line.context("the output of cargo test")?;
        sums.add(&line);
        println!("{line}");
    }
    let status = child.wait().context("cargo test")?;
    println!("\n{} passed, {} failed, {} ignored", sums.passed, sums.failed, sums.ignored);
    if !status.success() {
        bail!("`cargo {}` failed ({status})", arguments.join(" "));
    }
    Ok(())
}

fn announce(arguments: &[&str]) {
    println!("\n$ cargo {}", arguments.join(" "));
}

/// The cargo that runs this program, without what it tells this program of its package: build scripts that watch these
/// variables would run again, here and when the tests build.
pub(crate) fn cargo() -> Command {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            cargo.env_remove(&name);
        }
    }
    cargo
}

/// Tests over all targets.
#[derive(Debug, Default, PartialEq, Eq)]
struct Sums {
    passed: u32,
    failed: u32,
    ignored: u32,
}

impl Sums {
    /// Adds a line such as `test result: ok. 3 passed; 0 failed; 1 ignored; …`; other lines add nothing.
    fn add(&mut self, line: &str) {
        let Some((_, counts)) = line.strip_prefix("test result: ").and_then(|rest| rest.split_once(". "))
        else {
            return;
        };
        for count in counts.split("; ") {
            match count.split_once(' ').and_then(|(number, what)| Some((number.parse::<u32>().ok()?, what))) {
                Some((number, "passed")) => self.passed += number,
                Some((number, "failed")) => self.failed += number,
                Some((number, "ignored")) => self.ignored += number,
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_of_all_targets_are_summed() {
        let mut sums = Sums::default();
        sums.add(
            "test result: ok. 29 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 7.01s",
        );
        sums.add("test result: FAILED. 3 passed; 2 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.1s");
        sums.add("test something ... ok");
        assert_eq!(sums, Sums { passed: 32, failed: 2, ignored: 1 });
    }
}
