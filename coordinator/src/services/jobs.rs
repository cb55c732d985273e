//! The `Jobs` service.

use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};
use trackersplat_proto::v1::{
    CancelRequest, CancelResponse, FetchChunk, FetchRequest, JobEvent, JobSummary, ListRequest, ListResponse,
    SubmitRequest, SubmitResponse, WatchRequest, jobs_server::Jobs,
};

use super::{fetch, locate::locate_clip, state_failed, submit, uninterrupted, unknown_job, watch};
use crate::{
    hub::SharedHub,
    request::clip_name,
    store::{JobRecord, StoreError, Summary},
};

/// What clients say to the coordinator.
pub(crate) struct JobService {
    hub: SharedHub,
}

impl JobService {
    pub(crate) fn new(hub: SharedHub) -> Self {
        Self { hub }
    }

    async fn job(&self, id: &str) -> Result<JobRecord, Status> {
        let job = self.hub.store.job(id).await.map_err(|error| state_failed(&self.hub, error))?;
        job.ok_or_else(|| unknown_job(id))
    }
}

#[tonic::async_trait]
impl Jobs for JobService {
    type WatchStream = ReceiverStream<Result<JobEvent, Status>>;
    type FetchStream = ReceiverStream<Result<FetchChunk, Status>>;

    async fn submit(&self, request: Request<SubmitRequest>) -> Result<Response<SubmitResponse>, Status> {
        let (hub, request) = (self.hub.clone(), request.into_inner());
        submit::check(&request)?;
        // Copying a clip may take long: it ends when the client hangs up.
        let clip = locate_clip(&hub, &request.clip).await?;
        uninterrupted(async move { submit::submit(&hub, request, clip).await }).await.map(Response::new)
    }

    async fn watch(&self, request: Request<WatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let WatchRequest { job_id, after_sequence } = request.into_inner();
        let job = self.job(&job_id).await?;
        if after_sequence > job.last_sequence() {
            return Err(Status::out_of_range(format!(
                "job {job_id} has {} events, none after {after_sequence}; watch it from 0",
                job.last_sequence()
            )));
        }
        Ok(Response::new(watch::watch(self.hub.clone(), job_id, after_sequence)))
    }

    async fn list(&self, _request: Request<ListRequest>) -> Result<Response<ListResponse>, Status> {
        let summaries = self.hub.store.summaries().await;
        let summaries = summaries.map_err(|error| state_failed(&self.hub, error))?;
        let jobs: Result<Vec<JobSummary>, StoreError> = summaries.into_iter().map(summary_to_wire).collect();
        Ok(Response::new(ListResponse { jobs: jobs.map_err(|error| state_failed(&self.hub, error))? }))
    }

    async fn cancel(&self, request: Request<CancelRequest>) -> Result<Response<CancelResponse>, Status> {
        let id = request.into_inner().job_id;
        self.job(&id).await?;
        let hub = self.hub.clone();
        let cancel = async move {
            let state = hub.cancel_job(&id.into()).await;
            state.map_err(|error| state_failed(&hub, error))
        };
        let state = uninterrupted(cancel).await?;
        Ok(Response::new(CancelResponse { state: state.to_wire().into() }))
    }

    async fn fetch(&self, request: Request<FetchRequest>) -> Result<Response<Self::FetchStream>, Status> {
        let FetchRequest { job_id, paths } = request.into_inner();
        let job = self.job(&job_id).await?;
        fetch::fetch(&self.hub, &job, paths).map(Response::new)
    }
}

fn summary_to_wire(Summary { job, done, failed }: Summary) -> Result<JobSummary, StoreError> {
    let clip = clip_name(&job);
    Ok(JobSummary {
        state: job.state()?.to_wire().into(),
        frames: u32::try_from(job.frame_numbers()?.len()).unwrap_or(u32::MAX),
        frames_done: done,
        frames_failed: failed,
        job_id: job.id,
        clip,
        output: job.output,
        submitted_at: job.submitted_at,
    })
}
