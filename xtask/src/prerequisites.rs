//! What the tests need besides the Rust toolchain.

use std::{
    path::Path,
    process::{Command, Stdio},
};

use anyhow::{Result, bail};

/// A program or driver outside of the repository.
struct Tool {
    /// Programs of which one is enough.
    programs: &'static [&'static str],
    /// Folders of which one that has a file with a name that begins so is enough.
    folders: &'static [(&'static str, &'static str)],
    /// Packages on Debian and Ubuntu that bring one.
    packages: &'static [&'static str],
    /// What it is for.
    purpose: &'static str,
    /// Whether nothing works without it.
    is_required: bool,
}

const TOOLS: [Tool; 3] = [
    Tool {
        programs: &["cc", "gcc", "clang"],
        folders: &[],
        packages: &["gcc", "libc6-dev"],
        purpose: "a C compiler and linker, for the bundled SQLite and zstd",
        is_required: true,
    },
    Tool {
        programs: &["ffmpeg"],
        folders: &[],
        packages: &["ffmpeg"],
        purpose: "ffmpeg, for the tests of clips with videos; they are skipped without it",
        is_required: false,
    },
    Tool {
        programs: &[],
        folders: &[("/usr/share/vulkan/icd.d", "lvp_icd"), ("/etc/vulkan/icd.d", "lvp_icd")],
        packages: &["libvulkan1", "mesa-vulkan-drivers"],
        purpose: "software Vulkan (lavapipe), for the tests of the GPU engine; TRACKERSPLAT_TEST_DEVICE=none skips them, a \
                  card's name runs them there",
        is_required: false,
    },
];

/// Installs what is missing where that is possible; fails if something required is still missing.
pub(crate) fn provide() -> Result<()> {
    for tool in TOOLS.iter().filter(|tool| !tool.is_there()) {
        println!("missing: {}", tool.purpose);
        let is_there = install(tool.packages) && tool.is_there();
        if is_there {
            continue;
        }
        let remedy = format!("install {} and run this again", tool.packages.join(" and "));
        if tool.is_required {
            bail!("missing: {}; {remedy}", tool.purpose);
        }
        println!("going on without it; to have it, {remedy}");
    }
    Ok(())
}

impl Tool {
    fn is_there(&self) -> bool {
        let has_file = |(folder, prefix): &(&str, &str)| {
            let mut entries = Path::new(folder).read_dir().into_iter().flatten().flatten();
            entries.any(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
        };
        // Drivers of other systems come with them.
        if !self.folders.is_empty() && (!cfg!(target_os = "linux") || self.folders.iter().any(has_file)) {
            return true;
        }
        let folders = std::env::var_os("PATH").unwrap_or_default();
        let is_in = |folder: &Path| self.programs.iter().any(|program| folder.join(program).is_file());
        std::env::split_paths(&folders).any(|folder| is_in(&folder))
    }
}

/// Whether apt installed the packages: on Debian and Ubuntu, as root or with a sudo that asks nothing.
fn install(packages: &[&str]) -> bool {
    if !Path::new("/usr/bin/apt-get").exists() {
        return false;
    }
    let Some(prefix) = privileged() else { return false };
    let apt = |arguments: &[&str]| {
        let words: Vec<&str> =
            prefix.iter().copied().chain(["apt-get"]).chain(arguments.iter().copied()).collect();
        println!("$ {}", words.join(" "));
        succeeds(Command::new(words[0]).args(&words[1..]).env("DEBIAN_FRONTEND", "noninteractive"))
    };
    let arguments: Vec<&str> =
        ["install", "--yes", "--no-install-recommends"].into_iter().chain(packages.iter().copied()).collect();
    apt(&["update"]) && apt(&arguments)
}

/// The words that give the rights to install; `None` if there are none.
fn privileged() -> Option<&'static [&'static str]> {
    let user = Command::new("id").arg("-u").output().ok()?;
    if user.stdout.trim_ascii() == b"0" {
        return Some(&[]);
    }
    let sudo = succeeds(Command::new("sudo").args(["-n", "true"]).stderr(Stdio::null()));
    sudo.then_some(&["sudo", "-n"])
}

fn succeeds(command: &mut Command) -> bool {
    command.status().is_ok_and(|status| status.success())
}
