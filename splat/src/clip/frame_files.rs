//! Files of a folder, by name and by the frame number in the name.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use super::ClipError;

/// Extensions of image files; what a file holds is decided by its content.
pub(super) const IMAGE_EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// Entries of `folder`, sorted by name, without hidden ones; none if there is no such folder.
pub(super) fn entries(folder: &Path) -> Result<Vec<PathBuf>, ClipError> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let listed = fs::read_dir(folder).and_then(|entries| {
        entries.map(|entry| entry.map(|entry| entry.path())).collect::<Result<Vec<PathBuf>, _>>()
    });
    let mut paths = listed.map_err(ClipError::io(folder))?;
    paths.retain(|path| !name_of(path).starts_with('.'));
    paths.sort();
    Ok(paths)
}

/// Files of `folder` with one of these extensions in any case, sorted by name.
pub(super) fn files_with(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, ClipError> {
    let has_extension = |path: &PathBuf| {
        path.extension().is_some_and(|found| extensions.iter().any(|known| found.eq_ignore_ascii_case(known)))
    };
    Ok(entries(folder)?.into_iter().filter(|path| has_extension(path) && path.is_file()).collect())
}

/// The images of `folder` by frame number.
pub(super) fn numbered_images(folder: &Path) -> Result<BTreeMap<u32, PathBuf>, ClipError> {
    numbered(files_with(folder, &IMAGE_EXTENSIONS)?)
}

/// Files by the frame number in their name; every one must have its own.
pub(super) fn numbered(files: Vec<PathBuf>) -> Result<BTreeMap<u32, PathBuf>, ClipError> {
    let mut frames = BTreeMap::new();
    for path in files {
        let Some(frame) = frame_number(&path) else {
            return Err(ClipError::UnnumberedFrame { path });
        };
        if let Some(first) = frames.insert(frame, path.clone()) {
            return Err(ClipError::DuplicateFrame { frame, first, second: path });
        }
    }
    Ok(frames)
}

/// The last run of digits in a file's stem: 12 for `cam3_frame_0012.png`.
pub(super) fn frame_number(path: &Path) -> Option<u32> {
    let stem = stem_of(path);
    let digits = stem.rsplit(|c: char| !c.is_ascii_digit()).find(|run| !run.is_empty())?;
    digits.parse().ok()
}

/// File name as text.
pub(super) fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// File name without its extension.
pub(super) fn stem_of(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers() {
        let number = |name: &str| frame_number(Path::new(name));
        assert_eq!(number("images/cam07/frame_0012.png"), Some(12));
        assert_eq!(number("0000.jpg"), Some(0));
        assert_eq!(number("cam3_0012_left.png"), Some(12));
        assert_eq!(number("4294967295.png"), Some(u32::MAX));
        assert_eq!(number("4294967296.png"), None);
        assert_eq!(number("left.png"), None);
        assert_eq!(number(""), None);
    }

    #[test]
    fn folders_are_listed_in_order_without_strangers() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["frame_10.PNG", "frame_2.jpg", "notes.txt", "._frame_1.png", "depth_3.exr"] {
            fs::write(folder.path().join(name), b"").expect("a file");
        }
        let frames = numbered_images(folder.path()).expect("two frames");
        assert_eq!(frames.keys().copied().collect::<Vec<_>>(), [2, 10]);
        assert!(numbered_images(&folder.path().join("absent")).expect("nothing").is_empty());

        fs::write(folder.path().join("frame_02.png"), b"").expect("a file");
        let twice = numbered_images(folder.path());
        assert!(matches!(twice, Err(ClipError::DuplicateFrame { frame: 2, .. })));
        fs::remove_file(folder.path().join("frame_02.png")).expect("removed");

        fs::write(folder.path().join("left.png"), b"").expect("a file");
        let unnumbered = numbered_images(folder.path());
        assert!(matches!(unnumbered, Err(ClipError::UnnumberedFrame { path }) if path.ends_with("left.png")));
    }
}
