//! Why a clip could not be copied, and what helps.

use std::{
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

use thiserror::Error;

use super::ClipUrl;

/// Why a clip could not be copied from an object store. Holds no credentials.
#[derive(Debug, Error)]
pub(crate) enum RemoteClipError {
    /// The URL cannot be used.
    #[error("clip '{url}' {reason}; {remedy}")]
    Address { url: String, reason: String, remedy: &'static str },
    /// The store refuses, or cannot be reached.
    #[error("clip {url}: {cause}; {remedy}")]
    Store {
        url: String,
        cause: String,
        remedy: &'static str,
        /// Whether the same submission may succeed later.
        may_pass: bool,
    },
    /// There is nothing.
    #[error(
        "clip {url}: there is no object under this prefix; check bucket and prefix, which is the folder that holds the \
         clip's files"
    )]
    Empty { url: String },
    /// There is more than any clip has.
    #[error("clip {url}: there are more than {limit} under this prefix; give the prefix of one clip")]
    TooLarge { url: String, limit: String },
    /// A file of the copy cannot have the object's name.
    #[error("clip {url}: the object {name:?} {reason}; rename or remove it")]
    Name { url: String, name: String, reason: &'static str },
    /// The object is not what the store had listed.
    #[error("clip {url}: the object {name:?} {reason}; submit again when nobody writes to the clip")]
    Changed { url: String, name: String, reason: String },
    /// The copy must stay as it is.
    #[error(
        "clip {url}: its objects have changed, and job {job} still works on the former ones; wait until that job has ended, \
         or cancel it, then submit again"
    )]
    InUse { url: String, job: String },
    /// The copy cannot be written.
    #[error("clip {url}: cannot write its copy {path}: {source}; {}", .is_full.then_some(MAKE_ROOM).unwrap_or(MAKE_WRITABLE))]
    Local {
        url: String,
        path: PathBuf,
        source: io::Error,
        /// Whether there is no room: another submission may find some.
        is_full: bool,
    },
}

const MAKE_ROOM: &str =
    "make room on the disk of the coordinator's folder, then submit again: what was copied is kept";
const MAKE_WRITABLE: &str = "see to it that the coordinator can write below its folder, then submit again";

impl RemoteClipError {
    pub(super) fn unwritable(url: &ClipUrl, path: &Path, source: io::Error) -> Self {
        let is_full = matches!(source.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded);
        Self::Local { url: url.to_string(), path: path.to_owned(), source, is_full }
    }
}
