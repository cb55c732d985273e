//! `demo`: the bundled clip.

use std::path::{Path, PathBuf};

use clap::Args;

use super::reconstruct::{RunArgs, reconstruct};
use crate::{
    args::{JobArgs, SettingsArgs},
    error::CliError,
    logs::LogArgs,
};

/// The clip's place in the repository.
const DEMO_CLIP: &str = "assets/demo-clip";
/// Workers on a machine without a GPU unless stated otherwise.
const WORKERS: usize = 2;

/// Arguments of `demo`.
#[derive(Args, Debug)]
pub(crate) struct DemoArgs {
    /// Folder for the results; the same folder resumes.
    #[arg(short, long, value_name = "DIR", default_value = "trackersplat-demo", help_heading = "Output")]
    out: PathBuf,

    #[command(flatten)]
    settings: SettingsArgs,

    #[command(flatten)]
    run: RunArgs,
}

pub(super) async fn run(args: DemoArgs, logs: &LogArgs) -> Result<(), CliError> {
    let clip = find_clip(&candidates())?;
    let job = JobArgs {
        clip: clip.to_string_lossy().into_owned(),
        frames: None,
        test_views: Vec::new(),
        static_model: None,
        tracks: Vec::new(),
        tracker: None,
        settings: args.settings,
    };
    let request = job.request(Some(&args.out))?;
    reconstruct(request, &args.out, WORKERS, &args.run, logs).await
}

/// The current folder, the folders above the program, the repository that it was built from.
fn candidates() -> Vec<PathBuf> {
    let program = std::env::current_exe().unwrap_or_default();
    let mut folders = vec![PathBuf::from(".")];
    folders.extend(program.ancestors().skip(1).map(Path::to_path_buf));
    folders.push(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."));
    folders
}

fn find_clip(folders: &[PathBuf]) -> Result<PathBuf, CliError> {
    let clips = folders.iter().map(|folder| folder.join(DEMO_CLIP));
    clips.into_iter().find(|clip| clip.is_dir()).ok_or_else(|| {
        CliError::bad_input(DEMO_CLIP, "the bundled clip is not here; run the demo inside the repository")
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_nearest_copy_of_the_clip_counts() {
        let (near, far) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let folders = [near.path().to_owned(), far.path().to_owned()];
        assert_eq!(find_clip(&folders).unwrap_err().exit_code(), 3);
        std::fs::create_dir_all(far.path().join(DEMO_CLIP)).unwrap();
        assert_eq!(find_clip(&folders).unwrap(), far.path().join(DEMO_CLIP));
        std::fs::create_dir_all(near.path().join(DEMO_CLIP)).unwrap();
        assert_eq!(find_clip(&folders).unwrap(), near.path().join(DEMO_CLIP));
    }
}
