//! Guesses for hidden pixels: what no candidate sees moves most likely as its surface does where it is seen.

use super::consistency::Judged;

/// Difference of colours, summed over channels, that makes a neighbour count e times less, 0 to 255 scale.
const COLOUR_SCALE: f32 = 12.0;
/// Weight of all neighbours together below which a pixel waits for others.
const LEAST_WEIGHT: f32 = 1e-3;
/// Neighbours are looked for this many steps away, and steps double.
const REACH: isize = 2;

/// Replaces the displacements of hidden pixels by those of visible pixels of their colour nearby; where there is none
/// of the colour, of any. Without visible pixels all stay as they are. Visibility and doubt are not touched.
///
/// `colours` are the key frame's channels, 0 to 255.
pub(super) fn fill_hidden(tracks: &mut Judged, colours: &[Vec<f32>; 3]) {
    let mut known = tracks.visible.clone();
    if !known.contains(&true) {
        return;
    }
    for uses_colour in [true, false] {
        let mut step = 1;
        while known.contains(&false) && step <= tracks.flow.width.max(tracks.flow.height) {
            fill_from(tracks, &mut known, step, |a, b| {
                if !uses_colour {
                    return 1.0;
                }
                let difference: f32 = colours.iter().map(|channel| (channel[a] - channel[b]).abs()).sum();
                (-difference / COLOUR_SCALE).exp()
            });
            step *= 2;
        }
    }
}

/// One round: every unknown pixel that sees enough known ones at the given step takes their weighted mean.
fn fill_from(tracks: &mut Judged, known: &mut [bool], step: usize, weight: impl Fn(usize, usize) -> f32) {
    let flow = &mut tracks.flow;
    let (width, height) = (flow.width as isize, flow.height as isize);
    let mut found = Vec::new();
    for i in (0..known.len()).filter(|&i| !known[i]) {
        let (x, y) = (i as isize % width, i as isize / width);
        let (mut u, mut v, mut sum) = (0.0, 0.0, 0.0);
        for dy in -REACH..=REACH {
            for dx in -REACH..=REACH {
                let (x, y) = (x + dx * step as isize, y + dy * step as isize);
                if x < 0 || y < 0 || x >= width || y >= height {
                    continue;
                }
                let other = (y * width + x) as usize;
                if known[other] {
                    let weight = weight(i, other);
                    u += weight * flow.u[other];
                    v += weight * flow.v[other];
                    sum += weight;
                }
            }
        }
        if sum > LEAST_WEIGHT {
            found.push((i, u / sum, v / sum));
        }
    }
    // Only afterwards, so that the order of pixels does not matter.
    for (i, u, v) in found {
        (flow.u[i], flow.v[i], known[i]) = (u, v, true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::flow::Flow;

    /// A bright left and a dark right half that move apart; `visible` says who is seen.
    fn halves(visible: impl Fn(usize, usize) -> bool) -> (Judged, [Vec<f32>; 3]) {
        let (width, height) = (16, 4);
        let mut flow = Flow::zeros(width, height);
        let mut colours = [const { Vec::new() }; 3];
        let mut seen = Vec::new();
        for i in 0..width * height {
            let (x, y) = (i % width, i / width);
            let is_left = x < 8;
            seen.push(visible(x, y));
            // What is hidden has a wrong displacement.
            flow.u[i] = if !seen[i] {
                99.0
            } else if is_left {
                -3.0
            } else {
                5.0
            };
            flow.v[i] = if seen[i] { 1.0 } else { 99.0 };
            colours.iter_mut().for_each(|channel| channel.push(if is_left { 200.0 } else { 40.0 }));
        }
        (Judged::of(flow, seen, vec![1.0; width * height]), colours)
    }

    #[test]
    fn hidden_pixels_move_as_the_visible_ones_of_their_colour() {
        let (mut tracks, colours) = halves(|x, _| x != 7 && x != 8 && x < 13);
        fill_hidden(&mut tracks, &colours);
        for i in 0..16 * 4 {
            let expected = if i % 16 < 8 { -3.0 } else { 5.0 };
            assert!((tracks.flow.u[i] - expected).abs() < 1e-3, "{i}: {}", tracks.flow.u[i]);
            assert!((tracks.flow.v[i] - 1.0).abs() < 1e-3);
        }
        assert!(!tracks.visible[7] && !tracks.visible[15]);
    }

    #[test]
    fn without_the_colour_any_neighbour_serves_and_without_neighbours_nothing_changes() {
        let (mut tracks, colours) = halves(|x, _| x < 8);
        fill_hidden(&mut tracks, &colours);
        assert!(tracks.flow.u.iter().all(|u| (u + 3.0).abs() < 1e-3));
        let (mut tracks, colours) = halves(|_, _| false);
        fill_hidden(&mut tracks, &colours);
        assert!(tracks.flow.u.iter().all(|u| *u == 99.0));
    }

    #[test]
    fn colours_that_are_no_numbers_do_no_harm() {
        let (mut tracks, mut colours) = halves(|x, _| x < 8);
        colours[0][9] = f32::NAN;
        colours[1][3] = f32::INFINITY;
        fill_hidden(&mut tracks, &colours);
        assert!(tracks.flow.u.iter().all(|u| u.is_finite()));
    }
}
