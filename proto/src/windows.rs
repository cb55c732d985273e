//! Which frames a window of a view has, by their place among the frames of the view.

use std::ops::Range;

use crate::v1::{TrackFrame, TrackJob};

impl TrackJob {
    /// Places of the window's frames; the key frame has place 0.
    pub fn window(&self) -> Range<usize> {
        let first = self.first.max(1) as usize;
        first..first + self.frames.len().saturating_sub(1)
    }

    /// The frame at a place: the key frame, one of the window, or one that the state may remember.
    pub fn frame_at(&self, place: usize) -> Option<&TrackFrame> {
        let first = self.window().start;
        match place {
            0 => self.frames.first(),
            place if place >= first => self.frames.get(place - first + 1),
            place => self.past.get((place + self.past.len()).checked_sub(first)?),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_found_by_their_place_in_the_view() {
        let frames = |numbers: &[u32]| {
            numbers.iter().map(|&frame| TrackFrame { frame, ..TrackFrame::default() }).collect()
        };
        // Of the frames 10, 20, … 90 those at places 5 to 7, with two before them.
        let job = TrackJob {
            frames: frames(&[10, 60, 70, 80]),
            first: 5,
            past: frames(&[40, 50]),
            ..TrackJob::default()
        };
        assert_eq!(job.window(), 5..8);
        let number = |place: usize| job.frame_at(place).map(|frame| frame.frame);
        let found: Vec<_> = (0..9).map(number).collect();
        let expected = [Some(10), None, None, Some(40), Some(50), Some(60), Some(70), Some(80), None];
        assert_eq!(found, expected);
        assert_eq!(TrackJob::default().window(), 1..1);
        assert_eq!(TrackJob::default().frame_at(0), None);
    }
}
