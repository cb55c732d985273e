//! Which track fields of a job there are, and which are still to be made: pure data, kept by the hub.

use std::collections::{BTreeMap, BTreeSet};

use trackersplat_proto::v1::{Blob, Failure, TrackFrame, TrackJob, TrackedField, Tracker};

use crate::{failure::failure, queue::JobId};

/// The track fields of every training view of a job.
#[derive(Debug)]
pub(crate) struct TrackLedger {
    job: JobId,
    tracker: Tracker,
    key_frame: u32,
    views: BTreeMap<u32, TrackedView>,
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
    pub(crate) key_image: Blob,
    /// In order of frames, those after the key frame.
    pub(crate) fields: Vec<Field>,
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
        views: BTreeMap<u32, TrackedView>,
    ) -> Self {
        let fields = || views.values().flat_map(|view| &view.fields);
        let held = fields().filter(|field| field.tracks.is_some()).count();
        let counts = (held as u64, fields().count() as u64);
        Self { job, tracker, key_frame, views, counts, failed: None, adopted: BTreeSet::new() }
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

    /// What a worker gets; `None` if the view is not tracked.
    pub(crate) fn task(&self, position: u32) -> Option<TrackJob> {
        let view = self.views.get(&position)?;
        let key = TrackFrame { frame: self.key_frame, image: Some(view.key_image.clone()), tracks: None };
        let later = view.fields.iter().map(|field| TrackFrame {
            frame: field.frame,
            image: Some(field.image.clone()),
            tracks: field.tracks.clone(),
        });
        Some(TrackJob {
            job_id: self.job.to_string(),
            view: view.name.clone(),
            tracker: Some(self.tracker.clone()),
            frames: std::iter::once(key).chain(later).collect(),
        })
    }

    /// Where a field belongs; `None` if this very field is there already. Refuses a frame that the job does not have, and
    /// a second field that differs from the first: tracks are a function of the images and the tracker. Beside a field of
    /// another job any other is left aside.
    pub(crate) fn place(&self, position: u32, found: &TrackedField) -> Result<Option<Place>, String> {
        let field = self.field(position, found.frame).ok_or_else(|| {
            format!("tracks of view '{}' to frame {}: not of the job", self.name(position), found.frame)
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

    fn field(&self, position: u32, frame: u32) -> Option<&Field> {
        let fields = &self.views.get(&position)?.fields;
        fields.binary_search_by_key(&frame, |field| field.frame).ok().map(|index| &fields[index])
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use trackersplat_proto::v1::FailureKind;

    use super::*;

    fn blob(name: &str) -> Blob {
        Blob { digest: name.into(), size: 10 }
    }

    fn found(frame: u32, name: &str) -> TrackedField {
        TrackedField { frame, tracks: Some(blob(name)) }
    }

    /// Views 0 and 2 over frames 3, 4, 6; the key frame is 3.
    fn ledger() -> TrackLedger {
        let field = |frame: u32| Field {
            frame,
            image: blob(&format!("image-{frame}")),
            key: format!("key-{frame}"),
            tracks: None,
        };
        let view = |name: &str| TrackedView {
            name: name.into(),
            size: (8, 6),
            key_image: blob("image-3"),
            fields: vec![field(4), field(6)],
        };
        let tracker = Tracker { settings_json: "{}".into(), ..Tracker::default() };
        let views = [(0, view("cam00")), (2, view("cam02"))].into();
        TrackLedger::new("job".into(), 3, tracker, views)
    }

    #[test]
    fn a_frame_is_tracked_once_every_view_is() {
        let mut ledger = ledger();
        assert_eq!(ledger.at(3), Some(BTreeMap::new()), "nothing moves to the key frame");
        ledger.keep(0, &found(4, "a"));
        assert_eq!((ledger.at(4), ledger.missing(0), ledger.missing(2)), (None, Some(6), Some(4)));
        ledger.keep(2, &found(4, "b"));
        assert_eq!(ledger.at(4), Some([(0, blob("a")), (2, blob("b"))].into()));
        assert_eq!((ledger.at(6), ledger.at(5), ledger.counts()), (None, None, (2, 4)));
        ledger.keep(0, &found(6, "c"));
        assert_eq!((ledger.missing(0), ledger.positions()), (None, vec![0, 2]));
    }

    #[test]
    fn the_first_field_counts_and_another_one_is_a_defect() {
        let mut ledger = ledger();
        let place = Place { key: "key-4".into(), size: (8, 6) };
        assert_eq!(ledger.place(0, &found(4, "a")), Ok(Some(place)));
        ledger.keep(0, &found(4, "a"));
        assert_eq!(ledger.place(0, &found(4, "a")), Ok(None));
        let message = ledger.place(0, &found(4, "other")).unwrap_err();
        assert!(message.contains("cam00") && message.contains("frame 4"), "{message}");
        ledger.keep(0, &found(4, "other"));
        assert_eq!(ledger.task(0).unwrap().frames[1].tracks, Some(blob("a")));
        for (position, frame) in [(0, 3), (0, 5), (1, 4)] {
            assert!(ledger.place(position, &found(frame, "a")).is_err(), "{position} {frame}");
        }
        assert!(ledger.place(0, &TrackedField { frame: 6, tracks: None }).is_err());
    }

    #[test]
    fn a_field_of_another_job_counts_and_a_different_one_is_left_aside() {
        let mut ledger = ledger();
        ledger.adopt(0, 4, blob("theirs"));
        assert_eq!(
            (ledger.task(0).unwrap().frames[1].tracks.clone(), ledger.counts()),
            (Some(blob("theirs")), (1, 4))
        );
        assert_eq!(ledger.place(0, &found(4, "own")), Ok(None));
    }

    #[test]
    fn a_task_names_what_exists_and_a_failure_its_view() {
        let mut ledger = ledger();
        ledger.keep(2, &found(6, "c"));
        let task = ledger.task(2).unwrap();
        let frames: Vec<_> = task.frames.iter().map(|frame| (frame.frame, frame.tracks.is_some())).collect();
        assert_eq!(frames, [(3, false), (4, false), (6, true)]);
        assert_eq!((task.view.as_str(), ledger.task(1)), ("cam02", None));
        ledger.fail(2, &failure(FailureKind::BadInput, "frame 4 is no image"));
        ledger.fail(0, &failure(FailureKind::Bug, "later"));
        assert_eq!(ledger.failed().unwrap().message, "tracks of view 'cam02': frame 4 is no image");
    }
}
