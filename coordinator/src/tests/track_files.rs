#![allow(clippy::unwrap_used, reason = "tests")]
//! Which track file is imported for which view.

use std::path::Path;

use splat::formats::{track_blob, track_npz::TrackNpzWriter};
use tonic::Code;
use trackersplat_proto::v1::{JobState, SubmitRequest, TrackFiles, submit_request::Tracks};

use super::{
    harness::*,
    tracks::{shifted, tracked_request},
};

/// Tracks to frames 2 and 3 that move by `x` and twice that.
fn write_tracks(path: &Path, x: f32) {
    let mut writer = TrackNpzWriter::create(path, 3, 8, 6).unwrap();
    writer.push(&shifted(8, x)).unwrap();
    writer.push(&shifted(8, 2.0 * x)).unwrap();
    writer.finish().unwrap();
}

fn with_files(bench: &Bench, names: &[&str]) -> SubmitRequest {
    let paths = names.iter().map(|name| bench.path(name)).collect();
    SubmitRequest { tracks: Some(Tracks::TrackFiles(TrackFiles { paths })), ..tracked_request(bench) }
}

#[tokio::test]
async fn files_go_to_the_views_of_their_names_and_further_ones_are_ignored() {
    let bench = Bench::start().await;
    for (name, x) in [("cam00", 1.0), ("cam01", 2.0), ("cam02", 3.0), ("test00", 4.0)] {
        write_tracks(Path::new(&bench.path(&format!("{name}.npz"))), x);
    }
    let mut worker = bench.worker("w0").await;
    let all = with_files(&bench, &["test00.npz", "cam02.npz", "cam00.npz", "cam01.npz"]);
    let job = bench.submit(all).await.unwrap().job_id;
    for frame in [1, 2, 3] {
        let lease = worker.lease().await;
        assert_eq!(frame_job(&lease).frame, frame);
        if frame > 1 {
            let views = frame_job(&lease).training_views;
            let found: Vec<_> = views.into_iter().map(|view| view.tracks.unwrap().digest).collect();
            let field = |x: f32| track_blob::encode(&shifted(8, x * (frame - 1) as f32));
            let expected = [1.0, 2.0, 3.0].map(|x| crate::blobs::name(&field(x)).digest);
            assert_eq!(found, expected);
        }
        let success = bench.result(&lease).await;
        let outcome = trackersplat_proto::v1::report::Outcome::Success(success);
        assert!(worker.report(&lease, outcome).await.accepted);
    }
    assert_eq!(bench.ended(&job).await.0, JobState::Done);

    // The same files for the same views are the same job, however they come.
    let chosen = with_files(&bench, &["cam00.npz", "cam01.npz", "cam02.npz"]);
    let again = bench.submit(chosen).await.unwrap();
    assert_eq!((again.job_id, again.resumed), (job, true));
}

#[tokio::test]
async fn files_that_cannot_be_given_to_views_without_guessing_are_refused() {
    let bench = Bench::start().await;
    for name in ["cam00", "cam02", "test00", "any"] {
        write_tracks(Path::new(&bench.path(&format!("{name}.npz"))), 1.0);
    }
    // By order cam01 would be given the tracks of cam02, and cam02 those of the held-out view.
    for names in [&["cam00.npz", "cam02.npz", "test00.npz"][..], &["cam00.npz", "any.npz"]] {
        let status = bench.submit(with_files(&bench, names)).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument);
        for part in [names[1], "'cam01'", "cam00, cam01, cam02", "named after the views"] {
            assert!(status.message().contains(part), "{part} in: {}", status.message());
        }
    }
}
