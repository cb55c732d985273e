//! Which of several track files holds the tracks of which view.

use std::{collections::BTreeSet, fmt, path::Path};

use thiserror::Error;

use crate::clip::file_stem;

/// Why files cannot be given to views without guessing.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum TrackFilesError {
    /// Several files are named after one view.
    #[error("both {first} and {second} are named after view '{view}'; give one of them")]
    Ambiguous {
        /// The view.
        view: String,
        /// One file.
        first: String,
        /// Another.
        second: String,
    },
    /// Neither is every view some file's name, nor are there as many files as views.
    #[error(
        "no file is named after view '{missing}', and order decides only where there are as many files as views: there are \
         {} files ({files}) for {} views ({views}); give one npz per view, named after the views or in their order",
        files.0.len(), views.0.len()
    )]
    Count {
        /// A view that no file is named after.
        missing: String,
        /// The files.
        files: Names,
        /// The views.
        views: Names,
    },
    /// By order a view would be given a file that is named after another view.
    #[error(
        "no file is named after view '{missing}', and by order {file} would be given to view '{view}' instead of the view \
         of its name: the files are {files}, the views {views}; give one npz per view, named after the views or in \
         their order"
    )]
    Misplaced {
        /// A view that no file is named after.
        missing: String,
        /// The file.
        file: String,
        /// The view at its place.
        view: String,
        /// The files.
        files: Names,
        /// The views.
        views: Names,
    },
}

/// Names in a message, separated by commas.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Names(Vec<String>);

impl Names {
    fn of_files<P: AsRef<Path>>(files: &[P]) -> Self {
        Self(files.iter().map(file_name).collect())
    }
}

impl fmt::Display for Names {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.0.join(", "))
    }
}

/// The track file of each of `views`, in their order; `clip_views` are the names of all views of the clip.
///
/// If every one of `views` is the name of a file without its ending ([`file_stem`]), names decide, and further files are ignored.
/// Otherwise order decides, if there are as many files as views and none is named after another view of the clip than
/// the one that it would be given to. Whatever else is refused: tracks of the wrong view look like any others.
pub fn files_by_view<'a, P: AsRef<Path>>(
    files: &'a [P],
    views: &[&str],
    clip_views: &[&str],
) -> Result<Vec<&'a P>, TrackFilesError> {
    let named = views.iter().map(|view| file_named(files, view)).collect::<Result<Vec<_>, _>>()?;
    match views.iter().zip(&named).find(|(_, file)| file.is_none()) {
        None => Ok(named.into_iter().flatten().collect()),
        Some((missing, _)) => by_order(files, views, clip_views, missing),
    }
}

/// The file that is named after `view`, if there is one.
fn file_named<'a, P: AsRef<Path>>(files: &'a [P], view: &str) -> Result<Option<&'a P>, TrackFilesError> {
    let name = file_stem(view);
    let mut named = files.iter().filter(|file| stem(file) == Some(&name));
    let found = named.next();
    if let (Some(first), Some(second)) = (found, named.next()) {
        let [first, second] = [first, second].map(|file| file.as_ref().display().to_string());
        return Err(TrackFilesError::Ambiguous { view: view.to_owned(), first, second });
    }
    Ok(found)
}

/// Every file in order; `missing` is a view that none is named after.
fn by_order<'a, P: AsRef<Path>>(
    files: &'a [P],
    views: &[&str],
    clip_views: &[&str],
    missing: &str,
) -> Result<Vec<&'a P>, TrackFilesError> {
    let missing = missing.to_owned();
    let names = || (Names::of_files(files), Names(views.iter().map(|&view| view.to_owned()).collect()));
    if files.len() != views.len() {
        let (files, views) = names();
        return Err(TrackFilesError::Count { missing, files, views });
    }
    let names_in_clip: BTreeSet<String> = clip_views.iter().map(|view| file_stem(view)).collect();
    let is_of_another = |file: &P, view: &str| {
        stem(file).is_some_and(|name| name != file_stem(view) && names_in_clip.contains(name))
    };
    if let Some((file, view)) = files.iter().zip(views).find(|(file, view)| is_of_another(file, view)) {
        let (file, view) = (file_name(file), (*view).to_owned());
        let (files, views) = names();
        return Err(TrackFilesError::Misplaced { missing, file, view, files, views });
    }
    Ok(files.iter().collect())
}

/// File name without its ending.
fn stem<P: AsRef<Path>>(file: &P) -> Option<&str> {
    file.as_ref().file_stem().and_then(|stem| stem.to_str())
}

fn file_name<P: AsRef<Path>>(file: &P) -> String {
    file.as_ref().file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    const CLIP: [&str; 4] = ["cam00", "cam03", "cam05", "test00"];
    const VIEWS: [&str; 2] = ["cam03", "cam05"];

    fn refusal(files: &[&str]) -> String {
        files_by_view(files, &VIEWS, &CLIP).unwrap_err().to_string()
    }

    #[test]
    fn names_decide_where_every_view_is_one_and_further_files_are_ignored() {
        let files = ["t/cam00.npz", "t/cam05.npz", "t/test00.npz", "t/cam03.npz", "t/other.npz"];
        assert_eq!(files_by_view(&files, &VIEWS, &CLIP), Ok(vec![&files[3], &files[1]]));
        // A name may hold points.
        let files = ["b.1.npz", "a.1.npz"];
        assert_eq!(files_by_view(&files, &["a.1"], &["a.1", "b.1"]), Ok(vec![&files[1]]));
        assert_eq!(files_by_view(&files, &[], &[]), Ok(Vec::new()));
    }

    #[test]
    fn order_decides_only_where_no_name_contradicts_it() {
        for files in [["any.npz", "more.npz"], ["cam03.npz", "more.npz"], ["cam07.npz", "cam05.npz"]] {
            assert_eq!(files_by_view(&files, &VIEWS, &CLIP), Ok(vec![&files[0], &files[1]]));
        }
        // Of a view that is not chosen, of the held-out one, and of the other chosen one.
        for files in [["cam00.npz", "any.npz"], ["any.npz", "test00.npz"], ["cam05.npz", "any.npz"]] {
            let message = refusal(&files);
            let missing =
                if files[0] == "cam05.npz" { "'cam03'" } else { "no file is named after view 'cam" };
            for part in [files[0], files[1], "cam03, cam05", "named after the views", missing] {
                assert!(message.contains(part), "{part} in: {message}");
            }
        }
    }

    #[test]
    fn tracks_of_a_whole_clip_are_not_given_by_order_to_some_views() {
        // cam03 has no tracks: by order it would be given those of cam00.
        let message = refusal(&["cam00.npz", "cam05.npz"]);
        assert!(message.contains("cam00.npz would be given to view 'cam03'"), "{message}");
        let message = refusal(&["cam00.npz", "cam01.npz", "cam05.npz"]);
        for part in ["'cam03'", "3 files (cam00.npz, cam01.npz, cam05.npz)", "2 views (cam03, cam05)"] {
            assert!(message.contains(part), "{part} in: {message}");
        }
        assert!(refusal(&["any.npz"]).contains("1 files (any.npz)"));
        assert!(refusal(&[]).contains("0 files"));
    }

    #[test]
    fn nested_folders_of_a_view_are_one_name() {
        let views = ["left/cam0", "right/cam0"];
        let files = ["right_cam0.npz", "left_cam0.npz"];
        assert_eq!(files_by_view(&files, &views, &views), Ok(vec![&files[1], &files[0]]));
        let message = files_by_view(&["right_cam0.npz", "any.npz"], &views, &views).unwrap_err().to_string();
        assert!(message.contains("right_cam0.npz would be given to view 'left/cam0'"), "{message}");
    }

    #[test]
    fn two_files_of_one_view_are_refused_by_their_paths() {
        let message = refusal(&["old/cam03.npz", "cam05.npz", "new/cam03.npz"]);
        for part in ["old/cam03.npz", "new/cam03.npz", "'cam03'", "give one"] {
            assert!(message.contains(part), "{part} in: {message}");
        }
    }
}
