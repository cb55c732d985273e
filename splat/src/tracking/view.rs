//! Tracking of one view, frame after frame.

use std::{collections::VecDeque, convert::Infallible, ops::Range, sync::Arc};

use super::{
    TrackField, TrackingSettings, chain,
    consistency::{self, Judged},
    exposure::Exposure,
    fill,
    flow::{self, Flow},
    matcher::{PairMatcher, PatchSearch, Ways},
    pair::{Frame, Guides},
    state::{Remembered, StateMisfit, TrackState},
};
use crate::image::Image;

/// A frame that later frames may be chained to.
struct Past<P> {
    index: usize,
    frame: Frame<P>,
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
    track_whole(frame_count, &mut loaded, settings, &PatchSearch, &mut passed_on)
        .map_err(Failure::into_caller)
}

/// Tracks some frames of a view, from the state before them to the state after them, with the built-in tracker.
pub(super) fn track_window<E: From<StateMisfit>>(
    from: TrackState,
    frames: Range<usize>,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<TrackState, E> {
    let mut loaded = |index: usize| load(index).map_err(Failure::Caller);
    let mut passed_on = |index: usize, field: TrackField| emit(index, field).map_err(Failure::Caller);
    track_between(from, frames, &mut loaded, settings, &PatchSearch, &mut passed_on)
        .map_err(Failure::into_caller)
}

/// What ends the work when the matcher itself cannot fail.
enum Failure<E> {
    Caller(E),
}

impl<E> Failure<E> {
    fn into_caller(self) -> E {
        let Self::Caller(error) = self;
        error
    }
}

impl<E> From<Infallible> for Failure<E> {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

impl<E: From<StateMisfit>> From<StateMisfit> for Failure<E> {
    fn from(misfit: StateMisfit) -> Self {
        Self::Caller(misfit.into())
    }
}

/// [`track_view`] with any matcher of pairs.
pub(super) fn track_whole<E: From<M::Error>, M: PairMatcher>(
    frame_count: usize,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    matcher: &M,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<(), E> {
    if frame_count < 2 {
        return Ok(());
    }
    View::open(load, settings, matcher)?.track(1..frame_count, load, emit)
}

/// [`track_window`] with any matcher of pairs. The empty state is the one right after the key frame.
pub(super) fn track_between<E, M: PairMatcher>(
    from: TrackState,
    frames: Range<usize>,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    matcher: &M,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<TrackState, E>
where
    E: From<M::Error> + From<StateMisfit>,
{
    let mut view = View::open(load, settings, matcher)?;
    view.recall(from, frames.start, load)?;
    view.track(frames.clone(), load, emit)?;
    Ok(view.state_before(frames.end))
}

/// A view that is tracked.
struct View<'a, M: PairMatcher> {
    size: (u32, u32),
    /// None where the key frame has no pixels.
    tracker: Option<Tracker<'a, M>>,
}

impl<'a, M: PairMatcher> View<'a, M> {
    fn open<E>(
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        settings: &'a TrackingSettings,
        matcher: &'a M,
    ) -> Result<Self, E> {
        let key = load(0)?;
        let tracker = (key.pixel_count() > 0).then(|| Tracker::new(&key, settings, matcher));
        Ok(Self { size: (key.width, key.height), tracker })
    }

    /// Remembers the frames before `first` that the state names.
    fn recall<E: From<StateMisfit>>(
        &mut self,
        from: TrackState,
        first: usize,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    ) -> Result<(), E> {
        let Some(tracker) = &mut self.tracker else { return Ok(()) };
        let size = [from.width, from.height];
        for remembered in from.frames {
            let index = remembered.index as usize;
            if index >= first {
                return Err(
                    StateMisfit(format!("it knows frame {index}, from {first} on is to be tracked")).into()
                );
            }
            tracker.recall(&*load(index)?, size, remembered)?;
        }
        Ok(())
    }

    fn track<E: From<M::Error>>(
        &mut self,
        frames: Range<usize>,
        load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
        emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
    ) -> Result<(), E> {
        for index in frames {
            let image = load(index)?;
            let field = match &mut self.tracker {
                Some(tracker) if (image.width, image.height) == self.size => tracker.track(index, &image)?,
                _ => unknown(self.size),
            };
            emit(index, field)?;
        }
        Ok(())
    }

    fn state_before(self, next: usize) -> TrackState {
        self.tracker.map_or_else(TrackState::default, |tracker| tracker.state_before(next))
    }
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

pub(super) struct Tracker<'a, M: PairMatcher> {
    settings: &'a TrackingSettings,
    matcher: &'a M,
    width: u32,
    height: u32,
    key: Frame<M::Prepared>,
    exposure: Exposure,
    past: VecDeque<Past<M::Prepared>>,
}

impl<'a, M: PairMatcher> Tracker<'a, M> {
    pub(super) fn new(key: &Image, settings: &'a TrackingSettings, matcher: &'a M) -> Self {
        Self {
            settings,
            matcher,
            width: key.width,
            height: key.height,
            key: matcher.frame(key, settings),
            exposure: Exposure::of(key),
            past: VecDeque::new(),
        }
    }

    pub(super) fn track(&mut self, index: usize, image: &Image) -> Result<TrackField, M::Error> {
        let frame = self.matcher.frame(&self.exposure.equalised(image), self.settings);
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
        self.forget_before(index + 1);
        Ok(field)
    }

    /// Forgets what neither frame `next` nor a later one can be chained to.
    fn forget_before(&mut self, next: usize) {
        let reach = self.settings.reach() as usize;
        while self.past.front().is_some_and(|past| past.index + reach < next) {
            self.past.pop_front();
        }
    }

    /// What tracking goes on from at frame `next`.
    fn state_before(mut self, next: usize) -> TrackState {
        // Frames of another size than the key frame pass without a trace.
        self.forget_before(next);
        let [width, height] = [self.key.width(), self.key.height()].map(|side| side as u32);
        let frames: Vec<_> =
            self.past.into_iter().map(|past| Remembered::of(past.index, past.tracks)).collect();
        if frames.is_empty() { TrackState::default() } else { TrackState { width, height, frames } }
    }

    /// Remembers a frame, whose image is `image`, as if it had just been tracked.
    fn recall(
        &mut self,
        image: &Image,
        [width, height]: [u32; 2],
        remembered: Remembered,
    ) -> Result<(), StateMisfit> {
        let misfit = |what: String| Err(StateMisfit(format!("frame {}: {what}", remembered.index)));
        if (image.width, image.height) != (self.width, self.height) {
            return misfit("its image is of another size than the key frame".into());
        }
        let size = [self.key.width(), self.key.height()];
        if [width as usize, height as usize] != size {
            return misfit(format!(
                "tracks of {width}x{height}, frames are matched at {}x{}",
                size[0], size[1]
            ));
        }
        let frame = self.matcher.frame(&self.exposure.equalised(image), self.settings);
        let index = remembered.index as usize;
        self.past.push_back(Past { index, frame, tracks: remembered.into_judged(size) });
        Ok(())
    }

    /// Frames that later ones may be chained to.
    #[cfg(test)]
    pub(super) fn remembered(&self) -> usize {
        self.past.len()
    }

    /// The tracks of earlier frames, continued to this one.
    fn chains(&self, index: usize, frame: &Frame<M::Prepared>) -> Result<Vec<Judged>, M::Error> {
        let earlier =
            self.settings.gaps.iter().filter_map(|&gap| {
                self.past.iter().find(|past| gap > 0 && past.index + gap as usize == index)
            });
        let continue_from = |past: &Past<M::Prepared>| {
            let Ways { forward, backward } =
                self.matcher.both_ways(&past.frame, frame, None, self.settings)?;
            let onward = consistency::judge(&past.frame, frame, forward, &backward, M::NOISE, self.settings);
            let mut chained = chain::chain(&past.tracks, &onward);
            consistency::recheck(&self.key, frame, &mut chained, self.settings);
            Ok(chained)
        };
        earlier.map(continue_from).collect()
    }

    /// The match of the key frame with this one, helped by the chained tracks.
    fn direct(&self, frame: &Frame<M::Prepared>, guess: Option<&Judged>) -> Result<Judged, M::Error> {
        let back: Option<Flow> = guess.map(chain::inverted);
        let guides = match (guess, &back) {
            (Some(guess), Some(backward)) => Some(Guides { forward: &guess.flow, backward, scale: 1.0 }),
            _ => None,
        };
        let Ways { forward, backward } = self.matcher.both_ways(&self.key, frame, guides, self.settings)?;
        Ok(consistency::judge(&self.key, frame, forward, &backward, M::NOISE, self.settings))
    }

    /// The tracks, refined once more against the key frame itself.
    fn anchored(&self, frame: &Frame<M::Prepared>, tracks: Judged) -> Judged {
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
        let deviations = tracks.deviations();
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
                let deviation: f32 =
                    corners.iter().map(|&(corner, weight)| weight * deviations[corner]).sum();
                let position = [x as f32 + 0.5 + u * scale, y as f32 + 0.5 + v * scale];
                let (found, floor) = (deviation * scale, self.settings.sigma_floor);
                let stated = (found * found + floor * floor).sqrt();
                let sigma = stated + if visible { 0.0 } else { self.settings.hidden_sigma };
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
