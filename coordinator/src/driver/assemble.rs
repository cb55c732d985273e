//! Assembly: the finished frames become the job's outputs.

use std::{collections::BTreeMap, path::PathBuf, sync::Arc};

use splat::image::Image;
use trackersplat_proto::v1::{Blob, FailureKind};

use super::Job;
use crate::{
    assembly::{
        self, AssembledFrame, AssembledView, AssemblyInput, delta_path, frame_path, sequence::SequenceClip,
    },
    failure::StageError,
    hub::{FrameBase, Hub},
    queue::{Task, task::TaskState},
    store::{FrameRecord, ViewRecord},
};

/// What the outputs are made of, owned, so that it can go to another thread.
struct Parts {
    base: Arc<FrameBase>,
    static_ply: bytes::Bytes,
    static_report: serde_json::Value,
    frames: Vec<AssembledFrame>,
    views: Vec<ViewRecord>,
    /// By view name and frame number.
    test_images: BTreeMap<(String, u32), Blob>,
    stage_seconds: BTreeMap<String, f64>,
    bytes: BTreeMap<String, u64>,
}

impl Job {
    pub(super) async fn assemble(&mut self) -> Result<(), StageError> {
        self.hub.progress(&self.id, "assembly", 0, 1);
        let records = self.hub.store.frames(&self.id).await?;
        let parts = self.parts(&records).await?;
        let (hub, settings) = (self.hub.clone(), self.settings.clone());
        let job_id = self.id.to_string();
        let clip = SequenceClip {
            path: PathBuf::from(&self.record.clip),
            url: self.request.clip_url.clone(),
            digest: self.record.clip_digest.clone(),
        };
        let runtime = tokio::runtime::Handle::current();
        let write = move || {
            let test_image =
                |view: &str, frame: u32| load_image(&hub, &runtime, &parts.test_images, view, frame);
            let views = parts.views.into_iter();
            let input = AssemblyInput {
                output: parts.base.output.clone(),
                job_id,
                clip,
                settings: &settings,
                static_ply: parts.static_ply,
                static_report: parts.static_report,
                frames: parts.frames,
                views: views
                    .map(|ViewRecord { name, held_out, camera }| AssembledView { name, held_out, camera })
                    .collect(),
                test_image: &test_image,
                engine: hub.engine.as_ref(),
                stage_seconds: parts.stage_seconds,
                bytes: parts.bytes,
            };
            assembly::write_outputs(&input)
                .map_err(|error| StageError::new(FailureKind::Transient, error.to_string()))
        };
        let _turn = self.turn().await?;
        self.hub.compute.run(write).await?;
        self.hub.progress(&self.id, "assembly", 1, 1);
        self.failed_frames(&records).await
    }

    async fn parts(&self, records: &[FrameRecord]) -> Result<Parts, StageError> {
        let base = self.load_base().await?;
        let views = self.views().await?;
        let (mut image_bytes, mut track_bytes, mut delta_bytes) = (0, 0, 0);
        let mut test_images = BTreeMap::new();
        for &frame in &self.frames {
            for record in self.hub.store.images(&self.id, frame).await? {
                image_bytes += record.image.size + record.mask.map_or(0, |mask| mask.size);
                if let Some(view) = views.get(record.position).filter(|view| view.held_out) {
                    test_images.insert((view.name.clone(), frame), record.image);
                }
            }
        }
        let mut frames = Vec::new();
        for record in records {
            let training = record.request()?.training_views;
            track_bytes +=
                training.into_iter().filter_map(|view| view.tracks).map(|tracks| tracks.size).sum::<u64>();
            let frame = self.assembled(record, &base).await?;
            delta_bytes += frame.delta.as_ref().map_or(0, |delta| delta.len() as u64);
            frames.push(frame);
        }
        let bytes = [
            ("images", image_bytes),
            ("tracks", track_bytes),
            ("static_model", base.blob.size),
            ("deltas", delta_bytes),
        ];
        let job = self.hub.store.job(&self.id).await?.ok_or(StageError::Stopped)?;
        Ok(Parts {
            static_ply: self.hub.blobs.get(&base.blob).await?,
            static_report: serde_json::from_str(&job.static_report).unwrap_or_default(),
            stage_seconds: self.hub.store.stage_seconds(&self.id).await?,
            base,
            frames,
            views,
            test_images,
            bytes: bytes.map(|(what, size)| (what.to_owned(), size)).into(),
        })
    }

    /// One frame with its delta; its file is written again if somebody removed it.
    async fn assembled(
        &self,
        record: &FrameRecord,
        base: &Arc<FrameBase>,
    ) -> Result<AssembledFrame, StageError> {
        let delta = match record.delta() {
            Some(blob) => Some(self.hub.blobs.get(&blob).await?),
            None => None,
        };
        let exists = |file: PathBuf| base.output.join(file).exists();
        if let Some(delta) = &delta
            && !(exists(frame_path(record.frame)) && exists(delta_path(record.frame)))
        {
            self.hub.write_frame(base.clone(), record.frame, delta.clone()).await?;
        }
        Ok(AssembledFrame {
            number: record.frame,
            state: record.state()?,
            attempts: record.task.attempts,
            worker: record.task.worker.clone(),
            report: serde_json::from_str(&record.report).ok(),
            seconds: record.task.seconds,
            stage_seconds: record.stage_seconds(),
            delta,
        })
    }

    /// A job with failed frames has failed, though the others are there.
    async fn failed_frames(&self, records: &[FrameRecord]) -> Result<(), StageError> {
        let mut failed = Vec::new();
        for record in records {
            if record.state()? == TaskState::Failed {
                failed.push(record.frame);
            }
        }
        let Some(&first) = failed.first() else { return Ok(()) };
        let why = self.hub.store.last_failure(&self.id, Task::Frame(first)).await?;
        let (kind, reason) =
            why.unwrap_or((FailureKind::OutOfResources, "no worker has the memory for it".into()));
        let message = format!(
            "{} of {} frames failed: {failed:?}; frame {first}: {reason}; the others are in {}",
            failed.len(),
            records.len(),
            self.record.output
        );
        Err(StageError::new(kind, message))
    }
}

/// Runs on a thread of the compute pool, where waiting is allowed.
fn load_image(
    hub: &Hub,
    runtime: &tokio::runtime::Handle,
    images: &BTreeMap<(String, u32), Blob>,
    view: &str,
    frame: u32,
) -> Option<Image> {
    let blob = images.get(&(view.to_owned(), frame))?;
    let bytes = runtime.block_on(hub.blobs.get(blob));
    let image = bytes
        .map_err(|error| error.to_string())
        .and_then(|bytes| Image::decode(&bytes).map_err(|error| error.to_string()));
    image
        .inspect_err(|reason| tracing::warn!(view, frame, reason, "a test image is left out of the outputs"))
        .ok()
}
