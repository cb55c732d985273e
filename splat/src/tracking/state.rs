//! What tracking goes on from in the middle of a view: the tracks that later frames are chained to.

use thiserror::Error;

use super::{TrackingSettings, consistency::Judged, flow::Flow};

/// The tracker's memory between two frames of a view: with the images of the frames that it names, which are prepared
/// anew, tracking goes on as if it had never stopped, to the last bit.
///
/// Empty right after the key frame, and where nothing is chained: networks that see the key frame remember nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackState {
    /// Columns of the tracks, at the resolution at which frames are matched.
    pub(crate) width: u32,
    /// Rows of the tracks.
    pub(crate) height: u32,
    /// Ascending by index.
    pub(crate) frames: Vec<Remembered>,
}

/// Numbers per pixel of a frame that is remembered.
pub(crate) const PLANES: usize = 4;

/// A frame that later ones may be chained to.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Remembered {
    /// Position among the frames of the view; the key frame is 0.
    pub(crate) index: u32,
    /// Displacement along x and y, standard deviation, and links of [`Judged`], per pixel row by row.
    pub(crate) planes: [Vec<f32>; PLANES],
    /// Whether the track is visible, per pixel.
    pub(crate) visible: Vec<bool>,
}

impl Remembered {
    /// What chains carry on; the rest of `tracks` counts for their own frame only.
    pub(super) fn of(index: usize, tracks: Judged) -> Self {
        let Judged { flow: Flow { u, v, .. }, visible, sigma, links, .. } = tracks;
        // Views have less than 2³² frames: their numbers on the wire have 32 bits.
        Self { index: u32::try_from(index).unwrap_or(u32::MAX), planes: [u, v, sigma, links], visible }
    }

    /// The tracks, on a grid of this size.
    pub(super) fn into_judged(self, [width, height]: [usize; 2]) -> Judged {
        let [u, v, sigma, links] = self.planes;
        Judged { links, ..Judged::of(Flow { width, height, u, v }, self.visible, sigma) }
    }
}

impl TrackState {
    /// Frames that are remembered, ascending, by position among those of the view.
    pub fn indices(&self) -> impl Iterator<Item = usize> {
        self.frames.iter().map(|frame| frame.index as usize)
    }
}

impl TrackingSettings {
    /// The longest distance in frames over which tracks are chained: a state remembers at most as many frames.
    pub fn reach(&self) -> u32 {
        self.gaps.iter().copied().max().unwrap_or(0)
    }
}

/// A state that is not of this view, of these settings, or of the frames before the window.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("the tracker's state does not fit: {0}; track the view from its key frame")]
pub struct StateMisfit(pub(super) String);
