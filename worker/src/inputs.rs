//! A frame job's blobs and numbers, checked and converted to what `splat` takes.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use glam::{DMat3, DVec3};
use splat::{
    cameras::Camera,
    formats::{ply, track_blob},
    frame::{FrameInput, FrameView},
    gaussians::Gaussians,
    image::{Image, Mask},
    settings::Settings,
    tracking::TrackField,
};
use trackersplat_proto::v1::{self, Blob, FailureKind, FrameJob};

use crate::{
    blobs::{BlobError, Blobs},
    job::JobError,
};

/// Decoded bytes that are kept between jobs: the static model and the masks of static cameras come again.
const CACHE_BYTES: usize = 256 << 20;
/// Views that are fetched and decoded at the same time.
const CONCURRENT_VIEWS: usize = 2;
/// Largest image side; bounds what a wrong message makes the worker allocate.
const MAX_IMAGE_SIDE: u32 = 32_768;

/// Fetches and decodes everything a frame job names.
pub(crate) async fn load(job: &FrameJob, blobs: &Blobs, cache: &InputCache) -> Result<FrameInput, JobError> {
    let settings = parse_settings(&job.settings_json)?;
    if job.training_views.is_empty() {
        return Err(JobError::bad_input(format!("frame {} names no training view", job.frame)));
    }
    let loader = Loader { blobs, cache };
    let static_model = loader.gaussians(required(job.static_model.as_ref(), "the static model")?).await?;
    if static_model.is_empty() {
        return Err(JobError::bad_input(
            "the static model holds no Gaussian; reconstruct or import another".into(),
        ));
    }
    Ok(FrameInput {
        static_model,
        training_views: loader.views(&job.training_views).await?,
        test_views: loader.views(&job.test_views).await?,
        settings,
        is_key_frame: job.key_frame,
    })
}

fn parse_settings(json: &str) -> Result<Settings, JobError> {
    serde_json::from_str(json).map_err(|error| JobError::bad_input(format!("the job's settings: {error}")))
}

/// The camera of a message; refuses what no pinhole camera can be.
pub(crate) fn camera_from_wire(view: &str, camera: Option<&v1::Camera>) -> Result<Camera, JobError> {
    let wrong = |what: &str| JobError::bad_input(format!("view '{view}': {what}; check the clip's cameras"));
    let camera = camera.ok_or_else(|| wrong("no camera"))?;
    let rotation: [f64; 9] =
        camera.rotation.as_slice().try_into().map_err(|_| wrong("a rotation needs 9 values"))?;
    let translation: [f64; 3] =
        camera.translation.as_slice().try_into().map_err(|_| wrong("a translation needs 3 values"))?;
    let side_is_possible = |side: u32| (1..=MAX_IMAGE_SIDE).contains(&side);
    if !side_is_possible(camera.width) || !side_is_possible(camera.height) {
        return Err(wrong(&format!("an image of {} x {} pixels", camera.width, camera.height)));
    }
    let is_finite = [camera.cx, camera.cy].iter().chain(&rotation).chain(&translation).all(|v| v.is_finite());
    if !is_finite {
        return Err(wrong("a value is not finite"));
    }
    let focal_is_possible = |focal: f64| focal.is_finite() && focal > 0.0;
    if !focal_is_possible(camera.fx) || !focal_is_possible(camera.fy) {
        return Err(wrong(&format!("focal lengths {} and {} pixels", camera.fx, camera.fy)));
    }
    // glam stores columns, the wire rows.
    let rotation = DMat3::from_cols_array(&rotation).transpose();
    let deviation = (rotation * rotation.transpose() - DMat3::IDENTITY).to_cols_array();
    // 1e-3 admits poses written with four digits and refuses scaled or sheared ones.
    if deviation.iter().any(|d| d.abs() > 1e-3) || rotation.determinant() < 0.0 {
        return Err(wrong("the rotation is not orthonormal, or mirrored"));
    }
    Ok(Camera {
        width: camera.width,
        height: camera.height,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        rotation,
        translation: DVec3::from_array(translation),
    })
}

fn required<'a, T>(value: Option<&'a T>, what: &str) -> Result<&'a T, JobError> {
    value.ok_or_else(|| {
        JobError::bad_input(format!("the frame job lacks {what}; this is a defect of the coordinator"))
    })
}

/// Refuses an image, mask or track field of another size than its camera.
fn check_size(view: &str, what: &str, size: (u32, u32), camera: &Camera) -> Result<(), JobError> {
    if size == (camera.width, camera.height) {
        return Ok(());
    }
    Err(JobError::bad_input(format!(
        "view '{view}': {what} of {} x {} pixels, its camera is of {} x {}; make both the same size",
        size.0, size.1, camera.width, camera.height
    )))
}

struct Loader<'a> {
    blobs: &'a Blobs,
    cache: &'a InputCache,
}

impl Loader<'_> {
    async fn views(&self, views: &[v1::FrameView]) -> Result<Vec<FrameView>, JobError> {
        let views: Vec<_> = views.iter().map(|view| self.view(view)).collect();
        stream::iter(views).buffered(CONCURRENT_VIEWS).try_collect().await
    }

    async fn view(&self, view: &v1::FrameView) -> Result<FrameView, JobError> {
        let name = view.name.as_str();
        let camera = camera_from_wire(name, view.camera.as_ref())?;
        let image =
            self.image(name, required(view.image.as_ref(), &format!("the image of '{name}'"))?).await?;
        check_size(name, "an image", (image.width, image.height), &camera)?;
        let mask = match &view.mask {
            Some(blob) => Some(self.mask(name, blob).await?),
            None => None,
        };
        if let Some(mask) = &mask {
            check_size(name, "a mask", (mask.width, mask.height), &camera)?;
        }
        let tracks = match &view.tracks {
            Some(blob) => Some(self.tracks(name, blob).await?),
            None => None,
        };
        if let Some(tracks) = &tracks {
            check_size(name, "a track field", (tracks.width, tracks.height), &camera)?;
        }
        Ok(FrameView { name: name.to_owned(), camera, image, mask, tracks })
    }

    async fn gaussians(&self, blob: &Blob) -> Result<Arc<Gaussians>, JobError> {
        let decode =
            |bytes: &[u8]| ply::parse_ply(bytes).map_err(|error| format!("the static model: {error}"));
        self.decoded(blob, decode, Decoded::Gaussians, Decoded::gaussians).await
    }

    async fn image(&self, view: &str, blob: &Blob) -> Result<Arc<Image>, JobError> {
        let view = view.to_owned();
        let decode =
            move |bytes: &[u8]| Image::decode(bytes).map_err(|error| format!("view '{view}': {error}"));
        self.decoded(blob, decode, Decoded::Image, Decoded::image).await
    }

    async fn mask(&self, view: &str, blob: &Blob) -> Result<Arc<Mask>, JobError> {
        let view = view.to_owned();
        let decode =
            move |bytes: &[u8]| Mask::decode(bytes).map_err(|error| format!("mask of '{view}': {error}"));
        self.decoded(blob, decode, Decoded::Mask, Decoded::mask).await
    }

    async fn tracks(&self, view: &str, blob: &Blob) -> Result<Arc<TrackField>, JobError> {
        let view = view.to_owned();
        let decode = move |bytes: &[u8]| {
            track_blob::decode(bytes).map_err(|error| format!("tracks of '{view}': {error}"))
        };
        self.decoded(blob, decode, Decoded::Tracks, Decoded::tracks).await
    }

    /// From the cache, else fetched, verified and decoded away from the async threads.
    async fn decoded<T: Send + Sync + 'static>(
        &self,
        blob: &Blob,
        decode: impl FnOnce(&[u8]) -> Result<T, String> + Send + 'static,
        wrap: fn(Arc<T>) -> Decoded,
        unwrap: fn(Decoded) -> Option<Arc<T>>,
    ) -> Result<Arc<T>, JobError> {
        if let Some(known) = self.cache.get(&blob.digest).and_then(unwrap) {
            return Ok(known);
        }
        let bytes: Bytes = self.blobs.get(blob).await?;
        let value = tokio::task::spawn_blocking(move || decode(&bytes))
            .await
            .map_err(|error| {
                JobError::new(FailureKind::Bug, format!("decoding blob {}: {error}", blob.digest))
            })?
            .map_err(JobError::bad_input)?;
        let value = Arc::new(value);
        self.cache.insert(&blob.digest, wrap(value.clone()));
        Ok(value)
    }
}

impl From<BlobError> for JobError {
    fn from(error: BlobError) -> Self {
        Self::new(error.kind(), error.to_string())
    }
}

/// An input in memory.
#[derive(Clone, Debug)]
enum Decoded {
    Gaussians(Arc<Gaussians>),
    Image(Arc<Image>),
    Mask(Arc<Mask>),
    Tracks(Arc<TrackField>),
}

impl Decoded {
    fn gaussians(self) -> Option<Arc<Gaussians>> {
        if let Self::Gaussians(value) = self { Some(value) } else { None }
    }

    fn image(self) -> Option<Arc<Image>> {
        if let Self::Image(value) = self { Some(value) } else { None }
    }

    fn mask(self) -> Option<Arc<Mask>> {
        if let Self::Mask(value) = self { Some(value) } else { None }
    }

    fn tracks(self) -> Option<Arc<TrackField>> {
        if let Self::Tracks(value) = self { Some(value) } else { None }
    }

    /// Approximate size in memory.
    fn bytes(&self) -> usize {
        match self {
            Self::Gaussians(value) => value.len() * 44 + value.sh.len() * 4,
            Self::Image(value) => value.pixels.len() * 4,
            Self::Mask(value) => value.inside.len(),
            Self::Tracks(value) => value.positions.len() * 13,
        }
    }
}

/// Decoded inputs by digest, least recently used first, within a byte budget.
#[derive(Debug)]
pub(crate) struct InputCache {
    entries: Mutex<Vec<(String, Decoded)>>,
    budget: usize,
}

impl Default for InputCache {
    fn default() -> Self {
        Self { entries: Mutex::default(), budget: CACHE_BYTES }
    }
}

impl InputCache {
    fn get(&self, digest: &str) -> Option<Decoded> {
        let mut entries = self.lock();
        let position = entries.iter().position(|(known, _)| known == digest)?;
        let entry = entries.remove(position);
        let value = entry.1.clone();
        entries.push(entry);
        Some(value)
    }

    fn insert(&self, digest: &str, value: Decoded) {
        let mut entries = self.lock();
        entries.retain(|(known, _)| known != digest);
        entries.push((digest.to_owned(), value));
        let mut total: usize = entries.iter().map(|(_, value)| value.bytes()).sum();
        while total > self.budget {
            total -= entries.remove(0).1.bytes();
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<(String, Decoded)>> {
        // Every update leaves the list valid, so a panic elsewhere does not spoil it.
        self.entries.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::test_coordinator::{TestCoordinator, wire_camera};

    fn refusal(camera: v1::Camera) -> String {
        let error = camera_from_wire("cam07", Some(&camera)).unwrap_err();
        assert_eq!(error.kind, FailureKind::BadInput);
        error.message
    }

    #[test]
    fn a_camera_keeps_rows_as_rows() {
        // A quarter turn about z: row 0 is (0, -1, 0).
        let camera = v1::Camera {
            rotation: vec![0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
            translation: vec![1.0, 2.0, 3.0],
            ..wire_camera(4, 3)
        };
        let camera = camera_from_wire("cam00", Some(&camera)).unwrap();
        assert_eq!(camera.to_camera(DVec3::new(1.0, 0.0, 0.0)), DVec3::new(1.0, 3.0, 3.0));
        assert_eq!((camera.width, camera.height), (4, 3));
    }

    #[test]
    fn impossible_cameras_are_refused_by_view_and_value() {
        let good = wire_camera(4, 3);
        assert!(refusal(v1::Camera { rotation: vec![1.0; 8], ..good.clone() }).contains("9 values"));
        assert!(refusal(v1::Camera { translation: vec![], ..good.clone() }).contains("3 values"));
        assert!(refusal(v1::Camera { width: 0, ..good.clone() }).contains("0 x 3"));
        assert!(refusal(v1::Camera { height: u32::MAX, ..good.clone() }).contains("4294967295"));
        assert!(refusal(v1::Camera { fx: f64::NAN, ..good.clone() }).contains("NaN"));
        assert!(refusal(v1::Camera { fy: -3.0, ..good.clone() }).contains("-3"));
        assert!(refusal(v1::Camera { cx: f64::INFINITY, ..good.clone() }).contains("not finite"));
        let mirrored = vec![-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let message = refusal(v1::Camera { rotation: mirrored, ..good.clone() });
        assert!(message.contains("mirrored") && message.contains("cam07"), "{message}");
        let scaled = vec![2.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0];
        assert!(refusal(v1::Camera { rotation: scaled, ..good }).contains("orthonormal"));
        assert!(camera_from_wire("cam07", None).unwrap_err().message.contains("no camera"));
    }

    #[tokio::test]
    async fn a_frame_job_becomes_what_it_names() {
        let coordinator = TestCoordinator::start().await;
        let blobs = Blobs::open(&v1::Welcome::default(), coordinator.channel()).await;
        let job = coordinator.frame_job(2);
        let input = load(&job, &blobs, &InputCache::default()).await.unwrap();
        assert_eq!(input.static_model.len(), 2);
        assert_eq!(input.training_views.len(), 2);
        assert_eq!(input.training_views[1].name, "cam01");
        assert_eq!((input.training_views[0].image.width, input.training_views[0].image.height), (6, 4));
        assert_eq!(input.test_views.len(), 1);
        assert!(!input.is_key_frame);
        assert!(load(&coordinator.frame_job(1), &blobs, &InputCache::default()).await.unwrap().is_key_frame);
    }

    #[tokio::test]
    async fn wrong_inputs_are_bad_input_and_say_which() {
        let coordinator = TestCoordinator::start().await;
        let blobs = Blobs::open(&v1::Welcome::default(), coordinator.channel()).await;
        let good = coordinator.frame_job(2);
        let refusal = async |job: FrameJob| {
            let error = load(&job, &blobs, &InputCache::default()).await.unwrap_err();
            assert_eq!(error.kind, FailureKind::BadInput, "{}", error.message);
            error.message
        };

        let job = FrameJob { settings_json: r#"{"sede": 1}"#.into(), ..good.clone() };
        assert!(refusal(job).await.contains("sede"));
        assert!(
            refusal(FrameJob { training_views: vec![], ..good.clone() }).await.contains("no training view")
        );
        assert!(refusal(FrameJob { static_model: None, ..good.clone() }).await.contains("static model"));
        let job = FrameJob { static_model: Some(coordinator.store(b"not a PLY")), ..good.clone() };
        assert!(refusal(job).await.contains("static model"));

        let mut job = good.clone();
        job.training_views[1].camera = Some(wire_camera(8, 4));
        let message = refusal(job).await;
        assert!(
            message.contains("cam01") && message.contains("6 x 4") && message.contains("8 x 4"),
            "{message}"
        );

        let mut job = good.clone();
        job.training_views[0].image = Some(coordinator.store(b"\x89PNG cut short"));
        assert!(refusal(job).await.contains("cam00"));

        let mut job = good;
        let small_mask = Image::filled(2, 2, [1.0; 3]).encode_png();
        job.test_views[0].mask = Some(coordinator.store(&small_mask));
        assert!(refusal(job).await.contains("a mask of 2 x 2"));
    }

    #[tokio::test]
    async fn the_static_model_is_decoded_once_for_many_frames() {
        let coordinator = TestCoordinator::start().await;
        let blobs = Blobs::open(&v1::Welcome::default(), coordinator.channel()).await;
        let cache = InputCache::default();
        let first = load(&coordinator.frame_job(2), &blobs, &cache).await.unwrap();
        let second = load(&coordinator.frame_job(3), &blobs, &cache).await.unwrap();
        assert!(Arc::ptr_eq(&first.static_model, &second.static_model));
    }

    #[test]
    fn the_cache_forgets_the_least_recently_used_first() {
        let mask = |pixels| {
            Decoded::Mask(Arc::new(Mask { width: pixels, height: 1, inside: vec![true; pixels as usize] }))
        };
        let cache = InputCache { budget: 10, ..InputCache::default() };
        cache.insert("a", mask(4));
        cache.insert("b", mask(4));
        assert!(cache.get("a").is_some());
        cache.insert("c", mask(4));
        assert!(cache.get("b").is_none(), "b was used least recently");
        assert!(cache.get("a").is_some() && cache.get("c").is_some());
        cache.insert("larger than the budget", mask(11));
        assert!(cache.get("larger than the budget").is_none());
    }
}
