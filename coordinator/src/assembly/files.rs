//! Names in the output folder, and files that are complete or absent.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::{AssemblyError, CONTACT_SHEET, METRICS, SEQUENCE, STATIC_MODEL};

/// `frames/frame_0001.ply`, relative to the output folder.
pub fn frame_path(number: u32) -> PathBuf {
    Path::new("frames").join(format!("frame_{number:04}.ply"))
}

/// `deltas/frame_0001.delta`, relative to the output folder.
pub fn delta_path(number: u32) -> PathBuf {
    Path::new("deltas").join(format!("frame_{number:04}.delta"))
}

/// Whether an output folder holds anything that a job computed.
pub fn holds_results(output: &Path) -> bool {
    let files = [STATIC_MODEL, SEQUENCE, METRICS, CONTACT_SHEET].map(|name| output.join(name));
    let folders = [frame_path(1), delta_path(1)];
    let folders = folders.iter().filter_map(|file| file.parent()).map(|folder| output.join(folder));
    files.into_iter().chain(folders).any(|path| path.exists())
}

/// Writes a file under a temporary name, then renames it; makes its folder if needed.
pub(super) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), AssemblyError> {
    replace(path, bytes).map_err(|source| AssemblyError::Io { path: path.to_owned(), source })
}

fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if let Some(directory) = path.parent() {
        fs::create_dir_all(directory)?;
    }
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".partial");
    let temporary = PathBuf::from(temporary);
    let mut file = File::create(&temporary)?;
    file.write_all(bytes)?;
    // Before the rename, so that a power cut leaves the old file or the new one, never an empty one.
    file.sync_all()?;
    fs::rename(temporary, path)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn names_sort_in_frame_order_and_grow_past_four_digits() {
        assert_eq!(frame_path(1), Path::new("frames/frame_0001.ply"));
        assert_eq!(delta_path(12_345), Path::new("deltas/frame_12345.delta"));
    }

    #[test]
    fn results_are_known_by_their_names() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("notes.txt"), "mine").unwrap();
        assert!(!holds_results(folder.path()) && !holds_results(&folder.path().join("none")));
        write_atomically(&folder.path().join(frame_path(7)), b"x").unwrap();
        assert!(holds_results(folder.path()));
        fs::remove_dir_all(folder.path().join("frames")).unwrap();
        write_atomically(&folder.path().join(SEQUENCE), b"{}").unwrap();
        assert!(holds_results(folder.path()));
    }

    #[test]
    fn a_file_is_replaced_whole_and_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/er/file.txt");
        write_atomically(&path, b"first, long").unwrap();
        write_atomically(&path, b"second").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn an_unwritable_place_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a file");
        fs::write(&file, b"").unwrap();
        let error = write_atomically(&file.join("below/it"), b"x").unwrap_err().to_string();
        assert!(error.contains("below/it"), "{error}");
    }
}
