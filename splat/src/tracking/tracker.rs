//! What tracks a view: the built-in tracker or a network.

use std::sync::Arc;

use super::{
    TrackField, TrackingSettings,
    learned::{LearnedError, LearnedTracker},
    view::track_view,
};
use crate::image::Image;

/// What tracks a view.
#[derive(Debug)]
pub enum Tracker {
    /// Needs no weights.
    BuiltIn,
    /// A neural network.
    Learned(Box<LearnedTracker>),
}

impl Tracker {
    /// The built-in tracker, or the network of an ONNX file: its bytes, and how errors call it.
    pub fn new(model: Option<(Vec<u8>, &str)>, settings: &TrackingSettings) -> Result<Self, LearnedError> {
        let Some((bytes, name)) = model else { return Ok(Self::BuiltIn) };
        Ok(Self::Learned(Box::new(LearnedTracker::from_onnx(bytes, name, &settings.onnx)?)))
    }

    /// Tracks every pixel of frame 0 of one view to each later frame: see [`track_view`].
    pub fn track_view<E: From<LearnedError>>(
        &self,
        frame_count: usize,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &TrackingSettings,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<(), E> {
        self.track_missing(frame_count, &|_| true, load, settings, emit)
    }

    /// [`Self::track_view`] where the fields of some frames are there already.
    ///
    /// Frames that are not wanted and on which no wanted one depends are neither loaded nor tracked. Fields that have to
    /// be made for the sake of later ones are emitted, wanted or not.
    pub fn track_missing<E: From<LearnedError>>(
        &self,
        frame_count: usize,
        is_wanted: &dyn Fn(usize) -> bool,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &TrackingSettings,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<(), E> {
        let needed = (1..frame_count).rev().find(|&index| is_wanted(index)).map_or(0, |last| last + 1);
        match self {
            Self::BuiltIn => track_view(needed, load, settings, emit),
            Self::Learned(tracker) => tracker.track_missing(needed, is_wanted, load, settings, emit),
        }
    }
}
