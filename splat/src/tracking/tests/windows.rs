//! Views that are tracked window by window.

use super::*;
use crate::formats::track_state;

/// Seven frames in motion; frame 3 is of another size than the others.
fn frames() -> Vec<Arc<Image>> {
    let texture = Texture::new(11, 4.0);
    let (behind, before) = (Texture::new(12, 6.0), Texture::new(13, 3.0));
    let moving = |t: f32| {
        render(60, 44, |x, y| {
            let on_square = (x - 14.0 - 3.0 * t).abs() < 8.0 && (y - 20.0).abs() < 8.0;
            if on_square { before.at(x - 3.0 * t, y) } else { behind.at(x + 0.4 * t, y) }
        })
    };
    let mut frames: Vec<_> = (0..7).map(|t| moving(t as f32)).collect();
    frames[3] = render(50, 44, |x, y| texture.at(x, y));
    frames
}

/// The fields of windows of `length` frames; every state goes through its blob.
fn in_windows(frames: &[Arc<Image>], length: usize, settings: &TrackingSettings) -> Vec<TrackField> {
    let mut fields = Vec::new();
    let mut state = TrackState::default();
    let mut first = 1;
    while first < frames.len() {
        let end = frames.len().min(first + length);
        let known: Vec<usize> = state.indices().collect();
        let mut load = |index: usize| {
            assert!(index == 0 || known.contains(&index) || (first..end).contains(&index), "{index}");
            Ok::<_, Failed>(frames[index].clone())
        };
        let mut emit = |index, field| {
            assert_eq!(index, fields.len() + 1);
            fields.push(field);
            Ok(())
        };
        let tracker = Tracker::BuiltIn;
        let after = tracker.track_window(state, first..end, &|_| true, &mut load, settings, &mut emit);
        state = track_state::decode(&track_state::encode(&after.unwrap())).unwrap();
        assert!(state.indices().all(|index| index < end && index + settings.reach() as usize >= end));
        first = end;
    }
    fields
}

#[test]
fn any_cut_of_a_view_gives_the_bytes_of_the_whole() {
    let frames = frames();
    for gaps in [&[1][..], &[1, 2], &[1, 2, 4], &[3], &[]] {
        let settings = TrackingSettings { gaps: gaps.to_vec(), ..TrackingSettings::preset(Quality::Draft) };
        let whole = track(&frames, &settings);
        for length in [1, 2, 3, 6] {
            assert_eq!(in_windows(&frames, length, &settings), whole, "gaps {gaps:?}, windows of {length}");
        }
    }
}

#[test]
fn a_state_of_something_else_is_refused_and_says_what_to_do() {
    let frames = frames();
    let settings = balanced();
    let resumed = |state: TrackState, images: &[Arc<Image>], first: usize, settings: &TrackingSettings| {
        let mut load = |index: usize| Ok::<_, Failed>(images[index].clone());
        let mut emit = |_, _| Ok(());
        let window = first..first + 1;
        Tracker::BuiltIn.track_window(state, window, &|_| true, &mut load, settings, &mut emit)
    };
    let state = resumed(TrackState::default(), &frames, 1, &settings).unwrap();
    assert_eq!(state.indices().collect::<Vec<_>>(), [1]);
    assert!(resumed(state.clone(), &frames, 2, &settings).is_ok());

    let refusal = |ended: Result<TrackState, Failed>| {
        let Failed(message) = ended.unwrap_err();
        assert!(message.contains("track the view from its key frame"), "{message}");
        message
    };
    let early = refusal(resumed(state.clone(), &frames, 1, &settings));
    assert!(early.contains("knows frame 1, from 1 on"), "{early}");
    let halved = TrackingSettings { full_side: 32, ..settings.clone() };
    let other_size = refusal(resumed(state.clone(), &frames, 2, &halved));
    assert!(other_size.contains("60x44") && other_size.contains("30x22"), "{other_size}");
    let mut exchanged = frames.clone();
    exchanged[1] = frames[3].clone();
    let other_image = refusal(resumed(state, &exchanged, 2, &settings));
    assert!(other_image.contains("frame 1: its image"), "{other_image}");
}

#[test]
fn a_view_without_pixels_remembers_nothing() {
    let empty = Arc::new(Image::filled(0, 0, [0.0; 3]));
    let fields = in_windows(&[empty.clone(), empty.clone(), empty], 1, &balanced());
    assert_eq!(fields.len(), 2);
}
