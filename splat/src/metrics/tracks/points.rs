//! TAP-Vid scores of single points (Doersch et al., "TAP-Vid: A Benchmark for Tracking Any Point in a Video", 2022),
//! queried at the key frame.

use serde::Serialize;

use super::share;
use crate::tracking::TrackField;

/// Distances that count as found, pixels of an image scaled to 256×256.
pub const POINT_THRESHOLDS: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];
/// Side of the image in which distances are measured.
const SIDE: f64 = 256.0;

/// Counts of one view's points, over the frames after the key frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointScores {
    visible: u64,
    hidden: u64,
    occlusion_right: u64,
    called_visible: u64,
    /// Of the visible: within the threshold.
    found: [u64; POINT_THRESHOLDS.len()],
    /// Of these: called visible.
    found_and_called: [u64; POINT_THRESHOLDS.len()],
}

/// Figures of [`PointScores`]; none where there is nothing to measure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PointReport {
    /// Points times frames.
    pub points: u64,
    /// δ_avg: share of visible points within 1, 2, 4, 8 and 16 px, averaged.
    pub delta_average: Option<f64>,
    /// AJ: true positives over positives and false positives, averaged over the same distances.
    pub average_jaccard: Option<f64>,
    /// OA: share of points whose visibility is right.
    pub occlusion_accuracy: Option<f64>,
}

/// A point at one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointQuery {
    /// Its place in the key frame, pixels.
    pub at_key: [f64; 2],
    /// Its exact place at the frame, pixels; anything where it is hidden.
    pub exact: [f64; 2],
    /// Whether it is visible at the frame.
    pub visible: bool,
}

impl PointScores {
    /// Counts points at one frame, as the field tracks them. A position that is not a number is nowhere near.
    pub fn add(&mut self, field: &TrackField, points: impl IntoIterator<Item = PointQuery>) {
        let scale = [SIDE / f64::from(field.width), SIDE / f64::from(field.height)];
        for point in points {
            let Some((at, called_visible)) = interpolated(field, point.at_key) else { continue };
            let off = [0, 1].map(|axis: usize| (at[axis] - point.exact[axis]) * scale[axis]);
            self.count(off[0].hypot(off[1]), called_visible, point.visible);
        }
    }

    fn count(&mut self, distance: f64, called_visible: bool, visible: bool) {
        self.called_visible += u64::from(called_visible);
        self.occlusion_right += u64::from(called_visible == visible);
        if !visible {
            self.hidden += 1;
            return;
        }
        self.visible += 1;
        for (i, threshold) in POINT_THRESHOLDS.iter().enumerate() {
            let found = distance < *threshold;
            self.found[i] += u64::from(found);
            self.found_and_called[i] += u64::from(found && called_visible);
        }
    }

    /// Adds the counts of another.
    pub fn merge(&mut self, other: &Self) {
        self.visible += other.visible;
        self.hidden += other.hidden;
        self.occlusion_right += other.occlusion_right;
        self.called_visible += other.called_visible;
        for i in 0..POINT_THRESHOLDS.len() {
            self.found[i] += other.found[i];
            self.found_and_called[i] += other.found_and_called[i];
        }
    }

    /// The figures so far.
    pub fn report(&self) -> PointReport {
        let points = self.visible + self.hidden;
        let found = self.found.iter().sum::<u64>() as f64;
        // False positives: called visible, but hidden or too far away.
        let jaccard = |&right: &u64| {
            let false_positives = self.called_visible - right;
            share(right as f64, (self.visible + false_positives) as f64)
        };
        let jaccards: Option<Vec<f64>> = self.found_and_called.iter().map(jaccard).collect();
        let thresholds = POINT_THRESHOLDS.len() as f64;
        PointReport {
            points,
            delta_average: share(found, self.visible as f64 * thresholds),
            average_jaccard: jaccards.map(|values| values.iter().sum::<f64>() / thresholds),
            occlusion_accuracy: share(self.occlusion_right as f64, points as f64),
        }
    }
}

impl PointReport {
    /// The mean over the views of a clip, each counting the same, as TAP-Vid averages over videos.
    pub fn mean(views: &[Self]) -> Option<Self> {
        let average = |figure: fn(&Self) -> Option<f64>| {
            let known: Vec<f64> = views.iter().filter_map(figure).collect();
            share(known.iter().sum(), known.len() as f64)
        };
        (!views.is_empty()).then(|| Self {
            points: views.iter().map(|view| view.points).sum(),
            delta_average: average(|view| view.delta_average),
            average_jaccard: average(|view| view.average_jaccard),
            occlusion_accuracy: average(|view| view.occlusion_accuracy),
        })
    }
}

/// Where a dense field puts the point at `at` in the key frame, and whether it calls it visible: displacements
/// between pixel centres are interpolated bilinearly, visibility is that of the pixel. None outside the image.
pub fn interpolated(field: &TrackField, at: [f64; 2]) -> Option<([f64; 2], bool)> {
    let size = [field.width, field.height].map(f64::from);
    let inside = (0..2).all(|axis| at[axis] >= 0.0 && at[axis] < size[axis]);
    if !inside {
        return None;
    }
    let index = |x: usize, y: usize| y * field.width as usize + x;
    let last = [field.width as usize - 1, field.height as usize - 1];
    let place = [0, 1].map(|axis: usize| (at[axis] - 0.5).clamp(0.0, last[axis] as f64));
    let low = place.map(|value| value as usize);
    let mut moved = at;
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let (x, y) = ((low[0] + dx).min(last[0]), (low[1] + dy).min(last[1]));
        let share = |axis: usize, step: usize| {
            let fraction = place[axis] - low[axis] as f64;
            if step == 1 { fraction } else { 1.0 - fraction }
        };
        let weight = share(0, dx) * share(1, dy);
        if weight == 0.0 {
            continue;
        }
        let position = field.positions[index(x, y)];
        moved[0] += weight * (f64::from(position[0]) - (x as f64 + 0.5));
        moved[1] += weight * (f64::from(position[1]) - (y as f64 + 0.5));
    }
    Some((moved, field.visible[index(at[0] as usize, at[1] as usize)]))
}
