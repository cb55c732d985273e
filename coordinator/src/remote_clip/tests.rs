#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    fmt,
    sync::atomic::{AtomicUsize, Ordering},
};

use futures::stream::BoxStream;
use object_store::{
    CopyOptions, GetOptions, GetResult, GetResultPayload, ListResult, MultipartUpload, ObjectMeta,
    ObjectStoreExt, PutMultipartOptions, PutOptions, PutPayload, PutResult, memory::InMemory,
};

use super::*;

/// A store whose transfers break in the middle.
#[derive(Debug, Default)]
struct Breaking {
    objects: InMemory,
    /// Transfers that are still to break.
    breaks: AtomicUsize,
    transfers: AtomicUsize,
}

impl fmt::Display for Breaking {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Breaking")
    }
}

#[tonic::async_trait]
impl ObjectStore for Breaking {
    async fn put_opts(
        &self,
        location: &object_store::path::Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> object_store::Result<PutResult> {
        self.objects.put_opts(location, payload, options).await
    }

    async fn put_multipart_opts(
        &self,
        location: &object_store::path::Path,
        options: PutMultipartOptions,
    ) -> object_store::Result<Box<dyn MultipartUpload>> {
        self.objects.put_multipart_opts(location, options).await
    }

    async fn get_opts(
        &self,
        location: &object_store::path::Path,
        options: GetOptions,
    ) -> object_store::Result<GetResult> {
        self.transfers.fetch_add(1, Ordering::Relaxed);
        let got = self.objects.get_opts(location, options).await?;
        let left = self.breaks.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
        if left.is_err() {
            return Ok(got);
        }
        let (meta, range, attributes, extensions) =
            (got.meta.clone(), got.range.clone(), got.attributes.clone(), got.extensions.clone());
        let whole = got.bytes().await?;
        let broken = object_store::Error::Generic { store: "Breaking", source: "connection reset".into() };
        let chunks = [Ok(whole.slice(..whole.len() / 2)), Err(broken)];
        let payload = GetResultPayload::Stream(stream::iter(chunks).boxed());
        Ok(GetResult { payload, meta, range, attributes, extensions })
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, object_store::Result<object_store::path::Path>>,
    ) -> BoxStream<'static, object_store::Result<object_store::path::Path>> {
        self.objects.delete_stream(locations)
    }

    fn list(
        &self,
        prefix: Option<&object_store::path::Path>,
    ) -> BoxStream<'static, object_store::Result<ObjectMeta>> {
        self.objects.list(prefix)
    }

    async fn list_with_delimiter(
        &self,
        prefix: Option<&object_store::path::Path>,
    ) -> object_store::Result<ListResult> {
        self.objects.list_with_delimiter(prefix).await
    }

    async fn copy_opts(
        &self,
        from: &object_store::path::Path,
        to: &object_store::path::Path,
        options: CopyOptions,
    ) -> object_store::Result<()> {
        self.objects.copy_opts(from, to, options).await
    }
}

struct Bench {
    store: Breaking,
    folder: tempfile::TempDir,
    user: Option<String>,
    limits: Limits,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self { store: Breaking::default(), folder, user: None, limits: LIMITS }
    }

    async fn put(&self, name: &str, bytes: &'static [u8]) {
        self.store.put(&name.into(), PutPayload::from_static(bytes)).await.unwrap();
    }

    async fn copy(&self) -> Result<PathBuf, RemoteClipError> {
        let url = ClipUrl::parse("s3://bucket/a/clip").unwrap();
        let options = StoreOptions::default();
        let folder = self.folder.path().to_owned();
        let store = &self.store;
        Copying { store, url: &url, options: &options, folder, user: self.user.clone(), limits: self.limits }
            .run()
            .await
    }

    fn files(&self) -> Vec<(String, Vec<u8>)> {
        let root = self.folder.path().join("files");
        let listed = crate::output::list_files(&root, &[]).unwrap();
        listed
            .iter()
            .map(|name| (name.display().to_string(), std::fs::read(root.join(name)).unwrap()))
            .collect()
    }
}

#[tokio::test]
async fn a_copy_follows_the_objects() {
    let bench = Bench::new();
    bench.put("a/clip/images/cam00/1.png", b"one").await;
    bench.put("a/clip/images/cam01/1.png", b"two").await;
    bench.put("a/clip/images", b"").await;
    bench.put("a/clip2/other", b"not ours").await;
    let files = bench.copy().await.unwrap();
    assert_eq!(files, bench.folder.path().join("files"));
    let expected = |names: &[(&str, &[u8])]| {
        names.iter().map(|(name, bytes)| ((*name).to_owned(), bytes.to_vec())).collect::<Vec<_>>()
    };
    assert_eq!(bench.files(), expected(&[("images/cam00/1.png", b"one"), ("images/cam01/1.png", b"two")]));

    // An untouched object is not read again: what stands in its place here stays.
    std::fs::write(files.join("images/cam00/1.png"), b"ONE").unwrap();
    bench.put("a/clip/images/cam02/1.png", b"three").await;
    bench.store.delete(&"a/clip/images/cam01/1.png".into()).await.unwrap();
    bench.copy().await.unwrap();
    assert_eq!(bench.files(), expected(&[("images/cam00/1.png", b"ONE"), ("images/cam02/1.png", b"three")]));
    assert!(!files.join("images/cam01").exists(), "an empty folder would be a camera without images");

    // A changed object is copied again, and so is a file that is gone.
    bench.put("a/clip/images/cam00/1.png", b"two").await;
    std::fs::remove_file(files.join("images/cam02/1.png")).unwrap();
    bench.copy().await.unwrap();
    assert_eq!(bench.files(), expected(&[("images/cam00/1.png", b"two"), ("images/cam02/1.png", b"three")]));
}

#[tokio::test]
async fn nothing_under_the_prefix_and_an_object_that_is_a_folder_are_errors() {
    let bench = Bench::new();
    bench.put("a/clip2/other", b"not ours").await;
    let error = bench.copy().await.unwrap_err().to_string();
    assert!(error.contains("s3://bucket/a/clip") && error.contains("prefix"), "{error}");
    bench.put("a/clip/x", b"file").await;
    bench.put("a/clip/x/y", b"file").await;
    let error = bench.copy().await.unwrap_err().to_string();
    assert!(error.contains("a/clip/x") && error.contains("folder"), "{error}");
    assert!(!bench.folder.path().join("files").exists(), "nothing is touched before the names are known");
}

#[tokio::test]
async fn a_copy_that_a_job_works_on_stays_as_it_is() {
    let mut bench = Bench::new();
    bench.put("a/clip/1.png", b"one").await;
    bench.put("a/clip/2.png", b"two").await;
    bench.copy().await.unwrap();
    let before = bench.files();
    bench.user = Some("job-7".into());
    bench.copy().await.unwrap();
    // A file that got lost is the same when it is copied again.
    std::fs::remove_file(bench.folder.path().join("files/1.png")).unwrap();
    bench.copy().await.unwrap();
    assert_eq!(bench.files(), before);

    let refused = async |bench: &Bench| {
        let error = bench.copy().await.unwrap_err();
        assert!(matches!(error, RemoteClipError::InUse { .. }), "{error}");
        let said = error.to_string();
        assert!(
            said.contains("job-7") && said.contains("cancel") && said.contains("s3://bucket/a/clip"),
            "{said}"
        );
        assert_eq!(bench.files(), before);
    };
    bench.put("a/clip/3.png", b"three").await;
    refused(&bench).await;
    bench.store.delete(&"a/clip/3.png".into()).await.unwrap();
    bench.copy().await.unwrap();
    bench.store.delete(&"a/clip/2.png".into()).await.unwrap();
    refused(&bench).await;
    bench.put("a/clip/2.png", b"TWO").await;
    refused(&bench).await;
    bench.user = None;
    bench.copy().await.unwrap();
    assert_ne!(bench.files(), before);
}

#[tokio::test]
async fn a_transfer_that_breaks_is_tried_again_and_what_fails_leaves_no_partial_file() {
    let bench = Bench::new();
    bench.put("a/clip/1.png", b"one").await;
    bench.store.breaks.store(2, Ordering::Relaxed);
    bench.copy().await.unwrap();
    assert_eq!(bench.files(), [("1.png".to_owned(), b"one".to_vec())]);
    assert_eq!(bench.store.transfers.swap(0, Ordering::Relaxed), 3);

    bench.put("a/clip/2.png", b"two").await;
    bench.store.breaks.store(usize::MAX, Ordering::Relaxed);
    let error = bench.copy().await.unwrap_err();
    assert!(matches!(error, RemoteClipError::Store { may_pass: true, .. }), "{error}");
    assert!(error.to_string().contains("connection reset"), "{error}");
    assert_eq!(bench.store.transfers.load(Ordering::Relaxed), 4);
    assert_eq!(bench.files(), [("1.png".to_owned(), b"one".to_vec())]);
    assert!(!bench.folder.path().join("partial").exists());
}

#[tokio::test]
async fn more_than_a_clip_can_have_is_refused_before_it_is_copied() {
    let mut bench = Bench::new();
    bench.put("a/clip/1.png", b"one").await;
    bench.put("a/clip/2.png", b"two").await;
    for (limits, said) in
        [(Limits { objects: 1, bytes: 6 }, "1 objects"), (Limits { objects: 2, bytes: 5 }, "5 bytes")]
    {
        bench.limits = limits;
        let error = bench.copy().await.unwrap_err().to_string();
        assert!(error.contains(said) && error.contains("prefix of one clip"), "{error}");
    }
    assert!(!bench.folder.path().join("files").exists());
    bench.limits = Limits { objects: 2, bytes: 6 };
    bench.copy().await.unwrap();
}

#[test]
fn only_a_full_disk_asks_for_room() {
    let url = ClipUrl::parse("s3://bucket/a/clip").unwrap();
    let error =
        |kind: io::ErrorKind| RemoteClipError::unwritable(&url, Path::new("x"), kind.into()).to_string();
    assert!(error(io::ErrorKind::StorageFull).contains("make room"));
    assert!(error(io::ErrorKind::QuotaExceeded).contains("make room"));
    let denied = error(io::ErrorKind::PermissionDenied);
    assert!(!denied.contains("make room") && denied.contains("can write"), "{denied}");
}

#[test]
fn no_object_leaves_the_folder() {
    assert_eq!(local_name("a/clip", "a/clip/images/1.png"), Ok("images/1.png".into()));
    assert_eq!(local_name("", "images/..png"), Ok("images/..png".into()));
    for location in [
        "a/clip/../x",
        "a/clip/x/../../../y",
        "a/clip/./x",
        "a/clip//etc/passwd",
        "a/clip/",
        "a/clip/x/",
        "a/clip",
        "a/clip2/x",
        "../a/clip/x",
        "a/clip/..\\x",
        "a/clip/x\0",
        "a/clip/x\n",
    ] {
        assert!(local_name("a/clip", location).is_err(), "{location:?}");
    }
    for location in ["/etc/passwd", "..", ""] {
        assert!(local_name("", location).is_err(), "{location:?}");
    }
}

#[test]
fn reports_are_few() {
    let due = (0..=1000).map(|done| report_number(done, 1000)).collect::<BTreeSet<_>>();
    assert_eq!(due.len() as u64, REPORTS + 1);
    assert_eq!(report_number(0, 0), 0);
    assert_eq!(report_number(u64::MAX, u64::MAX), REPORTS);
}
