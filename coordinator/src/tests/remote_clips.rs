#![allow(clippy::unwrap_used, reason = "tests")]

use std::{
    collections::BTreeSet,
    net::SocketAddr,
    sync::{Arc, Mutex},
};

use hyper::service::{Service, service_fn};
use hyper_util::rt::TokioIo;
use s3s::{auth::SimpleAuth, service::S3ServiceBuilder};
use tokio::{net::TcpListener, sync::Notify};
use tonic::Code;
use trackersplat_proto::v1::{JobState, ListRequest, SubmitRequest};

use super::harness::*;
use crate::StoreOptions;

const KEY: &str = "tester";
const SECRET: &str = "hunter2hunter2";
/// Objects of the clip: three frames of four views, and their cameras.
const OBJECTS: usize = 15;

/// An S3 service of this process; its buckets are folders.
struct Bucket {
    folder: tempfile::TempDir,
    address: SocketAddr,
    seen: Arc<Seen>,
}

/// The objects that were asked for.
#[derive(Default)]
struct Seen {
    gets: Mutex<Vec<String>>,
    /// Further objects are not answered until this many more were asked for.
    answered: Mutex<Option<usize>>,
    asked: Notify,
}

impl Seen {
    fn take(&self) -> Vec<String> {
        std::mem::take(&mut *self.gets.lock().unwrap())
    }

    /// Notes a request; whether it is to be answered.
    fn note(&self, uri: &hyper::Uri) -> bool {
        // Listings have a query that says so.
        if uri.query().is_some_and(|query| query.contains("list-type")) {
            return true;
        }
        self.gets.lock().unwrap().push(uri.path().to_owned());
        self.asked.notify_one();
        match &mut *self.answered.lock().unwrap() {
            None => true,
            Some(0) => false,
            Some(left) => {
                *left -= 1;
                true
            }
        }
    }
}

impl Bucket {
    /// Serves the bucket `clips` with the clip `set/clip`.
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_clip(&folder.path().join("clips/set/clip"), 0);
        let mut service = S3ServiceBuilder::new(s3s_fs::FileSystem::new(folder.path()).unwrap());
        service.set_auth(SimpleAuth::from_single(KEY, SECRET));
        let service = service.build();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let seen = Arc::<Seen>::default();
        let noted = seen.clone();
        tokio::spawn(async move {
            while let Ok((socket, _)) = listener.accept().await {
                let (service, noted) = (service.clone(), noted.clone());
                let answer = service_fn(move |request: hyper::Request<hyper::body::Incoming>| {
                    let is_answered = noted.note(request.uri());
                    let answer = Service::call(&service, request);
                    async move { if is_answered { answer.await } else { std::future::pending().await } }
                });
                let connection = hyper::server::conn::http1::Builder::new();
                tokio::spawn(connection.serve_connection(TokioIo::new(socket), answer));
            }
        });
        Self { folder, address, seen }
    }

    async fn bench(&self, secret: &str) -> Bench {
        let endpoint = format!("http://{}", self.address);
        let variables = [
            ("AWS_ACCESS_KEY_ID", KEY),
            ("AWS_SECRET_ACCESS_KEY", secret),
            ("AWS_REGION", "us-east-1"),
            ("AWS_ENDPOINT_URL", &endpoint),
            ("AWS_ALLOW_HTTP", "true"),
            // Whatever proxy this machine has, it is not on the way to itself.
            ("AWS_PROXY_URL", "http://127.0.0.1:9"),
            ("AWS_PROXY_EXCLUDES", "127.0.0.1"),
        ];
        let variables = variables.map(|(name, value)| (name.to_owned(), value.to_owned()));
        Bench::start_with(|options| options.stores = StoreOptions::from_variables(variables)).await
    }
}

fn from(bench: &Bench, clip: &str) -> SubmitRequest {
    SubmitRequest { clip: clip.into(), ..bench.request() }
}

#[tokio::test]
async fn a_clip_in_an_object_store_is_the_same_job_as_by_path_and_is_copied_once() {
    let bucket = Bucket::start().await;
    let mut bench = bucket.bench(SECRET).await;
    let request = from(&bench, "s3://clips/set/clip");
    let job = bench.submit(request.clone()).await.unwrap().job_id;
    let copied = bucket.seen.take();
    assert_eq!(copied.iter().collect::<BTreeSet<_>>().len(), OBJECTS, "{copied:?}");
    assert_eq!(copied.len(), OBJECTS);

    // A job is known by the clip's digest.
    let by_path = bench.submit(bench.request()).await.unwrap();
    assert_eq!((by_path.job_id.as_str(), by_path.resumed), (job.as_str(), true));
    // By the URL with a slash, and after a restart.
    bench.stop().await;
    bench.restart().await;
    let again = bench.submit(from(&bench, "s3://clips/set/clip/")).await.unwrap();
    assert_eq!((again.job_id.as_str(), again.resumed), (job.as_str(), true));
    assert_eq!(bucket.seen.take(), [""; 0], "nothing is copied twice");

    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    // An image that changes is another clip; only that image is copied.
    let image = "clips/set/clip/images/cam01/frame_0002.png";
    let other = splat::image::Image::filled(8, 6, [0.9; 3]).encode_png();
    std::fs::write(bucket.folder.path().join(image), other).unwrap();
    let changed = SubmitRequest { output: bench.path("out2"), ..request };
    assert!(!bench.submit(changed).await.unwrap().resumed);
    assert_eq!(bucket.seen.take(), [format!("/{image}")]);
}

#[tokio::test]
async fn a_clip_that_changes_under_a_job_is_refused_until_the_job_has_ended() {
    let bucket = Bucket::start().await;
    let mut bench = bucket.bench(SECRET).await;
    let request = from(&bench, "s3://clips/set/clip");
    let job = bench.submit(request.clone()).await.unwrap().job_id;
    let image = "set/clip/images/cam01/frame_0002.png";
    let changed = splat::image::Image::filled(8, 6, [0.9; 3]).encode_png();
    std::fs::write(bucket.folder.path().join("clips").join(image), changed).unwrap();
    let other = SubmitRequest { output: bench.path("out2"), ..request.clone() };
    for _ in 0..2 {
        let refused = bench.submit(other.clone()).await.unwrap_err();
        assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
        for part in [job.as_str(), "cancel", "s3://clips/set/clip"] {
            assert!(refused.message().contains(part), "no {part:?} in {refused}");
        }
        // After a restart, too, when the job has not opened its clip again.
        bench.stop().await;
        bench.restart().await;
    }
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    let next = bench.submit(other).await.unwrap();
    assert!(!next.resumed && next.job_id != job);
}

#[tokio::test]
async fn people_read_the_url_and_not_the_copys_path() {
    let bucket = Bucket::start().await;
    let bench = bucket.bench(SECRET).await;
    let url = "s3://clips/set/clip";
    let request = from(&bench, "s3://clips/set/clip/");
    let job = bench.submit(request.clone()).await.unwrap().job_id;
    let listed = bench.jobs().list(ListRequest {}).await.unwrap().into_inner().jobs;
    assert_eq!(listed[0].clip, url);
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(bench.folder.path().join(name)).unwrap()).unwrap()
    };
    assert_eq!(json("out/trackersplat.json")["clip"], url);
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);
    let described = json("out/sequence.json");
    assert_eq!(described["clip"]["url"], url);
    assert!(std::path::Path::new(described["clip"]["path"].as_str().unwrap()).is_dir());

    let frames =
        SubmitRequest { first_frame: 8, last_frame: 9, output: bench.path("out2"), ..request.clone() };
    let refused = bench.submit(frames).await.unwrap_err();
    assert!(refused.message().contains(url) && !refused.message().contains(&bench.path("root")), "{refused}");
    // An image that cannot be decoded fails the job, by the object's name.
    let image = bucket.folder.path().join("clips/set/clip/images/cam01/frame_0002.png");
    let whole = std::fs::read(&image).unwrap();
    std::fs::write(&image, &whole[..whole.len() / 2]).unwrap();
    let damaged = SubmitRequest { output: bench.path("out3"), ..request };
    let job = bench.submit(damaged).await.unwrap().job_id;
    let failure = bench.ended(&job).await.1.unwrap();
    for part in [url, "images/cam01/frame_0002.png"] {
        assert!(failure.message.contains(part), "no {part:?} in {failure:?}");
    }
    assert!(!failure.message.contains(&bench.path("root")), "{failure:?}");
}

#[tokio::test]
async fn a_copy_that_is_broken_off_goes_on_where_it_was() {
    let bucket = Bucket::start().await;
    let bench = bucket.bench(SECRET).await;
    *bucket.seen.answered.lock().unwrap() = Some(5);
    let mut jobs = bench.jobs();
    let submission = jobs.submit(from(&bench, "s3://clips/set/clip"));
    // Five are finished once five more than may be under way at once were asked for.
    let enough = async {
        while bucket.seen.gets.lock().unwrap().len() < 5 + 8 {
            bucket.seen.asked.notified().await;
        }
    };
    tokio::select! {
        submitted = submission => panic!("{submitted:?}"),
        () = within(enough) => {}
    }
    bucket.seen.take();
    *bucket.seen.answered.lock().unwrap() = None;

    bench.submit(from(&bench, "s3://clips/set/clip")).await.unwrap();
    assert_eq!(bucket.seen.take().len(), OBJECTS - 5);
}

#[tokio::test]
async fn what_the_store_lacks_or_refuses_names_url_and_remedy_and_no_secret() {
    let bucket = Bucket::start().await;
    let bench = bucket.bench(SECRET).await;
    let stranger = bucket.bench("hunter3hunter3").await;
    for (bench, clip, said) in [
        (&bench, "s3://nothing/set/clip", ["NoSuchBucket", "check the bucket"]),
        (&bench, "s3://clips/set/other", ["no object", "check bucket and prefix"]),
        (&bench, "ftp://clips/set/clip", ["not supported", "s3://"]),
        (&bench, "s3://clips/set/clip?token=hunter4", ["query", "environment"]),
        (&stranger, "s3://clips/set/clip", ["403", "AWS_SECRET_ACCESS_KEY"]),
    ] {
        let status = bench.submit(from(bench, clip)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        let url = clip.split('?').next().unwrap();
        for part in [url, said[0], said[1]] {
            assert!(status.message().contains(part), "no {part:?} in {status}");
        }
        assert!(!status.message().contains("hunter"), "{status}");
        assert_eq!(bench.jobs().list(ListRequest {}).await.unwrap().into_inner().jobs, []);
    }
    // What cannot be meant is refused before anything is copied.
    let request =
        SubmitRequest { static_model: "s3://clips/static.ply".into(), ..from(&bench, "s3://clips/set/clip") };
    let status = bench.submit(request).await.unwrap_err();
    assert!(status.message().contains("static model 's3://clips/static.ply'"), "{status}");
    assert_eq!(bucket.seen.take(), [""; 0]);
}
