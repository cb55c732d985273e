//! The static model: reconstructed from the key frame, or imported.

use std::path::Path;

use bytes::Bytes;
use serde_json::json;
use splat::{
    clip::{Clip, Split},
    engine::{Engine, EngineError, TrainingView},
    formats::ply,
    gaussians::{Gaussians, validate},
    settings::{MaskUse, Settings},
    static_model::{StaticModelError, StaticModelInput, StaticModelProgress, reconstruct},
};

use super::{Job, progress::StageProgress};
use crate::{
    failure::StageError,
    keys::{StaticModelKey, VERSION, digest_of, engine_key},
    store::Artifact,
};

/// Position of the key frame among the clip's frames.
const KEY_INDEX: usize = 0;

impl Job {
    pub(super) async fn make_static_model(&mut self) -> Result<(), StageError> {
        let artifact = match self.request.static_model.clone() {
            Some(file) => self.import_static_model(&file.path, &file.digest).await?,
            None => self.reconstruct_static_model().await?,
        };
        let mut change = self.hub.store.change().await?;
        change.set_static_model(&self.id, &artifact.blob, &artifact.note).await?;
        Ok(change.commit().await?)
    }

    async fn import_static_model(&self, path: &str, submitted: &str) -> Result<Artifact, StageError> {
        let key = digest_of(&("imported static model", VERSION, submitted));
        if let Some(known) = self.held_artifact(&key).await? {
            return Ok(known);
        }
        let (path, submitted) = (path.to_owned(), submitted.to_owned());
        let (bytes, report) = self.hub.compute.run(move || import(Path::new(&path), &submitted)).await?;
        self.keep_static_model(&key, bytes, report).await
    }

    async fn reconstruct_static_model(&mut self) -> Result<Artifact, StageError> {
        let clip = self.clip().await?;
        let engine = self.hub.engine.clone();
        let engine_key = self.hub.compute.run(move || opened_key(engine.as_ref())).await?;
        let training = clip.views().iter().filter(|view| view.split == Split::Train);
        let key = digest_of(&StaticModelKey {
            kind: "static model",
            version: VERSION,
            engine: &engine_key,
            clip: &self.record.clip_digest,
            key_frame: self.key_frame(),
            training_views: training.map(|view| view.name.as_str()).collect(),
            background: self.settings.background,
            masks: self.settings.masks,
            seed: self.settings.seed,
            settings: &self.settings.static_model,
        });
        if let Some(known) = self.held_artifact(&key).await? {
            tracing::info!(job_id = %self.id, "static model reused");
            return Ok(known);
        }
        let progress = StageProgress::new(self, "static-model");
        let (engine, settings) = (self.hub.engine.clone(), self.settings.clone());
        let work = move || {
            let input = input(&clip, &settings)?;
            let mut last = StaticModelProgress { step: 0, steps: 0, gaussians: 0, loss: 0.0 };
            let mut on_progress = |now: StaticModelProgress| {
                last = now;
                progress.set(now.step.into(), now.steps.into())
            };
            let attempt = || reconstruct(engine.as_ref(), &input, &mut on_progress);
            let model = despite_a_loss(engine.as_ref(), attempt)?;
            let report = json!({
                "source": "reconstructed", "gaussians": model.len(), "sh_degree": model.sh_degree,
                "steps": last.step, "loss": last.loss, "points": input.points.len(),
                "device": engine.device_name().unwrap_or(engine.name()),
            });
            Ok((encode(&model, "the reconstruction")?, report.to_string()))
        };
        let _turn = self.turn().await?;
        let (bytes, report) = self.hub.compute.run(work).await?;
        self.keep_static_model(&key, bytes, report).await
    }

    async fn keep_static_model(
        &self,
        key: &str,
        bytes: Bytes,
        report: String,
    ) -> Result<Artifact, StageError> {
        let artifact = Artifact { blob: self.hub.blobs.put(bytes).await?, note: report };
        let mut change = self.hub.store.change().await?;
        change.put_artifact(key, "static-model", &artifact).await?;
        change.commit().await?;
        Ok(artifact)
    }

    /// What was computed before under a key, if its bytes are still there.
    pub(super) async fn held_artifact(&self, key: &str) -> Result<Option<Artifact>, StageError> {
        let Some(artifact) = self.hub.store.artifact(key).await? else { return Ok(None) };
        Ok(self.hub.blobs.holds(&artifact.blob).await.then_some(artifact))
    }
}

/// The key of the engine's device, once it is open: which of several opens is not known before.
fn opened_key(engine: &dyn Engine) -> Result<String, StageError> {
    engine.check()?;
    Ok(engine_key(engine))
}

/// A second attempt where the device was lost in the first one and came back.
fn despite_a_loss<T>(
    engine: &dyn Engine,
    mut attempt: impl FnMut() -> Result<T, StaticModelError>,
) -> Result<T, StaticModelError> {
    match attempt() {
        Err(StaticModelError::Engine(EngineError::DeviceLost(reason))) => {
            tracing::warn!(reason, "the static model begins again");
            engine.check()?;
            attempt()
        }
        ended => ended,
    }
}

fn import(path: &Path, submitted: &str) -> Result<(Bytes, String), StageError> {
    let bad = |reason: String| StageError::bad_input(format!("static model {}: {reason}", path.display()));
    let bytes = std::fs::read(path).map_err(|error| bad(format!("{error}; check the path")))?;
    if crate::blobs::name(&bytes).digest != submitted {
        return Err(bad("the file has changed since the job was submitted; submit the job again".into()));
    }
    let model = ply::parse_ply(&bytes).map_err(|error| bad(error.to_string()))?;
    if model.is_empty() {
        return Err(bad("it holds no Gaussian; give a file with at least one".into()));
    }
    let encoded = encode(&model, &path.display().to_string())?;
    let report = json!({
        "source": path.display().to_string(), "gaussians": model.len(), "sh_degree": model.sh_degree,
    });
    Ok((encoded, report.to_string()))
}

/// Every static model is stored in one layout, whatever tool made it.
fn encode(model: &Gaussians, source: &str) -> Result<Bytes, StageError> {
    validate::validate(model).map_err(|error| {
        StageError::bad_input(format!("static model from {source}: {error}; remove such Gaussians first"))
    })?;
    Ok(Bytes::from(ply::write_ply(model)))
}

fn input(clip: &Clip, settings: &Settings) -> Result<StaticModelInput, StageError> {
    let bad = |error: splat::clip::ClipError| StageError::bad_input(error.to_string());
    let mut views = Vec::new();
    for (index, view) in clip.views().iter().enumerate().filter(|(_, view)| view.split == Split::Train) {
        let mask = match settings.masks {
            MaskUse::Train => clip.mask(index, KEY_INDEX).map_err(bad)?,
            MaskUse::Evaluate => None,
        };
        let image = clip.image(index, KEY_INDEX).map_err(bad)?;
        views.push(TrainingView { camera: view.camera.clone(), image, mask });
    }
    Ok(StaticModelInput {
        views,
        points: clip.points().to_vec(),
        background: settings.background,
        seed: settings.seed,
        settings: settings.static_model.clone(),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering::SeqCst};

    use splat::{
        cameras::Camera,
        engine::{Rendering, Session, SessionInput},
        motion::{moments::FootprintMoments, reweighting::Reweighting},
        raster::CpuEngine,
        tracking::TrackField,
    };

    use super::*;

    /// Its first device does not open, which it finds out when it is asked.
    #[derive(Default)]
    struct Lazy(AtomicBool);

    impl Engine for Lazy {
        fn name(&self) -> &str {
            "gpu"
        }

        fn device_name(&self) -> Option<&str> {
            Some(if self.0.load(SeqCst) { "Card B" } else { "Card A" })
        }

        fn check(&self) -> Result<(), EngineError> {
            self.0.store(true, SeqCst);
            Ok(())
        }

        fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
            unreachable!("nobody asked")
        }

        fn footprint_moments(
            &self,
            _: &Gaussians,
            _: &Camera,
            _: &TrackField,
            _: Option<&Reweighting>,
        ) -> Result<Vec<FootprintMoments>, EngineError> {
            unreachable!("nobody asked")
        }

        fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
            unreachable!("nobody asked")
        }
    }

    #[test]
    fn the_key_names_the_device_that_opened() {
        assert_eq!(opened_key(&Lazy::default()).ok().as_deref(), Some("gpu Card B"));
    }

    fn lost<T>() -> Result<T, StaticModelError> {
        Err(StaticModelError::Engine(EngineError::DeviceLost("off the bus".into())))
    }

    #[test]
    fn a_lost_device_costs_one_attempt_and_nothing_else_is_tried_twice() {
        let engine = CpuEngine::default();
        let mut attempts = 0;
        let made = despite_a_loss(&engine, || {
            attempts += 1;
            if attempts == 1 { lost() } else { Ok(attempts) }
        });
        assert_eq!(made.ok(), Some(2));

        let mut attempts = 0;
        let failed = despite_a_loss::<()>(&engine, || {
            attempts += 1;
            lost()
        });
        assert!(matches!(failed, Err(StaticModelError::Engine(EngineError::DeviceLost(_)))));
        assert_eq!(attempts, 2);

        let mut attempts = 0;
        let refused = despite_a_loss::<()>(&engine, || {
            attempts += 1;
            Err(StaticModelError::BadInput("no view".into()))
        });
        assert!(matches!(refused, Err(StaticModelError::BadInput(_))));
        assert_eq!(attempts, 1);
    }
}
