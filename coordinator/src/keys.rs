//! Keys of results: digests of everything that decides them, so that retrying, resuming and caching are one thing.

use prost::Message;
use serde::Serialize;
use splat::{
    engine::Engine,
    settings::{MotionSource, Settings},
};
use trackersplat_proto::v1::FrameJob;

/// Part of every key: another version may compute other bytes.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Digest of a value's JSON. Struct fields serialise in a fixed order, so equal values have equal digests.
pub(crate) fn digest_of(value: &impl Serialize) -> String {
    let mut hasher = blake3::Hasher::new();
    // Numbers, strings, lists and structs always serialise, and a hasher takes every byte.
    if let Err(error) = serde_json::to_writer(&mut hasher, value) {
        unreachable!("keys are plain data: {error}");
    }
    hasher.finalize().to_hex().to_string()
}

/// What decides a reconstructed static model.
#[derive(Serialize)]
pub(crate) struct StaticModelKey<'a> {
    pub(crate) kind: &'static str,
    pub(crate) version: &'static str,
    pub(crate) engine: &'a str,
    pub(crate) clip: &'a str,
    pub(crate) key_frame: u32,
    pub(crate) training_views: Vec<&'a str>,
    pub(crate) background: [f32; 3],
    pub(crate) masks: splat::settings::MaskUse,
    pub(crate) seed: u64,
    pub(crate) settings: &'a splat::static_model::StaticModelSettings,
}

/// What decides the imported track field of one view and frame.
#[derive(Serialize)]
pub(crate) struct TrackKey<'a> {
    pub(crate) kind: &'static str,
    pub(crate) version: &'static str,
    /// Digest of the imported file.
    pub(crate) source: &'a str,
    pub(crate) clip: &'a str,
    /// Frames from the key frame to this one.
    pub(crate) frames: &'a [u32],
    pub(crate) view: &'a str,
}

/// What a computation of the coordinator depends on besides its input: other devices round differently.
pub(crate) fn engine_key(engine: &dyn Engine) -> String {
    match engine.device_name() {
        Some(device) => format!("{} {device}", engine.name()),
        None => engine.name().to_owned(),
    }
}

/// Key of a frame's result: its inputs by digest, the settings that a frame job reads, and the version. Not the device:
/// any worker may compute it, and what one has computed no other computes again because it would round differently.
pub(crate) fn frame_key(job: &FrameJob, settings: &Settings) -> String {
    let inputs = FrameJob { job_id: String::new(), settings_json: String::new(), ..job.clone() };
    #[derive(Serialize)]
    struct FrameSettings<'a> {
        seed: u64,
        background: [f32; 3],
        masks: splat::settings::MaskUse,
        motion_source: MotionSource,
        motion: &'a splat::motion::MotionSettings,
        refine: &'a splat::refine::RefineSettings,
    }
    let read = FrameSettings {
        seed: settings.seed,
        background: settings.background,
        masks: settings.masks,
        motion_source: settings.motion_source,
        motion: &settings.motion,
        refine: &settings.refine,
    };
    let inputs = blake3::hash(&inputs.encode_to_vec()).to_hex().to_string();
    digest_of(&("frame", VERSION, inputs, read))
}

#[cfg(test)]
mod tests {
    use trackersplat_proto::v1::{Blob, FrameView};

    use super::*;

    #[test]
    fn a_frame_key_knows_its_inputs_and_not_its_job() {
        let settings = Settings::default();
        let job =
            FrameJob { job_id: "a".into(), frame: 2, settings_json: "{}".into(), ..FrameJob::default() };
        let key = frame_key(&job, &settings);
        let renamed = FrameJob { job_id: "b".into(), settings_json: "other text".into(), ..job.clone() };
        assert_eq!(frame_key(&renamed, &settings), key);

        let image = Some(Blob { digest: "d".into(), size: 1 });
        let view = FrameView { image, ..FrameView::default() };
        let other_input = FrameJob { training_views: vec![view], ..job.clone() };
        let other_seed = Settings { seed: 1, ..settings.clone() };
        let others = [
            frame_key(&other_input, &settings),
            frame_key(&FrameJob { frame: 3, ..job.clone() }, &settings),
            frame_key(&FrameJob { key_frame: true, ..job.clone() }, &settings),
            frame_key(&job, &other_seed),
        ];
        assert!(others.iter().all(|other| *other != key));
    }
}
