//! Results of workers: refused when stale, verified before they count, committed once.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use splat::{
    frame::FrameReport,
    gaussians::{delta, validate},
};
use tokio_util::sync::CancellationToken;
use trackersplat_proto::v1::{
    Blob, Failure, FailureKind, Report, ReportReceipt, Success, coordinator_message::Message, report::Outcome,
};

use super::{FrameBase, Hub};
use crate::{
    assembly::{self, AssemblyError},
    blobs::BlobError,
    failure::{StageError, failure},
    queue::{Lease, SessionId, Stale, Task},
    store::{Artifact, CommittedFrame, StoreError},
};

/// Longest text that a worker may send: reports hold a few numbers per view.
const MAX_REPORT_BYTES: usize = 1 << 20;

/// Why a frame's result is not in the output folder.
#[derive(Debug)]
pub(crate) enum FrameError {
    /// The result is at fault: the attempt has failed.
    Result(Failure),
    /// The output folder takes no file: no attempt would do better, the job fails.
    Output(Failure),
}

impl From<FrameError> for StageError {
    fn from(error: FrameError) -> Self {
        let (FrameError::Result(reason) | FrameError::Output(reason)) = error;
        Self::Failed(reason)
    }
}

impl Hub {
    /// A worker reports. It gets a receipt unless an earlier report of the lease is still being verified: the worker
    /// then sends it again, and is answered by what became of the earlier one.
    pub(crate) async fn report(&self, session: SessionId, report: Report) -> Result<(), StoreError> {
        let Report { lease_id, attempt, outcome } = report;
        let held = {
            let mut desk = self.desk.lock().await;
            let begun = desk.queue.begin_report(session, &lease_id, attempt);
            let begun = begun.map(Option::<&Lease>::cloned);
            begun.map(|lease| lease.map(|lease| (desk.base(&lease.key.job), lease)))
        };
        let refusal = match (held, outcome) {
            (Ok(None), _) => {
                tracing::info!(lease_id, attempt, "reported again while the result is verified");
                return Ok(());
            }
            (Ok(Some((run, lease))), outcome) => match (lease.key.task, outcome) {
                (Task::Frame(_), Some(Outcome::Success(success))) => {
                    self.succeeded(&lease, run, success).await?
                }
                (Task::Tracks(_), Some(Outcome::Tracked(tracked))) => self.tracked(&lease, tracked).await?,
                (Task::Tracks(_), Some(Outcome::Failure(reason))) => {
                    self.window_failed(&lease, reason).await?
                }
                (_, outcome) => self.failed(&lease_id, attempt, reason_of(outcome)).await?,
            },
            (Err(stale), Some(Outcome::Success(_) | Outcome::Tracked(_))) => {
                self.stale_success(&lease_id, attempt, &stale).await?
            }
            (Err(stale), _) => {
                tracing::warn!(lease_id, attempt, %stale, "stale failure refused");
                Some(stale.to_string())
            }
        };
        let mut desk = self.desk.lock().await;
        let accepted = refusal.is_none();
        let receipt = ReportReceipt { lease_id, accepted, reason: refusal.unwrap_or_default() };
        desk.send(session, Message::Receipt(receipt));
        self.dispatch(&mut desk).await
    }

    /// The verification of this stream's report, or field, ended in a panic: the attempt has failed.
    pub(crate) async fn report_panicked(&self, session: SessionId) -> Result<(), StoreError> {
        let mut desk = self.desk.lock().await;
        let Some(failed) = desk.queue.abandon_report(session) else { return Ok(()) };
        let reason =
            failure(FailureKind::Bug, "the coordinator panicked over the worker's report; its log says why");
        self.record_failed(&mut desk, &failed, &reason).await?;
        self.dispatch(&mut desk).await
    }

    /// A reported attempt has failed. `None`, or why the lease ended meanwhile.
    pub(super) async fn failed(
        &self,
        lease_id: &str,
        attempt: u32,
        reason: Failure,
    ) -> Result<Option<String>, StoreError> {
        let mut desk = self.desk.lock().await;
        match desk.queue.fail(lease_id, attempt, reason.kind()) {
            Ok(failed) => {
                let unusable = desk.lose_unusable_state(&failed.lease, reason.kind());
                self.record_failed(&mut desk, &failed, &reason).await?;
                self.forget_states(unusable.as_slice()).await?;
                Ok(None)
            }
            Err(stale) => Ok(Some(stale.to_string())),
        }
    }

    /// A result does not count: the attempt has failed.
    pub(super) async fn refused(
        &self,
        lease_id: &str,
        attempt: u32,
        reason: Failure,
    ) -> Result<Option<String>, StoreError> {
        let message = reason.message.clone();
        let stale = self.failed(lease_id, attempt, reason).await?;
        Ok(Some(stale.unwrap_or(message)))
    }

    /// `None` if the result counts, else why not. `run` is what it is verified against, and ends with the job's run.
    async fn succeeded(
        &self,
        lease: &Lease,
        run: Option<(Arc<FrameBase>, CancellationToken)>,
        success: Success,
    ) -> Result<Option<String>, StoreError> {
        let (lease_id, attempt) = (lease.id.as_str(), lease.attempt);
        let seconds = Instant::now().saturating_duration_since(lease.since).as_secs_f64();
        let Some((base, stop)) = run else {
            let reason = failure(FailureKind::Transient, "the job is not ready for results");
            return self.refused(lease_id, attempt, reason).await;
        };
        let delta = match self.verify(lease, base, &success).await {
            Ok(delta) => delta,
            Err(FrameError::Output(reason)) => {
                let message = reason.message.clone();
                self.keep_result(lease, &success).await?;
                self.fail_run(&lease.key.job, &stop, reason).await?;
                return Ok(Some(message));
            }
            Err(FrameError::Result(reason)) => {
                return self.refused(lease_id, attempt, reason).await;
            }
        };
        let stage_seconds: BTreeMap<String, f64> = success
            .seconds
            .iter()
            .filter(|stage| stage.seconds.is_finite())
            .map(|stage| (stage.stage.clone(), stage.seconds))
            .collect();
        let mut desk = self.desk.lock().await;
        let lease = match desk.queue.commit(lease_id, attempt) {
            Ok(lease) => lease,
            Err(stale) => {
                drop(desk);
                return self.stale_success(lease_id, attempt, &stale).await;
            }
        };
        let result = CommittedFrame {
            delta: &delta,
            report: &success.report_json,
            worker: &lease.worker_id,
            seconds,
            stage_seconds: &stage_seconds,
        };
        self.record_done(&mut desk, &lease, &result).await?;
        Ok(None)
    }

    /// A report that comes again because its receipt was lost is acknowledged; any other stale one is dropped.
    pub(super) async fn stale_success(
        &self,
        lease_id: &str,
        attempt: u32,
        stale: &Stale,
    ) -> Result<Option<String>, StoreError> {
        if self.store.was_committed(lease_id, attempt).await? {
            return Ok(None);
        }
        tracing::warn!(lease_id, attempt, %stale, "stale result refused");
        Ok(Some(stale.to_string()))
    }

    /// Keeps a verified result that the output folder does not take, so that the resubmitted job need not compute it.
    async fn keep_result(&self, lease: &Lease, success: &Success) -> Result<(), StoreError> {
        let record = self.store.frame(&lease.key.job, lease.key.task.number()).await?;
        let (Some(record), Some(delta)) = (record, &success.delta) else { return Ok(()) };
        let artifact = Artifact { blob: delta.clone(), note: success.report_json.clone() };
        let mut change = self.store.change().await?;
        change.put_artifact(&record.result_key, "frame", &artifact).await?;
        change.commit().await
    }

    /// The delta exists, is what its name says, fits the static model and is finite; then the frame's file is written.
    async fn verify(
        &self,
        lease: &Lease,
        base: Arc<FrameBase>,
        success: &Success,
    ) -> Result<Blob, FrameError> {
        let bug = |message: String| FrameError::Result(failure(FailureKind::Bug, message));
        let delta = success.delta.clone().ok_or_else(|| bug("the worker's result names no delta".into()))?;
        check_report(&success.report_json).map_err(bug)?;
        let bytes = self.fetched(&delta, "the worker's delta").await.map_err(FrameError::Result)?;
        self.write_frame(base, lease.key.task.number(), bytes).await?;
        Ok(delta)
    }

    /// The verified bytes of a blob that a result names.
    pub(super) async fn fetched(&self, blob: &Blob, what: &str) -> Result<bytes::Bytes, Failure> {
        self.blobs.get(blob).await.map_err(|error| unfetched(&error, what))
    }

    /// Checks a delta against the static model and writes the frame's file into the output folder.
    pub(crate) async fn write_frame(
        &self,
        base: Arc<FrameBase>,
        frame: u32,
        bytes: bytes::Bytes,
    ) -> Result<(), FrameError> {
        let work = move || {
            let bug = |message: String| FrameError::Result(failure(FailureKind::Bug, message));
            let gaussians = delta::apply(&base.model, &base.digest, &bytes).map_err(|error| {
                bug(format!("the delta of frame {frame} does not fit the static model: {error}"))
            })?;
            validate::validate(&gaussians)
                .map_err(|error| bug(format!("the Gaussians of frame {frame} are not valid: {error}")))?;
            assembly::write_frame(&base.output, frame, &base.model, &base.blob.digest, &bytes).map_err(
                |error| match error {
                    AssemblyError::Io { .. } => FrameError::Output(failure(
                        FailureKind::Transient,
                        format!("{error}; the same command then goes on with what is computed"),
                    )),
                    error => bug(error.to_string()),
                },
            )
        };
        let ended = tokio::task::spawn_blocking(work).await;
        ended.unwrap_or_else(|error| {
            let message = format!("reading the delta of frame {frame}: {error}");
            Err(FrameError::Result(failure(FailureKind::Bug, message)))
        })
    }
}

/// What follows for a result from a blob of it that cannot be read.
pub(super) fn unfetched(error: &BlobError, what: &str) -> Failure {
    let kind = match error {
        BlobError::Name(_) | BlobError::TooLarge { .. } => FailureKind::Bug,
        BlobError::Missing(_) | BlobError::Corrupt { .. } | BlobError::Store(_) => FailureKind::Transient,
    };
    failure(kind, format!("{what}: {error}"))
}

/// Why the worker gave the frame up.
fn reason_of(outcome: Option<Outcome>) -> Failure {
    match outcome {
        Some(Outcome::Failure(reason)) => reason,
        Some(_) => failure(FailureKind::Bug, "the worker reports the result of another kind of task"),
        None => failure(FailureKind::Bug, "the worker's report has no outcome"),
    }
}

fn check_report(json: &str) -> Result<(), String> {
    if json.len() > MAX_REPORT_BYTES {
        return Err(format!(
            "the worker's report has {} bytes, at most {MAX_REPORT_BYTES} are accepted",
            json.len()
        ));
    }
    // JSON has neither NaN nor infinity: a report with one of them is not readable.
    serde_json::from_str::<FrameReport>(json)
        .map(|_| ())
        .map_err(|error| format!("the worker's report is not readable: {error}"))
}
