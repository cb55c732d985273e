#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeMap;

use tonic::Code;
use trackersplat_proto::{
    CHUNK_BYTES,
    v1::{Blob, FetchRequest, GetBlobRequest, PutBlobChunk},
};

use super::harness::*;

#[tokio::test]
async fn a_blob_goes_in_and_out_in_bounded_chunks() {
    let bench = Bench::start().await;
    let bytes: Vec<u8> = (0..3 * CHUNK_BYTES / 2).map(|i| (i % 251) as u8).collect();
    let blob = crate::blobs::name(&bytes);
    let first = PutBlobChunk { blob: Some(blob.clone()), data: Vec::new() };
    let rest = bytes.chunks(CHUNK_BYTES / 3).map(|data| PutBlobChunk { blob: None, data: data.to_vec() });
    let chunks: Vec<_> = std::iter::once(first).chain(rest).collect();
    bench.blobs().put(tokio_stream::iter(chunks)).await.unwrap();

    let request = GetBlobRequest { digest: blob.digest.clone() };
    let mut stream = bench.blobs().get(request).await.unwrap().into_inner();
    let mut got = Vec::new();
    while let Some(chunk) = within(stream.message()).await.unwrap() {
        assert!(chunk.data.len() <= CHUNK_BYTES);
        got.extend(chunk.data);
    }
    assert_eq!(got, bytes);
}

#[tokio::test]
async fn wrong_uploads_and_downloads_are_refused_and_leave_nothing() {
    let bench = Bench::start().await;
    let honest = crate::blobs::name(b"what it says");
    let code = async |blob: Option<Blob>, data: &[u8]| {
        let chunk = PutBlobChunk { blob, data: data.to_vec() };
        bench.blobs().put(tokio_stream::iter([chunk])).await.unwrap_err().code()
    };
    assert_eq!(code(None, b"no name").await, Code::InvalidArgument);
    assert_eq!(code(Some(honest.clone()), b"something el").await, Code::DataLoss);
    assert_eq!(code(Some(honest.clone()), b"short").await, Code::DataLoss);
    let traversal = Blob { digest: "../../escape".into(), size: 1 };
    assert_eq!(code(Some(traversal), b"x").await, Code::InvalidArgument);
    let huge = Blob { size: u64::MAX, ..honest.clone() };
    assert_eq!(code(Some(huge), b"x").await, Code::ResourceExhausted);
    assert_eq!(bench.get(&honest.digest).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(bench.get("not a digest").await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn fetch_streams_the_output_folder_and_nothing_else() {
    let bench = Bench::start().await;
    let job = bench.submitted().await;
    let out = bench.folder.path().join("out");
    std::fs::create_dir_all(out.join("frames")).unwrap();
    let large: Vec<u8> = (0..2 * CHUNK_BYTES + 5).map(|i| (i % 253) as u8).collect();
    std::fs::write(out.join("frames/large.bin"), &large).unwrap();
    std::fs::write(out.join("empty.csv"), b"").unwrap();
    std::fs::write(out.join(".half-written"), b"x").unwrap();

    let fetch = async |paths: &[&str]| {
        let paths = paths.iter().map(|&path| path.to_owned()).collect();
        let request = FetchRequest { job_id: job.clone(), paths };
        let mut stream = bench.jobs().fetch(request).await?.into_inner();
        let mut files: BTreeMap<String, (u64, String, Vec<u8>)> = BTreeMap::new();
        while let Some(chunk) = within(stream.message()).await? {
            let file =
                files.entry(chunk.path).or_insert_with(|| (chunk.size, chunk.digest.clone(), Vec::new()));
            file.2.extend(chunk.data);
        }
        Ok::<_, tonic::Status>(files)
    };
    let all = fetch(&[]).await.unwrap();
    let names: Vec<&str> = all.keys().map(String::as_str).collect();
    for name in ["empty.csv", "frames/large.bin", "trackersplat.json"] {
        assert!(names.contains(&name), "{names:?}");
    }
    assert!(!names.contains(&".half-written"));
    for (size, digest, bytes) in all.values() {
        assert_eq!(crate::blobs::name(bytes), Blob { digest: digest.clone(), size: *size });
    }
    assert_eq!(all["frames/large.bin"].2, large);
    assert_eq!(fetch(&["empty.csv"]).await.unwrap().len(), 1);
    for outside in ["../static.ply", "/etc/passwd", "nothing.ply"] {
        assert_eq!(fetch(&[outside]).await.unwrap_err().code(), Code::NotFound, "{outside}");
    }
}
