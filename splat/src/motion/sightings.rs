//! What each view says of each Gaussian, and which of it the lift believes: for those who judge tracks, or the lift.

use glam::{DVec2, DVec3};

use super::{
    MotionField, MotionOrigin, MotionSettings, MotionView, estimate_observed,
    observe::{self, Observation},
    solve_alone,
};
use crate::{
    engine::{Engine, EngineError},
    gaussians::Gaussians,
};

/// Where one view sees a Gaussian's mean at the target frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Index of the view.
    pub view: usize,
    /// Pixels.
    pub pixel: DVec2,
    /// What `pixel` may err by, standard deviation per axis, pixels.
    pub deviation: f64,
}

/// What a Gaussian's own views make of its motion, before its neighbours have a say.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// [`MotionOrigin::Static`], [`MotionOrigin::Solved`], or [`MotionOrigin::Unsolved`] where neighbours must supply what the
    /// views do not determine.
    pub origin: MotionOrigin,
    /// World displacement of the mean; along directions that no view sees, none.
    pub translation: DVec3,
    /// The views that were believed, ascending.
    pub believed: Vec<usize>,
}

/// All that the views see of some Gaussians.
pub struct Sightings<'a> {
    gaussians: &'a Gaussians,
    views: &'a [MotionView],
    settings: &'a MotionSettings,
    observations: Vec<Vec<Observation>>,
}

impl<'a> Sightings<'a> {
    /// Measures and fits all footprints, as [`super::estimate`] does.
    ///
    /// # Errors
    /// Those of [`super::estimate`].
    pub fn gather(
        engine: &dyn Engine,
        gaussians: &'a Gaussians,
        views: &'a [MotionView],
        settings: &'a MotionSettings,
    ) -> Result<Self, EngineError> {
        let observations = observe::observe(engine, gaussians, views, settings)?;
        Ok(Self { gaussians, views, settings, observations })
    }

    /// Where the views see a Gaussian, views ascending.
    pub fn of(&self, gaussian: usize) -> impl Iterator<Item = Seen> + '_ {
        self.observations[gaussian].iter().map(|observation| Seen {
            view: observation.view,
            pixel: observation.fit.target,
            deviation: observation.fit.variance.sqrt(),
        })
    }

    /// What the views of a Gaussian for which `keeps` holds say of it; `None` if they say nothing, or if no more than half of
    /// them agree.
    pub fn verdict(&self, gaussian: usize, keeps: impl Fn(usize) -> bool) -> Option<Verdict> {
        let kept = self.observations[gaussian].iter().copied().filter(|seen| keeps(seen.view));
        let kept: Vec<Observation> = kept.collect();
        let state = solve_alone(self.gaussians.mean(gaussian), &kept, self.views, self.settings);
        let own = state.own?;
        let believed = own.inliers.iter().map(|&index| kept[index].view).collect();
        Some(Verdict { origin: state.origin, translation: own.translation, believed })
    }

    /// The motion of all Gaussians if each is only seen by the views for which `keeps` holds, of its index and the view's: but for
    /// rounding what [`super::estimate`] finds, where that is all.
    ///
    /// # Errors
    /// Those of [`super::estimate`].
    pub fn field(&self, keeps: impl Fn(usize, usize) -> bool) -> Result<MotionField, EngineError> {
        let kept = |(gaussian, seen): (usize, &Vec<Observation>)| {
            seen.iter().copied().filter(|seen| keeps(gaussian, seen.view)).collect()
        };
        let kept: Vec<Vec<Observation>> = self.observations.iter().enumerate().map(kept).collect();
        estimate_observed(self.gaussians, &kept, self.views, self.settings, &mut |_| ())
    }
}
