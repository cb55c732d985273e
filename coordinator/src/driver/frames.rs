//! Frame jobs are made and handed to the queue; workers do the rest.

use std::{collections::BTreeMap, sync::Arc};

use splat::{
    formats::ply,
    settings::{MotionSource, Settings},
};
use trackersplat_proto::v1::{Blob, FailureKind, FrameJob, FrameView};

use super::{Job, progress::StageProgress};
use crate::{
    convert::camera_to_wire,
    failure::StageError,
    hub::FrameBase,
    keys::frame_key,
    store::{Artifact, CommittedFrame, ViewRecord},
};

impl Job {
    pub(super) async fn compute_frames(&mut self) -> Result<(), StageError> {
        let base = self.load_base().await?;
        self.hub.set_frame_base(&self.id, base.clone()).await;
        let views = self.views().await?;
        let tracks = self.all_tracks(&views).await?;
        let progress = StageProgress::new(self, "publish");
        for &frame in &self.frames {
            let request = self.frame_job(frame, &base.blob, &views, &tracks).await?;
            let key = frame_key(&request, &self.settings);
            let is_done = self.is_done(frame).await?;
            match self.held_artifact(&key).await? {
                Some(known) if !is_done => self.reuse(&base, &request, &key, &known).await?,
                _ => self.hub.publish(&self.id, &self.stop, &request, &key).await?,
            }
            let _ = progress.advance(self.frames.len() as u64);
        }
        self.frames_ended().await
    }

    /// Waits until every frame is done or has failed.
    async fn frames_ended(&self) -> Result<(), StageError> {
        while self.hub.open_frames(&self.id).await > 0 {
            let ended = self.stop.run_until_cancelled(self.frame_ended.notified()).await;
            ended.ok_or(StageError::Stopped)?;
        }
        Ok(())
    }

    /// Whether a frame has its result. A result whose bytes are gone is given up.
    async fn is_done(&self, frame: u32) -> Result<bool, StageError> {
        let record = self.hub.store.frame(&self.id, frame).await?;
        let Some(delta) = record.and_then(|record| record.delta()) else { return Ok(false) };
        if self.hub.blobs.holds(&delta).await {
            return Ok(true);
        }
        self.hub.lose_result(&self.id, &self.stop, frame).await?;
        Ok(false)
    }

    /// The static model, decoded: results are verified against it.
    pub(super) async fn load_base(&self) -> Result<Arc<FrameBase>, StageError> {
        let record = self.hub.store.job(&self.id).await?.ok_or(StageError::Stopped)?;
        let blob = record
            .static_model()
            .ok_or_else(|| StageError::new(FailureKind::Bug, "the job has no static model yet"))?;
        let digest = *blake3::Hash::from_hex(&blob.digest)
            .map_err(|error| StageError::new(FailureKind::Bug, format!("the static model's name: {error}")))?
            .as_bytes();
        let bytes = self.hub.blobs.get(&blob).await?;
        let decode = move || {
            ply::parse_ply(&bytes).map_err(|error| {
                StageError::new(FailureKind::Bug, format!("the stored static model: {error}"))
            })
        };
        let model = self.hub.compute.run(decode).await?;
        Ok(Arc::new(FrameBase { model, blob, digest, output: record.output.into() }))
    }

    /// Tracks by view position and frame number; empty where the motion is not tracked.
    async fn all_tracks(&self, views: &[ViewRecord]) -> Result<Vec<BTreeMap<u32, Blob>>, StageError> {
        let mut tracks = vec![BTreeMap::new(); views.len()];
        if self.settings.motion_source == MotionSource::None {
            return Ok(tracks);
        }
        for (position, view) in views.iter().enumerate().filter(|(_, view)| !view.held_out) {
            tracks[position] = self.tracks_of(position, &view.name).await?.ok_or_else(|| {
                let message =
                    format!("the stored tracks of view '{}' are gone; submit the job again", view.name);
                StageError::new(FailureKind::Transient, message)
            })?;
        }
        Ok(tracks)
    }

    async fn frame_job(
        &self,
        frame: u32,
        static_model: &Blob,
        views: &[ViewRecord],
        tracks: &[BTreeMap<u32, Blob>],
    ) -> Result<FrameJob, StageError> {
        let images = self.hub.store.images(&self.id, frame).await?;
        let mut job = FrameJob {
            job_id: self.id.to_string(),
            frame,
            settings_json: settings_json(&self.settings)?,
            static_model: Some(static_model.clone()),
            key_frame: frame == self.key_frame(),
            ..FrameJob::default()
        };
        for record in images {
            let (Some(view), Some(view_tracks)) = (views.get(record.position), tracks.get(record.position))
            else {
                continue;
            };
            let frame_view = FrameView {
                name: view.name.clone(),
                camera: Some(camera_to_wire(&view.camera)),
                image: Some(record.image),
                mask: record.mask,
                tracks: view_tracks.get(&frame).cloned(),
            };
            if view.held_out { job.test_views.push(frame_view) } else { job.training_views.push(frame_view) }
        }
        Ok(job)
    }

    async fn reuse(
        &self,
        base: &Arc<FrameBase>,
        request: &FrameJob,
        key: &str,
        known: &Artifact,
    ) -> Result<(), StageError> {
        let bytes = self.hub.blobs.get(&known.blob).await?;
        self.hub.write_frame(base.clone(), request.frame, bytes).await?;
        let result = CommittedFrame {
            delta: &known.blob,
            report: &known.note,
            worker: "",
            seconds: 0.0,
            stage_seconds: &BTreeMap::new(),
        };
        self.hub.reuse(&self.id, &self.stop, request, key, &result).await
    }
}

fn settings_json(settings: &Settings) -> Result<String, StageError> {
    serde_json::to_string(settings)
        .map_err(|error| StageError::new(FailureKind::Bug, format!("the settings as JSON: {error}")))
}
