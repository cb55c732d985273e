#![allow(clippy::unwrap_used, reason = "tests")]

use tonic::Code;
use trackersplat_proto::v1::{JobState, SubmitRequest};

use super::harness::*;

fn owner(bench: &Bench) -> String {
    let marker = std::fs::read(bench.folder.path().join("out/trackersplat.json")).unwrap();
    let marker: serde_json::Value = serde_json::from_slice(&marker).unwrap();
    marker["job_id"].as_str().unwrap().to_owned()
}

fn seeded(bench: &Bench) -> SubmitRequest {
    SubmitRequest { settings_json: r#"{"motion_source": "none", "seed": 1}"#.into(), ..bench.request() }
}

#[tokio::test]
async fn a_job_that_finished_no_frame_leaves_its_folder_to_the_repaired_clip() {
    let mut bench = Bench::start().await;
    let image = bench.folder.path().join("clip/images/cam01/frame_0002.png");
    let whole = std::fs::read(&image).unwrap();
    std::fs::write(&image, &whole[..whole.len() / 2]).unwrap();
    let damaged = bench.submitted().await;
    assert_eq!(bench.ended(&damaged).await.0, JobState::Failed);
    assert_eq!(owner(&bench), damaged);

    std::fs::write(&image, &whole).unwrap();
    let repaired = bench.submitted().await;
    assert_ne!(repaired, damaged);
    assert_eq!(owner(&bench), repaired);
    bench.stop().await;
    bench.restart().await;
    let again = bench.submit(bench.request()).await.unwrap();
    assert_eq!((again.job_id.as_str(), again.resumed), (repaired.as_str(), true));
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        worker.work_once(&bench).await;
    }
    assert_eq!(bench.ended(&repaired).await.0, JobState::Done);

    // Now there is something to lose: neither the old job nor another may have the folder.
    let refused = bench.submit(seeded(&bench)).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    std::fs::write(&image, &whole[..whole.len() / 2]).unwrap();
    let refused = bench.submit(bench.request()).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert_eq!(owner(&bench), repaired);
}

#[tokio::test]
async fn a_job_whose_frames_all_failed_leaves_its_folder_to_the_next() {
    let bench = Bench::start().await;
    let failed = bench.submitted().await;
    let mut worker = bench.worker("w").await;
    for _ in 0..3 {
        let lease = worker.lease().await;
        worker.fail(&lease, trackersplat_proto::v1::FailureKind::BadInput).await;
    }
    assert_eq!(bench.ended(&failed).await.0, JobState::Failed);
    let described = bench.folder.path().join("out/sequence.json");
    assert!(described.exists(), "it is assembled all the same");
    let next = bench.submit(seeded(&bench)).await.unwrap().job_id;
    assert_eq!(owner(&bench), next);
    assert!(!described.exists(), "it describes nothing that is there");
}

#[tokio::test]
async fn the_folder_of_a_job_that_goes_on_is_refused() {
    let mut bench = Bench::start().await;
    let job = bench.submitted().await;
    bench.stop().await;
    bench.restart().await;
    let refused = bench.submit(seeded(&bench)).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert_eq!(owner(&bench), job);
    assert_eq!(bench.worker("w").await.work_once(&bench).await, 1);
}

#[tokio::test]
async fn a_run_replaces_what_an_earlier_run_left_behind_without_a_finished_frame() {
    let mut bench = Bench::start_with(|options| options.replaces_abandoned_jobs = true).await;
    let abandoned = bench.submitted().await;
    bench.stop().await;
    bench.restart().await;
    let job = bench.submit(seeded(&bench)).await.unwrap().job_id;
    assert_eq!(bench.ended(&abandoned).await.0, JobState::Cancelled);
    assert_eq!(owner(&bench), job);
    let mut worker = bench.worker("w").await;
    let lease = worker.lease().await;
    assert_eq!(frame_job(&lease).job_id, job);
    let success = bench.result(&lease).await;
    let outcome = trackersplat_proto::v1::report::Outcome::Success(success);
    assert!(worker.report(&lease, outcome).await.accepted);
    drop(worker);

    bench.stop().await;
    bench.restart().await;
    let refused = bench.submit(bench.request()).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(bench.submit(seeded(&bench)).await.unwrap().resumed, "it was not cancelled");
    assert_eq!(owner(&bench), job);
}
