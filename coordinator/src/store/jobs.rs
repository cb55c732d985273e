//! Jobs and how long their stages took.

use std::collections::BTreeMap;

use sqlx::FromRow;
use trackersplat_proto::v1::{Blob, Failure};

use super::{Change, Store, StoreError, signed, unsigned};
use crate::queue::job::JobState;

/// A job as it is submitted.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// Sorts by time of submission.
    pub id: String,
    /// Path of the clip.
    pub clip: String,
    /// Digest of its content.
    pub clip_digest: String,
    /// Folder of the results.
    pub output: String,
    /// The folder as it was asked for; empty: the coordinator chose.
    pub output_request: String,
    /// Every setting, JSON.
    pub settings: String,
    /// Over everything but clip and output.
    pub settings_digest: String,
    /// What else was asked for, JSON.
    pub request: String,
    /// Frame numbers, JSON list; the first is the key frame.
    pub frame_numbers: String,
}

/// A job as it is.
#[derive(Clone, Debug, FromRow)]
pub struct JobRecord {
    /// Sorts by time of submission.
    pub id: String,
    state: String,
    failure_kind: String,
    failure_message: String,
    /// Path of the clip.
    pub clip: String,
    /// Digest of its content.
    pub clip_digest: String,
    /// Folder of the results.
    pub output: String,
    /// Every setting, JSON.
    pub settings: String,
    /// Over everything but clip and output.
    pub settings_digest: String,
    /// What else was asked for, JSON.
    pub request: String,
    frame_numbers: String,
    static_digest: String,
    static_size: i64,
    /// How the static model came about, JSON; empty before there is one.
    pub static_report: String,
    last_sequence: i64,
    /// RFC 3339.
    pub submitted_at: String,
}

/// What a list of jobs shows.
#[derive(Clone, Debug)]
pub struct Summary {
    /// The job.
    pub job: JobRecord,
    /// Frames that are done.
    pub done: u32,
    /// Frames that have failed.
    pub failed: u32,
}

impl JobRecord {
    /// Where the job is.
    pub fn state(&self) -> Result<JobState, StoreError> {
        JobState::from_label(&self.state)
            .ok_or_else(|| StoreError::Value { place: "jobs.state", value: self.state.clone() })
    }

    /// Why it failed, if it did.
    pub fn failure(&self) -> Option<Failure> {
        super::events::failure(&self.failure_kind, &self.failure_message)
    }

    /// Frame numbers in order; the first is the key frame.
    pub fn frame_numbers(&self) -> Result<Vec<u32>, StoreError> {
        serde_json::from_str(&self.frame_numbers)
            .map_err(|_| StoreError::Value { place: "jobs.frame_numbers", value: self.frame_numbers.clone() })
    }

    /// The static model's blob, if there is one yet.
    pub fn static_model(&self) -> Option<Blob> {
        let size = unsigned(self.static_size);
        (!self.static_digest.is_empty()).then(|| Blob { digest: self.static_digest.clone(), size })
    }

    /// Sequence number of the last stored event.
    pub fn last_sequence(&self) -> u64 {
        unsigned(self.last_sequence)
    }
}

impl Store {
    /// One job.
    pub async fn job(&self, id: &str) -> Result<Option<JobRecord>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM jobs WHERE id = ?").bind(id).fetch_optional(&self.pool).await?)
    }

    /// The job that has the same clip, settings and output.
    pub async fn same_job(
        &self,
        clip_digest: &str,
        settings_digest: &str,
        output_request: &str,
    ) -> Result<Option<JobRecord>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE clip_digest = ? AND settings_digest = ? AND output_request = ?";
        let query = sqlx::query_as(sql).bind(clip_digest).bind(settings_digest).bind(output_request);
        Ok(query.fetch_optional(&self.pool).await?)
    }

    /// Every job, oldest first.
    pub async fn jobs(&self) -> Result<Vec<JobRecord>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM jobs ORDER BY id").fetch_all(&self.pool).await?)
    }

    /// Every job with its frame counts, oldest first.
    pub async fn summaries(&self) -> Result<Vec<Summary>, StoreError> {
        let sql = "SELECT job_id, SUM(state = 'done'), SUM(state = 'failed') FROM tasks \
                   WHERE kind = 'frame' GROUP BY job_id";
        let counts: Vec<(String, u32, u32)> = sqlx::query_as(sql).fetch_all(&self.pool).await?;
        let counts: BTreeMap<String, (u32, u32)> =
            counts.into_iter().map(|(job, done, failed)| (job, (done, failed))).collect();
        let jobs = self.jobs().await?.into_iter();
        Ok(jobs
            .map(|job| {
                let (done, failed) = counts.get(&job.id).copied().unwrap_or_default();
                Summary { job, done, failed }
            })
            .collect())
    }

    /// Seconds per stage of a job, summed over restarts.
    pub async fn stage_seconds(&self, job: &str) -> Result<BTreeMap<String, f64>, StoreError> {
        let query = sqlx::query_as("SELECT stage, seconds FROM stages WHERE job_id = ?").bind(job);
        let rows: Vec<(String, f64)> = query.fetch_all(&self.pool).await?;
        Ok(rows.into_iter().collect())
    }
}

impl Change {
    /// A new job, ingesting.
    pub async fn insert_job(&mut self, job: &NewJob) -> Result<(), StoreError> {
        let sql = "INSERT INTO jobs (id, state, clip, clip_digest, output, output_request, settings, \
                   settings_digest, request, frame_numbers, submitted_at, changed_at) \
                   VALUES (?, 'ingesting', ?, ?, ?, ?, ?, ?, ?, ?, \
                   strftime('%Y-%m-%dT%H:%M:%fZ', 'now'), strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))";
        let query = sqlx::query(sql).bind(&job.id).bind(&job.clip).bind(&job.clip_digest).bind(&job.output);
        let query = query.bind(&job.output_request).bind(&job.settings).bind(&job.settings_digest);
        query.bind(&job.request).bind(&job.frame_numbers).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Where the job is now, inside this change.
    pub async fn job_state(&mut self, job: &str) -> Result<JobState, StoreError> {
        let query = sqlx::query_scalar("SELECT state FROM jobs WHERE id = ?").bind(job);
        let label: String = query.fetch_one(&mut *self.transaction).await?;
        JobState::from_label(&label).ok_or(StoreError::Value { place: "jobs.state", value: label })
    }

    /// The job's new state, and why, if it failed.
    pub async fn set_job_state(
        &mut self,
        job: &str,
        state: JobState,
        failure: Option<&Failure>,
    ) -> Result<(), StoreError> {
        let (kind, message) = super::events::failure_columns(failure);
        let sql = "UPDATE jobs SET state = ?, failure_kind = ?, failure_message = ?, \
                   changed_at = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE id = ?";
        let query = sqlx::query(sql).bind(state.label()).bind(kind).bind(message).bind(job);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Where the job's files are: the clip's path, and the request with the others'.
    pub async fn set_job_inputs(&mut self, job: &str, clip: &str, request: &str) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET clip = ?, request = ? WHERE id = ?";
        sqlx::query(sql).bind(clip).bind(request).bind(job).execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// The job's static model and how it came about.
    pub async fn set_static_model(
        &mut self,
        job: &str,
        model: &Blob,
        report: &str,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET static_digest = ?, static_size = ?, static_report = ? WHERE id = ?";
        let query = sqlx::query(sql).bind(&model.digest).bind(signed(model.size)).bind(report).bind(job);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }

    /// Adds to the time that a stage has taken.
    pub async fn add_stage_seconds(
        &mut self,
        job: &str,
        stage: &str,
        seconds: f64,
    ) -> Result<(), StoreError> {
        let sql = "INSERT INTO stages (job_id, stage, seconds) VALUES (?, ?, ?) \
                   ON CONFLICT (job_id, stage) DO UPDATE SET seconds = seconds + excluded.seconds";
        let query = sqlx::query(sql).bind(job).bind(stage).bind(seconds);
        query.execute(&mut *self.transaction).await?;
        Ok(())
    }
}
