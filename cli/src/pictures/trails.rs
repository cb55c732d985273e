//! Tracks drawn over the frame they lead to.

use std::collections::VecDeque;

use splat::{image::Image, tracking::TrackField};

use super::{
    colours::{mixed, wheel},
    displacement,
};

/// Tracks along the longer side of the image.
const TRACKS_PER_SIDE: u32 = 32;
/// Frames that a trail reaches back.
const LENGTH: usize = 16;
/// Share of the frame's own colour that remains under the trails.
const FRAME_LIGHT: f32 = 0.5;

/// A sparse grid of tracks and where they were in the last frames.
pub(crate) struct Trails {
    /// Key-frame pixels that are drawn.
    pixels: Vec<usize>,
    /// Places and visibility of each, the newest frame last.
    past: VecDeque<Vec<([f32; 2], bool)>>,
}

impl Trails {
    /// The grid for images of a size.
    pub(crate) fn new(width: u32, height: u32) -> Self {
        let step = width.max(height).div_ceil(TRACKS_PER_SIDE).max(1);
        let rows = (step / 2..height).step_by(step as usize);
        let pixels: Vec<usize> = rows
            .flat_map(|y| {
                (step / 2..width)
                    .step_by(step as usize)
                    .map(move |x| y as usize * width as usize + x as usize)
            })
            .collect();
        let centre = |&i: &usize| {
            let width = width as usize;
            ([(i % width) as f32 + 0.5, (i / width) as f32 + 0.5], true)
        };
        let past = VecDeque::from([pixels.iter().map(centre).collect()]);
        Self { pixels, past }
    }

    /// The frame with the trails that end in it. A trail has the colour of its displacement's direction; where the
    /// track is hidden it is interrupted, and has no head.
    pub(crate) fn draw(&mut self, frame: &Image, field: &TrackField) -> Image {
        self.past.push_back(self.pixels.iter().map(|&i| (field.positions[i], field.visible[i])).collect());
        if self.past.len() > LENGTH + 1 {
            self.past.pop_front();
        }
        let mut picture = frame.clone();
        picture.pixels.iter_mut().for_each(|value| *value *= FRAME_LIGHT);
        for (track, &i) in self.pixels.iter().enumerate() {
            let colour = trail_colour(displacement(field, i));
            let places: Vec<_> = self.past.iter().map(|frame| frame[track]).collect();
            for pair in places.windows(2).filter(|pair| pair[0].1 && pair[1].1) {
                line(&mut picture, pair[0].0, pair[1].0, colour);
            }
            if field.visible[i] {
                head(&mut picture, field.positions[i], colour);
            }
        }
        picture
    }
}

/// Direction as hue, never white: a track that rests is to be seen as well.
fn trail_colour([u, v]: [f32; 2]) -> [f32; 3] {
    let length = u.hypot(v);
    if length < 0.5 {
        return [0.8; 3];
    }
    wheel([u / length, v / length].map(|value| 0.999 * value))
}

/// Blends a straight line, a point per half pixel.
fn line(picture: &mut Image, from: [f32; 2], to: [f32; 2], colour: [f32; 3]) {
    let length = (to[0] - from[0]).hypot(to[1] - from[1]);
    let diagonal = (picture.width as f32).hypot(picture.height as f32);
    // A segment longer than the image is no motion that could be drawn.
    if !(length <= diagonal) {
        return;
    }
    let steps = (2.0 * length).ceil().max(1.0) as u32;
    for step in 0..=steps {
        let share = step as f32 / steps as f32;
        let at = [from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1])];
        dot(picture, at, colour, 0.6);
    }
}

fn head(picture: &mut Image, at: [f32; 2], colour: [f32; 3]) {
    for [dx, dy] in [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]] {
        dot(picture, [at[0] + dx, at[1] + dy], colour, 1.0);
    }
}

fn dot(picture: &mut Image, at: [f32; 2], colour: [f32; 3], share: f32) {
    let size = [picture.width, picture.height].map(|side| side as f32);
    let inside = (0..2).all(|axis| at[axis] >= 0.0 && at[axis] < size[axis]);
    if !inside {
        return;
    }
    let first = 3 * (at[1] as usize * picture.width as usize + at[0] as usize);
    let old = [0, 1, 2].map(|channel: usize| picture.pixels[first + channel]);
    picture.pixels[first..first + 3].copy_from_slice(&mixed(old, colour, share));
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn moved(shift: [f32; 2], visible: bool) -> TrackField {
        let positions =
            (0..64 * 48).map(|i| [(i % 64) as f32 + 0.5 + shift[0], (i / 64) as f32 + 0.5 + shift[1]]);
        TrackField {
            width: 64,
            height: 48,
            positions: positions.collect(),
            visible: vec![visible; 64 * 48],
            sigma: vec![1.0; 64 * 48],
        }
    }

    #[test]
    fn trails_lead_from_where_tracks_were_to_where_they_are() {
        let frame = Image::filled(64, 48, [0.2; 3]);
        let mut trails = Trails::new(64, 48);
        let picture = trails.draw(&frame, &moved([6.0, 0.0], true));
        // The track of pixel (33, 25) ends at (39, 25), in red; it starts where it was.
        assert!(picture.at(39, 25)[0] > 0.9 && picture.at(39, 25)[1] < 0.1);
        assert!(picture.at(33, 25)[0] > 0.5);
        // Behind the track there is nothing but the frame, darker.
        assert_eq!(picture.at(30, 24), [0.1; 3]);
    }

    #[test]
    fn hidden_tracks_and_impossible_ones_are_not_drawn() {
        let frame = Image::filled(64, 48, [0.2; 3]);
        let dark = [0.1; 3];
        let mut trails = Trails::new(64, 48);
        let picture = trails.draw(&frame, &moved([6.0, 0.0], false));
        assert!((0..64).all(|x| picture.at(x, 25) == dark));
        for shift in [[f32::NAN, 0.0], [1e30, 0.0], [f32::INFINITY, -1.0]] {
            let picture = trails.draw(&frame, &moved(shift, true));
            assert!((0..64).all(|x| picture.at(x, 25) == dark), "{shift:?}");
        }
        assert_eq!(Trails::new(0, 0).pixels.len(), 0);
    }

    #[test]
    fn a_trail_forgets_what_is_long_past() {
        let frame = Image::filled(64, 48, [0.2; 3]);
        let mut trails = Trails::new(64, 48);
        for _ in 0..40 {
            trails.draw(&frame, &moved([0.0, 0.0], true));
        }
        assert_eq!(trails.past.len(), LENGTH + 1);
    }
}
