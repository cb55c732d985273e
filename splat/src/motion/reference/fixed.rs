//! Gaussians at rest.

use super::{MIN_VIEWS, Sight};
use crate::tracking::TrackField;

/// Displacement, px of the tracks, below which a pixel stays.
const STILL: f64 = 0.2;
/// Share of a footprint's weight that must stay.
const STILL_SHARE: f64 = 0.9;
/// Pixels of a footprint that are not enough for a vote.
const TOO_FEW_PIXELS: u32 = 9;
/// A view votes if it sees this share of what the best view sees …
const SHARE_OF_BEST: f64 = 0.5;
/// … or this much, whatever the others see.
const ENOUGH_WEIGHT: f64 = 1.0;

/// Which pixels of the key frame stay where they are.
pub(super) fn still_pixels(tracks: &TrackField) -> Vec<bool> {
    let width = (tracks.width as usize).max(1);
    let stays = |(pixel, [x, y]): (usize, &[f32; 2])| {
        let (column, row) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        (f64::from(*x) - column).hypot(f64::from(*y) - row) < STILL
    };
    tracks.positions.iter().enumerate().map(stays).collect()
}

/// Whether more than two views that see the Gaussian well find nearly all of it at rest.
pub(super) fn is_fixed(sights: &[Sight]) -> bool {
    let best = sights.iter().map(|sight| sight.weight).fold(0.0, f64::max);
    let votes = sights.iter().filter(|sight| {
        let sees_it = sight.weight >= SHARE_OF_BEST * best || sight.weight > ENOUGH_WEIGHT;
        sight.pixels > TOO_FEW_PIXELS && sight.still_weight > STILL_SHARE * sight.weight && sees_it
    });
    votes.count() > MIN_VIEWS
}
