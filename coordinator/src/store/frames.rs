//! Views, images and frames.

use std::collections::BTreeMap;

use prost::Message;
use splat::cameras::Camera;
use sqlx::FromRow;
use trackersplat_proto::v1::{Blob, FrameJob};

use super::{Change, Store, StoreError, signed, tasks::TaskRecord, unsigned};
use crate::queue::{Task, TaskHistory, task::TaskState};

/// A view of a job's clip.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewRecord {
    /// Name in the clip.
    pub name: String,
    /// Whether it is held out for evaluation.
    pub held_out: bool,
    /// Where it was taken from.
    pub camera: Camera,
}

/// One view's stored files at one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageRecord {
    /// Position of the view.
    pub position: usize,
    /// Encoded image.
    pub image: Blob,
    /// Encoded mask.
    pub mask: Option<Blob>,
}

/// A frame as it is.
#[derive(Clone, Debug, FromRow)]
pub struct FrameRecord {
    /// Frame number.
    #[sqlx(rename = "number")]
    pub frame: u32,
    /// What it shares with every task.
    #[sqlx(flatten)]
    pub task: TaskRecord,
    request: Vec<u8>,
    /// Names the result among the artifacts.
    pub result_key: String,
    delta_digest: String,
    delta_size: i64,
    /// JSON; empty unless done.
    pub report: String,
    stage_seconds: String,
}

/// A result that is committed.
#[derive(Clone, Debug)]
pub struct CommittedFrame<'a> {
    /// The delta.
    pub delta: &'a Blob,
    /// The frame's report, JSON.
    pub report: &'a str,
    /// Who computed it.
    pub worker: &'a str,
    /// From lease to result.
    pub seconds: f64,
    /// Seconds per stage.
    pub stage_seconds: &'a BTreeMap<String, f64>,
}

impl FrameRecord {
    /// Where the frame is.
    pub fn state(&self) -> Result<TaskState, StoreError> {
        self.task.state()
    }

    /// What a worker gets.
    pub fn request(&self) -> Result<FrameJob, StoreError> {
        FrameJob::decode(self.request.as_slice())
            .map_err(|error| StoreError::Value { place: "tasks.request", value: error.to_string() })
    }

    /// What the queue must know.
    pub fn history(&self) -> Result<TaskHistory, StoreError> {
        self.task.history()
    }

    /// The committed result.
    pub fn delta(&self) -> Option<Blob> {
        let size = unsigned(self.delta_size);
        (!self.delta_digest.is_empty()).then(|| Blob { digest: self.delta_digest.clone(), size })
    }

    /// Seconds per stage of the worker.
    pub fn stage_seconds(&self) -> BTreeMap<String, f64> {
        serde_json::from_str(&self.stage_seconds).unwrap_or_default()
    }
}

/// Every frame of a job, in order.
const FRAMES: &str = "SELECT * FROM tasks WHERE job_id = ? AND kind = 'frame' ORDER BY number";

impl Store {
    /// The views of a job, in order.
    pub async fn views(&self, job: &str) -> Result<Vec<ViewRecord>, StoreError> {
        let sql = "SELECT name, held_out, camera FROM views WHERE job_id = ? ORDER BY position";
        let rows: Vec<(String, bool, String)> = sqlx::query_as(sql).bind(job).fetch_all(&self.pool).await?;
        let record = |(name, held_out, camera): (String, bool, String)| {
            let camera = serde_json::from_str(&camera)
                .map_err(|_| StoreError::Value { place: "views.camera", value: camera.clone() })?;
            Ok(ViewRecord { name, held_out, camera })
        };
        rows.into_iter().map(record).collect()
    }

    /// The stored files of one frame, in view order.
    pub async fn images(&self, job: &str, frame: u32) -> Result<Vec<ImageRecord>, StoreError> {
        let sql = "SELECT position, image_digest, image_size, mask_digest, mask_size FROM images \
                   WHERE job_id = ? AND frame = ? ORDER BY position";
        let rows: Vec<(u32, String, i64, String, i64)> =
            sqlx::query_as(sql).bind(job).bind(frame).fetch_all(&self.pool).await?;
        let record =
            |(position, digest, size, mask, mask_size): (u32, String, i64, String, i64)| ImageRecord {
                position: position as usize,
                image: Blob { digest, size: unsigned(size) },
                mask: (!mask.is_empty()).then(|| Blob { digest: mask, size: unsigned(mask_size) }),
            };
        Ok(rows.into_iter().map(record).collect())
    }

    /// The stored images of one view with their frames, in order.
    pub async fn images_of_view(&self, job: &str, position: u32) -> Result<Vec<(u32, Blob)>, StoreError> {
        let sql = "SELECT frame, image_digest, image_size FROM images WHERE job_id = ? AND position = ? \
                   ORDER BY frame";
        let query = sqlx::query_as(sql).bind(job).bind(position);
        let rows: Vec<(u32, String, i64)> = query.fetch_all(&self.pool).await?;
        let image = |(frame, digest, size)| (frame, Blob { digest, size: unsigned(size) });
        Ok(rows.into_iter().map(image).collect())
    }

    /// Every frame of a job that was published, in order.
    pub async fn frames(&self, job: &str) -> Result<Vec<FrameRecord>, StoreError> {
        Ok(sqlx::query_as(FRAMES).bind(job).fetch_all(&self.pool).await?)
    }

    /// One frame.
    pub async fn frame(&self, job: &str, frame: u32) -> Result<Option<FrameRecord>, StoreError> {
        let sql = "SELECT * FROM tasks WHERE job_id = ? AND kind = 'frame' AND number = ?";
        let query = sqlx::query_as(sql).bind(job).bind(frame);
        Ok(query.fetch_optional(&self.pool).await?)
    }

    /// Whether a job has a frame that is done.
    pub async fn has_finished_frame(&self, job: &str) -> Result<bool, StoreError> {
        let sql =
            "SELECT EXISTS (SELECT 1 FROM tasks WHERE job_id = ? AND kind = 'frame' AND state = 'done')";
        Ok(sqlx::query_scalar(sql).bind(job).fetch_one(&self.pool).await?)
    }
}

impl Change {
    /// Replaces the views of a job.
    pub async fn set_views(&mut self, job: &str, views: &[ViewRecord]) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM views WHERE job_id = ?").bind(job).execute(&mut *self.transaction).await?;
        for (position, view) in views.iter().enumerate() {
            let camera = serde_json::to_string(&view.camera)
                .map_err(|error| StoreError::Value { place: "views.camera", value: error.to_string() })?;
            let sql = "INSERT INTO views (job_id, position, name, held_out, camera) VALUES (?, ?, ?, ?, ?)";
            let query = sqlx::query(sql).bind(job).bind(signed(position as u64)).bind(&view.name);
            query.bind(view.held_out).bind(camera).execute(&mut *self.transaction).await?;
        }
        Ok(())
    }

    /// Every frame of a job that was published, in order, inside this change.
    pub async fn frames(&mut self, job: &str) -> Result<Vec<FrameRecord>, StoreError> {
        Ok(sqlx::query_as(FRAMES).bind(job).fetch_all(&mut *self.transaction).await?)
    }

    /// Records the stored files of one frame.
    pub async fn set_images(
        &mut self,
        job: &str,
        frame: u32,
        images: &[ImageRecord],
    ) -> Result<(), StoreError> {
        for record in images {
            let mask = record.mask.clone().unwrap_or_default();
            let sql = "INSERT OR REPLACE INTO images \
                       (job_id, frame, position, image_digest, image_size, mask_digest, mask_size) \
                       VALUES (?, ?, ?, ?, ?, ?, ?)";
            let query = sqlx::query(sql).bind(job).bind(frame).bind(signed(record.position as u64));
            let query = query.bind(&record.image.digest).bind(signed(record.image.size));
            let query = query.bind(&mask.digest).bind(signed(mask.size));
            query.execute(&mut *self.transaction).await?;
        }
        Ok(())
    }

    /// A frame becomes ready for the first time. A frame that is there already keeps its state.
    pub async fn publish_frame(&mut self, request: &FrameJob, result_key: &str) -> Result<(), StoreError> {
        let sql = "INSERT INTO tasks (job_id, kind, number, state, request, result_key, changed_at) \
                   VALUES (?, 'frame', ?, 'ready', ?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now')) \
                   ON CONFLICT (job_id, kind, number) \
                   DO UPDATE SET request = excluded.request, result_key = excluded.result_key";
        let query = sqlx::query(sql).bind(&request.job_id).bind(request.frame);
        query.bind(request.encode_to_vec()).bind(result_key).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A frame is done.
    pub async fn commit_frame(
        &mut self,
        job: &str,
        frame: u32,
        result: &CommittedFrame<'_>,
    ) -> Result<(), StoreError> {
        self.set_task_state(job, Task::Frame(frame), TaskState::Done).await?;
        let stage_seconds = serde_json::to_string(result.stage_seconds)
            .map_err(|error| StoreError::Value { place: "tasks.stage_seconds", value: error.to_string() })?;
        let sql = "UPDATE tasks SET delta_digest = ?, delta_size = ?, report = ?, worker = ?, seconds = ?, \
                   stage_seconds = ? WHERE job_id = ? AND kind = 'frame' AND number = ?";
        let query = sqlx::query(sql).bind(&result.delta.digest).bind(signed(result.delta.size));
        let query = query.bind(result.report).bind(result.worker).bind(result.seconds).bind(stage_seconds);
        query.bind(job).bind(frame).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// The result of a frame is gone: it is ready again, with all its attempts.
    pub async fn lose_result(&mut self, job: &str, frame: u32) -> Result<(), StoreError> {
        let sql = "UPDATE tasks SET delta_digest = '', delta_size = 0, report = '', seconds = 0, stage_seconds = '{}' \
                   WHERE job_id = ? AND kind = 'frame' AND number = ?";
        sqlx::query(sql).bind(job).bind(frame).execute(&mut *self.transaction).await?;
        self.reopen_task(job, Task::Frame(frame)).await
    }
}
