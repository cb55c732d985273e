//! Tracking of one view, frame after frame.

use std::{collections::VecDeque, convert::Infallible, sync::Arc};

use super::{
    TrackField, TrackingSettings, chain,
    consistency::{self, Judged},
    exposure::Exposure,
    fill,
    flow::{self, Flow},
    matcher::{PairMatcher, PatchSearch, Ways},
    pair::{Frame, Guides},
};
use crate::image::Image;

/// A frame that later frames may be chained to.
struct Past {
    index: usize,
    frame: Frame,
    tracks: Judged,
}

/// Tracks every pixel of frame 0 of one view to each later frame.
///
/// `load(i)` gives frame `i` of `frame_count` (0 is the key frame); `emit(i, field)` takes the field of frame `i`,
/// in ascending order from 1. The first error of either ends the work. Positions are finite whatever the frames
/// hold; where nothing can be said (a frame of another size than the key frame, say) all pixels are hidden and stay
/// where they were.
pub fn track_view<E>(
    frame_count: usize,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<(), E> {
    let mut loaded = |index: usize| load(index).map_err(Failure::Caller);
    let mut passed_on = |index: usize, field: TrackField| emit(index, field).map_err(Failure::Caller);
    track_frames(frame_count, &mut loaded, settings, &PatchSearch, &mut passed_on).map_err(|failure| {
        match failure {
            Failure::Caller(error) => error,
        }
    })
}

/// What ends the work when the matcher itself cannot fail.
enum Failure<E> {
    Caller(E),
}

impl<E> From<Infallible> for Failure<E> {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

/// [`track_view`] with any matcher of pairs.
pub(super) fn track_frames<E, M: PairMatcher>(
    frame_count: usize,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    matcher: &M,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<(), E>
where
    E: From<M::Error>,
{
    if frame_count < 2 {
        return Ok(());
    }
    let key_image = load(0)?;
    let size = (key_image.width, key_image.height);
    let empty = key_image.pixel_count() == 0;
    let mut tracker = if empty { None } else { Some(Tracker::new(&key_image, settings, matcher)) };
    drop(key_image);
    for index in 1..frame_count {
        let image = load(index)?;
        let field = match &mut tracker {
            Some(tracker) if (image.width, image.height) == size => tracker.track(index, &image)?,
            _ => unknown(size),
        };
        emit(index, field)?;
    }
    Ok(())
}

/// All pixels hidden, where they were.
pub(super) fn unknown((width, height): (u32, u32)) -> TrackField {
    let pixels = width as usize * height as usize;
    let centres = (0..height).flat_map(|y| (0..width).map(move |x| [x as f32 + 0.5, y as f32 + 0.5]));
    let sigma = unknown_sigma(width, height);
    TrackField {
        width,
        height,
        positions: centres.collect(),
        visible: vec![false; pixels],
        sigma: vec![sigma; pixels],
    }
}

/// Standard deviation of a position that may be anywhere in the image.
fn unknown_sigma(width: u32, height: u32) -> f32 {
    width.max(height).max(1) as f32
}

pub(super) struct Tracker<'a, M> {
    settings: &'a TrackingSettings,
    matcher: &'a M,
    width: u32,
    height: u32,
    key: Frame,
    exposure: Exposure,
    past: VecDeque<Past>,
}

impl<'a, M: PairMatcher> Tracker<'a, M> {
    pub(super) fn new(key: &Image, settings: &'a TrackingSettings, matcher: &'a M) -> Self {
        Self {
            settings,
            matcher,
            width: key.width,
            height: key.height,
            key: Frame::new(key, settings),
            exposure: Exposure::of(key),
            past: VecDeque::new(),
        }
    }

    pub(super) fn track(&mut self, index: usize, image: &Image) -> Result<TrackField, M::Error> {
        let frame = Frame::new(&self.exposure.equalised(image), self.settings);
        let chains = self.chains(index, &frame)?;
        let guess = (!chains.is_empty()).then(|| chain::choose(&chains));
        let direct = self.direct(&frame, guess.as_ref())?;
        // The direct match comes first: of equals, the one that cannot have drifted.
        let candidates: Vec<Judged> = std::iter::once(direct).chain(chains).collect();
        let mut tracks = chain::choose(&candidates);
        fill::fill_hidden(&mut tracks, &self.key.colours.interiors());
        let tracks = self.anchored(&frame, tracks);
        let field = self.field(&tracks);

        self.past.push_back(Past { index, frame, tracks });
        let longest = self.settings.gaps.iter().copied().max().unwrap_or(0) as usize;
        while self.past.front().is_some_and(|past| past.index + longest <= index) {
            self.past.pop_front();
        }
        Ok(field)
    }

    /// Frames that later ones may be chained to.
    #[cfg(test)]
    pub(super) fn remembered(&self) -> usize {
        self.past.len()
    }

    /// The tracks of earlier frames, continued to this one.
    fn chains(&self, index: usize, frame: &Frame) -> Result<Vec<Judged>, M::Error> {
        let earlier =
            self.settings.gaps.iter().filter_map(|&gap| {
                self.past.iter().find(|past| gap > 0 && past.index + gap as usize == index)
            });
        let continue_from = |past: &Past| {
            let Ways { forward, backward } =
                self.matcher.both_ways(&past.frame, frame, None, self.settings)?;
            let onward =
                consistency::judge(&past.frame, frame, forward, &backward, M::SMOOTHS_REST, self.settings);
            let mut chained = chain::chain(&past.tracks, &onward);
            consistency::recheck(&self.key, frame, &mut chained, self.settings);
            Ok(chained)
        };
        earlier.map(continue_from).collect()
    }

    /// The match of the key frame with this one, helped by the chained tracks.
    fn direct(&self, frame: &Frame, guess: Option<&Judged>) -> Result<Judged, M::Error> {
        let back: Option<Flow> = guess.map(chain::inverted);
        let guides = match (guess, &back) {
            (Some(guess), Some(backward)) => Some(Guides { forward: &guess.flow, backward, scale: 1.0 }),
            _ => None,
        };
        let Ways { forward, backward } = self.matcher.both_ways(&self.key, frame, guides, self.settings)?;
        Ok(consistency::judge(&self.key, frame, forward, &backward, M::SMOOTHS_REST, self.settings))
    }

    /// The tracks, refined once more against the key frame itself.
    fn anchored(&self, frame: &Frame, tracks: Judged) -> Judged {
        let flow = self.matcher.anchored(&self.key, frame, &tracks, self.settings);
        let before = tracks.flow;
        let mut anchored = Judged { flow, ..tracks };
        consistency::account_for_alignment(&mut anchored, &before);
        anchored
    }

    /// The tracks at the resolution of the images.
    fn field(&self, tracks: &Judged) -> TrackField {
        let (width, height) = (self.width as usize, self.height as usize);
        let flow = &tracks.flow;
        let scale = Flow::reduction([width, height], [flow.width, flow.height]);
        let stated = tracks.stated_sigma(self.settings.sigma_floor);
        let mut field = TrackField {
            width: self.width,
            height: self.height,
            positions: Vec::with_capacity(width * height),
            visible: Vec::with_capacity(width * height),
            sigma: Vec::with_capacity(width * height),
        };
        for y in 0..height {
            for x in 0..width {
                let (fx, fy) = ((x as f32 + 0.5) / scale - 0.5, (y as f32 + 0.5) / scale - 0.5);
                let corners = flow.corners(fx, fy);
                let [u, v] = flow.between(&corners);
                let visible = flow::sees(&corners, &tracks.visible);
                let sigma: f32 = corners.iter().map(|&(corner, weight)| weight * stated[corner]).sum();
                let position = [x as f32 + 0.5 + u * scale, y as f32 + 0.5 + v * scale];
                let sigma = sigma * scale + if visible { 0.0 } else { self.settings.hidden_sigma };
                if position[0].is_finite() && position[1].is_finite() && sigma.is_finite() && sigma > 0.0 {
                    field.positions.push(position);
                    field.visible.push(visible);
                    field.sigma.push(sigma);
                } else {
                    // Only settings without sense lead here.
                    field.positions.push([x as f32 + 0.5, y as f32 + 0.5]);
                    field.visible.push(false);
                    field.sigma.push(unknown_sigma(self.width, self.height));
                }
            }
        }
        field
    }
}
