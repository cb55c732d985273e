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
        state_size: (4, 3),
        key_image: blob("image-3"),
        fields: vec![field(4), field(6)],
        window: 16,
        states: Vec::new(),
    };
    let tracker = Tracker { settings_json: "{}".into(), ..Tracker::default() };
    let views = [(0, view("cam00")), (2, view("cam02"))].into();
    TrackLedger::new("job".into(), 3, tracker, 2, views)
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
    assert!(ledger.place(0, &found(4, "a")).is_err(), "nobody has a lease");
    ledger.lease(0).unwrap();
    let place = Place { key: "key-4".into(), size: (8, 6) };
    assert_eq!(ledger.place(0, &found(4, "a")), Ok(Some(place)));
    ledger.keep(0, &found(4, "a"));
    assert_eq!(ledger.place(0, &found(4, "a")), Ok(None));
    let message = ledger.place(0, &found(4, "other")).unwrap_err();
    assert!(message.contains("cam00") && message.contains("frame 4"), "{message}");
    ledger.keep(0, &found(4, "other"));
    assert_eq!(ledger.lease(0).unwrap().frames[1].tracks, Some(blob("a")));
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
        (ledger.lease(0).unwrap().frames[1].tracks.clone(), ledger.counts()),
        (Some(blob("theirs")), (1, 4))
    );
    assert_eq!(ledger.place(0, &found(4, "own")), Ok(None));
}

#[test]
fn a_task_names_what_exists_and_a_failure_its_view() {
    let mut ledger = ledger();
    ledger.keep(2, &found(6, "c"));
    let task = ledger.lease(2).unwrap();
    let frames: Vec<_> = task.frames.iter().map(|frame| (frame.frame, frame.tracks.is_some())).collect();
    assert_eq!(frames, [(3, false), (4, false)], "nobody needs frame 6 again");
    assert_eq!((task.view.as_str(), ledger.lease(1)), ("cam02", None));
    ledger.fail(2, &failure(FailureKind::BadInput, "frame 4 is no image"));
    ledger.fail(0, &failure(FailureKind::Bug, "later"));
    assert_eq!(ledger.failed().unwrap().message, "tracks of view 'cam02': frame 4 is no image");
}

/// One view over frames 10, 11, … 16 in windows of two; the key frame is 10.
fn in_windows(reach: usize) -> TrackLedger {
    in_windows_of(2, reach)
}

fn in_windows_of(window: usize, reach: usize) -> TrackLedger {
    let field = |frame: u32| Field {
        frame,
        image: blob(&format!("image-{frame}")),
        key: format!("key-{frame}"),
        tracks: None,
    };
    let view = TrackedView {
        name: "cam00".into(),
        size: (8, 6),
        state_size: (4, 3),
        key_image: blob("image-10"),
        fields: (11..=16).map(field).collect(),
        window,
        states: (0..6_usize.div_ceil(window) - 1)
            .map(|number| State { key: format!("state-{number}"), blob: None })
            .collect(),
    };
    TrackLedger::new("job".into(), 10, Tracker::default(), reach, [(0, view)].into())
}

fn numbers(frames: &[TrackFrame]) -> Vec<u32> {
    frames.iter().map(|frame| frame.frame).collect()
}

fn keep_leased(ledger: &mut TrackLedger, job: &TrackJob, state: Option<&str>) {
    for frame in &job.frames[1..] {
        ledger.keep(0, &found(frame.frame, "field"));
    }
    if let Some(state) = state {
        ledger.keep_state(0, &blob(state));
    }
}

#[test]
fn windows_follow_each_other_by_their_states() {
    let mut ledger = in_windows(3);
    assert_eq!(ledger.before(0), 0);
    let first = ledger.lease(0).unwrap();
    assert_eq!((numbers(&first.frames), first.first, first.past.len()), (vec![10, 11, 12], 1, 0));
    assert_eq!((&first.state, first.wants_state), (&None, true));
    assert_eq!(ledger.lacks(0).unwrap(), "the tracks to frame 11");
    keep_leased(&mut ledger, &first, None);
    assert!(ledger.lacks(0).unwrap().contains("state"));
    let place = StatePlace { key: "state-0".into(), past: 1..3, size: (4, 3), learned: false };
    assert_eq!(ledger.state_place(0), Some(place));
    keep_leased(&mut ledger, &first, Some("a"));
    assert_eq!((ledger.lacks(0), ledger.state_place(0), ledger.before(0)), (None, None, 11));

    let second = ledger.lease(0).unwrap();
    assert_eq!((numbers(&second.frames), numbers(&second.past)), (vec![10, 13, 14], vec![11, 12]));
    assert_eq!((second.first, second.state.clone(), second.wants_state), (3, Some(blob("a")), true));
    assert_eq!(ledger.state_place(0).unwrap().past, 2..5);
    assert_eq!(ledger.take_superseded(0), [], "it is begun from");
    keep_leased(&mut ledger, &second, Some("b"));
    assert_eq!(ledger.take_superseded(0), [], "the last but one is gone back to where the last is lost");

    let last = ledger.lease(0).unwrap();
    assert_eq!((numbers(&last.frames), numbers(&last.past)), (vec![10, 15, 16], vec![12, 13, 14]));
    assert_eq!((last.state.clone(), last.wants_state, ledger.before(0)), (Some(blob("b")), false, 13));
    keep_leased(&mut ledger, &last, None);
    assert_eq!((ledger.lacks(0), ledger.missing(0)), (None, None));
    let kept = |number: usize, name: &str| State { key: format!("state-{number}"), blob: Some(blob(name)) };
    assert_eq!(ledger.take_superseded(0), [kept(0, "a"), kept(1, "b")]);
}

#[test]
fn the_last_two_states_are_kept() {
    let mut ledger = in_windows_of(1, 1);
    let mut superseded = Vec::new();
    for state in ["a", "b", "c", "d"] {
        let job = ledger.lease(0).unwrap();
        keep_leased(&mut ledger, &job, Some(state));
        superseded.push(ledger.take_superseded(0).into_iter().map(|state| state.key).collect::<Vec<_>>());
    }
    assert_eq!(superseded, [vec![], vec![], vec!["state-0".to_owned()], vec!["state-1".to_owned()]]);
    ledger.lose_state(0, "state-3");
    let again = ledger.lease(0).unwrap();
    assert_eq!((again.first, again.state.clone()), (4, Some(blob("c"))), "one window is repeated");
}

#[test]
fn a_view_that_lacks_its_report_only_is_leased_with_an_empty_window() {
    let mut ledger = in_windows(1);
    for state in [Some("a"), Some("b"), None] {
        let job = ledger.lease(0).unwrap();
        keep_leased(&mut ledger, &job, state);
    }
    let job = ledger.lease(0).unwrap();
    assert_eq!((numbers(&job.frames), job.window().len(), job.past.len()), (vec![10], 0, 0));
    assert_eq!((job.state, job.wants_state), (None, false));
    assert_eq!((ledger.lacks(0), ledger.state_place(0), ledger.leased_state(0)), (None, None, None));
}

#[test]
fn only_fields_of_the_leased_window_are_placed() {
    let mut ledger = in_windows(1);
    for (window, state) in [([11, 12], "a"), ([13, 14], "b"), ([15, 16], "none")] {
        let job = ledger.lease(0).unwrap();
        for frame in 11..=16 {
            let placed = ledger.place(0, &found(frame, "field"));
            assert_eq!(placed.is_ok(), window.contains(&frame), "{window:?} {frame}");
        }
        keep_leased(&mut ledger, &job, Some(state));
    }
    let message = ledger.place(0, &found(11, "field")).unwrap_err();
    assert!(message.contains("frame 11: not of the window that is leased"), "{message}");
}

fn place(past: Range<usize>, learned: bool) -> StatePlace {
    StatePlace { key: "state".into(), past, size: (4, 3), learned }
}

#[test]
fn a_state_has_the_size_at_which_frames_are_matched_and_every_frame_that_is_needed() {
    let shape = |width, height, frames| Shape { width, height, frames };
    let refused = |learned, found| place(3..5, learned).check_shape(found).err().unwrap_or_default();
    for learned in [false, true] {
        assert_eq!(refused(learned, shape(4, 3, 2)), "");
        assert!(
            refused(learned, shape(4, 3, 1))
                .contains("remembers 1 frames of the view, the next window needs 2")
        );
        assert!(refused(learned, shape(4, 3, 3)).contains("needs 2"));
        assert!(refused(learned, shape(8, 6, 2)).contains("8 x 6 pixels"));
    }
    assert!(refused(false, shape(0, 0, 0)).contains("remembers 0 frames"));
    assert!(refused(false, shape(4, 2, 2)).contains("are of 4 x 3"));
    assert_eq!((refused(true, shape(0, 0, 0)), refused(true, shape(4, 2, 2))), Default::default());
    assert_eq!(place(3..3, false).check_shape(shape(0, 0, 0)), Ok(()), "nothing is chained");

    assert_eq!(place(3..5, false).check_frames(&[3, 4]), Ok(()));
    for other in [[2, 3], [3, 5]] {
        let message = place(3..5, false).check_frames(&other).unwrap_err();
        assert!(message.contains(&format!("{other:?}")) && message.contains("[3, 4]"), "{message}");
    }
}

#[test]
fn fields_that_are_missing_are_known_by_their_keys() {
    let mut ledger = ledger();
    let key = |frame: u32| (frame, format!("key-{frame}"));
    assert_eq!(ledger.missing_fields(0), [key(4), key(6)]);
    ledger.keep(0, &found(4, "a"));
    assert_eq!((ledger.missing_fields(0), ledger.missing_fields(1)), (vec![key(6)], vec![]));
}

#[test]
fn a_state_that_the_store_kept_well_is_not_counted_as_lost() {
    let mut ledger = in_windows(1);
    let job = ledger.lease(0).unwrap();
    keep_leased(&mut ledger, &job, Some("a"));
    assert!(ledger.drop_state(0, "state-0") && !ledger.drop_state(0, "state-0"));
    assert_eq!((ledger.next_state(0), ledger.lost_states(0)), (None, 0));
    ledger.count_lost(0);
    assert_eq!(ledger.lost_states(0), 1);
}

#[test]
fn lost_states_are_counted_until_a_field_comes() {
    let mut ledger = in_windows(1);
    let job = ledger.lease(0).unwrap();
    for _ in 0..2 {
        keep_leased(&mut ledger, &job, Some("a"));
        ledger.lose_state(0, "state-0");
        ledger.lose_state(0, "state-0");
        ledger.lease(0).unwrap();
    }
    assert_eq!(ledger.lost_states(0), 2, "the same loss counts once");
    ledger.keep(0, &found(13, "field"));
    assert_eq!(ledger.lost_states(0), 0);
}

#[test]
fn a_state_that_is_gone_costs_the_windows_before_it() {
    let mut ledger = in_windows(1);
    for state in ["a", "b"] {
        let job = ledger.lease(0).unwrap();
        keep_leased(&mut ledger, &job, Some(state));
    }
    assert_eq!(ledger.next_state(0).unwrap().key, "state-1");
    ledger.lose_state(0, "state-1");
    let again = ledger.lease(0).unwrap();
    assert_eq!((again.first, again.state.clone(), again.wants_state), (3, Some(blob("a")), true));
    assert!(again.frames[1..].iter().all(|frame| frame.tracks.is_some()), "only the state is missing");
    assert_eq!(ledger.leased_state(0).unwrap().key, "state-0");
    ledger.lose_state(0, "state-0");
    assert_eq!(ledger.lease(0).unwrap().first, 1);
    assert_eq!(ledger.leased_state(0), None);
    ledger.keep_state(0, &blob("a"));
    let again = ledger.lease(0).unwrap();
    assert_eq!((again.first, again.wants_state), (3, true));
}
