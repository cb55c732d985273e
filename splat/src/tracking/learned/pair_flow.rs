//! Networks of the pair-flow signature as the matcher of the chained tracker.

use super::{
    LearnedError, LearnedTracker,
    network::{Input, Maps},
};
use crate::{
    image::Image,
    tracking::{
        TrackingSettings,
        consistency::Judged,
        flow::Flow,
        matcher::{Noise, PairMatcher, Ways},
        pair::{Frame, Guides},
    },
};

/// Displacement that leads out of any image, in its longer sides: what stands where the network says nothing.
pub(super) const OUTSIDE: f32 = 2.0;

/// Least standard deviation of a network's match, pixels of the images that are matched.
const LEAST_SIGMA: f32 = 0.03;

impl PairMatcher for LearnedTracker {
    type Error = LearnedError;
    type Prepared = ();

    const NOISE: Noise = Noise::Unknown(LEAST_SIGMA);

    fn frame(&self, image: &Image, settings: &TrackingSettings) -> Frame<()> {
        Frame::plain(image, settings)
    }

    fn both_ways(
        &self,
        first: &Frame<()>,
        second: &Frame<()>,
        _guides: Option<Guides<'_>>,
        _settings: &TrackingSettings,
    ) -> Result<Ways, LearnedError> {
        let [first, second] = [first, second]
            .map(|frame| self.network.input(frame.width(), frame.height(), &frame.colours.interiors()));
        let (first, second) = (first?, second?);
        let (forward, backward) = rayon::join(|| self.flow(&first, &second), || self.flow(&second, &first));
        Ok(Ways { forward: forward?, backward: backward? })
    }

    /// The network has seen more than the refinement could add.
    fn anchored(
        &self,
        _key: &Frame<()>,
        _frame: &Frame<()>,
        tracks: &Judged,
        _settings: &TrackingSettings,
    ) -> Flow {
        tracks.flow.clone()
    }
}

impl LearnedTracker {
    /// The settings of the chains around the network: images are halved only as far as leaves it the resolution that it
    /// takes.
    pub(super) fn chained(&self, settings: &TrackingSettings) -> TrackingSettings {
        // Halving an image of twice the side or more leaves the side; `seen` is the largest that is not halved.
        let seen = 2 * self.network.longest_side() as u32 - 1;
        let [max_side, full_side] = [settings.max_side, settings.full_side].map(|side| side.max(seen));
        let quarter_side = settings.quarter_side.max(2 * seen);
        TrackingSettings { max_side, full_side, quarter_side, ..settings.clone() }
    }

    fn flow(&self, first: &Input, second: &Input) -> Result<Flow, LearnedError> {
        let maps = self.network.run(first, second)?;
        Ok(flow_of(first, &maps))
    }
}

/// The flow at the resolution of the images.
pub(super) fn flow_of(input: &Input, maps: &Maps) -> Flow {
    let (width, height) = input.fit.image;
    let outside = OUTSIDE * width.max(height) as f32;
    let scale = input.fit.scale();
    let known = |index: usize| {
        let [u, v] = [0, 1].map(|axis: usize| maps.flow[axis][index] * scale[axis]);
        // Also refuses what is not a number.
        u.abs() <= outside && v.abs() <= outside
    };
    let known: Vec<bool> = (0..maps.flow[0].len()).map(known).collect();
    // Unknown pixels must not touch their neighbours when the map is enlarged.
    let weight: Vec<f32> = known.iter().map(|&known| f32::from(u8::from(known))).collect();
    let certain = input.fit.enlarged(&weight);
    let [u, v] = [0, 1].map(|axis: usize| {
        let finite: Vec<f32> = maps.flow[axis]
            .iter()
            .zip(&known)
            .map(|(&value, &known)| if known { value } else { 0.0 })
            .collect();
        let enlarged = input.fit.enlarged(&finite);
        enlarged
            .iter()
            .zip(&certain)
            .map(|(&value, &certain)| if certain > 0.999 { value * scale[axis] } else { outside })
            .collect()
    });
    Flow { width, height, u, v }
}
