//! Starting and ending a coordinator.

use std::{
    fs::{File, TryLockError},
    net::SocketAddr,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use splat::engine::Engine;
use thiserror::Error;
use tokio::{
    net::TcpListener,
    task::JoinHandle,
    time::{MissedTickBehavior, interval},
};
use tokio_stream::wrappers::TcpListenerStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;
use trackersplat_proto::{
    MAX_WORKER_MESSAGE,
    v1::{blobs_server::BlobsServer, jobs_server::JobsServer, workers_server::WorkersServer},
};

use crate::{
    blobs::{BlobError, BlobStore},
    compute::Compute,
    hub::Hub,
    options::ServeOptions,
    services::{BlobService, JobService, WorkService},
    store::{Store, StoreError},
};

/// A silent peer is noticed within about twice this.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Streams of one connection that may be open at once.
const CONCURRENT_STREAMS: u32 = 256;
/// Longest wait for open streams at shutdown.
const FAREWELL: Duration = Duration::from_secs(5);

/// Why a coordinator could not start, or ended.
#[derive(Debug, Error)]
pub enum ServeError {
    /// The options contradict themselves.
    #[error("coordinator options: {0}")]
    Options(String),
    /// The folder of the coordinator's state cannot be used.
    #[error("coordinator folder {root}: {source}; give a folder that can be written")]
    Root {
        /// The folder.
        root: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Another coordinator uses the folder.
    #[error("another coordinator uses the folder {root}; stop it, or give another folder")]
    InUse {
        /// The folder.
        root: PathBuf,
    },
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}; stop the program that uses it, or give another port")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// The state cannot be read or written.
    #[error(transparent)]
    State(#[from] StoreError),
    /// The blob store cannot be opened.
    #[error(transparent)]
    Blobs(#[from] BlobError),
    /// No thread pool of that size.
    #[error("cannot start the compute threads: {0}; give a smaller number")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// The server ended by itself.
    #[error("the server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
}

/// A coordinator that serves.
#[derive(Debug)]
pub struct Running {
    /// Where it listens.
    pub address: SocketAddr,
    task: JoinHandle<Result<(), ServeError>>,
    #[cfg(test)]
    pub(crate) hub: std::sync::Weak<Hub>,
}

impl Running {
    /// Waits until the coordinator has ended after a shutdown: streams are closed, stages stopped, state is on disk.
    pub async fn finished(self) -> Result<(), ServeError> {
        match self.task.await {
            Ok(ended) => ended,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                Err(_) => Ok(()),
            },
        }
    }
}

/// Starts a coordinator: opens or creates its state, goes on with the jobs that are in it, and serves until
/// `shutdown` is cancelled. The engine reconstructs static models and renders the outputs.
pub async fn serve(
    mut options: ServeOptions,
    engine: Arc<dyn Engine>,
    shutdown: CancellationToken,
) -> Result<Running, ServeError> {
    if let Some(problem) = options.problem() {
        return Err(ServeError::Options(problem));
    }
    let root_failed = |source| ServeError::Root { root: options.root.clone(), source };
    let blob_folder = options.root.join("blobs");
    std::fs::create_dir_all(&blob_folder).map_err(root_failed)?;
    // Absolute, because workers open it from elsewhere.
    options.root = options.root.canonicalize().map_err(root_failed)?;
    let lock = lock(&options.root)?;
    let store = Store::open(&options.root.join("state.sqlite")).await?;
    let blobs = BlobStore::open(&options.root.join("blobs"))?;
    let probe = blobs.put(Bytes::from_static(b"trackersplat blob store")).await?;
    let compute = Compute::new(options.compute_threads)?;
    let listen = options.listen;
    let listen_failed = |source| ServeError::Listen { address: listen, source };
    let listener = TcpListener::bind(listen).await.map_err(listen_failed)?;
    let address = listener.local_addr().map_err(listen_failed)?;
    let hub = Arc::new(Hub::new(options, store, blobs, probe, compute, engine, shutdown));
    hub.recover().await?;
    tracing::info!(%address, root = %hub.options.root.display(), "coordinator serves");
    #[cfg(test)]
    let weak = Arc::downgrade(&hub);
    let task = tokio::spawn(run(hub, listener, lock));
    Ok(Running {
        address,
        task,
        #[cfg(test)]
        hub: weak,
    })
}

/// Two coordinators on one state would void each other's leases. The lock ends with the process at the latest.
fn lock(root: &Path) -> Result<File, ServeError> {
    let failed = |source| ServeError::Root { root: root.to_owned(), source };
    let file = File::create(root.join("lock")).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(ServeError::InUse { root: root.to_owned() }),
        Err(TryLockError::Error(source)) => Err(failed(source)),
    }
}

async fn run(hub: Arc<Hub>, listener: TcpListener, lock: File) -> Result<(), ServeError> {
    let ticker = tokio::spawn(tick(hub.clone()));
    let shutdown = hub.shutdown.clone();
    let server = Server::builder()
        .http2_keepalive_interval(Some(KEEP_ALIVE))
        .http2_keepalive_timeout(Some(KEEP_ALIVE))
        .tcp_nodelay(true)
        .max_concurrent_streams(CONCURRENT_STREAMS)
        .add_service(JobsServer::new(JobService::new(hub.clone())))
        .add_service(
            WorkersServer::new(WorkService::new(hub.clone())).max_decoding_message_size(MAX_WORKER_MESSAGE),
        )
        .add_service(BlobsServer::new(BlobService::new(hub.clone())))
        .serve_with_incoming_shutdown(TcpListenerStream::new(listener), shutdown.clone().cancelled_owned());
    let mut server = std::pin::pin!(server);
    let served = tokio::select! {
        served = &mut server => served,
        () = shutdown.cancelled() => {
            // Every stream watches the shutdown as well; one that does not end in time is dropped.
            tokio::time::timeout(FAREWELL, server).await.unwrap_or(Ok(()))
        }
    };
    shutdown.cancel();
    hub.drivers_ended().await;
    if let Err(error) = hub.release_own_leases().await {
        hub.fail(error);
    }
    // The ticker only waits for the shutdown now; it cannot fail.
    let _ = ticker.await;
    hub.store.close().await;
    drop(lock);
    served?;
    match hub.take_fatal() {
        Some(error) => Err(error.into()),
        None => Ok(()),
    }
}

/// Expires leases, until shutdown.
async fn tick(hub: Arc<Hub>) {
    let mut ticks = interval(hub.options.heartbeat_interval);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while hub.shutdown.run_until_cancelled(ticks.tick()).await.is_some() {
        if let Err(error) = hub.tick(Instant::now()).await {
            hub.fail(error);
        }
    }
}
