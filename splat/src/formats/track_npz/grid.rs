//! Fields from points that form a grid in the key frame.

use crate::tracking::TrackField;

use super::{DEFAULT_SIGMA, pixel_centre};

/// Coordinates closer than this are the same column or row, pixels: rounding of the tracker's own rescaling.
const SAME: f32 = 0.02;
/// Growth of the standard deviation with the distance from the nearest point, per pixel.
const GROWTH: f32 = 0.1;
/// Weight below which a point does not decide whether a pixel is visible.
const NEGLIGIBLE: f32 = 0.05;

/// Points at the crossings of columns and rows, in pixels of the image.
pub(super) struct Grid {
    columns: Vec<f32>,
    rows: Vec<f32>,
    /// Which point of the file is at each crossing, row by row.
    order: Vec<usize>,
}

/// A pixel's place between two columns or rows: the first, the second, the share of the second, and the distance of
/// the nearer.
#[derive(Clone, Copy)]
struct Between {
    first: usize,
    second: usize,
    share: f32,
    distance: f32,
}

impl Grid {
    /// The pixels of an image of size `from`, stretched over one of size `to`.
    pub(super) fn of_pixels(from: (u32, u32), to: (u32, u32)) -> Self {
        let centres =
            |from: u32, to: u32| (0..from).map(|i| (i as f32 + 0.5) * (to as f32 / from as f32)).collect();
        let order = (0..from.0 as usize * from.1 as usize).collect();
        Self { columns: centres(from.0, to.0), rows: centres(from.1, to.1), order }
    }

    /// The grid that points form within an image of `size`; the reason why not, to follow "its points".
    pub(super) fn of_points(points: &[[f32; 2]], size: (u32, u32)) -> Result<Self, String> {
        let inside = |point: &[f32; 2]| {
            (0.0..=size.0 as f32).contains(&point[0]) && (0.0..=size.1 as f32).contains(&point[1])
        };
        if let Some(outside) = points.iter().find(|point| !inside(point)) {
            let (x, y) = (outside[0], outside[1]);
            return Err(format!(
                "do not all start in the image of {} x {}: one is at {x}, {y}",
                size.0, size.1
            ));
        }
        let columns = distinct(points.iter().map(|point| point[0]));
        let rows = distinct(points.iter().map(|point| point[1]));
        let shape = format!("form no grid in the key frame: {} columns, {} rows", columns.len(), rows.len());
        if columns.len().checked_mul(rows.len()) != Some(points.len()) {
            return Err(shape);
        }
        let mut order = vec![usize::MAX; points.len()];
        for (index, point) in points.iter().enumerate() {
            let crossing = nearest(&rows, point[1]) * columns.len() + nearest(&columns, point[0]);
            if order[crossing] != usize::MAX {
                return Err(format!("{shape}, two points at {}, {}", point[0], point[1]));
            }
            order[crossing] = index;
        }
        Ok(Self { columns, rows, order })
    }

    /// The field of an image of `size`; `points` are position and visibility in the order of the file, `sigma` is the
    /// standard deviation of a point.
    pub(super) fn field(&self, points: &[([f32; 2], bool)], sigma: f32, size: (u32, u32)) -> TrackField {
        let pixels = size.0 as usize * size.1 as usize;
        let columns = between(&self.columns, size.0);
        let rows = between(&self.rows, size.1);
        let mut field = TrackField {
            width: size.0,
            height: size.1,
            positions: Vec::with_capacity(pixels),
            visible: Vec::with_capacity(pixels),
            sigma: Vec::with_capacity(pixels),
        };
        for (y, &row) in rows.iter().enumerate() {
            for (x, &column) in columns.iter().enumerate() {
                let index = y * columns.len() + x;
                let centre = pixel_centre(index, size.0);
                let (moved, visible, spread) = self.interpolated(points, column, row);
                let distance = column.distance.hypot(row.distance);
                let deviation =
                    (sigma * sigma + 0.5 * spread + (GROWTH * distance) * (GROWTH * distance)).sqrt();
                let known = moved[0].is_finite() && moved[1].is_finite() && deviation.is_finite();
                field.positions.push(if known {
                    [centre[0] + moved[0], centre[1] + moved[1]]
                } else {
                    centre
                });
                field.visible.push(known && visible);
                field.sigma.push(if known { deviation } else { DEFAULT_SIGMA });
            }
        }
        field
    }

    /// Displacement at a place, whether all points around see it, and how far their displacements differ: their
    /// weighted variance.
    fn interpolated(
        &self,
        points: &[([f32; 2], bool)],
        column: Between,
        row: Between,
    ) -> ([f32; 2], bool, f32) {
        let corners = [
            (column.first, row.first, (1.0 - column.share) * (1.0 - row.share)),
            (column.second, row.first, column.share * (1.0 - row.share)),
            (column.first, row.second, (1.0 - column.share) * row.share),
            (column.second, row.second, column.share * row.share),
        ];
        let mut moved = [0.0; 2];
        let mut squares = 0.0;
        let mut visible = true;
        for (column, row, weight) in corners.into_iter().filter(|corner| corner.2 > 0.0) {
            let (position, seen) = points[self.order[row * self.columns.len() + column]];
            let step = [position[0] - self.columns[column], position[1] - self.rows[row]];
            moved = [moved[0] + weight * step[0], moved[1] + weight * step[1]];
            squares += weight * (step[0] * step[0] + step[1] * step[1]);
            visible &= seen || weight < NEGLIGIBLE;
        }
        let spread = (squares - moved[0] * moved[0] - moved[1] * moved[1]).max(0.0);
        (moved, visible, spread)
    }
}

/// The different values, ascending.
fn distinct(values: impl Iterator<Item = f32>) -> Vec<f32> {
    let mut values: Vec<f32> = values.collect();
    values.sort_by(f32::total_cmp);
    values.dedup_by(|next, kept| *next - *kept < SAME);
    values
}

/// Index of the nearest of ascending values.
fn nearest(values: &[f32], value: f32) -> usize {
    let after = values.partition_point(|&known| known < value).min(values.len() - 1);
    match after > 0 && value - values[after - 1] < values[after] - value {
        true => after - 1,
        false => after,
    }
}

/// The place of each of `count` pixel centres between ascending coordinates; the first or last beyond them.
fn between(coordinates: &[f32], count: u32) -> Vec<Between> {
    let place = |pixel: u32| {
        let centre = pixel as f32 + 0.5;
        let second = coordinates.partition_point(|&known| known < centre).min(coordinates.len() - 1);
        let first = second.saturating_sub(usize::from(coordinates[second] > centre));
        let (low, high) = (coordinates[first], coordinates[second]);
        let share = if high > low { (centre - low) / (high - low) } else { 0.0 };
        let distance = (centre - low).abs().min((high - centre).abs());
        Between { first, second, share, distance }
    };
    (0..count).map(place).collect()
}
