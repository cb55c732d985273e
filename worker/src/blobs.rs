//! Verified bulk: from the store's directory where the worker can open it, else through the coordinator.

use std::path::Path as FilePath;

use bytes::{Bytes, BytesMut};
use futures::StreamExt;
use object_store::{ObjectStoreExt, local::LocalFileSystem, path::Path};
use thiserror::Error;
use tonic::transport::Channel;
use trackersplat_proto::{
    CHUNK_BYTES,
    ids::{InvalidId, check_digest},
    v1::{Blob, FailureKind, GetBlobRequest, PutBlobChunk, Welcome, blobs_client::BlobsClient},
};

/// Why bulk could not be read or written.
#[derive(Debug, Error)]
pub(crate) enum BlobError {
    #[error(transparent)]
    BadDigest(#[from] InvalidId),
    #[error(
        "blob {digest}: expected {expected}, got {got}; the store is damaged or the transfer was cut short"
    )]
    Corrupt { digest: String, expected: String, got: String },
    #[error("the store's directory: {0}; check that the worker may read and write it")]
    Store(#[from] object_store::Error),
    #[error("blob {digest} through the coordinator: {status}")]
    Transfer { digest: String, status: Box<tonic::Status> },
}

impl BlobError {
    /// Whether the same request fails again.
    pub(crate) fn kind(&self) -> FailureKind {
        match self {
            Self::BadDigest(_) => FailureKind::BadInput,
            Self::Corrupt { .. } | Self::Store(_) | Self::Transfer { .. } => FailureKind::Transient,
        }
    }

    /// Whether the store does not hold the blob, or other bytes under its name.
    pub(crate) fn is_lost(&self) -> bool {
        match self {
            Self::Corrupt { .. } | Self::Store(object_store::Error::NotFound { .. }) => true,
            Self::Transfer { status, .. } => {
                matches!(status.code(), tonic::Code::NotFound | tonic::Code::DataLoss)
            }
            Self::BadDigest(_) | Self::Store(_) => false,
        }
    }
}

/// Where the worker gets and puts blobs.
#[derive(Clone, Debug)]
pub(crate) enum Blobs {
    /// The store's own directory, shared with the coordinator.
    Directory(std::sync::Arc<LocalFileSystem>),
    /// Streams through the coordinator.
    Coordinator(BlobsClient<Channel>),
}

impl Blobs {
    /// Opens the directory that the coordinator names if the probe blob is there, else streams.
    pub(crate) async fn open(welcome: &Welcome, channel: Channel) -> Self {
        if let Some(directory) = open_directory(welcome).await {
            return directory;
        }
        tracing::info!("the store's directory is not visible here");
        Self::through_coordinator(channel)
    }

    /// Streams through the coordinator, whatever is visible here.
    pub(crate) fn through_coordinator(channel: Channel) -> Self {
        tracing::info!("bulk goes through the coordinator");
        Self::Coordinator(BlobsClient::new(channel))
    }

    /// The bytes of a blob, verified.
    pub(crate) async fn get(&self, blob: &Blob) -> Result<Bytes, BlobError> {
        let bytes = match self {
            Self::Directory(store) => store.get(&store_path(&blob.digest)?).await?.bytes().await?,
            Self::Coordinator(client) => download(client.clone(), blob).await?,
        };
        verify(blob, &bytes)?;
        Ok(bytes)
    }

    /// Stores bytes under their digest. Storing the same bytes twice is storing them once.
    pub(crate) async fn put(&self, bytes: Bytes) -> Result<Blob, BlobError> {
        let blob = Blob { digest: digest_of(&bytes), size: bytes.len() as u64 };
        match self {
            Self::Directory(store) => {
                store.put(&store_path(&blob.digest)?, bytes.into()).await?;
            }
            Self::Coordinator(client) => upload(client.clone(), &blob, bytes).await?,
        }
        Ok(blob)
    }
}

/// BLAKE3 in hexadecimal.
pub(crate) fn digest_of(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

/// A blob's place in the store: `ab/abcdef…`, so that no directory holds every file.
fn store_path(digest: &str) -> Result<Path, BlobError> {
    check_digest(digest)?;
    Ok(Path::from(format!("{}/{digest}", &digest[..2])))
}

fn verify(blob: &Blob, bytes: &[u8]) -> Result<(), BlobError> {
    if bytes.len() as u64 != blob.size {
        return Err(BlobError::Corrupt {
            digest: blob.digest.clone(),
            expected: format!("{} bytes", blob.size),
            got: format!("{} bytes", bytes.len()),
        });
    }
    let got = digest_of(bytes);
    if got != blob.digest {
        return Err(BlobError::Corrupt {
            digest: blob.digest.clone(),
            expected: "this digest".into(),
            got: format!("digest {got}"),
        });
    }
    Ok(())
}

/// The directory, if the probe is readable there: a directory of the same name on another machine does not have it.
async fn open_directory(welcome: &Welcome) -> Option<Blobs> {
    let probe = welcome.store_probe.as_ref()?;
    if welcome.store_directory.is_empty() || !FilePath::new(&welcome.store_directory).is_dir() {
        return None;
    }
    // What the coordinator acknowledges survives, power loss included: its own writes are synced as well.
    let store = LocalFileSystem::new_with_prefix(&welcome.store_directory).ok()?.with_fsync(true);
    let directory = Blobs::Directory(std::sync::Arc::new(store));
    directory.get(probe).await.is_ok().then_some(directory)
}

async fn download(mut client: BlobsClient<Channel>, blob: &Blob) -> Result<Bytes, BlobError> {
    let failed = |status| BlobError::Transfer { digest: blob.digest.clone(), status: Box::new(status) };
    store_path(&blob.digest)?;
    let request = GetBlobRequest { digest: blob.digest.clone() };
    let mut chunks = client.get(request).await.map_err(failed)?.into_inner();
    let mut bytes = BytesMut::new();
    while let Some(chunk) = chunks.next().await {
        bytes.extend_from_slice(&chunk.map_err(failed)?.data);
        // A peer that sends more than it announced must not fill the memory.
        if bytes.len() as u64 > blob.size {
            break;
        }
    }
    Ok(bytes.freeze())
}

async fn upload(mut client: BlobsClient<Channel>, blob: &Blob, bytes: Bytes) -> Result<(), BlobError> {
    let first = PutBlobChunk { blob: Some(blob.clone()), data: Vec::new() };
    let chunk_count = bytes.len().div_ceil(CHUNK_BYTES);
    let rest = (0..chunk_count).map(move |index| {
        let start = index * CHUNK_BYTES;
        let end = (start + CHUNK_BYTES).min(bytes.len());
        PutBlobChunk { blob: None, data: bytes[start..end].to_vec() }
    });
    let request = futures::stream::iter(std::iter::once(first).chain(rest));
    let failed = |status| BlobError::Transfer { digest: blob.digest.clone(), status: Box::new(status) };
    client.put(request).await.map_err(failed)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::test_coordinator::TestCoordinator;

    fn blob(bytes: &[u8]) -> Blob {
        Blob { digest: digest_of(bytes), size: bytes.len() as u64 }
    }

    async fn directory(root: &FilePath, probe: &[u8]) -> Blobs {
        let store = LocalFileSystem::new_with_prefix(root).unwrap();
        store.put(&store_path(&digest_of(probe)).unwrap(), probe.to_vec().into()).await.unwrap();
        Blobs::Directory(std::sync::Arc::new(store))
    }

    #[tokio::test]
    async fn a_blob_comes_back_as_it_was_put() {
        let root = tempfile::tempdir().unwrap();
        let blobs = directory(root.path(), b"probe").await;
        for bytes in [Vec::new(), vec![7; 3 * CHUNK_BYTES / 2]] {
            let stored = blobs.put(bytes.clone().into()).await.unwrap();
            assert_eq!(blobs.get(&stored).await.unwrap(), bytes);
            // Idempotent: a retried job puts the same result again.
            assert_eq!(blobs.put(bytes.into()).await.unwrap(), stored);
        }
    }

    #[tokio::test]
    async fn a_damaged_blob_is_refused_not_used() {
        let root = tempfile::tempdir().unwrap();
        let blobs = directory(root.path(), b"probe").await;
        let stored = blobs.put(b"static model".to_vec().into()).await.unwrap();
        let path = root.path().join(&stored.digest[..2]).join(&stored.digest);

        std::fs::write(&path, b"static_model").unwrap();
        assert!(matches!(blobs.get(&stored).await, Err(BlobError::Corrupt { .. })));
        std::fs::write(&path, b"static").unwrap();
        let error = blobs.get(&stored).await.unwrap_err();
        assert!(error.to_string().contains("12 bytes, got 6 bytes"), "{error}");
        assert_eq!(error.kind(), FailureKind::Transient);
    }

    #[tokio::test]
    async fn a_digest_that_is_a_path_never_reaches_the_file_system() {
        let root = tempfile::tempdir().unwrap();
        let blobs = directory(root.path(), b"probe").await;
        let long = "é".repeat(32);
        for digest in ["../../etc/passwd", "", &"A".repeat(64), &long] {
            let error = blobs.get(&Blob { digest: digest.to_string(), size: 1 }).await.unwrap_err();
            assert!(matches!(error, BlobError::BadDigest(_)), "{digest}: {error}");
            assert_eq!(error.kind(), FailureKind::BadInput);
        }
    }

    #[tokio::test]
    async fn the_directory_is_used_only_where_the_probe_is_readable() {
        let root = tempfile::tempdir().unwrap();
        directory(root.path(), b"probe").await;
        let coordinator = TestCoordinator::start().await;
        let mut welcome = Welcome {
            store_directory: root.path().to_string_lossy().into_owned(),
            store_probe: Some(blob(b"probe")),
            ..Welcome::default()
        };
        let opened = Blobs::open(&welcome, coordinator.channel()).await;
        let Blobs::Directory(store) = opened else { panic!("{opened:?}") };
        // All that the store says of it.
        assert!(format!("{store:?}").contains("fsync: true"), "{store:?}");
        welcome.store_probe = Some(blob(b"another store's probe"));
        assert!(matches!(Blobs::open(&welcome, coordinator.channel()).await, Blobs::Coordinator(_)));
    }

    #[tokio::test]
    async fn blobs_stream_through_the_coordinator_and_are_verified() {
        let coordinator = TestCoordinator::start().await;
        let blobs = Blobs::open(&Welcome::default(), coordinator.channel()).await;
        let large = vec![3; 5 * CHUNK_BYTES / 2];
        let stored = blobs.put(large.clone().into()).await.unwrap();
        assert_eq!(blobs.get(&stored).await.unwrap(), large);

        coordinator.damage(&stored.digest);
        assert!(matches!(blobs.get(&stored).await, Err(BlobError::Corrupt { .. })));
        let missing = blobs.get(&blob(b"never stored")).await.unwrap_err();
        assert!(matches!(missing, BlobError::Transfer { .. }), "{missing}");
    }
}
