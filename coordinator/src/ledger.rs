//! Which track fields of a job there are, and which are still to be made: pure data, kept by the hub.
//!
//! Views are tracked in windows of some frames. Tracking goes on at the end of any window whose state is there; where
//! none is, at the key frame.

#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::Range,
};

use splat::formats::track_state::Shape;
use trackersplat_proto::v1::{Blob, Failure, TrackFrame, TrackJob, TrackedField, Tracker};

use crate::{failure::failure, queue::JobId};

/// The track fields of every training view of a job.
#[derive(Debug)]
pub(crate) struct TrackLedger {
    job: JobId,
    tracker: Tracker,
    key_frame: u32,
    /// Frames that a state may reach back.
    reach: usize,
    views: BTreeMap<u32, TrackedView>,
    /// What the last lease of each view covers.
    leased: BTreeMap<u32, Window>,
    /// States lost of each view since its last new field.
    lost: BTreeMap<u32, u32>,
    /// Fields that are there, and all.
    counts: (u64, u64),
    failed: Option<Failure>,
    /// Positions and frames of fields that another job was first to make.
    adopted: BTreeSet<(u32, u32)>,
}

/// One view and its fields.
#[derive(Clone, Debug)]
pub(crate) struct TrackedView {
    pub(crate) name: String,
    /// Width and height of its images, and so of its fields.
    pub(crate) size: (u32, u32),
    /// Width and height of the tracker's states; of a network's, the largest possible.
    pub(crate) state_size: (u32, u32),
    pub(crate) key_image: Blob,
    /// In order of frames, those after the key frame.
    pub(crate) fields: Vec<Field>,
    /// Fields per window, at least one.
    pub(crate) window: usize,
    /// The tracker's states after every window but the last.
    pub(crate) states: Vec<State>,
}

/// What the tracker remembers after a window.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct State {
    /// Names the state among the artifacts.
    pub(crate) key: String,
    /// The state, while there is one.
    pub(crate) blob: Option<Blob>,
}

/// What one lease covers: consecutive fields of a view; none where only the report is left.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Window {
    number: usize,
    /// By index.
    fields: Range<usize>,
    /// Whether there is more to track after it, and nothing to go on from.
    wants_state: bool,
}

/// The tracks of one view to one frame.
#[derive(Clone, Debug)]
pub(crate) struct Field {
    pub(crate) frame: u32,
    pub(crate) image: Blob,
    /// Names the field among the artifacts.
    pub(crate) key: String,
    /// The field, once there is one.
    pub(crate) tracks: Option<Blob>,
}

/// Where the state belongs that a window is to leave.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct StatePlace {
    pub(crate) key: String,
    /// Places in the view of the frames that it remembers: all that the next window may be chained to.
    pub(crate) past: Range<usize>,
    /// Its width and height; of a network's, the largest possible.
    pub(crate) size: (u32, u32),
    /// Whether a network tracks the view.
    pub(crate) learned: bool,
}

impl StatePlace {
    /// Refuses a state that does not belong here, before it is decompressed: with one that forgets frames, tracking would
    /// go on to other fields.
    pub(crate) fn check_shape(&self, found: Shape) -> Result<(), String> {
        let Shape { width, height, frames } = found;
        let needed = self.past.len();
        // Networks that see the key frame remember nothing.
        if frames == 0 && (self.learned || needed == 0) {
            return Ok(());
        }
        if frames as usize != needed {
            return Err(format!(
                "the tracker's state remembers {frames} frames of the view, the next window needs {needed}"
            ));
        }
        let (of_view, is_right) = match self.learned {
            true => ("at most ", width <= self.size.0 && height <= self.size.1),
            false => ("", (width, height) == self.size),
        };
        if !is_right {
            let (columns, rows) = self.size;
            return Err(format!(
                "the tracker's state is of {width} x {height} pixels, the view's are of {of_view}{columns} x {rows}"
            ));
        }
        Ok(())
    }

    /// Refuses a state of [the right shape](Self::check_shape) that remembers other frames.
    pub(crate) fn check_frames(&self, found: &[usize]) -> Result<(), String> {
        if found.is_empty() || found.iter().copied().eq(self.past.clone()) {
            return Ok(());
        }
        let needed: Vec<usize> = self.past.clone().collect();
        Err(format!(
            "the tracker's state remembers the view's frames {found:?}, the next window needs {needed:?}"
        ))
    }
}

impl TrackedView {
    /// What is to be tracked next, if anything is.
    fn next(&self) -> Option<Window> {
        let is_missing = |field: &Field| field.tracks.is_none();
        let first_missing = self.fields.iter().position(is_missing)?;
        let last_missing = self.fields.iter().rposition(is_missing)?;
        let is_there = |number: &usize| *number == 0 || self.state(number - 1).is_some();
        let number = (0..=first_missing / self.window).rev().find(is_there)?;
        let start = number * self.window;
        let end = start.saturating_add(self.window).min(self.fields.len());
        let wants_state = last_missing >= end && self.state(number).is_none();
        // Fields that exist after the last missing one are for nobody.
        let end = if wants_state { end } else { end.min(last_missing + 1) };
        Some(Window { number, fields: start..end, wants_state })
    }

    /// The state after a window.
    fn state(&self, number: usize) -> Option<&Blob> {
        self.states.get(number)?.blob.as_ref()
    }
}

/// Where a field belongs that is not there yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) key: String,
    pub(crate) size: (u32, u32),
}

impl TrackLedger {
    /// `views` by position in the clip.
    pub(crate) fn new(
        job: JobId,
        key_frame: u32,
        tracker: Tracker,
        reach: usize,
        views: BTreeMap<u32, TrackedView>,
    ) -> Self {
        let fields = || views.values().flat_map(|view| &view.fields);
        let held = fields().filter(|field| field.tracks.is_some()).count();
        let counts = (held as u64, fields().count() as u64);
        Self {
            job,
            tracker,
            key_frame,
            reach,
            views,
            leased: BTreeMap::new(),
            lost: BTreeMap::new(),
            counts,
            failed: None,
            adopted: BTreeSet::new(),
        }
    }

    /// Positions of the views, complete or not.
    pub(crate) fn positions(&self) -> Vec<u32> {
        self.views.keys().copied().collect()
    }

    /// Keys of a view's fields, in order of frames.
    pub(crate) fn keys(&self, position: u32) -> Vec<String> {
        let fields = self.views.get(&position).map(|view| view.fields.as_slice()).unwrap_or_default();
        fields.iter().map(|field| field.key.clone()).collect()
    }

    /// Name of a view; empty if it is not tracked.
    pub(crate) fn name(&self, position: u32) -> &str {
        self.views.get(&position).map_or("", |view| view.name.as_str())
    }

    /// What a worker gets that is to go on with a view; `None` if there is no such view. Whoever made the last field may be
    /// lost before its report: the window is empty then, and so is the report that ends the view.
    pub(crate) fn lease(&mut self, position: u32) -> Option<TrackJob> {
        let window = self.views.get(&position)?.next().unwrap_or_default();
        let job = self.job_of(position, &window);
        self.leased.insert(position, window);
        job
    }

    fn job_of(&self, position: u32, window: &Window) -> Option<TrackJob> {
        let view = self.views.get(&position)?;
        let start = window.fields.start;
        let frame = |field: &Field| TrackFrame {
            frame: field.frame,
            image: Some(field.image.clone()),
            tracks: field.tracks.clone(),
        };
        let key = TrackFrame { frame: self.key_frame, image: Some(view.key_image.clone()), tracks: None };
        Some(TrackJob {
            job_id: self.job.to_string(),
            view: view.name.clone(),
            tracker: Some(self.tracker.clone()),
            frames: std::iter::once(key)
                .chain(view.fields[window.fields.clone()].iter().map(frame))
                .collect(),
            // Places count the key frame.
            first: u32::try_from(start + 1).unwrap_or(u32::MAX),
            state: self.begins_from(position, window).and_then(|state| state.blob.clone()),
            past: view.fields[start.saturating_sub(self.reach)..start].iter().map(frame).collect(),
            wants_state: window.wants_state,
        })
    }

    /// The state that a window begins from; `None` at the key frame.
    fn begins_from(&self, position: u32, window: &Window) -> Option<&State> {
        self.views.get(&position)?.states.get(window.number.checked_sub(1)?)
    }

    /// The frame before which a view's next window goes out: tracks are made a window ahead of the frames that need them,
    /// those of all views in step.
    pub(crate) fn before(&self, position: u32) -> u32 {
        let Some(view) = self.views.get(&position) else { return 0 };
        let next = view.next().and_then(|window| window.number.checked_sub(1));
        next.map_or(0, |earlier| view.fields[earlier * view.window].frame)
    }

    /// The state that a view would go on from.
    pub(crate) fn next_state(&self, position: u32) -> Option<State> {
        let window = self.views.get(&position)?.next()?;
        self.begins_from(position, &window).cloned()
    }

    /// The state that the leased window of a view began from.
    pub(crate) fn leased_state(&self, position: u32) -> Option<State> {
        self.begins_from(position, self.leased.get(&position)?).cloned()
    }

    /// What the leased window of a view still lacks.
    pub(crate) fn lacks(&self, position: u32) -> Option<String> {
        let (view, window) = (self.views.get(&position)?, self.leased.get(&position)?);
        let missing = view.fields[window.fields.clone()].iter().find(|field| field.tracks.is_none());
        if let Some(field) = missing {
            return Some(format!("the tracks to frame {}", field.frame));
        }
        let lacks_state = window.wants_state && view.state(window.number).is_none();
        lacks_state.then(|| "the tracker's state after its window".to_owned())
    }

    /// Where the state belongs that the leased window of a view is to leave; `None` if none is wanted.
    pub(crate) fn state_place(&self, position: u32) -> Option<StatePlace> {
        let (view, window) = (self.views.get(&position)?, self.leased.get(&position)?);
        if !window.wants_state || view.state(window.number).is_some() {
            return None;
        }
        let next = window.fields.end + 1;
        let past = next.saturating_sub(self.reach).max(1)..next;
        let key = view.states.get(window.number)?.key.clone();
        Some(StatePlace { key, past, size: view.state_size, learned: self.tracker.model.is_some() })
    }

    /// The state after the leased window of a view is there.
    pub(crate) fn keep_state(&mut self, position: u32, blob: &Blob) {
        let Some(window) = self.leased.get(&position) else { return };
        let states = self.views.get_mut(&position).map(|view| &mut view.states);
        if let Some(state) = states.and_then(|states| states.get_mut(window.number)) {
            state.blob = Some(blob.clone());
        }
    }

    /// A state is gone: what is tracked next begins before it.
    pub(crate) fn lose_state(&mut self, position: u32, key: &str) {
        if self.drop_state(position, key) {
            self.count_lost(position);
        }
    }

    /// Takes a state away that the store has not lost: what is tracked next begins before it. Whether there was one.
    pub(crate) fn drop_state(&mut self, position: u32, key: &str) -> bool {
        let mut states = self.views.get_mut(&position).into_iter().flat_map(|view| &mut view.states);
        states.find(|state| state.key == key).is_some_and(|state| state.blob.take().is_some())
    }

    /// Counts a state that was lost, though it may never have been kept.
    pub(crate) fn count_lost(&mut self, position: u32) {
        *self.lost.entry(position).or_default() += 1;
    }

    /// States lost of a view since its last new field: many are a store that keeps none.
    pub(crate) fn lost_states(&self, position: u32) -> u32 {
        self.lost.get(&position).copied().unwrap_or_default()
    }

    /// Takes the states of a view that nobody needs any more: those before the one to go on from, but for the last of
    /// them, from which the window before is repeated where that one is lost.
    pub(crate) fn take_superseded(&mut self, position: u32) -> Vec<State> {
        let Some(view) = self.views.get_mut(&position) else { return Vec::new() };
        let needed = view.next().map_or(usize::MAX, |window| window.number.saturating_sub(2));
        let superseded = view.states.iter_mut().take(needed).filter(|state| state.blob.is_some());
        superseded.map(|state| State { key: state.key.clone(), blob: state.blob.take() }).collect()
    }

    /// Where a field belongs; `None` if this very field is there already. Refuses a frame that the leased window does not
    /// have, and a second field that differs from the first: tracks are a function of the images and the tracker. Beside a
    /// field of another job any other is left aside.
    pub(crate) fn place(&self, position: u32, found: &TrackedField) -> Result<Option<Place>, String> {
        let field = self.leased_field(position, found.frame).ok_or_else(|| {
            let view = self.name(position);
            format!("tracks of view '{view}' to frame {}: not of the window that is leased", found.frame)
        })?;
        let given = found.tracks.as_ref().ok_or("the worker's field names no blob")?;
        match &field.tracks {
            None => Ok(Some(Place { key: field.key.clone(), size: self.views[&position].size })),
            Some(known) if known == given => Ok(None),
            Some(_) if self.adopted.contains(&(position, found.frame)) => Ok(None),
            Some(known) => Err(format!(
                "tracks of view '{}' to frame {}: blob {} where {} was reported before",
                self.name(position),
                found.frame,
                given.digest,
                known.digest
            )),
        }
    }

    /// A field is there. The first one counts.
    pub(crate) fn keep(&mut self, position: u32, found: &TrackedField) {
        let Some(view) = self.views.get_mut(&position) else { return };
        let Ok(index) = view.fields.binary_search_by_key(&found.frame, |field| field.frame) else { return };
        if view.fields[index].tracks.is_none() {
            view.fields[index].tracks.clone_from(&found.tracks);
            self.counts.0 += 1;
            self.lost.remove(&position);
        }
    }

    /// Another job was first to make a field: its field counts here too.
    pub(crate) fn adopt(&mut self, position: u32, frame: u32, tracks: Blob) {
        self.adopted.insert((position, frame));
        self.keep(position, &TrackedField { frame, tracks: Some(tracks) });
    }

    /// The first frame to which a view is not tracked.
    pub(crate) fn missing(&self, position: u32) -> Option<u32> {
        let mut fields = self.views.get(&position)?.fields.iter();
        fields.find(|field| field.tracks.is_none()).map(|field| field.frame)
    }

    /// Frames to which a view is not tracked, in order, with the keys of their fields.
    pub(crate) fn missing_fields(&self, position: u32) -> Vec<(u32, String)> {
        let fields = self.views.get(&position).map(|view| view.fields.as_slice()).unwrap_or_default();
        let missing = fields.iter().filter(|field| field.tracks.is_none());
        missing.map(|field| (field.frame, field.key.clone())).collect()
    }

    /// The tracks of every view to a frame by position; `None` if any is missing. To the key frame there are none.
    pub(crate) fn at(&self, frame: u32) -> Option<BTreeMap<u32, Blob>> {
        if frame == self.key_frame {
            return Some(BTreeMap::new());
        }
        let tracks = |&position: &u32| Some((position, self.field(position, frame)?.tracks.clone()?));
        self.views.keys().map(tracks).collect()
    }

    /// Fields that are there, and all.
    pub(crate) fn counts(&self) -> (u64, u64) {
        self.counts
    }

    /// A view cannot be tracked, and why; without it no frame can be computed.
    pub(crate) fn fail(&mut self, position: u32, reason: &Failure) {
        let message = format!("tracks of view '{}': {}", self.name(position), reason.message);
        self.failed.get_or_insert(failure(reason.kind(), message));
    }

    /// Why a view cannot be tracked, if so.
    pub(crate) fn failed(&self) -> Option<&Failure> {
        self.failed.as_ref()
    }

    /// The tracks of one view to a frame.
    #[cfg(test)]
    pub(crate) fn tracks(&self, position: u32, frame: u32) -> Option<Blob> {
        self.field(position, frame)?.tracks.clone()
    }

    fn field(&self, position: u32, frame: u32) -> Option<&Field> {
        let index = self.index(position, frame)?;
        self.views.get(&position)?.fields.get(index)
    }

    /// The field to a frame of the leased window.
    fn leased_field(&self, position: u32, frame: u32) -> Option<&Field> {
        let index = self.index(position, frame)?;
        let is_leased = self.leased.get(&position)?.fields.contains(&index);
        self.views.get(&position)?.fields.get(index).filter(|_| is_leased)
    }

    fn index(&self, position: u32, frame: u32) -> Option<usize> {
        self.views.get(&position)?.fields.binary_search_by_key(&frame, |field| field.frame).ok()
    }
}
