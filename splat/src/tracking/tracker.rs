//! What tracks a view: the built-in tracker or a network.

use std::{ops::Range, sync::Arc};

use super::{
    StateMisfit, TrackField, TrackState, TrackingSettings,
    learned::{LearnedError, LearnedTracker},
    view::{track_view, track_window},
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
        match self {
            Self::BuiltIn => track_view(frame_count, load, settings, emit),
            Self::Learned(tracker) => tracker.track_view(frame_count, load, settings, emit),
        }
    }

    /// Tracks the frames of a window of a view: from the state before them, which is the empty one where they begin with
    /// frame 1, to the state after them.
    ///
    /// However a view is cut, the fields are those of [`Self::track_view`] to the last bit. Besides the frames of the
    /// window, `load` is asked for the key frame and for those that the state names. Fields that are not wanted are
    /// emitted all the same where later ones depend on them, else their frames are not even loaded.
    pub fn track_window<E: From<LearnedError> + From<StateMisfit>>(
        &self,
        from: TrackState,
        frames: Range<usize>,
        is_wanted: &dyn Fn(usize) -> bool,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &TrackingSettings,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<TrackState, E> {
        match self {
            Self::BuiltIn => track_window(from, frames, load, settings, emit),
            Self::Learned(tracker) => tracker.track_window(from, frames, is_wanted, load, settings, emit),
        }
    }
}
