//! An engine that outlives its device.

use std::sync::{Arc, Mutex, PoisonError};

use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};

/// Opens a device.
pub(super) type Open = Box<dyn Fn() -> Result<Arc<dyn Engine>, EngineError> + Send + Sync>;

/// An engine whose device is opened again when it is needed after it was lost. What was on it is lost: sessions of before
/// fail, and whoever had them begins again.
pub(super) struct ReopeningEngine {
    open: Open,
    name: String,
    device: Option<String>,
    /// `None` while the device cannot be opened.
    current: Mutex<Option<Arc<dyn Engine>>>,
}

impl ReopeningEngine {
    pub(super) fn new(open: Open) -> Result<Self, EngineError> {
        let engine = open()?;
        Ok(Self {
            name: engine.name().to_owned(),
            device: engine.device_name().map(str::to_owned),
            current: Mutex::new(Some(engine)),
            open,
        })
    }

    fn current(&self) -> Result<Arc<dyn Engine>, EngineError> {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        let lost = match &*current {
            Some(engine) => match engine.check() {
                Ok(()) => return Ok(engine.clone()),
                Err(error) => error.to_string(),
            },
            None => "it was lost before".to_owned(),
        };
        // Its memory is free before the device is asked for the same again.
        *current = None;
        tracing::warn!(device = self.device, lost, "opening the device again");
        let engine = (self.open)()
            .map_err(|error| EngineError::DeviceLost(format!("{lost}; opening it again: {error}")))?;
        *current = Some(engine.clone());
        Ok(engine)
    }
}

impl Engine for ReopeningEngine {
    fn name(&self) -> &str {
        &self.name
    }

    fn device_name(&self) -> Option<&str> {
        self.device.as_deref()
    }

    fn check(&self) -> Result<(), EngineError> {
        self.current().map(drop)
    }

    fn render(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<Rendering, EngineError> {
        self.current()?.render(gaussians, camera, background)
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        self.current()?.footprint_moments(gaussians, camera, tracks, reweighting)
    }

    fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        self.current()?.session(input)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};

    use glam::{DMat3, DVec3};
    use splat::raster::CpuEngine;

    use super::*;

    #[derive(Default)]
    struct Bus {
        is_lost: AtomicBool,
        is_dead: AtomicBool,
        opened: AtomicU32,
    }

    /// The CPU engine behind a bus that can fail.
    struct Card {
        bus: Arc<Bus>,
    }

    impl Card {
        fn alive(&self) -> Result<CpuEngine, EngineError> {
            self.check().map(|()| CpuEngine::default())
        }
    }

    impl Engine for Card {
        fn name(&self) -> &str {
            "gpu"
        }

        fn device_name(&self) -> Option<&str> {
            Some("Card A")
        }

        fn check(&self) -> Result<(), EngineError> {
            if self.bus.is_lost.load(SeqCst) {
                return Err(EngineError::DeviceLost("off the bus".into()));
            }
            Ok(())
        }

        fn render(
            &self,
            gaussians: &Gaussians,
            camera: &Camera,
            background: [f32; 3],
        ) -> Result<Rendering, EngineError> {
            self.alive()?.render(gaussians, camera, background)
        }

        fn footprint_moments(
            &self,
            gaussians: &Gaussians,
            camera: &Camera,
            tracks: &TrackField,
            reweighting: Option<&Reweighting>,
        ) -> Result<Vec<FootprintMoments>, EngineError> {
            self.alive()?.footprint_moments(gaussians, camera, tracks, reweighting)
        }

        fn session(&self, input: SessionInput) -> Result<Box<dyn Session>, EngineError> {
            self.alive()?.session(input)
        }
    }

    fn open(bus: &Arc<Bus>) -> Open {
        let bus = bus.clone();
        Box::new(move || {
            if bus.is_dead.load(SeqCst) {
                return Err(EngineError::DeviceLost("no driver".into()));
            }
            bus.is_lost.store(false, SeqCst);
            bus.opened.fetch_add(1, SeqCst);
            Ok(Arc::new(Card { bus: bus.clone() }))
        })
    }

    fn camera() -> Camera {
        let (rotation, translation) = (DMat3::IDENTITY, DVec3::ZERO);
        Camera { width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.5, rotation, translation }
    }

    #[test]
    fn a_lost_device_is_opened_again_once_and_only_then() {
        let bus = Arc::new(Bus::default());
        let engine = ReopeningEngine::new(open(&bus)).unwrap();
        assert_eq!((engine.name(), engine.device_name()), ("gpu", Some("Card A")));
        let render = || engine.render(&Gaussians::empty(0), &camera(), [0.5; 3]);
        for (is_lost, opened) in [(false, 1), (false, 1), (true, 2), (false, 2)] {
            bus.is_lost.store(is_lost, SeqCst);
            assert_eq!(render().unwrap().image.pixels, [0.5; 36]);
            assert_eq!(bus.opened.load(SeqCst), opened);
        }
    }

    #[test]
    fn a_device_that_stays_away_is_lost_with_both_reasons_until_it_is_back() {
        let bus = Arc::new(Bus::default());
        let engine = ReopeningEngine::new(open(&bus)).unwrap();
        bus.is_lost.store(true, SeqCst);
        bus.is_dead.store(true, SeqCst);
        let error = engine.check().unwrap_err();
        assert!(
            matches!(&error, EngineError::DeviceLost(why) if why.contains("off the bus") && why.contains("no driver")),
            "{error}"
        );
        assert!(matches!(engine.check(), Err(EngineError::DeviceLost(_))));
        bus.is_dead.store(false, SeqCst);
        engine.check().unwrap();
        assert_eq!(bus.opened.load(SeqCst), 2);
    }
}
