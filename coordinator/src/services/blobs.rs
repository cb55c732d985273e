//! The `Blobs` service, for workers that cannot open the store's folder.

use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt, stream::BoxStream};
use tonic::{Request, Response, Status, Streaming};
use trackersplat_proto::{
    CHUNK_BYTES,
    v1::{BlobChunk, GetBlobRequest, PutBlobChunk, PutBlobResponse, blobs_server::Blobs},
};

use crate::{
    blobs::{BlobError, Upload},
    hub::SharedHub,
};

/// Longest silence in the middle of an upload.
const UPLOAD_SILENCE: Duration = Duration::from_secs(60);

/// Bulk through the coordinator.
pub(crate) struct BlobService {
    hub: SharedHub,
}

impl BlobService {
    pub(crate) fn new(hub: SharedHub) -> Self {
        Self { hub }
    }
}

#[tonic::async_trait]
impl Blobs for BlobService {
    type GetStream = BoxStream<'static, Result<BlobChunk, Status>>;

    async fn get(&self, request: Request<GetBlobRequest>) -> Result<Response<Self::GetStream>, Status> {
        let digest = request.into_inner().digest;
        let chunks = self.hub.blobs.read(&digest, CHUNK_BYTES).await.map_err(status)?;
        let messages = chunks.map(|chunk| match chunk {
            Ok(data) => Ok(BlobChunk { data: data.into() }),
            Err(error) => Err(status(error)),
        });
        Ok(Response::new(messages.boxed()))
    }

    async fn put(
        &self,
        request: Request<Streaming<PutBlobChunk>>,
    ) -> Result<Response<PutBlobResponse>, Status> {
        let mut chunks = request.into_inner();
        let first = next(&mut chunks).await?;
        let Some(PutBlobChunk { blob: Some(blob), data }) = first else {
            return Err(Status::invalid_argument("the first chunk of an upload must name the blob"));
        };
        let mut upload = self.hub.blobs.upload(blob).await.map_err(status)?;
        match receive(&mut upload, data, &mut chunks).await {
            Ok(()) => upload.finish().await.map_err(status)?,
            Err(error) => {
                upload.discard().await;
                return Err(error);
            }
        }
        Ok(Response::new(PutBlobResponse {}))
    }
}

async fn receive(
    upload: &mut Upload,
    first: Vec<u8>,
    chunks: &mut Streaming<PutBlobChunk>,
) -> Result<(), Status> {
    let mut data = Some(first);
    while let Some(bytes) = data {
        upload.write(Bytes::from(bytes)).await.map_err(status)?;
        data = next(chunks).await?.map(|chunk| chunk.data);
    }
    Ok(())
}

async fn next(chunks: &mut Streaming<PutBlobChunk>) -> Result<Option<PutBlobChunk>, Status> {
    tokio::time::timeout(UPLOAD_SILENCE, chunks.message()).await.unwrap_or_else(|_| {
        Err(Status::deadline_exceeded(format!(
            "no chunk for {} s; put the blob again",
            UPLOAD_SILENCE.as_secs()
        )))
    })
}

fn status(error: BlobError) -> Status {
    let message = error.to_string();
    match error {
        BlobError::Name(_) => Status::invalid_argument(message),
        BlobError::Missing(_) => Status::not_found(message),
        BlobError::Corrupt { .. } => Status::data_loss(message),
        BlobError::TooLarge { .. } => Status::resource_exhausted(message),
        BlobError::Store(_) => Status::unavailable(message),
    }
}
