//! The file of a learned tracker.

use std::{fs::File, io::Read, path::Path};

use splat::tracking::learned::MAX_MODEL_BYTES;
use trackersplat_proto::v1::Blob;

use crate::{failure::StageError, hub::Hub, keys::digest_of, request::InputFile, store::Artifact};

/// Key of a network among the artifacts.
pub(crate) fn key(file: &InputFile) -> String {
    digest_of(&("tracker model", &file.digest))
}

/// Puts a network into the store, where workers find it.
pub(crate) async fn keep(hub: &Hub, file: &InputFile, bytes: Vec<u8>) -> Result<Blob, StageError> {
    let artifact = Artifact { blob: hub.blobs.put(bytes.into()).await?, note: String::new() };
    let mut change = hub.store.change().await?;
    change.put_artifact(&key(file), "tracker model", &artifact).await?;
    change.commit().await?;
    Ok(artifact.blob)
}

/// A model file whole, and its digest; the reason, with the file's name, if it cannot be.
pub(crate) fn read(path: &Path) -> Result<(InputFile, Vec<u8>), String> {
    let name = path.display();
    let mut bytes = Vec::new();
    let limit = MAX_MODEL_BYTES as u64;
    let file = File::open(path).and_then(|file| file.take(limit + 1).read_to_end(&mut bytes));
    file.map_err(|error| format!("tracker {name}: {error}; check that the file is there and may be read"))?;
    if bytes.len() as u64 > limit {
        return Err(format!("tracker {name}: it has more than {limit} bytes; export a smaller network"));
    }
    let digest = blake3::hash(&bytes).to_hex().to_string();
    Ok((InputFile { path: name.to_string(), digest }, bytes))
}

/// The bytes of a model file that was submitted; refuses another file in its place.
pub(crate) fn read_again(submitted: &InputFile) -> Result<Vec<u8>, String> {
    let (now, bytes) = read(Path::new(&submitted.path))?;
    if now.digest != submitted.digest {
        return Err(format!(
            "tracker {}: the file has changed since the job was submitted; submit the job again",
            submitted.path
        ));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_submitted_file_and_no_other_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("net.onnx");
        assert!(read(&path).unwrap_err().contains("net.onnx"));
        std::fs::write(&path, b"submitted").unwrap();
        let (submitted, bytes) = read(&path).unwrap();
        assert_eq!(bytes, b"submitted");
        assert_eq!(submitted, InputFile::read(&path).unwrap());
        assert_eq!(read_again(&submitted).unwrap(), bytes);
        std::fs::write(&path, b"changed").unwrap();
        let message = read_again(&submitted).unwrap_err();
        assert!(message.contains("net.onnx") && message.contains("has changed"), "{message}");
        // As large as is refused, without the bytes on the disk.
        File::create(&path).unwrap().set_len(MAX_MODEL_BYTES as u64 + 1).unwrap();
        assert!(read(&path).unwrap_err().contains("smaller network"));
    }
}
