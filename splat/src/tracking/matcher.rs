//! The socket of pair matchers: what finds the flow between two frames that the tracks are chained from.

use std::convert::Infallible;

use super::{
    TrackingSettings,
    consistency::Judged,
    flow::Flow,
    pair::{Frame, Guides, Pyramid, match_frames},
};
use crate::image::Image;

/// The flow from a frame to another, and back, at the finest level of the frames.
pub(super) struct Ways {
    pub(super) forward: Flow,
    pub(super) backward: Flow,
}

/// How the matches of a matcher err.
#[derive(Clone, Copy)]
pub(super) enum Noise {
    /// As the model of standard deviations is fitted to it: neighbours that rest share their noise, as the flow is smoothed
    /// there.
    SharedAtRest,
    /// Nobody has measured it: by at least this standard deviation per axis, pixels, and by more than the model says.
    Unknown(f32),
}

/// Finds the flow between two frames of the same size.
pub(super) trait PairMatcher: Sync {
    /// Why it may fail.
    type Error;

    /// What it makes of a frame, once.
    type Prepared;

    /// How far its matches err where nothing speaks against them.
    const NOISE: Noise;

    /// A frame for this matcher.
    fn frame(&self, image: &Image, settings: &TrackingSettings) -> Frame<Self::Prepared>;

    /// The flow both ways; `guides` is what is known beforehand.
    fn both_ways(
        &self,
        first: &Frame<Self::Prepared>,
        second: &Frame<Self::Prepared>,
        guides: Option<Guides<'_>>,
        settings: &TrackingSettings,
    ) -> Result<Ways, Self::Error>;

    /// The flow of chosen tracks from the key frame, drawn to where the key frame itself says they are.
    fn anchored(
        &self,
        key: &Frame<Self::Prepared>,
        frame: &Frame<Self::Prepared>,
        tracks: &Judged,
        settings: &TrackingSettings,
    ) -> Flow;
}

/// The matcher without weights: patch search and variational refinement.
pub(super) struct PatchSearch;

impl PairMatcher for PatchSearch {
    type Error = Infallible;
    type Prepared = Pyramid;

    const NOISE: Noise = Noise::SharedAtRest;

    fn frame(&self, image: &Image, settings: &TrackingSettings) -> Frame<Pyramid> {
        Frame::new(image, settings)
    }

    fn both_ways(
        &self,
        first: &Frame<Pyramid>,
        second: &Frame<Pyramid>,
        guides: Option<Guides<'_>>,
        settings: &TrackingSettings,
    ) -> Result<Ways, Infallible> {
        let (forward, backward) = match_frames(first, second, guides, settings);
        Ok(Ways { forward, backward })
    }

    fn anchored(
        &self,
        key: &Frame<Pyramid>,
        frame: &Frame<Pyramid>,
        tracks: &Judged,
        settings: &TrackingSettings,
    ) -> Flow {
        key.refined(frame, tracks.flow.clone(), &tracks.visible, settings)
    }
}
