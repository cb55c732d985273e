//! Exact trajectories of single points of a rendered clip.
//!
//! | array | content |
//! |---|---|
//! | `xyz` | f32 or f64 `[T, N, 3]`: place in the world, frame by frame |
//! | `visible` | u8, `numpy.packbits` over the points of bool `[T, C, N]` |
//! | `cameras` | text `[C]`: the views that `visible` is about |
//! | `dynamic` | bool or u8 `[N]`: whether the point is on a mover |

use std::path::Path;

use glam::DVec3;
use npyz::TypeChar;

use super::{Archive, numpy_bit};
use crate::{cameras::Camera, formats::TrackError, metrics::tracks::PointQuery};

/// Exact trajectories of points, and which views see them.
#[derive(Clone, Debug)]
pub struct PointTracks {
    views: Vec<String>,
    moving: Vec<bool>,
    /// `[T][N]`.
    places: Vec<DVec3>,
    /// `[T][C]` rows of `row` bytes.
    visible: Vec<u8>,
    row: usize,
}

impl PointTracks {
    /// Reads the points of a clip.
    pub fn read(path: &Path) -> Result<Self, TrackError> {
        let mut archive = Archive::open(path)?;
        let xyz = archive.floats(&["xyz"])?;
        let &[frames, points, 3] = &xyz.shape[..] else {
            return Err(archive.shape(&xyz.name, &xyz.shape, "[T, N, 3]".into()));
        };
        let views = archive.texts(&["cameras"])?;
        let row = points.div_ceil(8);
        let visible = archive.bytes(&["visible"])?;
        let packed = [frames, views.values.len() as u64, row];
        if visible.shape != packed {
            let expected = format!("{packed:?} (packed bits of {points} points)");
            return Err(archive.shape(&visible.name, &visible.shape, expected));
        }
        let moving = archive.floats(&["dynamic"])?;
        if moving.shape != [points] {
            return Err(archive.shape(&moving.name, &moving.shape, format!("[{points}]")));
        }
        let place = |xyz: &[f32]| DVec3::new(xyz[0].into(), xyz[1].into(), xyz[2].into());
        Ok(Self {
            views: views.values,
            moving: moving.values.iter().map(|&value| value > 0.5).collect(),
            places: xyz.values.chunks_exact(3).map(place).collect(),
            visible: visible.values,
            row: row as usize,
        })
    }

    /// Points on movers (`moving`), or the others, that a view sees in the first frame, as they are at frame `frame`
    /// (0 is the first). None for a frame or a view that is not there.
    pub fn queries(
        &self,
        view: &str,
        camera: &Camera,
        frame: usize,
        moving: bool,
    ) -> Option<Vec<PointQuery>> {
        let column = self.views.iter().position(|name| name == view)?;
        let count = self.moving.len();
        let now = self.places.get(frame * count..(frame + 1) * count)?;
        let is_seen = |frame: usize, point: usize| {
            numpy_bit(&self.visible[(frame * self.views.len() + column) * self.row..], point)
        };
        let query = |point: usize| {
            let at_key = camera.project_world(self.places[point])?;
            let exact = camera.project_world(now[point]);
            let asked = self.moving[point] == moving && is_seen(0, point) && camera.contains(at_key);
            asked.then(|| PointQuery {
                at_key: at_key.to_array(),
                exact: exact.unwrap_or_default().to_array(),
                visible: exact.is_some() && is_seen(frame, point),
            })
        };
        Some((0..count).filter_map(query).collect())
    }
}

impl Archive<'_> {
    fn texts(&mut self, names: &[&str]) -> Result<super::Array<String>, TrackError> {
        self.read(names, |kind, file| match kind {
            (TypeChar::UnicodeStr, _) => Ok(file.into_vec::<String>()),
            _ => Err("text (as numpy.array(['cam00', ...]) gives)"),
        })
    }
}
