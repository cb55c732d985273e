//! One object becomes one file.

use std::{path::Path, time::Duration};

use backon::{ExponentialBuilder, Retryable};
use futures::TryStreamExt;
use object_store::ObjectStoreExt;
use tokio::io::AsyncWriteExt;

use super::{Copying, Object, RemoteClipError};

/// Further attempts at an object whose transfer broke; requests that are refused were tried again by the store's client.
const RETRIES: usize = 3;
/// Pause before the first of them; later ones are longer.
const FIRST_PAUSE: Duration = Duration::from_millis(200);

/// Why an object is not copied.
enum Broken {
    /// In the middle: the next attempt may get through.
    Transfer(RemoteClipError),
    /// For good.
    Refused(RemoteClipError),
}

impl Copying<'_> {
    /// Copies an object to `partial`, then renames it to `target`.
    pub(super) async fn copy_object(
        &self,
        object: &Object,
        partial: &Path,
        target: &Path,
    ) -> Result<(), RemoteClipError> {
        let pauses = ExponentialBuilder::default().with_min_delay(FIRST_PAUSE).with_max_times(RETRIES);
        let copied = (|| self.transfer(object, partial, target))
            .retry(pauses)
            .when(|broken| matches!(broken, Broken::Transfer(_)))
            .await;
        copied.map_err(|(Broken::Transfer(error) | Broken::Refused(error))| error)
    }

    async fn transfer(&self, object: &Object, partial: &Path, target: &Path) -> Result<(), Broken> {
        let changed = |reason: String| {
            Broken::Refused(RemoteClipError::Changed {
                url: self.url.to_string(),
                name: object.location.to_string(),
                reason,
            })
        };
        let got = self.store.get(&object.location).await.map_err(|error| match error {
            object_store::Error::NotFound { .. } => changed("was removed while the clip was copied".into()),
            error => Broken::Refused(self.refused(&error)),
        })?;
        let unwritable = |source| Broken::Refused(RemoteClipError::unwritable(self.url, target, source));
        let mut file = tokio::fs::File::create(partial).await.map_err(unwritable)?;
        let mut chunks = got.into_stream();
        let mut written = 0;
        while let Some(chunk) =
            chunks.try_next().await.map_err(|error| Broken::Transfer(self.refused(&error)))?
        {
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
}
