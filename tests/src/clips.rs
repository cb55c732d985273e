//! Copies of the bundled clip that a test may damage.

use std::path::Path;

use image::imageops::FilterType;
use tempfile::TempDir;

/// Copies the bundled clip's first `frames` frames of its first `views` training views and one test view to `target`.
///
/// # Panics
/// If the file system refuses.
pub fn copy(target: &Path, frames: u32, views: usize) {
    let source = crate::program::demo_clip();
    let cameras: Vec<String> =
        (0..views).map(|view| format!("cam{view:02}")).chain(["test00".to_owned()]).collect();
    std::fs::create_dir_all(target.join("transforms")).expect("a scratch folder");
    for frame in 1..=frames {
        let name = format!("transforms/frame_{frame:04}.json");
        let text = std::fs::read_to_string(source.join(&name)).expect("the bundled clip");
        let mut document: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let entries = document["frames"].as_array_mut().expect("a list of frames");
        entries.retain(|entry| cameras.iter().any(|camera| entry["camera"] == camera.as_str()));
        std::fs::write(target.join(&name), document.to_string()).expect("a scratch file");
        for camera in &cameras {
            for file in [
                format!("images/{camera}/frame_{frame:04}.webp"),
                format!("masks/{camera}/frame_{frame:04}.png"),
            ] {
                copy_file(&source, target, &file);
            }
        }
    }
    for camera in cameras.iter().filter(|camera| camera.starts_with("cam")) {
        copy_file(&source, target, &format!("flow/{camera}.npz"));
    }
    copy_file(&source, target, "points3D.ply");
}

/// [`copy`] into a folder of its own, which lives as long as the result.
///
/// # Panics
/// If the file system refuses.
pub fn scratch(frames: u32, views: usize) -> TempDir {
    let folder = tempfile::tempdir().expect("a scratch folder");
    copy(folder.path(), frames, views);
    folder
}

/// [`scratch`] at half the width and height, without exact flow.
///
/// # Panics
/// If the file system refuses.
pub fn halved(frames: u32, views: usize) -> TempDir {
    let folder = scratch(frames, views);
    for frame in 1..=frames {
        let path = folder.path().join(format!("transforms/frame_{frame:04}.json"));
        let text = std::fs::read_to_string(&path).expect("a scratch file");
        let mut document: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        halve(&mut document);
        let entries = document["frames"].as_array_mut().expect("a list of frames");
        for entry in entries {
            halve(entry);
            let camera = entry["camera"].as_str().expect("a name");
            // A mask is one value per pixel: nothing between them.
            halve_file(
                folder.path(),
                &format!("images/{camera}/frame_{frame:04}.webp"),
                FilterType::Triangle,
            );
            halve_file(folder.path(), &format!("masks/{camera}/frame_{frame:04}.png"), FilterType::Nearest);
        }
        std::fs::write(&path, document.to_string()).expect("a scratch file");
    }
    std::fs::remove_dir_all(folder.path().join("flow")).expect("a scratch folder");
    folder
}

fn halve(place: &mut serde_json::Value) {
    for key in ["fl_x", "fl_y", "cx", "cy"] {
        if let Some(value) = place[key].as_f64() {
            place[key] = (value / 2.0).into();
        }
    }
    for key in ["w", "h"] {
        if let Some(value) = place[key].as_u64() {
            place[key] = (value / 2).into();
        }
    }
}

fn halve_file(folder: &Path, name: &str, filter: FilterType) {
    let path = folder.join(name);
    let image = image::open(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
    let (width, height) = (image.width() / 2, image.height() / 2);
    image.resize_exact(width, height, filter).save(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
}

fn copy_file(source: &Path, target: &Path, name: &str) {
    let to = target.join(name);
    std::fs::create_dir_all(to.parent().expect("a file has a folder")).expect("a scratch folder");
    std::fs::copy(source.join(name), &to).unwrap_or_else(|error| panic!("{name}: {error}"));
}
