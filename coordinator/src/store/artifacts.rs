//! What was computed once and is used again.

use trackersplat_proto::v1::Blob;

use super::{Change, Store, StoreError, signed, unsigned};

/// A stored result of work.
#[derive(Clone, Debug, PartialEq)]
pub struct Artifact {
    /// Its bytes.
    pub blob: Blob,
    /// Its report, JSON, if it has one.
    pub note: String,
}

impl Store {
    /// The artifact of a key.
    pub async fn artifact(&self, key: &str) -> Result<Option<Artifact>, StoreError> {
        let query = sqlx::query_as("SELECT digest, size, note FROM artifacts WHERE key = ?").bind(key);
        let row: Option<(String, i64, String)> = query.fetch_optional(&self.pool).await?;
        Ok(row.map(|(digest, size, note)| Artifact { blob: Blob { digest, size: unsigned(size) }, note }))
    }

    /// Keys of the artifacts whose content a blob is.
    pub async fn artifact_keys(&self, blob: &Blob) -> Result<Vec<String>, StoreError> {
        let query = sqlx::query_scalar("SELECT key FROM artifacts WHERE digest = ?").bind(&blob.digest);
        Ok(query.fetch_all(&self.pool).await?)
    }
}

impl Change {
    /// Remembers an artifact. The same key twice is the same content twice, unless the older one was damaged.
    pub async fn put_artifact(
        &mut self,
        key: &str,
        kind: &str,
        artifact: &Artifact,
    ) -> Result<(), StoreError> {
        let sql = "INSERT OR REPLACE INTO artifacts (key, kind, digest, size, note, created_at) \
                   VALUES (?, ?, ?, ?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))";
        let query = sqlx::query(sql).bind(key).bind(kind).bind(&artifact.blob.digest);
        let query = query.bind(signed(artifact.blob.size)).bind(&artifact.note);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Forgets an artifact that nobody needs any more, or whose bytes are gone.
    pub async fn remove_artifact(&mut self, key: &str) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM artifacts WHERE key = ?").bind(key).execute(&mut *self.transaction).await?;
        Ok(())
    }
}
