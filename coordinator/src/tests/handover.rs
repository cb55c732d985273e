#![allow(clippy::unwrap_used, reason = "tests")]
//! Views that a worker and the coordinator track in turn: the state that goes from one to the other.

use std::{collections::BTreeMap, sync::Arc};

use splat::{
    formats::{track_blob, track_state},
    image::Image,
    tracking::{TrackState, Tracker, TrackingSettings},
};
use trackersplat_proto::v1::{
    Blob, JobState, Lease, TaskState, Tracked, TrackedField, job_event::Event, report::Outcome,
};

use super::{harness::*, own_tracks::tracking_alone_on, windows::*};
use crate::{failure::StageError, ledger::TrackLedger};

/// [`bench`] with something to see in its images.
async fn textured() -> Bench {
    let bench = bench().await;
    for (shift, view) in [0.3, 0.5, 0.7, 0.9].into_iter().zip(["cam00", "cam01", "cam02", "test00"]) {
        for frame in 1..=7 {
            let mut image = Image::filled(8, 6, [0.0; 3]);
            for (index, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
                let (x, y) = ((index % 8) as f32 - shift * frame as f32, (index / 8) as f32);
                pixel.fill(0.5 + 0.25 * (x * 0.9).sin() + 0.25 * (y * 0.7).cos());
            }
            let file = bench.folder.path().join(format!("clip/images/{view}/frame_{frame:04}.png"));
            std::fs::write(file, image.encode_png()).unwrap();
        }
    }
    bench
}

/// What a worker reports that does as it is told, on what the lease names.
async fn tracked(bench: &Bench, lease: &Lease) -> Tracked {
    let job = track_job(lease);
    let settings_json = job.tracker.clone().unwrap().settings_json;
    let settings: TrackingSettings = serde_json::from_str(&settings_json).unwrap();
    let mut images = BTreeMap::new();
    for place in 0..job.window().end {
        if let Some(image) = job.frame_at(place).and_then(|frame| frame.image.as_ref()) {
            let image = Image::decode(&bench.get(&image.digest).await.unwrap()).unwrap();
            images.insert(place, Arc::new(image));
        }
    }
    let from = match &job.state {
        Some(blob) => track_state::decode(&bench.get(&blob.digest).await.unwrap()).unwrap(),
        None => TrackState::default(),
    };
    let mut found = Vec::new();
    let mut load = |place: usize| Ok::<_, StageError>(images[&place].clone());
    let mut emit = |place: usize, field| {
        found.push((job.frame_at(place).unwrap().frame, track_blob::encode(&field)));
        Ok(())
    };
    let after = Tracker::BuiltIn.track_window(from, job.window(), &|_| true, &mut load, &settings, &mut emit);
    let after = after.ok().unwrap();
    let mut fields = Vec::new();
    for (frame, encoded) in found {
        fields.push(TrackedField { frame, tracks: Some(bench.put(encoded).await) });
    }
    let state = match job.wants_state {
        true => Some(bench.put(track_state::encode(&after)).await),
        false => None,
    };
    Tracked { fields, state }
}

impl Worker {
    /// Tracks the next window, once the frames before it are done.
    async fn track(&mut self, bench: &Bench) -> Lease {
        let lease = self.window(bench).await;
        let outcome = Outcome::Tracked(tracked(bench, &lease).await);
        let receipt = self.report(&lease, outcome).await;
        assert!(receipt.accepted, "{receipt:?}");
        lease
    }
}

/// The fields of a job that is tracked, by frame and position.
async fn fields(bench: &Bench, job: &str) -> Vec<Option<BTreeMap<u32, Blob>>> {
    let all = |ledger: &TrackLedger| (2..=7).map(|frame| ledger.at(frame)).collect();
    bench.hub().tracks(&job.into(), all).await.unwrap()
}

fn is_tracked(event: &Event) -> bool {
    matches!(event, Event::JobState(j) if j.state() == JobState::Frames)
}

/// The fields that the coordinator alone finds, of views that are not cut.
async fn expected() -> Vec<Option<BTreeMap<u32, Blob>>> {
    let bench = textured().await;
    let job = bench.submit(request(&bench, 16)).await.unwrap().job_id;
    bench.watch(&job, 0).await.until(is_tracked).await;
    fields(&bench, &job).await
}

#[tokio::test]
async fn the_coordinator_goes_on_from_the_states_of_workers() {
    let bench = textured().await;
    let mut worker = bench.worker("w").await;
    let job = bench.submit(request(&bench, 2)).await.unwrap().job_id;
    for view in ["cam00", "cam01", "cam02"] {
        assert_eq!(leased(&worker.track(&bench).await), (view.into(), vec![2, 3]));
    }
    drop(worker);
    let mut done = Vec::new();
    let mut watch = bench.watch(&job, 0).await;
    watch
        .until(|event| {
            if let Event::TracksState(tracks) = event
                && tracks.state() == TaskState::Done
            {
                done.push((tracks.view.clone(), tracks.worker_id.clone(), tracks.attempt));
            }
            is_tracked(event)
        })
        .await;
    done.sort();
    let by_itself = |view: &str| (view.to_owned(), crate::queue::OWN_NAME.to_owned(), 3);
    assert_eq!(done, ["cam00", "cam01", "cam02"].map(by_itself), "its are the second and third windows");
    assert_eq!(fields(&bench, &job).await, expected().await);
}

#[tokio::test]
async fn workers_go_on_from_the_states_of_the_coordinator() {
    let bench = textured().await;
    let (job, mut watch, busy) = tracking_alone_on(&bench, request(&bench, 2)).await;
    let mut worker = bench.worker("w").await;
    drop(busy);
    // The coordinator finishes the window that it has begun.
    let goes_on = |event: &Event| matches!(event, Event::TracksState(t) if t.view == "cam00" && t.attempt == 1 && t.state() == TaskState::Ready);
    watch.until(goes_on).await;
    let mut windows = Vec::new();
    while windows.len() < 8 {
        let lease = worker.track(&bench).await;
        let job = track_job(&lease);
        assert_eq!(job.state.is_some(), job.first > 1, "{:?}", leased(&lease));
        windows.push(leased(&lease));
    }
    assert!(!windows.contains(&("cam00".into(), vec![2, 3])), "{windows:?}");
    assert!(windows.contains(&("cam00".into(), vec![4, 5])), "{windows:?}");
    watch.until(is_tracked).await;
    assert_eq!(fields(&bench, &job).await, expected().await);
}
