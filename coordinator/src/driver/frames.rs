//! Frame jobs are made and handed to the queue; workers do the rest.

use std::{collections::BTreeMap, sync::Arc};

use splat::{formats::ply, settings::Settings};
use trackersplat_proto::v1::{Blob, FailureKind, FrameJob, FrameView};

use super::{Job, progress::StageProgress};
use crate::{
    convert::camera_to_wire,
    failure::StageError,
    hub::FrameBase,
    keys::frame_key,
    store::{Artifact, CommittedFrame, ViewRecord},
};

/// What every frame job of a job is made of.
pub(super) struct FrameWork {
    base: Arc<FrameBase>,
    views: Vec<ViewRecord>,
}

impl Job {
    /// Publishes the frames that were not when they were tracked, and waits for all.
    pub(super) async fn compute_frames(&mut self) -> Result<(), StageError> {
        if self.published < self.frames.len() {
            let work = self.frame_work().await?;
            let ledger = if self.is_tracked() { Some(self.ledger().await?) } else { None };
            let progress = StageProgress::new(self, "publish");
            for &frame in &self.frames[self.published..] {
                let tracks = match &ledger {
                    Some(ledger) => ledger.at(frame).ok_or_else(|| tracks_gone(frame))?,
                    None => BTreeMap::new(),
                };
                self.publish_frame(&work, frame, &tracks).await?;
                let _ = progress.advance(self.frames.len() as u64);
            }
        }
        self.frames_ended().await
    }

    /// From now on results of frames can be verified.
    pub(super) async fn frame_work(&self) -> Result<FrameWork, StageError> {
        let base = self.load_base().await?;
        self.hub.set_frame_base(&self.id, base.clone()).await;
        Ok(FrameWork { base, views: self.views().await? })
    }

    /// Makes a frame ready for workers, or done if its result was computed before. `tracks` by position of the view.
    pub(super) async fn publish_frame(
        &self,
        work: &FrameWork,
        frame: u32,
        tracks: &BTreeMap<u32, Blob>,
    ) -> Result<(), StageError> {
        let request = self.frame_job(frame, work, tracks).await?;
        let key = frame_key(&request, &self.settings);
        let is_done = self.is_done(frame).await?;
        match self.held_artifact(&key).await? {
            Some(known) if !is_done => self.reuse(&work.base, &request, &key, &known).await,
            _ => self.hub.publish(&self.id, &self.stop, &request, &key).await,
        }
    }

    /// Waits until every frame is done or has failed.
    async fn frames_ended(&self) -> Result<(), StageError> {
        let mut changed = self.changed.clone();
        loop {
            changed.borrow_and_update();
            if self.hub.open_tasks(&self.id).await == 0 {
                return Ok(());
            }
            let woken = self.stop.run_until_cancelled(changed.changed()).await;
            woken.and_then(Result::ok).ok_or(StageError::Stopped)?;
        }
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

    async fn frame_job(
        &self,
        frame: u32,
        work: &FrameWork,
        tracks: &BTreeMap<u32, Blob>,
    ) -> Result<FrameJob, StageError> {
        let images = self.hub.store.images(&self.id, frame).await?;
        let mut job = FrameJob {
            job_id: self.id.to_string(),
            frame,
            settings_json: settings_json(&self.settings)?,
            static_model: Some(work.base.blob.clone()),
            key_frame: frame == self.key_frame(),
            ..FrameJob::default()
        };
        for record in images {
            let Some(view) = work.views.get(record.position) else { continue };
            let position = u32::try_from(record.position).unwrap_or(u32::MAX);
            let frame_view = FrameView {
                name: view.name.clone(),
                camera: Some(camera_to_wire(&view.camera)),
                image: Some(record.image),
                mask: record.mask,
                tracks: tracks.get(&position).cloned(),
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

fn tracks_gone(frame: u32) -> StageError {
    let message = format!("the stored tracks to frame {frame} are gone; submit the job again");
    StageError::new(FailureKind::Transient, message)
}

fn settings_json(settings: &Settings) -> Result<String, StageError> {
    serde_json::to_string(settings)
        .map_err(|error| StageError::new(FailureKind::Bug, format!("the settings as JSON: {error}")))
}
