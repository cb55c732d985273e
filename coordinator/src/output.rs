//! The output folder of a job: who owns it, and what may be read from it.

use std::{
    ffi::OsStr,
    io::Write,
    path::{Component, Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// File that says whose results a folder holds.
pub(crate) const MARKER: &str = "trackersplat.json";

/// Why a folder cannot take a job's results.
#[derive(Debug, Error)]
pub(crate) enum OutputError {
    /// It holds the results of another clip.
    #[error(
        "the output folder {output} belongs to the clip {} (digest {}), not to {clip} (digest {digest}); \
         give another output folder",
        .owner.clip,
        .owner.clip_digest
    )]
    OtherClip {
        /// The folder.
        output: PathBuf,
        /// The job whose results it holds.
        owner: Box<Marker>,
        /// Path of the submitted clip.
        clip: String,
        /// Its digest.
        digest: String,
    },
    /// It holds results of the same clip with other settings.
    #[error(
        "the output folder {output} holds job {job_id} of the same clip with other settings, frames, test views, static \
         model or tracks; give another output folder, or remove this one"
    )]
    OtherSettings {
        /// The folder.
        output: PathBuf,
        /// The job whose results it holds.
        job_id: String,
    },
    /// It cannot be created or written.
    #[error("cannot write to the output folder {output}: {source}; give a folder that can be written")]
    Unwritable {
        /// The folder.
        output: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Its marker cannot be read.
    #[error("{path} is no marker of trackersplat: {reason}; give another output folder, or remove the file")]
    BadMarker {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

impl OutputError {
    /// The job that a folder belongs to.
    pub(crate) fn owner(&self) -> Option<&str> {
        match self {
            Self::OtherClip { owner, .. } => Some(&owner.job_id),
            Self::OtherSettings { job_id, .. } => Some(job_id),
            Self::Unwritable { .. } | Self::BadMarker { .. } => None,
        }
    }
}

/// Whose results a folder holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Marker {
    pub(crate) job_id: String,
    pub(crate) clip: String,
    pub(crate) clip_digest: String,
    pub(crate) settings_digest: String,
    pub(crate) version: String,
}

/// Refuses a folder that belongs to other results; touches nothing.
pub(crate) fn check_owner(output: &Path, wanted: &Marker) -> Result<(), OutputError> {
    let path = output.join(MARKER);
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(source) => return Err(OutputError::Unwritable { output: output.to_owned(), source }),
    };
    let marker: Marker = serde_json::from_slice(&bytes)
        .map_err(|error| OutputError::BadMarker { path, reason: error.to_string() })?;
    if marker.clip_digest != wanted.clip_digest {
        return Err(OutputError::OtherClip {
            output: output.to_owned(),
            owner: Box::new(marker),
            clip: wanted.clip.clone(),
            digest: wanted.clip_digest.clone(),
        });
    }
    if marker.settings_digest != wanted.settings_digest {
        return Err(OutputError::OtherSettings { output: output.to_owned(), job_id: marker.job_id });
    }
    Ok(())
}

/// Creates the folder if it is missing and marks it; fails if it cannot be written.
pub(crate) fn claim(output: &Path, marker: &Marker) -> Result<(), OutputError> {
    let unwritable = |source| OutputError::Unwritable { output: output.to_owned(), source };
    std::fs::create_dir_all(output).map_err(unwritable)?;
    let json = serde_json::to_vec_pretty(marker).map_err(|error| unwritable(error.into()))?;
    let temporary = output.join(format!(".{MARKER}.{}", marker.job_id));
    let write = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(&json)?;
        file.sync_all()?;
        std::fs::rename(&temporary, output.join(MARKER))
    };
    write().map_err(unwritable)
}

/// The finished files under a folder, relative to it, in order; hidden and temporary ones, links and `private` left out.
pub(crate) fn list_files(output: &Path, private: &[PathBuf]) -> std::io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    let mut folders = vec![output.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let (path, kind) = (entry.path(), entry.file_type()?);
            if is_unfinished(&entry.file_name()) || private.contains(&path) {
                continue;
            }
            if kind.is_dir() {
                folders.push(path);
            } else if kind.is_file()
                && let Ok(relative) = path.strip_prefix(output)
            {
                files.push(relative.to_owned());
            }
        }
    }
    files.sort();
    Ok(files)
}

/// Hidden, or written under a temporary name.
fn is_unfinished(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    name.starts_with('.') || name.ends_with(".partial")
}

/// The file that a relative path names, if it is one that [`list_files`] would list.
pub(crate) fn resolve(output: &Path, relative: &str, private: &[PathBuf]) -> Option<PathBuf> {
    let is_plain = |part| matches!(part, Component::Normal(name) if !is_unfinished(name));
    let relative = Path::new(relative);
    if relative.as_os_str().is_empty() || !relative.components().all(is_plain) {
        return None;
    }
    let path = output.join(relative);
    // A link inside the folder may lead out of it.
    let resolved = path.canonicalize().ok()?;
    let is_inside = resolved.starts_with(output.canonicalize().ok()?);
    let is_private = private.iter().any(|private| path.starts_with(private));
    (is_inside && !is_private && resolved.is_file()).then_some(resolved)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn marker(clip: &str, settings: &str) -> Marker {
        Marker {
            job_id: "job-1".into(),
            clip: format!("/clips/{clip}"),
            clip_digest: clip.into(),
            settings_digest: settings.into(),
            version: "1".into(),
        }
    }

    #[test]
    fn a_folder_of_another_clip_is_refused_by_both_names_and_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        check_owner(folder.path(), &marker("a", "s")).unwrap();
        claim(folder.path(), &marker("a", "s")).unwrap();
        check_owner(folder.path(), &marker("a", "s")).unwrap();
        let before = std::fs::read(folder.path().join(MARKER)).unwrap();
        let error = check_owner(folder.path(), &marker("b", "s")).unwrap_err().to_string();
        assert!(error.contains("/clips/a") && error.contains("/clips/b"), "{error}");
        let error = check_owner(folder.path(), &marker("a", "t")).unwrap_err();
        assert_eq!(error.owner(), Some("job-1"));
        assert!(matches!(error, OutputError::OtherSettings { .. }), "{error}");
        assert_eq!(std::fs::read(folder.path().join(MARKER)).unwrap(), before);
    }

    #[test]
    fn a_folder_that_cannot_be_made_is_an_error_that_names_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "x").unwrap();
        let error = claim(&file.join("out"), &marker("a", "s")).unwrap_err().to_string();
        assert!(error.contains("file/out"), "{error}");
        std::fs::write(folder.path().join(MARKER), "{}").unwrap();
        let error = check_owner(folder.path(), &marker("a", "s")).unwrap_err();
        assert!(matches!(error, OutputError::BadMarker { .. }), "{error}");
    }

    #[test]
    fn nothing_outside_the_folder_is_served() {
        let root = tempfile::tempdir().unwrap();
        let output = root.path().join("out");
        std::fs::create_dir_all(output.join("frames")).unwrap();
        std::fs::create_dir_all(output.join("blobs")).unwrap();
        let secret = root.path().join("secret");
        for file in [
            secret.clone(),
            output.join("a.csv"),
            output.join("frames/1.ply"),
            output.join(".hidden"),
            output.join("a.csv.partial"),
            output.join("blobs/b"),
        ] {
            std::fs::write(file, "x").unwrap();
        }
        #[cfg(unix)]
        std::os::unix::fs::symlink(&secret, output.join("link")).unwrap();
        let private = [output.join("blobs")];
        let listed = list_files(&output, &private).unwrap();
        assert_eq!(listed, [PathBuf::from("a.csv"), PathBuf::from("frames/1.ply")]);
        assert!(resolve(&output, "frames/1.ply", &private).is_some());
        let absolute = secret.to_string_lossy().into_owned();
        for outside in [
            "",
            "..",
            "../secret",
            "frames/../../secret",
            &absolute,
            "link",
            ".hidden",
            "a.csv.partial",
            "frames",
            "blobs/b",
            "none",
        ] {
            assert_eq!(resolve(&output, outside, &private), None, "{outside}");
        }
    }
}
