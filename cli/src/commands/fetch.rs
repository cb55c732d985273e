//! `fetch`: copies a job's results here, verified.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Component, Path, PathBuf},
};

use clap::Args;
use trackersplat_proto::v1::{FetchChunk, FetchRequest};

use crate::{args::CoordinatorArgs, client, error::CliError, stdout};

/// Arguments of `fetch`.
#[derive(Args, Debug)]
pub(crate) struct FetchArgs {
    /// The job, as `submit` or `list` print it.
    job: String,

    /// Files to fetch, relative to the job's output folder [default: all].
    paths: Vec<String>,

    /// Folder to put them in.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,

    #[command(flatten)]
    coordinator: CoordinatorArgs,
}

pub(super) async fn run(args: FetchArgs) -> Result<(), CliError> {
    let mut client = client::connect(&args.coordinator.coordinator).await?;
    let request = FetchRequest { job_id: args.job, paths: args.paths };
    let mut chunks = client.fetch(request).await?.into_inner();
    let mut download = Download::into(&args.out);
    while let Some(chunk) = chunks.message().await? {
        download.take(chunk)?;
    }
    let files = download.finish()?;
    stdout::line(format_args!("{} files in {}", files, args.out.display()));
    Ok(())
}

/// Files from a stream of chunks: each is complete and verified, or absent.
struct Download<'a> {
    folder: &'a Path,
    current: Option<Partial>,
    finished: usize,
}

/// The file whose chunks arrive.
struct Partial {
    name: String,
    path: PathBuf,
    temporary: PathBuf,
    file: File,
    hasher: blake3::Hasher,
    size: u64,
    digest: String,
}

impl<'a> Download<'a> {
    fn into(folder: &'a Path) -> Self {
        Self { folder, current: None, finished: 0 }
    }

    fn take(&mut self, chunk: FetchChunk) -> Result<(), CliError> {
        let continues = self.current.as_ref().is_some_and(|current| current.name == chunk.path);
        if !continues {
            self.complete()?;
            self.current = Some(Partial::begin(self.folder, &chunk)?);
        }
        let Some(current) = &mut self.current else { return Ok(()) };
        current.hasher.update(&chunk.data);
        current
            .file
            .write_all(&chunk.data)
            .map_err(|error| CliError::bad_input(current.path.display(), error))
    }

    /// Number of files, once the stream has ended.
    fn finish(mut self) -> Result<usize, CliError> {
        self.complete()?;
        Ok(self.finished)
    }

    fn complete(&mut self) -> Result<(), CliError> {
        let Some(current) = self.current.take() else { return Ok(()) };
        current.complete()?;
        self.finished += 1;
        Ok(())
    }
}

impl Partial {
    fn begin(folder: &Path, first: &FetchChunk) -> Result<Self, CliError> {
        let path = folder.join(inside(&first.path)?);
        let mut temporary = path.clone().into_os_string();
        temporary.push(".partial");
        let temporary = PathBuf::from(temporary);
        let file = create(&temporary).map_err(|error| CliError::bad_input(path.display(), error))?;
        Ok(Self {
            name: first.path.clone(),
            path,
            temporary,
            file,
            hasher: blake3::Hasher::new(),
            size: first.size,
            digest: first.digest.clone(),
        })
    }

    fn complete(self) -> Result<(), CliError> {
        let (size, digest) = (self.hasher.count(), self.hasher.finalize().to_hex().to_string());
        if size != self.size || digest != self.digest {
            // What is wrong is removed if possible, and never gets its name.
            let _ = fs::remove_file(&self.temporary);
            let why = format!(
                "{size} bytes of digest {digest} arrived, {} of {} were announced",
                self.size, self.digest
            );
            return Err(CliError::failed(&self.name, format!("{why}; fetch again")));
        }
        let renamed = self.file.sync_all().and_then(|()| fs::rename(&self.temporary, &self.path));
        renamed.map_err(|error| CliError::bad_input(self.path.display(), error))
    }
}

fn create(path: &Path) -> io::Result<File> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    File::create(path)
}

/// A path that stays inside the folder it is joined to.
fn inside(path: &str) -> Result<&Path, CliError> {
    let relative = Path::new(path);
    let is_inside = relative.components().all(|component| matches!(component, Component::Normal(_)));
    if path.is_empty() || !is_inside {
        return Err(CliError::failed(
            format!("file '{path}'"),
            "the coordinator names a place outside of the folder",
        ));
    }
    Ok(relative)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn chunks(path: &str, bytes: &[u8]) -> Vec<FetchChunk> {
        let digest = blake3::hash(bytes).to_hex().to_string();
        let half = bytes.len() / 2;
        let first =
            FetchChunk { path: path.into(), size: bytes.len() as u64, digest, data: bytes[..half].to_vec() };
        let second = FetchChunk { path: path.into(), data: bytes[half..].to_vec(), ..FetchChunk::default() };
        vec![first, second]
    }

    fn receive(folder: &Path, chunks: Vec<FetchChunk>) -> Result<usize, CliError> {
        let mut download = Download::into(folder);
        chunks.into_iter().try_for_each(|chunk| download.take(chunk))?;
        download.finish()
    }

    #[test]
    fn files_arrive_whole_and_in_their_folders() {
        let folder = tempfile::tempdir().unwrap();
        let both = [chunks("sequence.json", b"{}"), chunks("frames/frame_0001.ply", b"ply...")].concat();
        assert_eq!(receive(folder.path(), both).unwrap(), 2);
        assert_eq!(fs::read(folder.path().join("sequence.json")).unwrap(), b"{}");
        assert_eq!(fs::read(folder.path().join("frames/frame_0001.ply")).unwrap(), b"ply...");
        assert_eq!(fs::read_dir(folder.path().join("frames")).unwrap().count(), 1);
        assert_eq!(receive(folder.path(), chunks("empty", b"")).unwrap(), 1);
        assert_eq!(receive(folder.path(), Vec::new()).unwrap(), 0);
    }

    #[test]
    fn a_damaged_or_short_file_never_gets_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let mut damaged = chunks("a.ply", b"0123456789");
        damaged[1].data[0] ^= 1;
        assert_eq!(receive(folder.path(), damaged).unwrap_err().exit_code(), 1);
        let mut short = chunks("a.ply", b"0123456789");
        short.pop();
        assert!(receive(folder.path(), short).unwrap_err().to_string().contains("5 bytes"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn no_file_lands_outside_of_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        for path in ["../escape", "/etc/passwd", "a/../../b", "", "./a"] {
            assert!(receive(&folder.path().join("inner"), chunks(path, b"x")).is_err(), "{path}");
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
