//! Names in the output folder, and files that are complete or absent.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::AssemblyError;

/// `frames/frame_0001.ply`, relative to the output folder.
pub fn frame_path(number: u32) -> PathBuf {
    Path::new("frames").join(format!("frame_{number:04}.ply"))
}

/// `deltas/frame_0001.delta`, relative to the output folder.
pub fn delta_path(number: u32) -> PathBuf {
    Path::new("deltas").join(format!("frame_{number:04}.delta"))
}

/// Whether an output folder holds a finished frame; a folder that cannot be read may.
pub fn holds_results(output: &Path) -> bool {
    let is_finished = |file: io::Result<fs::DirEntry>| file.map_or(true, |file| !is_temporary(&file.path()));
    let holds_finished = |folder: PathBuf| match fs::read_dir(folder) {
        Ok(mut files) => files.any(is_finished),
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    };
    let folders = [frame_path(1), delta_path(1)];
    folders.iter().filter_map(|file| file.parent()).any(|folder| holds_finished(output.join(folder)))
}

/// Whether a file was being written when its writer ended.
fn is_temporary(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "partial")
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
        // What a job whose frames have all failed leaves behind.
        write_atomically(&folder.path().join(crate::assembly::STATIC_MODEL), b"x").unwrap();
        write_atomically(&folder.path().join(crate::assembly::SEQUENCE), b"{}").unwrap();
        fs::create_dir(folder.path().join("frames")).unwrap();
        fs::write(folder.path().join("frames/frame_0007.ply.partial"), b"x").unwrap();
        assert!(!holds_results(folder.path()));
        for file in [frame_path(7), delta_path(7)] {
            write_atomically(&folder.path().join(&file), b"x").unwrap();
            assert!(holds_results(folder.path()));
            fs::remove_file(folder.path().join(file)).unwrap();
        }
        assert!(!holds_results(folder.path()));
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
