//! The files of a job's output folder as a stream, never anything outside of it.

use std::{
    io::{Read, Seek},
    path::{Path, PathBuf},
};

use tokio::sync::mpsc::{self, Sender};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use trackersplat_proto::{CHUNK_BYTES, v1::FetchChunk};

use super::STREAM_QUEUE;
use crate::{
    hub::Hub,
    output::{list_files, resolve},
    store::JobRecord,
};

/// Paths that one request may name.
const MAX_PATHS: usize = 10_000;

pub(super) fn fetch(
    hub: &Hub,
    job: &JobRecord,
    paths: Vec<String>,
) -> Result<ReceiverStream<Result<FetchChunk, Status>>, Status> {
    if paths.len() > MAX_PATHS {
        return Err(Status::invalid_argument(format!(
            "{} paths, at most {MAX_PATHS} are served at once; ask for fewer, or for everything with none",
            paths.len()
        )));
    }
    let (output, private) = (PathBuf::from(&job.output), hub.private_paths());
    let private = private.into_iter().filter(|path| !output.starts_with(path)).collect::<Vec<_>>();
    let files = wanted_files(&output, paths, &private)?;
    let (sender, receiver) = mpsc::channel(STREAM_QUEUE);
    tokio::task::spawn_blocking(move || {
        for (name, path) in files {
            match send_file(&name, &path, &sender) {
                Ok(true) => {}
                Ok(false) => return,
                Err(error) => {
                    let status = Status::unavailable(format!("{name}: {error}; fetch again"));
                    // A client that is gone needs no status.
                    let _ = sender.blocking_send(Err(status));
                    return;
                }
            }
        }
    });
    Ok(ReceiverStream::new(receiver))
}

fn wanted_files(
    output: &Path,
    paths: Vec<String>,
    private: &[PathBuf],
) -> Result<Vec<(String, PathBuf)>, Status> {
    if paths.is_empty() {
        let files = list_files(output, private).map_err(|error| {
            Status::failed_precondition(format!(
                "the output folder {}: {error}; was it removed?",
                output.display()
            ))
        })?;
        let named = |file: PathBuf| (file.to_string_lossy().into_owned(), output.join(file));
        return Ok(files.into_iter().map(named).collect());
    }
    let known = |path: String| match resolve(output, &path, private) {
        Some(file) => Ok((path, file)),
        None => {
            let path: String = path.chars().take(200).collect();
            Err(Status::not_found(format!(
                "no file '{path}' in the output folder; fetch without paths to get all"
            )))
        }
    };
    paths.into_iter().map(known).collect()
}

/// Sends one file. Whether the client wants more.
fn send_file(name: &str, path: &Path, sender: &Sender<Result<FetchChunk, Status>>) -> std::io::Result<bool> {
    // The handle stays with this file even if a newer one is renamed over it.
    let mut file = std::fs::File::open(path)?;
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(&mut file)?;
    let size = hasher.count();
    file.rewind()?;
    let mut header = Some((size, hasher.finalize().to_hex().to_string()));
    let mut remaining = size;
    while header.is_some() || remaining > 0 {
        let wanted = usize::try_from(remaining).unwrap_or(CHUNK_BYTES).min(CHUNK_BYTES);
        let mut data = vec![0; wanted];
        file.read_exact(&mut data)?;
        remaining -= data.len() as u64;
        let (size, digest) = header.take().unwrap_or_default();
        let chunk = FetchChunk { path: name.to_owned(), size, digest, data };
        if sender.blocking_send(Ok(chunk)).is_err() {
            return Ok(false);
        }
    }
    Ok(true)
}
