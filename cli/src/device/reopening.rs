//! An engine that outlives its device.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};

/// Opens a device.
pub(super) type Open = Box<dyn Fn() -> Result<Arc<dyn Engine>, EngineError> + Send + Sync>;

/// A device that may be taken.
pub(super) struct Candidate {
    /// What [`Engine::device_name`] says of it.
    pub(super) name: String,
    pub(super) open: Open,
}

/// An engine that opens its device when it is first needed, so that nobody waits for a device to hear that his input is wrong; the
/// first of its candidates that opens. That one is opened again when it is needed after it was lost. What was on
/// it is lost: sessions of before fail, and whoever had them begins again.
pub(super) struct ReopeningEngine {
    /// The best first.
    candidates: Vec<Candidate>,
    /// Which of them was opened.
    chosen: OnceLock<usize>,
    /// `None` before a device is opened, and while it cannot be.
    current: Mutex<Option<Arc<dyn Engine>>>,
}

impl ReopeningEngine {
    pub(super) fn new(candidates: Vec<Candidate>) -> Self {
        Self { candidates, chosen: OnceLock::new(), current: Mutex::new(None) }
    }

    fn current(&self) -> Result<Arc<dyn Engine>, EngineError> {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        let lost = match (&*current, self.chosen.get()) {
            (Some(engine), _) => match engine.check() {
                Ok(()) => return Ok(engine.clone()),
                Err(error) => error.to_string(),
            },
            (None, Some(_)) => "it was lost before".to_owned(),
            (None, None) => return self.open_first(&mut current),
        };
        // Its memory is free before the device is asked for the same again.
        *current = None;
        tracing::warn!(device = self.device_name(), lost, "opening the device again");
        self.open_first(&mut current).map_err(|error| match error {
            EngineError::DeviceLost(error) => {
                EngineError::DeviceLost(format!("{lost}; opening it again: {error}"))
            }
            other => other,
        })
    }

    /// Opens the chosen device, or chooses the first that opens.
    fn open_first(&self, current: &mut Option<Arc<dyn Engine>>) -> Result<Arc<dyn Engine>, EngineError> {
        let mut refusals = Vec::new();
        for (number, candidate) in self.candidates.iter().enumerate() {
            if self.chosen.get().is_some_and(|&chosen| chosen != number) {
                continue;
            }
            match (candidate.open)() {
                Ok(engine) => {
                    self.chosen.get_or_init(|| number);
                    return Ok(current.insert(engine).clone());
                }
                Err(error) => {
                    tracing::warn!(device = candidate.name, %error, "the device does not open");
                    refusals.push(error);
                }
            }
        }
        Err(refused(refusals))
    }
}

/// What the refusals of all candidates come to: the last if all are bugs or all want of memory, which another attempt does not
/// mend; else no device is there.
fn refused(mut refusals: Vec<EngineError>) -> EngineError {
    let are_bugs = refusals.iter().all(|error| matches!(error, EngineError::Internal(_)));
    let want_memory = refusals.iter().all(|error| matches!(error, EngineError::OutOfResources { .. }));
    if (are_bugs || want_memory)
        && let Some(last) = refusals.pop()
    {
        return last;
    }
    let refusals: Vec<_> = refusals.iter().map(EngineError::to_string).collect();
    EngineError::DeviceLost(format!("{}; --device cpu does without a GPU", refusals.join("; ")))
}

impl Engine for ReopeningEngine {
    fn name(&self) -> &str {
        "gpu"
    }

    fn device_name(&self) -> Option<&str> {
        let taken = self.chosen.get().copied().unwrap_or_default();
        self.candidates.get(taken).map(|candidate| candidate.name.as_str())
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

    fn on(bus: &Arc<Bus>) -> Candidate {
        named("Card A", bus)
    }

    fn named(name: &str, bus: &Arc<Bus>) -> Candidate {
        let bus = bus.clone();
        let open: Open = Box::new(move || {
            if bus.is_dead.load(SeqCst) {
                return Err(EngineError::DeviceLost("no driver".into()));
            }
            bus.is_lost.store(false, SeqCst);
            bus.opened.fetch_add(1, SeqCst);
            Ok(Arc::new(Card { bus: bus.clone() }))
        });
        Candidate { name: name.to_owned(), open }
    }

    fn camera() -> Camera {
        let (rotation, translation) = (DMat3::IDENTITY, DVec3::ZERO);
        Camera { width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.5, rotation, translation }
    }

    #[test]
    fn a_lost_device_is_opened_again_once_and_only_then() {
        let bus = Arc::new(Bus::default());
        let engine = ReopeningEngine::new(vec![on(&bus)]);
        assert_eq!(bus.opened.load(SeqCst), 0, "nobody has asked for anything");
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
        let engine = ReopeningEngine::new(vec![on(&bus)]);
        engine.check().unwrap();
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

    #[test]
    fn refusals_of_one_kind_keep_their_kind() {
        let bug = || EngineError::Internal("a kernel".into());
        let memory = || EngineError::OutOfResources { needed: 2, available: 1 };
        assert!(matches!(refused(vec![bug(), bug()]), EngineError::Internal(_)));
        assert!(matches!(refused(vec![memory()]), EngineError::OutOfResources { needed: 2, .. }));
        for mixed in
            [vec![bug(), memory()], vec![memory(), EngineError::DeviceLost("gone".into())], Vec::new()]
        {
            assert!(matches!(refused(mixed), EngineError::DeviceLost(_)));
        }
    }

    #[test]
    fn the_next_is_taken_where_the_first_does_not_open_and_is_kept() {
        let buses = [Arc::new(Bus::default()), Arc::new(Bus::default())];
        let opened = || buses.each_ref().map(|bus| bus.opened.load(SeqCst));
        let engine = ReopeningEngine::new(vec![named("Card A", &buses[0]), named("Card B", &buses[1])]);
        buses.iter().for_each(|bus| bus.is_dead.store(true, SeqCst));
        let error = engine.check().unwrap_err().to_string();
        assert!(error.matches("no driver").count() == 2 && error.contains("--device cpu"), "{error}");
        buses[1].is_dead.store(false, SeqCst);
        engine.check().unwrap();
        assert_eq!((engine.device_name(), opened()), (Some("Card B"), [0, 1]));
        // Results of another device would differ: the one that was lost is waited for.
        buses[0].is_dead.store(false, SeqCst);
        buses[1].is_dead.store(true, SeqCst);
        buses[1].is_lost.store(true, SeqCst);
        assert!(engine.check().is_err());
        buses[1].is_dead.store(false, SeqCst);
        engine.check().unwrap();
        assert_eq!((engine.device_name(), opened()), (Some("Card B"), [0, 2]));
    }
}
