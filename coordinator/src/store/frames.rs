//! Views, images, frames and their attempts.

use std::collections::{BTreeMap, BTreeSet};

use prost::Message;
use splat::cameras::Camera;
use sqlx::FromRow;
use trackersplat_proto::v1::{Blob, FailureKind, FrameJob};

use super::{Change, Store, StoreError, signed, unsigned};
use crate::queue::{FrameHistory, Lease, frame::FrameState};

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
    pub frame: u32,
    state: String,
    /// Leases given.
    pub attempts: u32,
    /// Attempts that failed.
    pub failures: u32,
    excluded: String,
    /// Worker of the last attempt.
    pub worker: String,
    request: Vec<u8>,
    /// Names the result among the artifacts.
    pub result_key: String,
    delta_digest: String,
    delta_size: i64,
    /// JSON; empty unless done.
    pub report: String,
    /// From lease to result.
    pub seconds: f64,
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

/// How an attempt ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttemptOutcome<'a> {
    /// Its result is committed.
    Done,
    /// Given back through no fault of the frame.
    Released(&'a str),
    /// The job was cancelled.
    Cancelled,
    /// It failed.
    Failed(FailureKind, &'a str),
}

impl FrameRecord {
    /// Where the frame is.
    pub fn state(&self) -> Result<FrameState, StoreError> {
        FrameState::from_label(&self.state)
            .ok_or_else(|| StoreError::Value { place: "frames.state", value: self.state.clone() })
    }

    /// What a worker gets.
    pub fn request(&self) -> Result<FrameJob, StoreError> {
        FrameJob::decode(self.request.as_slice())
            .map_err(|error| StoreError::Value { place: "frames.request", value: error.to_string() })
    }

    /// What the queue must know.
    pub fn history(&self) -> Result<FrameHistory, StoreError> {
        let excluded: BTreeSet<String> = serde_json::from_str(&self.excluded)
            .map_err(|_| StoreError::Value { place: "frames.excluded", value: self.excluded.clone() })?;
        Ok(FrameHistory { attempts: self.attempts, failures: self.failures, excluded })
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
const FRAMES: &str = "SELECT * FROM frames WHERE job_id = ? ORDER BY frame";

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

    /// Every frame of a job that was published, in order.
    pub async fn frames(&self, job: &str) -> Result<Vec<FrameRecord>, StoreError> {
        Ok(sqlx::query_as(FRAMES).bind(job).fetch_all(&self.pool).await?)
    }

    /// One frame.
    pub async fn frame(&self, job: &str, frame: u32) -> Result<Option<FrameRecord>, StoreError> {
        let query =
            sqlx::query_as("SELECT * FROM frames WHERE job_id = ? AND frame = ?").bind(job).bind(frame);
        Ok(query.fetch_optional(&self.pool).await?)
    }

    /// Whether a job has a frame that is done.
    pub async fn has_finished_frame(&self, job: &str) -> Result<bool, StoreError> {
        let sql = "SELECT EXISTS (SELECT 1 FROM frames WHERE job_id = ? AND state = 'done')";
        Ok(sqlx::query_scalar(sql).bind(job).fetch_one(&self.pool).await?)
    }

    /// Whether a lease's result was committed, for a report that comes again.
    pub async fn was_committed(&self, lease_id: &str, attempt: u32) -> Result<bool, StoreError> {
        let sql = "SELECT COUNT(*) FROM attempts WHERE lease_id = ? AND attempt = ? AND outcome = 'done'";
        let query = sqlx::query_scalar(sql).bind(lease_id).bind(attempt);
        let count: i64 = query.fetch_one(&self.pool).await?;
        Ok(count > 0)
    }

    /// Kind and message of a frame's last failed attempt.
    pub async fn last_failure(
        &self,
        job: &str,
        frame: u32,
    ) -> Result<Option<(FailureKind, String)>, StoreError> {
        let sql = "SELECT outcome, message FROM attempts WHERE job_id = ? AND frame = ? \
                   AND outcome NOT IN ('running', 'done', 'released', 'cancelled') ORDER BY attempt DESC LIMIT 1";
        let query = sqlx::query_as(sql).bind(job).bind(frame);
        let row: Option<(String, String)> = query.fetch_optional(&self.pool).await?;
        Ok(row.map(|(kind, message)| (FailureKind::from_label(&kind), message)))
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
        let sql = "INSERT INTO frames (job_id, frame, state, request, result_key, changed_at) \
                   VALUES (?, ?, 'ready', ?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now')) \
                   ON CONFLICT (job_id, frame) DO UPDATE SET request = excluded.request";
        let query = sqlx::query(sql).bind(&request.job_id).bind(request.frame);
        query.bind(request.encode_to_vec()).bind(result_key).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A frame's new state.
    pub async fn set_frame_state(
        &mut self,
        job: &str,
        frame: u32,
        state: FrameState,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE frames SET state = ?, changed_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') \
                   WHERE job_id = ? AND frame = ?";
        let query = sqlx::query(sql).bind(state.label()).bind(job).bind(frame);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A worker got the lease of a frame.
    pub async fn grant(&mut self, lease: &Lease) -> Result<(), StoreError> {
        let (job, frame) = (&*lease.key.job, lease.key.frame);
        self.set_frame_state(job, frame, FrameState::Leased).await?;
        let sql = "UPDATE frames SET attempts = ?, worker = ? WHERE job_id = ? AND frame = ?";
        let query = sqlx::query(sql).bind(lease.attempt).bind(&lease.worker_id).bind(job).bind(frame);
        query.execute(&mut *self.transaction).await?;
        let sql = "INSERT INTO attempts (job_id, frame, attempt, lease_id, worker, granted_at) \
                   VALUES (?, ?, ?, ?, ?, strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))";
        let query = sqlx::query(sql).bind(job).bind(frame).bind(lease.attempt).bind(&lease.id);
        query.bind(&lease.worker_id).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// An attempt ended.
    pub async fn end_attempt(
        &mut self,
        lease_id: &str,
        outcome: AttemptOutcome<'_>,
    ) -> Result<(), StoreError> {
        let (label, message) = match outcome {
            AttemptOutcome::Done => ("done", ""),
            AttemptOutcome::Released(reason) => ("released", reason),
            AttemptOutcome::Cancelled => ("cancelled", ""),
            AttemptOutcome::Failed(kind, message) => (kind.label(), message),
        };
        let sql = "UPDATE attempts SET outcome = ?, message = ?, \
                   ended_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE lease_id = ?";
        let query = sqlx::query(sql).bind(label).bind(message).bind(lease_id);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Counts a failed attempt of a frame; `excluded` names the worker that must not get it again.
    pub async fn count_failure(
        &mut self,
        job: &str,
        frame: u32,
        excluded: Option<&str>,
    ) -> Result<(), StoreError> {
        // The worker is appended to the JSON list.
        let sql = "UPDATE frames SET failures = failures + 1, \
                   excluded = CASE WHEN ?1 = '' THEN excluded ELSE json_insert(excluded, '$[#]', ?1) END \
                   WHERE job_id = ?2 AND frame = ?3";
        let query = sqlx::query(sql).bind(excluded.unwrap_or_default()).bind(job).bind(frame);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// A frame is done.
    pub async fn commit_frame(
        &mut self,
        job: &str,
        frame: u32,
        result: &CommittedFrame<'_>,
    ) -> Result<(), StoreError> {
        self.set_frame_state(job, frame, FrameState::Done).await?;
        let stage_seconds = serde_json::to_string(result.stage_seconds)
            .map_err(|error| StoreError::Value { place: "frames.stage_seconds", value: error.to_string() })?;
        let sql = "UPDATE frames SET delta_digest = ?, delta_size = ?, report = ?, worker = ?, seconds = ?, \
                   stage_seconds = ? WHERE job_id = ? AND frame = ?";
        let query = sqlx::query(sql).bind(&result.delta.digest).bind(signed(result.delta.size));
        let query = query.bind(result.report).bind(result.worker).bind(result.seconds).bind(stage_seconds);
        query.bind(job).bind(frame).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Gives the failed and cancelled frames of a job all their attempts again. Returns them.
    pub async fn reopen_frames(&mut self, job: &str) -> Result<Vec<u32>, StoreError> {
        let sql = "UPDATE frames SET state = 'ready', failures = 0, excluded = '[]', \
                   changed_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') \
                   WHERE job_id = ? AND state IN ('failed', 'cancelled') RETURNING frame";
        Ok(sqlx::query_scalar(sql).bind(job).fetch_all(&mut *self.transaction).await?)
    }

    /// The result of a frame is gone: it is ready again, with all its attempts.
    pub async fn lose_result(&mut self, job: &str, frame: u32) -> Result<(), StoreError> {
        self.set_frame_state(job, frame, FrameState::Ready).await?;
        let sql = "UPDATE frames SET failures = 0, excluded = '[]', delta_digest = '', delta_size = 0, report = '', \
                   seconds = 0, stage_seconds = '{}' WHERE job_id = ? AND frame = ?";
        sqlx::query(sql).bind(job).bind(frame).execute(&mut *self.transaction).await?;
        self.append_ready_event(job, frame).await
    }

    /// Leases of a coordinator that is gone: `(job, frame, attempt, lease, worker)`.
    pub async fn orphaned_leases(&mut self) -> Result<Vec<(String, u32, u32, String, String)>, StoreError> {
        let sql = "SELECT job_id, frame, attempt, lease_id, worker FROM attempts WHERE outcome = 'running' \
                   ORDER BY job_id, frame";
        Ok(sqlx::query_as(sql).fetch_all(&mut *self.transaction).await?)
    }
}

impl Change {
    /// A lease is void through no fault of the frame: it is ready again.
    pub async fn release_frame(
        &mut self,
        job: &str,
        frame: u32,
        attempt: u32,
        worker: &str,
    ) -> Result<(), StoreError> {
        self.set_frame_state(job, frame, FrameState::Ready).await?;
        let event = super::events::FrameEvent { frame, attempt, worker, ..Default::default() };
        self.append_frame_event(job, FrameState::Ready, &event).await?;
        Ok(())
    }

    /// Appends that a frame waits for a worker.
    pub async fn append_ready_event(&mut self, job: &str, frame: u32) -> Result<(), StoreError> {
        let event = super::events::FrameEvent { frame, ..Default::default() };
        self.append_frame_event(job, FrameState::Ready, &event).await?;
        Ok(())
    }
}
