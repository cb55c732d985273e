//! A clip in an object store is copied into the coordinator's state, and is a local clip from then on.
//!
//! ```text
//! clips/<digest of the URL>/manifest.jsonl   what was copied, so that it is not copied again
//!                          /partial/         what is being copied
//!                          /files/           the clip
//! ```

mod address;
mod manifest;
mod stores;

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    path::{Component, Path, PathBuf},
};

use futures::{StreamExt, TryStreamExt, stream};
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt};
use thiserror::Error;
use tokio::io::AsyncWriteExt;

pub(crate) use self::address::{ClipUrl, is_remote, without_secrets};
use self::manifest::{Manifest, Version};
pub use self::stores::StoreOptions;

/// Objects that are copied at once.
const CONCURRENT: usize = 8;
/// Log lines that a copy says how far it is by.
const REPORTS: u64 = 20;

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
    /// A file of the copy cannot have the object's name.
    #[error("clip {url}: the object {name:?} {reason}; rename or remove it")]
    Name { url: String, name: String, reason: &'static str },
    /// The object is not what the store had listed.
    #[error("clip {url}: the object {name:?} {reason}; submit again when nobody writes to the clip")]
    Changed { url: String, name: String, reason: String },
    /// The copy cannot be written.
    #[error(
        "clip {url}: cannot write its copy {path}: {source}; make room on the disk of the coordinator's folder, then \
         submit again"
    )]
    Local { url: String, path: PathBuf, source: io::Error },
}

/// An object of the clip.
struct Object {
    /// In the store.
    location: object_store::path::Path,
    /// Below the clip's folder.
    name: PathBuf,
    version: Version,
}

/// Copies a clip below `clips`, or what of it is new or has changed since it was copied last; files whose objects are
/// gone are removed. Returns the clip's folder. Broken off, it keeps the objects that it finished.
pub(crate) async fn copy(
    url: &ClipUrl,
    options: &StoreOptions,
    clips: &Path,
) -> Result<PathBuf, RemoteClipError> {
    let store = stores::open(url, options).map_err(|error| stores::refused(url, options, &error))?;
    Copying { store: store.as_ref(), url, options, folder: clips.join(url.digest()) }.run().await
}

struct Copying<'a> {
    store: &'a dyn ObjectStore,
    url: &'a ClipUrl,
    options: &'a StoreOptions,
    folder: PathBuf,
}

impl Copying<'_> {
    async fn run(&self) -> Result<PathBuf, RemoteClipError> {
        let objects = self.list().await?;
        let (files, partial) = (self.folder.join("files"), self.folder.join("partial"));
        let names: BTreeSet<&Path> = objects.iter().map(|object| object.name.as_path()).collect();
        let prepare = || -> io::Result<Manifest> {
            std::fs::create_dir_all(&files)?;
            remove_others(&files, Path::new(""), &names)?;
            if partial.exists() {
                std::fs::remove_dir_all(&partial)?;
            }
            std::fs::create_dir(&partial)?;
            Manifest::open(&self.folder.join("manifest.jsonl"), |name| names.contains(name))
        };
        let mut manifest = prepare().map_err(|source| self.unwritable(&self.folder, source))?;
        let is_copied = |object: &Object| {
            manifest.version(&object.name) == Some(&object.version)
                && std::fs::metadata(files.join(&object.name))
                    .is_ok_and(|file| file.is_file() && file.len() == object.version.size)
        };
        let (present, missing): (Vec<_>, Vec<_>) = objects.into_iter().partition(is_copied);
        let (url, bytes) = (self.url, bytes_of(&missing));
        tracing::info!(%url, objects = missing.len(), bytes, present = present.len(), "copying the clip");
        self.copy_objects(missing, &files, &partial, &mut manifest).await?;
        tracing::info!(%url, folder = %files.display(), "the clip is copied");
        Ok(files)
    }

    async fn copy_objects(
        &self,
        objects: Vec<Object>,
        files: &Path,
        partial: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), RemoteClipError> {
        let (mut done, total) = (0, bytes_of(&objects));
        let copies = objects.into_iter().enumerate().map(|(index, object)| {
            let (partial, target) = (partial.join(index.to_string()), files.join(&object.name));
            async move { self.copy_object(&object, &partial, &target).await.map(|()| object) }
        });
        let mut copies = stream::iter(copies).buffer_unordered(CONCURRENT);
        while let Some(object) = copies.try_next().await? {
            let recorded = manifest.record(&object.name, &object.version);
            recorded.map_err(|source| self.unwritable(&self.folder, source))?;
            let before = done;
            done += object.version.size;
            if report_number(before, total) != report_number(done, total) {
                tracing::info!(url = %self.url, bytes = done, of = total, "copying the clip");
            }
        }
        Ok(())
    }

    /// Every object of the clip, in order; empty ones that only stand for a folder are left out.
    async fn list(&self) -> Result<Vec<Object>, RemoteClipError> {
        let listed: Vec<ObjectMeta> = self
            .store
            .list(Some(self.url.prefix()))
            .try_collect()
            .await
            .map_err(|error| self.refused(&error))?;
        let mut objects = BTreeMap::new();
        // A console's "folder" is an empty object; that of the clip itself has no name below it.
        for meta in listed.into_iter().filter(|meta| meta.location != *self.url.prefix()) {
            let named = local_name(self.url.prefix().as_ref(), meta.location.as_ref());
            let name = named.map_err(|reason| self.misnamed(meta.location.as_ref(), reason))?;
            let version =
                Version { size: meta.size, e_tag: meta.e_tag, modified: meta.last_modified.to_rfc3339() };
            objects.insert(name.clone(), Object { location: meta.location, name, version });
        }
        let folders: BTreeSet<PathBuf> =
            objects.keys().flat_map(|name| name.ancestors().skip(1)).map(Path::to_owned).collect();
        objects.retain(|name, object| object.version.size > 0 || !folders.contains(name));
        if let Some((_, twin)) = objects.iter().find(|(name, _)| folders.contains(*name)) {
            return Err(self.misnamed(twin.location.as_ref(), "is an object and a folder at once"));
        }
        if objects.is_empty() {
            return Err(RemoteClipError::Empty { url: self.url.to_string() });
        }
        Ok(objects.into_values().collect())
    }

    async fn copy_object(
        &self,
        object: &Object,
        partial: &Path,
        target: &Path,
    ) -> Result<(), RemoteClipError> {
        let changed = |reason: String| RemoteClipError::Changed {
            url: self.url.to_string(),
            name: object.location.to_string(),
            reason,
        };
        let got = self.store.get(&object.location).await.map_err(|error| match error {
            object_store::Error::NotFound { .. } => changed("was removed while the clip was copied".into()),
            error => self.refused(&error),
        })?;
        let unwritable = |source| self.unwritable(target, source);
        let mut file = tokio::fs::File::create(partial).await.map_err(unwritable)?;
        let mut chunks = got.into_stream();
        let mut written = 0;
        while let Some(chunk) = chunks.try_next().await.map_err(|error| self.refused(&error))? {
            file.write_all(&chunk).await.map_err(unwritable)?;
            written += chunk.len() as u64;
        }
        if written != object.version.size {
            let listed = object.version.size;
            return Err(changed(format!("has {written} bytes, but was listed with {listed}")));
        }
        // Before the rename, so that a power cut leaves the old file or the new one, never an empty one.
        file.sync_all().await.map_err(unwritable)?;
        if let Some(folder) = target.parent() {
            tokio::fs::create_dir_all(folder).await.map_err(unwritable)?;
        }
        tokio::fs::rename(partial, target).await.map_err(unwritable)
    }

    fn refused(&self, error: &object_store::Error) -> RemoteClipError {
        stores::refused(self.url, self.options, error)
    }

    fn misnamed(&self, name: &str, reason: &'static str) -> RemoteClipError {
        RemoteClipError::Name { url: self.url.to_string(), name: name.to_owned(), reason }
    }

    fn unwritable(&self, path: &Path, source: io::Error) -> RemoteClipError {
        RemoteClipError::Local { url: self.url.to_string(), path: path.to_owned(), source }
    }
}

fn bytes_of(objects: &[Object]) -> u64 {
    objects.iter().map(|object| object.version.size).sum()
}

/// Which of the reports is due after `done` bytes of `total`.
fn report_number(done: u64, total: u64) -> u64 {
    (u128::from(done) * u128::from(REPORTS)).checked_div(u128::from(total)).map_or(0, |number| number as u64)
}

/// The path of an object below the clip's folder. Never leads out of it, whatever the store says.
fn local_name(prefix: &str, location: &str) -> Result<PathBuf, &'static str> {
    let outside = "is not under the clip's prefix";
    let relative = location.strip_prefix(prefix).ok_or(outside)?;
    let relative = if prefix.is_empty() { relative } else { relative.strip_prefix('/').ok_or(outside)? };
    let mut name = PathBuf::new();
    for part in relative.split('/') {
        let mut components = Path::new(part).components();
        let is_plain = matches!((components.next(), components.next()), (Some(Component::Normal(only)), None) if only == part);
        // Backslashes part folders elsewhere, and control characters are nobody's file name.
        if !is_plain || part.contains('\\') || part.contains(char::is_control) {
            return Err("has a name that cannot be a file's below the clip's folder");
        }
        name.push(part);
    }
    Ok(name)
}

/// Removes the files that are not among `names`, and folders without files. Returns whether `folder` is empty now.
fn remove_others(root: &Path, folder: &Path, names: &BTreeSet<&Path>) -> io::Result<bool> {
    let mut is_empty = true;
    for entry in std::fs::read_dir(root.join(folder))? {
        let entry = entry?;
        let name = folder.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            if remove_others(root, &name, names)? {
                std::fs::remove_dir(entry.path())?;
            } else {
                is_empty = false;
            }
        } else if names.contains(name.as_path()) {
            is_empty = false;
        } else {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(is_empty)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use object_store::{PutPayload, memory::InMemory};

    use super::*;

    struct Bench {
        store: InMemory,
        folder: tempfile::TempDir,
    }

    impl Bench {
        fn new() -> Self {
            Self { store: InMemory::new(), folder: tempfile::tempdir().unwrap() }
        }

        async fn put(&self, name: &str, bytes: &'static [u8]) {
            self.store.put(&name.into(), PutPayload::from_static(bytes)).await.unwrap();
        }

        async fn copy(&self) -> Result<PathBuf, RemoteClipError> {
            let url = ClipUrl::parse("s3://bucket/a/clip").unwrap();
            let options = StoreOptions::default();
            let folder = self.folder.path().to_owned();
            Copying { store: &self.store, url: &url, options: &options, folder }.run().await
        }

        fn files(&self) -> Vec<(String, Vec<u8>)> {
            let root = self.folder.path().join("files");
            let listed = crate::output::list_files(&root, &[]).unwrap();
            listed
                .iter()
                .map(|name| (name.display().to_string(), std::fs::read(root.join(name)).unwrap()))
                .collect()
        }
    }

    #[tokio::test]
    async fn a_copy_follows_the_objects() {
        let bench = Bench::new();
        bench.put("a/clip/images/cam00/1.png", b"one").await;
        bench.put("a/clip/images/cam01/1.png", b"two").await;
        bench.put("a/clip/images", b"").await;
        bench.put("a/clip2/other", b"not ours").await;
        let files = bench.copy().await.unwrap();
        assert_eq!(files, bench.folder.path().join("files"));
        let expected = |names: &[(&str, &[u8])]| {
            names.iter().map(|(name, bytes)| ((*name).to_owned(), bytes.to_vec())).collect::<Vec<_>>()
        };
        assert_eq!(
            bench.files(),
            expected(&[("images/cam00/1.png", b"one"), ("images/cam01/1.png", b"two")])
        );

        // An untouched object is not read again: what stands in its place here stays.
        std::fs::write(files.join("images/cam00/1.png"), b"ONE").unwrap();
        bench.put("a/clip/images/cam02/1.png", b"three").await;
        bench.store.delete(&"a/clip/images/cam01/1.png".into()).await.unwrap();
        bench.copy().await.unwrap();
        assert_eq!(
            bench.files(),
            expected(&[("images/cam00/1.png", b"ONE"), ("images/cam02/1.png", b"three")])
        );
        assert!(!files.join("images/cam01").exists(), "an empty folder would be a camera without images");

        // A changed object is copied again, and so is a file that is gone.
        bench.put("a/clip/images/cam00/1.png", b"two").await;
        std::fs::remove_file(files.join("images/cam02/1.png")).unwrap();
        bench.copy().await.unwrap();
        assert_eq!(
            bench.files(),
            expected(&[("images/cam00/1.png", b"two"), ("images/cam02/1.png", b"three")])
        );
    }

    #[tokio::test]
    async fn nothing_under_the_prefix_and_an_object_that_is_a_folder_are_errors() {
        let bench = Bench::new();
        bench.put("a/clip2/other", b"not ours").await;
        let error = bench.copy().await.unwrap_err().to_string();
        assert!(error.contains("s3://bucket/a/clip") && error.contains("prefix"), "{error}");
        bench.put("a/clip/x", b"file").await;
        bench.put("a/clip/x/y", b"file").await;
        let error = bench.copy().await.unwrap_err().to_string();
        assert!(error.contains("a/clip/x") && error.contains("folder"), "{error}");
        assert!(!bench.folder.path().join("files").exists(), "nothing is touched before the names are known");
    }

    #[test]
    fn no_object_leaves_the_folder() {
        assert_eq!(local_name("a/clip", "a/clip/images/1.png"), Ok("images/1.png".into()));
        assert_eq!(local_name("", "images/..png"), Ok("images/..png".into()));
        for location in [
            "a/clip/../x",
            "a/clip/x/../../../y",
            "a/clip/./x",
            "a/clip//etc/passwd",
            "a/clip/",
            "a/clip/x/",
            "a/clip",
            "a/clip2/x",
            "../a/clip/x",
            "a/clip/..\\x",
            "a/clip/x\0",
            "a/clip/x\n",
        ] {
            assert!(local_name("a/clip", location).is_err(), "{location:?}");
        }
        for location in ["/etc/passwd", "..", ""] {
            assert!(local_name("", location).is_err(), "{location:?}");
        }
    }

    #[test]
    fn reports_are_few() {
        let due = (0..=1000).map(|done| report_number(done, 1000)).collect::<BTreeSet<_>>();
        assert_eq!(due.len() as u64, REPORTS + 1);
        assert_eq!(report_number(0, 0), 0);
        assert_eq!(report_number(u64::MAX, u64::MAX), REPORTS);
    }
}
