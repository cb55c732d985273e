//! What of a clip was copied already: one JSON line per object, the last line of a name counts.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

/// What tells one version of an object from another, as the store lists it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Version {
    /// Bytes.
    pub(super) size: u64,
    pub(super) e_tag: Option<String>,
    /// RFC 3339.
    pub(super) modified: String,
}

#[derive(Serialize, Deserialize)]
struct Line {
    name: PathBuf,
    #[serde(flatten)]
    version: Version,
}

/// The manifest of a copy. A copy that is broken off keeps what it recorded.
pub(super) struct Manifest {
    file: File,
    versions: BTreeMap<PathBuf, Version>,
}

impl Manifest {
    /// Opens the manifest, forgets the names that are not `wanted`, and writes it anew without them.
    pub(super) fn open(path: &Path, wanted: impl Fn(&Path) -> bool) -> io::Result<Self> {
        let mut versions = read(path)?;
        versions.retain(|name, _| wanted(name));
        let temporary = path.with_extension("partial");
        let mut file = File::create(&temporary)?;
        for (name, version) in &versions {
            write_line(&mut file, name, version)?;
        }
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        Ok(Self { file: OpenOptions::new().append(true).open(path)?, versions })
    }

    /// The version of an object that was copied.
    pub(super) fn version(&self, name: &Path) -> Option<&Version> {
        self.versions.get(name)
    }

    /// An object was copied.
    pub(super) fn record(&mut self, name: &Path, version: &Version) -> io::Result<()> {
        write_line(&mut self.file, name, version)
    }
}

/// The objects that were copied; none if there is no manifest.
pub(super) fn read(path: &Path) -> io::Result<BTreeMap<PathBuf, Version>> {
    let text = match std::fs::read(path) {
        Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
        Err(error) => return Err(error),
    };
    // A line that a killed coordinator wrote by half is none: its object is copied again.
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Line>(line).ok());
    Ok(lines.map(|line| (line.name, line.version)).collect())
}

/// In one write, so that lines are not torn but by a crash.
fn write_line(file: &mut File, name: &Path, version: &Version) -> io::Result<()> {
    let mut line = serde_json::to_vec(&Line { name: name.to_owned(), version: version.clone() })?;
    line.push(b'\n');
    file.write_all(&line)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn what_was_recorded_is_known_after_a_crash_and_torn_lines_are_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("manifest.jsonl");
        let version =
            |size| Version { size, e_tag: Some("\"x\"".into()), modified: "2026-01-01T00:00:00Z".into() };
        let mut manifest = Manifest::open(&path, |_| true).unwrap();
        for (name, size) in [("a", 1), ("b/c", 2), ("a", 3), ("gone", 4)] {
            manifest.record(Path::new(name), &version(size)).unwrap();
        }
        drop(manifest);
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"{\"name\":\"torn\",\"si").unwrap();
        for _ in 0..2 {
            let manifest = Manifest::open(&path, |name| name != Path::new("gone")).unwrap();
            assert_eq!(manifest.version(Path::new("a")), Some(&version(3)));
            assert_eq!(manifest.version(Path::new("b/c")), Some(&version(2)));
            assert_eq!(manifest.version(Path::new("gone")), None);
            assert_eq!(manifest.version(Path::new("torn")), None);
        }
    }
}
