//! Tracks as other trackers' programs give them, besides the project's own arrays.
//!
//! | convention | arrays |
//! |---|---|
//! | own | `tracks` `[T, H, W, 2]` and `visible`: see the module above |
//! | DOT | `tracks` `[T, H, W, 3]` or `[1, T, H, W, 3]`: `x, y` and visibility; of every pixel at the tracker's resolution, which may differ from the images' |
//! | CoTracker | `pred_tracks` `[1, T, N, 2]` or `[T, N, 2]`, `pred_visibility` `[1, T, N]` or `[T, N]`; optionally `queries` `[1, N, 3]` or `[N, 3]`: frame, `x, y` |
//!
//! DOT and CoTracker count pixels from the centre of the top-left one: half a pixel is added. CoTracker's points may
//! come in any order, but must form a grid in the key frame; a sparse grid is interpolated, and its standard
//! deviations grow with the distance from the tracked points. Points at will determine no field and are refused.

use std::path::Path;

use super::{Archive, Array, DEFAULT_SIGMA, ImportedTracks, POSITIONS, fields_of, grid::Grid, later};
use crate::formats::TrackError;

/// What is added to positions that count from the centre of the top-left pixel.
const CENTRE: f32 = 0.5;

/// Reads a tracker's fields of one view whose images have `size` (width, height), in any of the conventions; index `i`
/// is the field of frame `i + 2`, counting the key frame as 1.
///
/// Fields of DOT and CoTracker have the size of the images; for the project's own see [`read_track_npz`](super::read_track_npz).
pub fn open_tracks(path: &Path, size: (u32, u32)) -> Result<ImportedTracks, TrackError> {
    let mut archive = Archive::open(path)?;
    if archive.has("pred_tracks") {
        return cotracker(&mut archive, size);
    }
    if POSITIONS.iter().all(|name| !archive.has(name)) {
        return Err(archive.missing(&["tracks", "positions", "pred_tracks"]));
    }
    let tracks = archive.floats(&POSITIONS)?;
    match tracks.shape.last() {
        Some(3) => dot(&archive, tracks, size),
        _ => fields_of(&mut archive, tracks),
    }
}

fn dot(archive: &Archive<'_>, tracks: Array<f32>, size: (u32, u32)) -> Result<ImportedTracks, TrackError> {
    let (frames, height, width) = match tracks.shape[..] {
        [frames, height, width, 3] | [1, frames, height, width, 3] => (frames, height, width),
        _ => {
            let expected = "[T, H, W, 3] or [1, T, H, W, 3], as DOT gives";
            return Err(archive.shape(&tracks.name, &tracks.shape, expected.into()));
        }
    };
    let (width, height, pixels) = archive.size(&tracks.name, &tracks.shape, width, height)?;
    let scale = [size.0 as f32 / width as f32, size.1 as f32 / height as f32];
    let grid = Grid::of_pixels((width, height), size);
    let sigma = DEFAULT_SIGMA * scale[0].max(scale[1]).max(1.0);
    let field = move |index: usize| {
        let frame = index + 1;
        let entries = &tracks.values[3 * pixels * frame..3 * pixels * (frame + 1)];
        let positions = entries.chunks_exact(3);
        let position = |entry: &[f32]| [(entry[0] + CENTRE) * scale[0], (entry[1] + CENTRE) * scale[1]];
        let points: Vec<_> = positions.map(|entry| (position(entry), entry[2] > 0.5)).collect();
        grid.field(&points, sigma, size)
    };
    Ok(ImportedTracks::new(later(frames), size, field))
}

fn cotracker(archive: &mut Archive<'_>, size: (u32, u32)) -> Result<ImportedTracks, TrackError> {
    let tracks = archive.floats(&["pred_tracks"])?;
    let (frames, points) = match tracks.shape[..] {
        [frames, points, 2] | [1, frames, points, 2] if frames > 0 && points > 0 => (frames, points),
        _ => {
            let expected = "[1, T, N, 2] or [T, N, 2], as CoTracker gives for one video";
            return Err(archive.shape(&tracks.name, &tracks.shape, expected.into()));
        }
    };
    let visible = archive.floats(&["pred_visibility"])?;
    if !matches!(visible.shape[..], [f, n] | [1, f, n] | [1, f, n, 1] if (f, n) == (frames, points)) {
        let expected = format!("[1, {frames}, {points}] or [{frames}, {points}], as `{}` has", tracks.name);
        return Err(archive.shape(&visible.name, &visible.shape, expected));
    }
    let points = points as usize;
    let (name, starts) = starts(archive, &tracks, points)?;
    let path = archive.path;
    let grid = Grid::of_points(&starts, size).map_err(|reason| TrackError::Array {
        path: path.into(),
        array: name,
        problem: format!(
            "its {points} points {reason}; track a grid of the key frame at the size of the images (CoTrackerPredictor \
             without queries, or with grid_size), or give every pixel as `tracks` [T, H, W, 2]"
        ),
    })?;
    let field = move |index: usize| {
        let frame = index + 1;
        let entries = frame * points..(frame + 1) * points;
        let positions = tracks.values[2 * entries.start..2 * entries.end].chunks_exact(2);
        let points: Vec<_> = positions
            .zip(&visible.values[entries])
            .map(|(position, &visible)| ([position[0] + CENTRE, position[1] + CENTRE], visible > 0.5))
            .collect();
        grid.field(&points, DEFAULT_SIGMA, size)
    };
    Ok(ImportedTracks::new(later(frames), size, field))
}

/// Where the points are in the key frame, and the array that says so: the queries, or the first frame's positions.
fn starts(
    archive: &mut Archive<'_>,
    tracks: &Array<f32>,
    points: usize,
) -> Result<(String, Vec<[f32; 2]>), TrackError> {
    if !archive.has("queries") {
        let first = tracks.values[..2 * points].chunks_exact(2);
        return Ok((tracks.name.clone(), first.map(|p| [p[0] + CENTRE, p[1] + CENTRE]).collect()));
    }
    let queries = archive.floats(&["queries"])?;
    if !matches!(queries.shape[..], [n, 3] | [1, n, 3] if n as usize == points) {
        let expected = format!("[1, {points}, 3] or [{points}, 3], a query for each of `{}`", tracks.name);
        return Err(archive.shape(&queries.name, &queries.shape, expected));
    }
    if let Some(late) = queries.values.chunks_exact(3).find(|query| query[0] != 0.0) {
        return Err(TrackError::Array {
            path: archive.path.into(),
            array: queries.name,
            problem: format!(
                "it asks for points of frame {}; ask for points of frame 0, the key frame",
                late[0]
            ),
        });
    }
    let starts = queries.values.chunks_exact(3).map(|query| [query[1] + CENTRE, query[2] + CENTRE]).collect();
    Ok((queries.name, starts))
}

#[cfg(test)]
mod tests;
