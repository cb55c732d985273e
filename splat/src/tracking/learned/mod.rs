//! Trackers that are neural networks, from ONNX files that the user brings.
//!
//! A network takes two images `image1`, `image2`, f32 `[1, 3, H, W]`, and gives one of two sets of outputs:
//!
//! | signature | outputs |
//! |---|---|
//! | pair flow | `flow` `[1, 2, H, W]` |
//! | key to frame | `flow`, and `visibility` (probability) or `visibility_logits`, `[1, 1, H, W]` or `[1, H, W]`; optionally `sigma` (standard deviation per axis) or `log_variance`, of the same shape |
//!
//! `flow` is the displacement `x, y` in pixels of the input from `image1` to `image2`. Pair flow takes the place of
//! the built-in matcher: chaining, forward-backward and photometric agreement decide visibility and standard
//! deviation. A network of the other signature sees the key frame and a later one, and what it says is taken.
//!
//! A network is a program in a sandbox: it reads nothing but its inputs, but how much time and memory it takes is
//! bounded only by the size of the file and of the images.

mod error;
mod images;
mod key_to_frame;
mod network;
mod pair_flow;
mod settings;
mod signature;
#[cfg(test)]
mod test_model;
#[cfg(test)]
mod tests;
mod wire;

use std::{ops::Range, sync::Arc};

pub use error::LearnedError;
use network::Network;
pub use network::{MAX_MODEL_BYTES, MAX_SIDE};
pub use settings::{OnnxSettings, ValueRange};
pub use signature::Signature;

use super::{StateMisfit, TrackField, TrackState, TrackingSettings, view};
use crate::image::Image;

/// Standard deviation of tracks from networks that state none, pixels of the network's input.
const DEFAULT_SIGMA: f32 = 0.5;

/// A neural network that tracks.
#[derive(Debug)]
pub struct LearnedTracker {
    network: Network,
}

impl LearnedTracker {
    /// Reads an ONNX file; `name` is how errors call it.
    ///
    /// Files that are broken, larger than [`MAX_MODEL_BYTES`], need operators that the runtime lacks, or have neither
    /// signature are refused.
    pub fn from_onnx(bytes: Vec<u8>, name: &str, settings: &OnnxSettings) -> Result<Self, LearnedError> {
        Ok(Self { network: Network::load(bytes, name, settings)? })
    }

    /// What the network gives.
    pub fn signature(&self) -> Signature {
        self.network.signature()
    }

    /// Tracks every pixel of frame 0 of one view to each later frame, as [`track_view`](super::track_view) does.
    ///
    /// The bytes of the fields do not depend on the number of threads. Where the network gives no finite flow, the
    /// pixel is hidden.
    pub fn track_view<E: From<LearnedError>>(
        &self,
        frame_count: usize,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &TrackingSettings,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<(), E> {
        match self.signature() {
            Signature::PairFlow => view::track_whole(frame_count, load, &self.chained(settings), self, emit),
            Signature::KeyToFrame => {
                key_to_frame::track(self, 1..frame_count, &|_| true, load, settings, emit)
            }
        }
    }

    /// [`Tracker::track_window`](super::Tracker::track_window).
    pub(super) fn track_window<E: From<LearnedError> + From<StateMisfit>>(
        &self,
        from: TrackState,
        frames: Range<usize>,
        is_wanted: &dyn Fn(usize) -> bool,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &TrackingSettings,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<TrackState, E> {
        match self.signature() {
            Signature::PairFlow => {
                view::track_between(from, frames, load, &self.chained(settings), self, emit)
            }
            Signature::KeyToFrame => {
                key_to_frame::track(self, frames, is_wanted, load, settings, emit)?;
                Ok(TrackState::default())
            }
        }
    }
}
