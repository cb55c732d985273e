//! Opening a clip outside of a coordinator: one that is only videos needs a folder for their frames.

use std::path::{Path, PathBuf};

use splat::clip::{Clip, ClipError, ClipOptions};

/// A clip and the folder that its images may lie in.
#[derive(Debug)]
pub(crate) struct OpenedClip {
    pub(crate) clip: Clip,
    _scratch: Option<Scratch>,
}

/// A folder for decoded frames; a temporary one goes when this does.
#[derive(Debug)]
struct Scratch {
    folder: PathBuf,
    is_temporary: bool,
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if self.is_temporary {
            // A folder of the system's that is cleaned anyway.
            let _ = std::fs::remove_dir_all(&self.folder);
        }
    }
}

/// Opens a clip. Videos are decoded into `decoded` if that is given and can be written, else into a temporary folder;
/// clips of images touch neither.
pub(crate) fn open(
    path: &Path,
    options: &ClipOptions,
    decoded: Option<&Path>,
) -> Result<OpenedClip, ClipError> {
    match Clip::open(path, options) {
        Err(ClipError::NoScratch { .. }) => {}
        opened => return Ok(OpenedClip { clip: opened?, _scratch: None }),
    }
    let scratch = match decoded.filter(|folder| can_be_written(folder)) {
        Some(folder) => Scratch { folder: folder.to_owned(), is_temporary: false },
        None => Scratch { folder: temporary_folder(), is_temporary: true },
    };
    let options = ClipOptions { scratch: Some(scratch.folder.clone()), ..options.clone() };
    Ok(OpenedClip { clip: Clip::open(path, &options)?, _scratch: Some(scratch) })
}

fn temporary_folder() -> PathBuf {
    std::env::temp_dir().join(format!("trackersplat-decoded-{}", std::process::id()))
}

/// By trying: permissions, read-only media and quotas have no common question.
fn can_be_written(folder: &Path) -> bool {
    let probe = folder.join(format!(".probe-{}", std::process::id()));
    std::fs::create_dir_all(&probe).and_then(|()| std::fs::remove_dir(&probe)).is_ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_folder_below_a_file_cannot_be_written() {
        let folder = tempfile::tempdir().unwrap();
        assert!(can_be_written(&folder.path().join("a/b")));
        assert_eq!(std::fs::read_dir(folder.path().join("a/b")).unwrap().count(), 0, "no probe is left");
        let file = folder.path().join("file");
        std::fs::write(&file, b"").unwrap();
        assert!(!can_be_written(&file.join("decoded")));
    }

    #[test]
    fn a_temporary_folder_goes_and_a_given_one_stays() {
        let folder = tempfile::tempdir().unwrap();
        for (name, is_temporary) in [("kept", false), ("gone", true)] {
            let path = folder.path().join(name);
            std::fs::create_dir(&path).unwrap();
            drop(Scratch { folder: path.clone(), is_temporary });
            assert_eq!(path.exists(), !is_temporary);
        }
    }
}
