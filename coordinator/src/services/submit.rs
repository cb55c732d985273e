//! Submission: everything that can be refused is refused before anything is touched.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use splat::{
    clip::{Clip, Split},
    formats::track_npz::files_by_view,
    settings::{MotionSource, Settings},
    tracking::learned::LearnedTracker,
};
use tonic::Status;
use trackersplat_proto::v1::{SubmitRequest, SubmitResponse, submit_request::Tracks};

use super::{
    locate::{LocatedClip, local_path},
    state_failed,
};
use crate::{
    assembly::{SEQUENCE, holds_results},
    failure::StageError,
    hub::{Hub, SharedHub},
    keys::VERSION,
    model,
    output::{self, Marker, OutputError},
    queue::job::JobState,
    request::{InputFile, JobRequest, TrackSource, by_url},
    store::{JobRecord, NewJob},
};

/// A submission that was read and found possible.
struct Submission {
    clip_path: PathBuf,
    clip: Arc<Clip>,
    clip_digest: String,
    settings: Settings,
    settings_digest: String,
    request: JobRequest,
    /// The network of a learned tracker, whole.
    model: Option<Vec<u8>>,
    /// Empty: the coordinator chooses.
    output_request: String,
}

/// Refuses what cannot be meant, before a clip is copied for it.
pub(super) fn check(request: &SubmitRequest) -> Result<(), Status> {
    read_settings(&request.settings_json)?;
    read_frames(request.first_frame, request.last_frame)?;
    let files = match &request.tracks {
        Some(Tracks::TrackFiles(files)) => files.paths.as_slice(),
        Some(Tracks::TrackerModel(file)) => std::slice::from_ref(file),
        Some(Tracks::ExactTracks(_)) | None => &[],
    };
    let files = files.iter().map(|file| ("tracks or tracker", file));
    let given = [("static model", &request.static_model), ("output", &request.output)].into_iter();
    for (what, path) in given.filter(|(_, path)| !path.is_empty()).chain(files) {
        local_path(what, path)?;
    }
    Ok(())
}

impl Submission {
    fn marker(&self, job_id: &str) -> Marker {
        Marker {
            job_id: job_id.to_owned(),
            clip: self.request.clip_url.clone().unwrap_or_else(|| self.clip_path.display().to_string()),
            clip_digest: self.clip_digest.clone(),
            settings_digest: self.settings_digest.clone(),
            version: VERSION.to_owned(),
        }
    }
}

pub(super) async fn submit(
    hub: &SharedHub,
    request: SubmitRequest,
    clip: LocatedClip,
) -> Result<SubmitResponse, Status> {
    if hub.shutdown.is_cancelled() {
        return Err(Status::unavailable("the coordinator shuts down; submit again when it is back"));
    }
    let _one_at_a_time = hub.submitting.lock().await;
    let scratch = hub.scratch_folder();
    let (clip_path, url) = (clip.path.clone(), clip.url.clone());
    let reading = tokio::task::spawn_blocking(move || read(request, clip_path, url, scratch)).await;
    let submission = reading.map_err(|error| Status::internal(format!("reading the submission: {error}")))?;
    let mut submission = submission.map_err(|status| {
        let path = clip.path.display().to_string();
        Status::new(status.code(), by_url(status.message(), &path, clip.url.as_deref()))
    })?;
    keep_model(hub, &mut submission).await?;
    let known = hub
        .store
        .same_job(&submission.clip_digest, &submission.settings_digest, &submission.output_request)
        .await
        .map_err(|error| state_failed(hub, error))?;
    match known {
        Some(job) => resume(hub, job, submission).await,
        None => begin(hub, submission).await,
    }
}

/// Puts the network into the store: from here on the job does not need its file.
async fn keep_model(hub: &Hub, submission: &mut Submission) -> Result<(), Status> {
    let (TrackSource::Learned(file), Some(bytes)) = (&submission.request.tracks, submission.model.take())
    else {
        return Ok(());
    };
    match model::keep(hub, file, bytes).await {
        Ok(_) => Ok(()),
        Err(StageError::State(error)) => Err(state_failed(hub, error)),
        Err(StageError::Failed(failure)) => Err(Status::unavailable(format!(
            "storing the tracker {}: {}; submit again",
            file.path, failure.message
        ))),
        Err(StageError::Stopped) => Err(Status::unavailable("the coordinator shuts down; submit again")),
    }
}

async fn resume(hub: &SharedHub, job: JobRecord, submission: Submission) -> Result<SubmitResponse, Status> {
    let state = job.state().map_err(|error| state_failed(hub, error))?;
    let output = PathBuf::from(&job.output);
    let response = SubmitResponse { job_id: job.id.clone(), resumed: true };
    // A finished job whose outputs were removed puts them together again.
    let is_complete = state == JobState::Done
        && output.join(SEQUENCE).exists()
        && output::check_owner(&output, &submission.marker(&job.id)).is_ok();
    if is_complete || !state.has_ended() {
        return Ok(response);
    }
    claim(hub, &output, &submission, &job.id).await?;
    let clip_path = submission.clip_path.display().to_string();
    let request = json("the request", serde_json::to_string(&submission.request))?;
    let resumed = hub.resubmit_job(&job.id, &clip_path, &request, submission.clip).await;
    resumed.map_err(|error| state_failed(hub, error))?;
    Ok(response)
}

async fn begin(hub: &SharedHub, submission: Submission) -> Result<SubmitResponse, Status> {
    let id = uuid::Uuid::now_v7().simple().to_string();
    let output = match submission.output_request.as_str() {
        "" => hub.options.root.join("jobs").join(&id),
        chosen => PathBuf::from(chosen),
    };
    claim(hub, &output, &submission, &id).await?;
    let job = NewJob {
        id: id.clone(),
        clip: submission.clip_path.display().to_string(),
        clip_digest: submission.clip_digest,
        output: output.display().to_string(),
        output_request: submission.output_request,
        settings: json("the settings", serde_json::to_string(&submission.settings))?,
        settings_digest: submission.settings_digest,
        request: json("the request", serde_json::to_string(&submission.request))?,
        frame_numbers: json("the frame numbers", serde_json::to_string(submission.clip.frames()))?,
    };
    hub.create_job(&job, submission.clip).await.map_err(|error| state_failed(hub, error))?;
    Ok(SubmitResponse { job_id: id, resumed: false })
}

fn json(what: &str, value: serde_json::Result<String>) -> Result<String, Status> {
    value.map_err(|error| Status::internal(format!("{what} as JSON: {error}")))
}

/// Makes sure that the output folder is this job's, or nobody's who has results in it, and marks it.
async fn claim(hub: &Hub, output: &Path, submission: &Submission, job_id: &str) -> Result<(), Status> {
    let marker = submission.marker(job_id);
    let refused = |error: OutputError| Status::failed_precondition(error.to_string());
    let mut takes_over = false;
    if let Err(error) = output::check_owner(output, &marker) {
        let gives_way = match error.owner() {
            Some(owner) if !holds_results(output) => hub.gives_way(owner).await,
            _ => Ok(false),
        };
        if !gives_way.map_err(|error| state_failed(hub, error))? {
            return Err(refused(error));
        }
        takes_over = true;
    }
    let active = hub.active_outputs().await.map_err(|error| state_failed(hub, error))?;
    if let Some((other, _)) = active.iter().find(|(other, folder)| folder == output && other != job_id) {
        return Err(Status::failed_precondition(format!(
            "job {other} is writing to the output folder {}; wait for it, cancel it, or give another folder",
            output.display()
        )));
    }
    if takes_over {
        remove_description(output).map_err(refused)?;
    }
    output::claim(output, &marker).map_err(refused)
}

/// The former owner's description of a sequence without frames would pass for the new one's.
fn remove_description(output: &Path) -> Result<(), OutputError> {
    match std::fs::remove_file(output.join(SEQUENCE)) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(OutputError::Unwritable { output: output.to_owned(), source })
        }
        _ => Ok(()),
    }
}

fn read(
    request: SubmitRequest,
    clip_path: PathBuf,
    clip_url: Option<String>,
    scratch: PathBuf,
) -> Result<Submission, Status> {
    let settings = read_settings(&request.settings_json)?;
    let (tracks, model) = read_tracks(request.tracks, &settings)?;
    let mut job_request = JobRequest {
        frames: read_frames(request.first_frame, request.last_frame)?,
        test_views: request.test_views,
        static_model: match request.static_model.as_str() {
            "" => None,
            path => Some(input_file("static model", path)?),
        },
        tracks,
        clip_url,
        ..JobRequest::default()
    };
    let options = job_request.clip_options(scratch);
    let bad_clip = |error: splat::clip::ClipError| Status::invalid_argument(error.to_string());
    let clip = Clip::open(&clip_path, &options).map_err(bad_clip)?;
    if clip.frames().is_empty() {
        return Err(Status::invalid_argument(format!("the clip {} has no such frames", clip_path.display())));
    }
    let training = clip.views().iter().enumerate().filter(|(_, view)| view.split == Split::Train);
    let (positions, names): (Vec<usize>, Vec<&str>) =
        training.map(|(position, view)| (position, view.name.as_str())).unzip();
    let needs_tracks = settings.motion_source != MotionSource::None && clip.frames().len() > 1;
    if let TrackSource::Files(files) = &mut job_request.tracks
        && needs_tracks
    {
        let all: Vec<&str> = clip.views().iter().map(|view| view.name.as_str()).collect();
        let of_views = files_by_view(files, &names, &all);
        let of_views = of_views.map_err(|error| Status::invalid_argument(format!("track files: {error}")))?;
        *files = of_views.into_iter().cloned().collect();
    }
    if let TrackSource::Exact(files) = &mut job_request.tracks
        && needs_tracks
    {
        let flow = positions.iter().map(|&position| clip.exact_flow_path(position));
        *files = flow.map(|path| read_file("exact tracks", &path)).collect::<Result<_, _>>()?;
    }
    job_request.training_positions = positions;
    let clip_digest = clip.digest().map_err(bad_clip)?;
    let output_request = match request.output.as_str() {
        "" => String::new(),
        output => local_path("output", output)?.display().to_string(),
    };
    let settings_digest = job_request.settings_digest(&settings);
    let clip = Arc::new(clip);
    Ok(Submission {
        clip_path,
        clip,
        clip_digest,
        settings,
        settings_digest,
        request: job_request,
        model,
        output_request,
    })
}

/// Empty: the defaults. An unknown key is refused by name.
fn read_settings(json: &str) -> Result<Settings, Status> {
    if json.is_empty() {
        return Ok(Settings::default());
    }
    serde_json::from_str(json).map_err(|error| Status::invalid_argument(format!("settings_json: {error}")))
}

fn read_frames(first: u32, last: u32) -> Result<Option<(u32, u32)>, Status> {
    match (first, last) {
        (0, 0) => Ok(None),
        (first, last) if first <= last => Ok(Some((first, last))),
        (first, last) => Err(Status::invalid_argument(format!(
            "frames {first} to {last}: the first comes after the last; swap them, or give 0 and 0 for all"
        ))),
    }
}

/// Where the tracks come from, and the network where they come from one.
fn read_tracks(
    tracks: Option<Tracks>,
    settings: &Settings,
) -> Result<(TrackSource, Option<Vec<u8>>), Status> {
    match tracks {
        None => Ok((TrackSource::Own, None)),
        Some(Tracks::ExactTracks(_)) => Ok((TrackSource::Exact(Vec::new()), None)),
        Some(Tracks::TrackFiles(files)) if files.paths.is_empty() => {
            Err(Status::invalid_argument("track_files names no file; give one npz per training view"))
        }
        Some(Tracks::TrackFiles(files)) => {
            let files: Result<_, _> = files.paths.iter().map(|path| input_file("tracks", path)).collect();
            Ok((TrackSource::Files(files?), None))
        }
        Some(Tracks::TrackerModel(path)) => {
            let (file, bytes) =
                model::read(&local_path("tracker", &path)?).map_err(Status::invalid_argument)?;
            // What no worker could use is refused before anything is computed for it.
            LearnedTracker::from_onnx(bytes.clone(), &file.path, &settings.tracking.onnx)
                .map_err(|error| Status::invalid_argument(error.to_string()))?;
            Ok((TrackSource::Learned(file), Some(bytes)))
        }
    }
}

fn input_file(what: &str, path: &str) -> Result<InputFile, Status> {
    read_file(what, &local_path(what, path)?)
}

fn read_file(what: &str, path: &Path) -> Result<InputFile, Status> {
    InputFile::read(path).map_err(|error| {
        Status::invalid_argument(format!(
            "{what} {}: {error}; check that the file is there and may be read",
            path.display()
        ))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn an_unknown_setting_is_named() {
        assert_eq!(read_settings("").unwrap(), Settings::default());
        let status = read_settings(r#"{"sede": 1}"#).unwrap_err();
        assert!(status.message().contains("sede") && status.message().contains("settings_json"), "{status}");
    }

    #[test]
    fn a_range_of_frames_runs_forwards() {
        assert_eq!(read_frames(0, 0).unwrap(), None);
        assert_eq!(read_frames(2, 2).unwrap(), Some((2, 2)));
        assert!(read_frames(3, 2).is_err());
    }
}
