//! Bulk bytes named by their BLAKE3 digest: the blob `abcd…` is `ab/abcd…` under the store's folder.

use std::{path::Path as FilePath, sync::Arc};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream::BoxStream};
use object_store::{
    MultipartUpload, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload, local::LocalFileSystem,
    path::Path,
};
use thiserror::Error;
use trackersplat_proto::{
    ids::{InvalidId, check_digest},
    v1::Blob,
};

/// Largest blob that a peer may upload: a delta of four million Gaussians of degree 3 with room to spare.
pub(crate) const MAX_UPLOAD_BYTES: u64 = 2 << 30;

/// Why bulk could not be read or written.
#[derive(Debug, Error)]
pub enum BlobError {
    /// Not the name of a blob.
    #[error(transparent)]
    Name(#[from] InvalidId),
    /// There is no such blob.
    #[error("blob {0} is not in the store; it was removed by hand, or never put")]
    Missing(String),
    /// The bytes are not those that the name promises.
    #[error("blob {digest}: expected {expected}, got {got}; remove the file and run the job again")]
    Corrupt {
        /// The blob.
        digest: String,
        /// Digest or size.
        expected: String,
        /// Digest or size.
        got: String,
    },
    /// Larger than the coordinator accepts.
    #[error("blob {digest} has {size} bytes, at most {limit} are accepted")]
    TooLarge {
        /// The blob.
        digest: String,
        /// Its size.
        size: u64,
        /// The limit.
        limit: u64,
    },
    /// The store refuses.
    #[error("the blob store: {0}; check that its disk is not full and can be written")]
    Store(#[from] object_store::Error),
}

/// The blob store. Cheap to clone.
#[derive(Clone, Debug)]
pub struct BlobStore {
    store: Arc<LocalFileSystem>,
}

impl BlobStore {
    /// Opens the store in a folder, which must exist. Uploads that a coordinator before left unfinished are removed.
    pub fn open(folder: &FilePath) -> Result<Self, BlobError> {
        if let Err(error) = std::fs::remove_dir_all(folder.join("incoming"))
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(%error, "unfinished uploads are left behind");
        }
        // A receipt promises that the result survives, power loss included.
        let store = LocalFileSystem::new_with_prefix(folder)?.with_fsync(true);
        Ok(Self { store: Arc::new(store) })
    }

    /// Stores bytes under their digest. The same bytes twice are stored once; a damaged older copy is replaced.
    pub async fn put(&self, bytes: Bytes) -> Result<Blob, BlobError> {
        let blob = name(&bytes);
        let path = path_of(&blob.digest)?;
        let create = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        match self.store.put_opts(&path, PutPayload::from_bytes(bytes.clone()), create).await {
            Ok(_) => Ok(blob),
            Err(object_store::Error::AlreadyExists { .. }) => {
                // Of the right size it may be damaged all the same.
                match self.get(&blob).await {
                    Ok(_) => return Ok(blob),
                    Err(BlobError::Missing(_) | BlobError::Corrupt { .. }) => {}
                    Err(error) => return Err(error),
                }
                self.store.put(&path, PutPayload::from_bytes(bytes)).await?;
                Ok(blob)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Removes a blob that nothing names any more. What cannot be removed is left behind.
    pub async fn remove(&self, blob: &Blob) {
        let Ok(path) = path_of(&blob.digest) else { return };
        if let Err(error) = self.store.delete(&path).await
            && !matches!(error, object_store::Error::NotFound { .. })
        {
            tracing::warn!(digest = blob.digest, %error, "a blob that nobody needs is left behind");
        }
    }

    /// Whether a blob is there and of its size. Its content is verified when it is read.
    pub async fn holds(&self, blob: &Blob) -> bool {
        let Ok(path) = path_of(&blob.digest) else { return false };
        self.store.head(&path).await.is_ok_and(|found| found.size == blob.size)
    }

    /// Whether a blob is known to be gone, or of another size. A store that cannot be asked now lacks nothing.
    pub async fn lacks(&self, blob: &Blob) -> bool {
        let Ok(path) = path_of(&blob.digest) else { return true };
        match self.store.head(&path).await {
            Ok(found) => found.size != blob.size,
            Err(error) => matches!(error, object_store::Error::NotFound { .. }),
        }
    }

    /// The bytes of a blob, verified.
    pub async fn get(&self, blob: &Blob) -> Result<Bytes, BlobError> {
        let bytes = self.open_blob(&blob.digest).await?.bytes().await?;
        if bytes.len() as u64 != blob.size {
            return Err(BlobError::Corrupt {
                digest: blob.digest.clone(),
                expected: format!("{} bytes", blob.size),
                got: format!("{} bytes", bytes.len()),
            });
        }
        let found = name(&bytes).digest;
        check_content(&blob.digest, &found)?;
        Ok(bytes)
    }

    /// The bytes of a blob in chunks of at most `chunk_bytes`; ends in an error if they are not what the name promises.
    pub async fn read(
        &self,
        digest: &str,
        chunk_bytes: usize,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let pieces = self.open_blob(digest).await?.into_stream().map_err(BlobError::from);
        let chunks =
            pieces.map_ok(move |piece| futures::stream::iter(split(piece, chunk_bytes))).try_flatten();
        let expected = digest.to_owned();
        let verified = futures::stream::unfold(
            Some((chunks.boxed(), blake3::Hasher::new(), expected)),
            |state| async move {
                let (mut chunks, mut hasher, expected) = state?;
                match chunks.next().await {
                    Some(Ok(chunk)) => {
                        hasher.update(&chunk);
                        Some((Ok(chunk), Some((chunks, hasher, expected))))
                    }
                    Some(Err(error)) => Some((Err(error), None)),
                    None => {
                        let found = hasher.finalize().to_hex();
                        check_content(&expected, &found).err().map(|error| (Err(error), None))
                    }
                }
            },
        );
        Ok(verified.boxed())
    }

    /// Begins an upload; nothing is visible before [`Upload::finish`] has verified it.
    pub async fn upload(&self, blob: Blob) -> Result<Upload, BlobError> {
        let target = path_of(&blob.digest)?;
        if blob.size > MAX_UPLOAD_BYTES {
            let Blob { digest, size } = blob;
            return Err(BlobError::TooLarge { digest, size, limit: MAX_UPLOAD_BYTES });
        }
        let temporary = Path::from(format!("incoming/{}", uuid::Uuid::now_v7().simple()));
        let parts = self.store.put_multipart(&temporary).await?;
        let hasher = blake3::Hasher::new();
        Ok(Upload { store: self.clone(), parts, temporary, target, blob, hasher, received: 0 })
    }

    async fn open_blob(&self, digest: &str) -> Result<object_store::GetResult, BlobError> {
        match self.store.get(&path_of(digest)?).await {
            Ok(found) => Ok(found),
            Err(object_store::Error::NotFound { .. }) => Err(BlobError::Missing(digest.to_owned())),
            Err(error) => Err(error.into()),
        }
    }
}

/// A blob on its way in.
pub struct Upload {
    store: BlobStore,
    parts: Box<dyn MultipartUpload>,
    temporary: Path,
    target: Path,
    blob: Blob,
    hasher: blake3::Hasher,
    received: u64,
}

impl Upload {
    /// Takes the next bytes.
    pub async fn write(&mut self, data: Bytes) -> Result<(), BlobError> {
        self.received += data.len() as u64;
        if self.received > self.blob.size {
            return Err(self.wrong_size());
        }
        self.hasher.update(&data);
        if !data.is_empty() {
            self.parts.put_part(PutPayload::from_bytes(data)).await?;
        }
        Ok(())
    }

    /// Makes the blob visible if digest and size are as announced.
    pub async fn finish(mut self) -> Result<(), BlobError> {
        if self.received != self.blob.size {
            let error = self.wrong_size();
            self.discard().await;
            return Err(error);
        }
        if let Err(error) = check_content(&self.blob.digest, &self.hasher.finalize().to_hex()) {
            self.discard().await;
            return Err(error);
        }
        self.parts.complete().await?;
        // Renaming over an older copy is harmless: both are what the name promises, or the older one is damaged.
        Ok(self.store.store.rename(&self.temporary, &self.target).await?)
    }

    /// Forgets what has come so far.
    pub async fn discard(mut self) {
        if let Err(error) = self.parts.abort().await {
            tracing::warn!(%error, "an upload's temporary file is left behind");
        }
    }

    fn wrong_size(&self) -> BlobError {
        BlobError::Corrupt {
            digest: self.blob.digest.clone(),
            expected: format!("{} bytes", self.blob.size),
            got: format!("{} bytes", self.received),
        }
    }
}

/// Digest and size of bytes.
pub(crate) fn name(bytes: &[u8]) -> Blob {
    Blob { digest: blake3::hash(bytes).to_hex().to_string(), size: bytes.len() as u64 }
}

fn path_of(digest: &str) -> Result<Path, BlobError> {
    check_digest(digest)?;
    Ok(Path::from(format!("{}/{digest}", &digest[..2])))
}

fn check_content(expected: &str, found: &str) -> Result<(), BlobError> {
    if expected == found {
        return Ok(());
    }
    Err(BlobError::Corrupt {
        digest: expected.to_owned(),
        expected: "this digest".into(),
        got: format!("digest {found}"),
    })
}

fn split(mut piece: Bytes, chunk_bytes: usize) -> Vec<Result<Bytes, BlobError>> {
    let mut chunks = Vec::with_capacity(piece.len().div_ceil(chunk_bytes));
    while !piece.is_empty() {
        chunks.push(Ok(piece.split_to(chunk_bytes.min(piece.len()))));
    }
    chunks
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn store() -> (tempfile::TempDir, BlobStore) {
        let folder = tempfile::tempdir().unwrap();
        let store = BlobStore::open(folder.path()).unwrap();
        (folder, store)
    }

    async fn read_all(store: &BlobStore, digest: &str) -> Result<Vec<Bytes>, BlobError> {
        store.read(digest, 1000).await?.try_collect().await
    }

    #[tokio::test]
    async fn bytes_come_back_whole_and_in_bounded_chunks() {
        let (_folder, store) = store();
        for bytes in [Bytes::new(), Bytes::from(vec![3; 2500])] {
            let blob = store.put(bytes.clone()).await.unwrap();
            assert_eq!(store.put(bytes.clone()).await.unwrap(), blob, "twice is once");
            assert_eq!(store.get(&blob).await.unwrap(), bytes);
            let chunks = read_all(&store, &blob.digest).await.unwrap();
            assert!(chunks.iter().all(|chunk| chunk.len() <= 1000));
            assert_eq!(chunks.concat(), bytes);
        }
    }

    #[tokio::test]
    async fn a_damaged_blob_is_never_handed_out_and_put_mends_it() {
        let (folder, store) = store();
        let bytes = Bytes::from_static(b"twelve bytes");
        let blob = store.put(bytes.clone()).await.unwrap();
        let file = folder.path().join(&blob.digest[..2]).join(&blob.digest);
        std::fs::write(&file, b"other bytes!").unwrap();
        assert!(matches!(store.get(&blob).await, Err(BlobError::Corrupt { .. })));
        assert!(matches!(read_all(&store, &blob.digest).await, Err(BlobError::Corrupt { .. })));
        // Cut short, and of the same size.
        for damaged in [&b"cut"[..], b"other bytes!"] {
            std::fs::write(&file, damaged).unwrap();
            assert_eq!(store.holds(&blob).await, damaged.len() == bytes.len());
            store.put(bytes.clone()).await.unwrap();
            assert_eq!(store.get(&blob).await.unwrap(), bytes);
        }
    }

    #[tokio::test]
    async fn a_missing_blob_and_a_path_as_a_name_are_refused() {
        let (_folder, store) = store();
        let absent = name(b"absent");
        assert!(matches!(store.get(&absent).await, Err(BlobError::Missing(_))));
        assert!(!store.holds(&absent).await);
        assert!(matches!(store.read("../../etc/passwd", 10).await, Err(BlobError::Name(_))));
        let hostile = Blob { digest: "../up".into(), size: 1 };
        assert!(matches!(store.upload(hostile).await, Err(BlobError::Name(_))));
    }

    #[tokio::test]
    async fn a_store_that_cannot_be_asked_lacks_nothing_and_holds_nothing() {
        let (folder, store) = store();
        let blob = store.put(Bytes::from_static(b"twelve bytes")).await.unwrap();
        assert!(!store.lacks(&blob).await);
        assert!(store.lacks(&Blob { size: 11, ..blob.clone() }).await);
        assert!(store.lacks(&name(b"absent")).await);
        assert!(store.lacks(&Blob { digest: "../up".into(), size: 1 }).await);
        let (inside, aside) = (folder.path().join(&blob.digest[..2]), folder.path().join("aside"));
        std::fs::rename(&inside, &aside).unwrap();
        assert!(store.lacks(&blob).await);
        // A folder that is a file is no answer, as an input or output error is none.
        std::fs::write(&inside, b"").unwrap();
        assert!(!store.lacks(&blob).await && !store.holds(&blob).await);
        std::fs::remove_file(&inside).unwrap();
        std::fs::rename(&aside, &inside).unwrap();
        assert!(!store.lacks(&blob).await && store.holds(&blob).await);
    }

    #[tokio::test]
    async fn an_upload_is_visible_only_when_it_is_what_was_announced() {
        let (folder, store) = store();
        let blob = name(b"hello world");
        let mut short = store.upload(blob.clone()).await.unwrap();
        short.write(Bytes::from_static(b"hello")).await.unwrap();
        assert!(matches!(short.finish().await, Err(BlobError::Corrupt { .. })));
        let mut wrong = store.upload(blob.clone()).await.unwrap();
        wrong.write(Bytes::from_static(b"hello earth")).await.unwrap();
        assert!(matches!(wrong.finish().await, Err(BlobError::Corrupt { .. })));
        let mut long = store.upload(blob.clone()).await.unwrap();
        assert!(long.write(Bytes::from(vec![0; 12])).await.is_err());
        long.discard().await;
        assert!(!store.holds(&blob).await);

        for _ in 0..2 {
            let mut right = store.upload(blob.clone()).await.unwrap();
            right.write(Bytes::from_static(b"hello ")).await.unwrap();
            right.write(Bytes::from_static(b"world")).await.unwrap();
            right.finish().await.unwrap();
            assert_eq!(store.get(&blob).await.unwrap(), "hello world");
        }
        let left_behind = std::fs::read_dir(folder.path().join("incoming")).unwrap().count();
        assert_eq!(left_behind, 0);
    }

    #[tokio::test]
    async fn an_upload_beyond_the_limit_is_refused_before_it_begins() {
        let (_folder, store) = store();
        let huge = Blob { digest: name(b"x").digest, size: MAX_UPLOAD_BYTES + 1 };
        assert!(matches!(store.upload(huge).await, Err(BlobError::TooLarge { .. })));
    }
}
