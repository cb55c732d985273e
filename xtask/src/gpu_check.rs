//! One folder that checks and times the GPU engine on a machine without Rust.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Stdio,
};

use anyhow::{Context, Result, bail};
use clap::Args;

use crate::{bench, cargo};

/// The program's name, in cargo and in the folder.
const PROGRAM: &str = "gpu_check";

/// The folder is sent by mail and kept in tickets.
const LARGEST: u64 = 40 << 20;

/// What `cargo xtask gpu-check` takes.
#[derive(Args)]
pub(crate) struct GpuCheck {
    /// Where the folder goes; what it held of an earlier one is replaced.
    #[arg(long, value_name = "DIR", default_value = "target/gpu-check")]
    out: PathBuf,
    /// Scene files (npz) to pack and time instead of the generated scenes.
    #[arg(long, value_name = "FILE.npz")]
    scene: Vec<PathBuf>,
}

impl GpuCheck {
    /// Builds and packs.
    pub(crate) fn run(&self) -> Result<()> {
        let program = build()?;
        let data = self.out.join("data");
        if data.exists() {
            if !self.out.join(PROGRAM).exists() {
                bail!("{} is not of an earlier check; give --out a folder of its own", data.display());
            }
            fs::remove_dir_all(&data).with_context(|| format!("cannot empty {}", data.display()))?;
        }
        let folder = if self.scene.is_empty() { &self.out } else { &data };
        fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
        copy(&program, &self.out.join(PROGRAM))?;
        let mut names = Vec::new();
        for scene in &self.scene {
            let name = scene.file_name().and_then(|name| name.to_str());
            let name = name.with_context(|| format!("{} has no name", scene.display()))?;
            copy(scene, &data.join(name))?;
            names.push(name.to_owned());
        }
        let script = self.out.join("run.sh");
        fs::write(&script, run_script(&names))
            .with_context(|| format!("cannot write {}", script.display()))?;
        make_executable(&script)?;
        let size = size_of_folder(&self.out)?;
        println!("{}: {:.1} MB; ./run.sh on the other machine", self.out.display(), size as f64 / 1e6);
        if size > LARGEST {
            bail!("the folder has {size} bytes, more than {LARGEST}; pack fewer scenes");
        }
        Ok(())
    }
}

/// The program, optimised and without symbols.
fn build() -> Result<PathBuf> {
    let arguments = [
        "build",
        "--release",
        "--package",
        "splat-shaders",
        "--example",
        PROGRAM,
        "--message-format",
        "json-render-diagnostics",
    ];
    let output = cargo::cargo()
        .args(arguments)
        .env("CARGO_PROFILE_RELEASE_STRIP", "symbols")
        .stderr(Stdio::inherit())
        .output()
        .context("cannot start cargo")?;
    if !output.status.success() {
        bail!("`cargo {}` failed ({})", arguments.join(" "), output.status);
    }
    bench::executable(&String::from_utf8_lossy(&output.stdout), PROGRAM)
        .with_context(|| format!("cargo built no `{PROGRAM}`"))
}

/// Runs the program beside it with the packed scenes, and keeps the figures.
fn run_script(scenes: &[String]) -> String {
    let scenes: String = scenes.iter().map(|name| format!(" --scene \"data/{name}\"")).collect();
    format!(
        "#!/bin/sh\n\
         # Checks the GPU engine on this machine's device, then times it; figures go to gpu-check.json.\n\
         # Options are passed on: --device NAME, --quick, --max-gaussians N, --no-benchmark; see --help.\n\
         cd \"$(dirname \"$0\")\" || exit 2\n\
         exec ./{PROGRAM}{scenes} --json gpu-check.json \"$@\"\n"
    )
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to).with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))?;
    Ok(())
}

#[cfg(unix)]
fn make_executable(path: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(path, fs::Permissions::from_mode(0o755))
        .with_context(|| format!("cannot make {} executable", path.display()))
}

#[cfg(not(unix))]
fn make_executable(_path: &Path) -> Result<()> {
    Ok(())
}

/// Bytes of all files below.
fn size_of_folder(folder: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))? {
        let entry = entry?;
        let data = entry.metadata()?;
        bytes += if data.is_dir() { size_of_folder(&entry.path())? } else { data.len() };
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_script_times_the_packed_scenes_and_passes_options_on() {
        let script = run_script(&["a b.npz".to_owned(), "c.npz".to_owned()]);
        let command =
            "exec ./gpu_check --scene \"data/a b.npz\" --scene \"data/c.npz\" --json gpu-check.json \"$@\"";
        assert_eq!(script.lines().last(), Some(command));
        assert!(script.starts_with("#!/bin/sh\n"));
    }

    #[test]
    fn a_folder_is_as_large_as_its_files() -> Result<()> {
        let folder = tempfile::tempdir()?;
        fs::create_dir(folder.path().join("data"))?;
        fs::write(folder.path().join("one"), [0; 10])?;
        fs::write(folder.path().join("data/two"), [0; 7])?;
        assert_eq!(size_of_folder(folder.path())?, 17);
        Ok(())
    }
}
