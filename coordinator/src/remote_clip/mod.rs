//! A clip in an object store is copied into the coordinator's state, and is a local clip from then on.
//!
//! ```text
//! clips/<digest of the URL>/manifest.jsonl   what was copied, so that it is not copied again
//!                          /partial/         what is being copied
//!                          /files/           the clip
//! ```

mod address;
mod error;
mod manifest;
mod object;
mod stores;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    path::{Component, Path, PathBuf},
};

use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;

pub(crate) use self::address::{ClipUrl, is_remote, without_secrets};
pub(crate) use self::error::RemoteClipError;
use self::manifest::{Manifest, Version};
pub use self::stores::StoreOptions;

/// Objects that are copied at once.
const CONCURRENT: usize = 8;
/// Log lines that a copy says how far it is by.
const REPORTS: u64 = 20;
/// More than any clip has: the listing of a whole bucket ends here, before it fills memory or disk.
const LIMITS: Limits = Limits { objects: 500_000, bytes: 4 << 40 };

/// How much is taken for one clip.
#[derive(Clone, Copy, Debug)]
struct Limits {
    objects: usize,
    bytes: u64,
}

/// An object of the clip.
struct Object {
    /// In the store.
    location: object_store::path::Path,
    /// Below the clip's folder.
    name: PathBuf,
    version: Version,
}

/// Where the copy of a clip is, or will be.
pub(crate) fn folder(url: &ClipUrl, clips: &Path) -> PathBuf {
    clips.join(url.digest()).join("files")
}

/// Copies a clip below `clips`, or what of it is new or has changed since it was copied last; files whose objects are
/// gone are removed. Returns the clip's folder. Broken off, it keeps the objects that it finished. While the job `user`
/// works on the copy, it is not made another clip.
pub(crate) async fn copy(
    url: &ClipUrl,
    options: &StoreOptions,
    clips: &Path,
    user: Option<String>,
) -> Result<PathBuf, RemoteClipError> {
    let store = stores::open(url, options).map_err(|error| stores::unopened(url, options, &error))?;
    let folder = clips.join(url.digest());
    Copying { store: store.as_ref(), url, options, folder, user, limits: LIMITS }.run().await
}

struct Copying<'a> {
    store: &'a dyn ObjectStore,
    url: &'a ClipUrl,
    options: &'a StoreOptions,
    folder: PathBuf,
    user: Option<String>,
    limits: Limits,
}

/// The folder of what is being copied; gone with it.
struct Partial(PathBuf);

impl Partial {
    fn create(folder: PathBuf) -> io::Result<Self> {
        if folder.exists() {
            std::fs::remove_dir_all(&folder)?;
        }
        std::fs::create_dir(&folder)?;
        Ok(Self(folder))
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        // What cannot be removed now is removed by the next copy, or fails it.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

impl Copying<'_> {
    async fn run(&self) -> Result<PathBuf, RemoteClipError> {
        let objects = self.list().await?;
        let (files, manifest) = (self.folder.join("files"), self.folder.join("manifest.jsonl"));
        let unwritable = |source| RemoteClipError::unwritable(self.url, &self.folder, source);
        if let Some(job) = &self.user
            && differs(&manifest::read(&manifest).map_err(unwritable)?, &objects)
        {
            return Err(RemoteClipError::InUse { url: self.url.to_string(), job: job.clone() });
        }
        let names: BTreeSet<&Path> = objects.iter().map(|object| object.name.as_path()).collect();
        let prepare = || -> io::Result<(Partial, Manifest)> {
            std::fs::create_dir_all(&files)?;
            remove_others(&files, Path::new(""), &names)?;
            let partial = Partial::create(self.folder.join("partial"))?;
            Ok((partial, Manifest::open(&manifest, |name| names.contains(name))?))
        };
        let (partial, mut manifest) = prepare().map_err(unwritable)?;
        let is_copied = |object: &Object| {
            manifest.version(&object.name) == Some(&object.version)
                && std::fs::metadata(files.join(&object.name))
                    .is_ok_and(|file| file.is_file() && file.len() == object.version.size)
        };
        let (present, missing): (Vec<_>, Vec<_>) = objects.into_iter().partition(is_copied);
        let (url, bytes) = (self.url, bytes_of(&missing));
        tracing::info!(%url, objects = missing.len(), bytes, present = present.len(), "copying the clip");
        self.copy_objects(missing, &files, &partial.0, &mut manifest).await?;
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
            recorded.map_err(|source| RemoteClipError::unwritable(self.url, &self.folder, source))?;
            let before = done;
            done = object.version.size.saturating_add(done);
            if report_number(before, total) != report_number(done, total) {
                tracing::info!(url = %self.url, bytes = done, of = total, "copying the clip");
            }
        }
        Ok(())
    }

    /// Every object of the clip, in order; empty ones that only stand for a folder are left out.
    async fn list(&self) -> Result<Vec<Object>, RemoteClipError> {
        let mut listed = self.store.list(Some(self.url.prefix()));
        let mut objects = BTreeMap::new();
        while let Some(meta) = listed.try_next().await.map_err(|error| self.refused(&error))? {
            if objects.len() == self.limits.objects {
                return Err(self.too_large(format!("{} objects", self.limits.objects)));
            }
            // A console's "folder" is an empty object; that of the clip itself has no name below it.
            if meta.location == *self.url.prefix() {
                continue;
            }
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
        let objects: Vec<Object> = objects.into_values().collect();
        if bytes_of(&objects) > self.limits.bytes {
            return Err(self.too_large(format!("{} bytes", self.limits.bytes)));
        }
        Ok(objects)
    }

    fn refused(&self, error: &object_store::Error) -> RemoteClipError {
        stores::refused(self.url, self.options, error)
    }

    fn misnamed(&self, name: &str, reason: &'static str) -> RemoteClipError {
        RemoteClipError::Name { url: self.url.to_string(), name: name.to_owned(), reason }
    }

    fn too_large(&self, limit: String) -> RemoteClipError {
        RemoteClipError::TooLarge { url: self.url.to_string(), limit }
    }
}

fn bytes_of(objects: &[Object]) -> u64 {
    objects.iter().fold(0, |sum, object| object.version.size.saturating_add(sum))
}

/// Whether the objects are others than those that were copied.
fn differs(copied: &BTreeMap<PathBuf, Version>, objects: &[Object]) -> bool {
    copied.len() != objects.len()
        || objects.iter().any(|object| copied.get(&object.name) != Some(&object.version))
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
