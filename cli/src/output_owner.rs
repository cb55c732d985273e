//! Whose results an output folder holds, looked at before anything in it is touched.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use splat::clip::ClipOptions;
use trackersplat_coordinator::assembly::{holds_results, sequence::Sequence};
use trackersplat_proto::v1::SubmitRequest;

use crate::{embedded::STATE_FOLDER, error::CliError, scratch};

/// File that the coordinator marks an output folder with.
const MARKER: &str = "trackersplat.json";

/// The clip whose results a folder holds.
#[derive(Debug, Deserialize)]
struct Owner {
    clip: String,
    clip_digest: String,
}

/// Refuses a folder with the results of another clip than the submission's. Touches nothing.
///
/// The coordinator refuses it too, but only once it serves, and by then it goes on with the folder's unfinished job. A
/// run whose state is in the folder without results there may give way: that is the coordinator's to decide.
pub(crate) fn check(output: &Path, request: &SubmitRequest) -> Result<(), CliError> {
    let Some(owner) = owner(output) else { return Ok(()) };
    let Some(clip) = local_path(&request.clip) else { return Ok(()) };
    let digest = digest(&clip, request)?;
    let may_give_way = output.join(STATE_FOLDER).is_dir() && !holds_results(output);
    if digest == owner.clip_digest || may_give_way {
        return Ok(());
    }
    Err(CliError::bad_input(
        output.display(),
        format!(
            "the folder holds the results of another clip: {} (digest {}), not {} (digest {digest}), or of other \
             frames or views of it; give another --out, or remove the folder",
            owner.clip,
            owner.clip_digest,
            clip.display()
        ),
    ))
}

/// From the marker, else from the finished description. A marker that cannot be read is the coordinator's to refuse.
fn owner(output: &Path) -> Option<Owner> {
    if let Ok(bytes) = std::fs::read(output.join(MARKER)) {
        return serde_json::from_slice(&bytes).ok();
    }
    let clip = Sequence::read(output).ok()?.clip;
    let name = clip.url.unwrap_or_else(|| clip.path.display().to_string());
    Some(Owner { clip: name, clip_digest: clip.digest })
}

/// `None` for a URL that needs decoding; the coordinator reads those.
fn local_path(clip: &str) -> Option<PathBuf> {
    match clip.split_once("://") {
        None => Some(clip.into()),
        Some(("file", path)) if !path.contains('%') => Some(path.into()),
        Some(_) => None,
    }
}

fn digest(clip: &Path, request: &SubmitRequest) -> Result<String, CliError> {
    let options = ClipOptions {
        test_views: request.test_views.clone(),
        frames: (request.first_frame != 0 || request.last_frame != 0)
            .then_some((request.first_frame, request.last_frame)),
        ..ClipOptions::default()
    };
    let opened = scratch::open(clip, &options, None);
    opened.and_then(|opened| opened.clip.digest()).map_err(|error| CliError::BadInput(error.to_string()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn request(clip: &Path) -> SubmitRequest {
        SubmitRequest { clip: clip.display().to_string(), ..SubmitRequest::default() }
    }

    #[test]
    fn only_a_folder_of_another_clip_is_refused() {
        let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/demo-clip");
        let output = tempfile::tempdir().unwrap();
        let request = request(&clip);
        check(&output.path().join("new"), &request).unwrap();
        check(output.path(), &request).unwrap();

        let mark = |digest: &str| {
            let marker = serde_json::json!({ "clip": "/clips/theirs", "clip_digest": digest });
            std::fs::write(output.path().join(MARKER), marker.to_string()).unwrap();
        };
        mark(&digest(&clip, &request).unwrap());
        check(output.path(), &request).unwrap();
        mark("0123");
        let error = check(output.path(), &request).unwrap_err();
        assert_eq!(error.exit_code(), 3);
        for part in ["another clip", "/clips/theirs", "demo-clip", "--out"] {
            assert!(error.to_string().contains(part), "{error}");
        }
        assert_eq!(std::fs::read_dir(output.path()).unwrap().count(), 1, "nothing is created");

        std::fs::create_dir(output.path().join(STATE_FOLDER)).unwrap();
        check(output.path(), &request).unwrap();
        std::fs::write(output.path().join("static.ply"), "").unwrap();
        check(output.path(), &request).unwrap();
        std::fs::create_dir(output.path().join("frames")).unwrap();
        std::fs::write(output.path().join("frames/frame_0001.ply"), "").unwrap();
        check(output.path(), &request).unwrap_err();
    }

    #[test]
    fn plain_urls_are_paths_and_others_the_coordinators() {
        assert_eq!(local_path("/clip"), Some("/clip".into()));
        assert_eq!(local_path("file:///clip"), Some("/clip".into()));
        assert_eq!(local_path("file:///my%20clip"), None);
        assert_eq!(local_path("https://host/clip"), None);
    }
}
