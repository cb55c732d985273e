//! Where the files of a submission lie on this machine.

use std::path::PathBuf;

use tokio::sync::OwnedMutexGuard;
use tonic::Status;

use super::state_failed;
use crate::{
    hub::Hub,
    remote_clip::{self, ClipUrl, RemoteClipError, is_remote, without_secrets},
};

/// A clip on this machine.
pub(super) struct LocatedClip {
    pub(super) path: PathBuf,
    /// Where it was copied from; holds no credentials.
    pub(super) url: Option<String>,
    /// A copy does not change while this is held.
    _copying: Option<OwnedMutexGuard<()>>,
}

/// A clip by its path, or the copy of one in an object store. Dropped, it stops copying and keeps what it has.
pub(super) async fn locate_clip(hub: &Hub, clip: &str) -> Result<LocatedClip, Status> {
    if !is_remote(clip) {
        return Ok(LocatedClip { path: local_path("clip", clip)?, url: None, _copying: None });
    }
    let url = ClipUrl::parse(clip).map_err(refused)?;
    let copy = async {
        let guard = hub.copying(&url.digest()).lock_owned().await;
        let clips = hub.clip_folder();
        // Under the lock, under which jobs begin to use the copy.
        let user = hub.clip_user(&remote_clip::folder(&url, &clips)).await;
        let user = user.map_err(|error| state_failed(hub, error))?;
        let path = remote_clip::copy(&url, &hub.options.stores, &clips, user).await.map_err(refused)?;
        let name = url.to_string().trim_end_matches('/').to_owned();
        Ok(LocatedClip { path, url: Some(name), _copying: Some(guard) })
    };
    let copied = hub.shutdown.run_until_cancelled(copy).await;
    copied.unwrap_or_else(|| {
        Err(Status::unavailable(format!(
            "the coordinator shuts down while it copies the clip {url}; submit again when it is back: what was copied is \
             kept"
        )))
    })
}

fn refused(error: RemoteClipError) -> Status {
    let message = error.to_string();
    match error {
        RemoteClipError::Store { may_pass: true, .. }
        | RemoteClipError::Changed { .. }
        | RemoteClipError::Local { is_full: true, .. } => Status::unavailable(message),
        RemoteClipError::InUse { .. } | RemoteClipError::Local { .. } => Status::failed_precondition(message),
        _ => Status::invalid_argument(message),
    }
}

/// An absolute path from a path or a `file://` URL.
pub(super) fn local_path(what: &str, given: &str) -> Result<PathBuf, Status> {
    let wrong = |reason: &str| {
        Status::invalid_argument(format!(
            "{what} '{}' {reason}; give a path on the coordinator's machine or a file:// URL",
            if is_remote(given) { without_secrets(given) } else { given.to_owned() }
        ))
    };
    let path = match given.split_once("://") {
        _ if is_remote(given) => {
            return Err(wrong(
                "is not on the coordinator's machine; only the clip may lie in an object store",
            ));
        }
        Some((_, path)) => percent_decoded(path).ok_or_else(|| wrong("is no valid URL"))?,
        None => given.to_owned(),
    };
    if path.is_empty() {
        return Err(wrong("is empty"));
    }
    std::path::absolute(&path).map_err(|error| wrong(&error.to_string()))
}

/// `%20` and the like as the bytes they stand for.
fn percent_decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((&first, tail)) = rest.split_first() {
        rest = tail;
        if first != b'%' {
            bytes.push(first);
            continue;
        }
        let digits = tail.get(..2)?;
        bytes.push(u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?);
        rest = &tail[2..];
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::path::Path;

    use super::*;

    #[test]
    fn paths_and_file_urls_are_absolute_local_paths() {
        assert_eq!(local_path("clip", "file:///a%20b/c").unwrap(), Path::new("/a b/c"));
        assert_eq!(local_path("clip", "/a b/c").unwrap(), Path::new("/a b/c"));
        assert!(local_path("clip", "relative").unwrap().is_absolute());
        for wrong in ["", "s3://bucket/clip", "file:///a%2", "file:///a%zz", "file://"] {
            let status = local_path("clip", wrong).unwrap_err();
            assert_eq!(status.code(), tonic::Code::InvalidArgument, "{wrong}");
        }
    }

    #[test]
    fn what_is_not_local_is_refused_without_its_credentials() {
        for given in ["https://me:hunter2@host/static.ply", "https://host/static.ply?sig=hunter2"] {
            let status = local_path("static model", given).unwrap_err();
            assert!(status.message().contains("only the clip"), "{status}");
            assert!(
                status.message().contains("https://") && !status.message().contains("hunter2"),
                "{status}"
            );
        }
    }
}
