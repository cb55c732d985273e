//! Dense tracks against exact ones.

use serde::Serialize;

use super::{calibration::Calibration, calibration::SigmaDecile, histogram::Histogram, share};
use crate::tracking::TrackField;

/// Counts of one clip's tracks: all pixels of the key frame, those on movers, and the others.
#[derive(Clone, Debug, Default)]
pub struct FieldScores {
    all: Group,
    moving: Group,
    still: Group,
}

#[derive(Clone, Debug, Default)]
struct Group {
    errors: Histogram,
    rightly_visible: u64,
    wrongly_visible: u64,
    missed: u64,
    calibration: Calibration,
}

/// Figures of [`FieldScores`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FieldReport {
    /// Every pixel whose truth is known.
    pub all: GroupReport,
    /// Pixels on movers.
    pub moving: GroupReport,
    /// Pixels on the rest.
    pub still: GroupReport,
}

/// Figures of one group of pixels; none where there is nothing to measure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupReport {
    /// Distance of tracks from the truth where the surface is truly visible, whatever the tracker says of it.
    pub endpoint: Option<EndpointError>,
    /// Agreement on what is visible.
    pub visibility: Visibility,
    /// Shares of errors per axis within one and two standard deviations, over pixels rightly called visible.
    pub within: Option<[f64; 2]>,
    /// The same by the stated standard deviation; empty if there is no such pixel.
    pub deciles: Vec<SigmaDecile>,
}

/// End-point errors, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EndpointError {
    /// Pixels measured, over all frames.
    pub pixels: u64,
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// 90th percentile.
    pub p90: f64,
}

/// End-point errors of the pixels of one frame that are truly visible, by the groups of [`FieldScores`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameErrors {
    /// Every pixel whose truth is known.
    pub all: ErrorSum,
    /// Pixels on movers.
    pub moving: ErrorSum,
}

/// How many errors there are, and their sum in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorSum {
    /// Number of errors.
    pub count: u64,
    /// Their sum.
    pub sum: f64,
}

/// Agreement on what is visible.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Visibility {
    /// Share of those called visible that are.
    pub precision: Option<f64>,
    /// Share of the visible that are called so.
    pub recall: Option<f64>,
    /// Intersection over union of those called visible with those that are.
    pub iou: Option<f64>,
}

impl FieldScores {
    /// Counts one frame of one view, and gives the frame's own errors. `valid` and `moving` hold a flag per pixel:
    /// whether the truth is known, and whether the pixel is on a mover.
    ///
    /// A position that is not a number counts as an error of the image's diagonal. Nothing is counted beyond the
    /// shortest of the arrays.
    pub fn add(
        &mut self,
        tracks: &TrackField,
        exact: &TrackField,
        valid: &[bool],
        moving: &[bool],
    ) -> FrameErrors {
        let mut frame = FrameErrors::default();
        let diagonal = (exact.width as f32).hypot(exact.height as f32);
        let held = [&tracks.positions, &exact.positions].map(Vec::len);
        let flags = [&tracks.visible[..], &exact.visible, valid, moving].map(<[bool]>::len);
        let lengths = held.into_iter().chain(flags).chain([tracks.sigma.len()]);
        let pixels = lengths.min().unwrap_or_default();
        for i in (0..pixels).filter(|&i| valid[i]) {
            let (at, truth) = (tracks.positions[i], exact.positions[i]);
            let off = [at[0] - truth[0], at[1] - truth[1]];
            let distance = off[0].hypot(off[1]);
            let pixel = Pixel {
                off,
                distance: if distance.is_finite() { distance } else { diagonal },
                sigma: tracks.sigma[i],
                called_visible: tracks.visible[i],
                is_visible: exact.visible[i],
            };
            self.all.add(&pixel);
            let other = if moving[i] { &mut self.moving } else { &mut self.still };
            other.add(&pixel);
            frame.add(&pixel, moving[i]);
        }
        frame
    }

    /// Adds the counts of another.
    pub fn merge(&mut self, other: &Self) {
        self.all.merge(&other.all);
        self.moving.merge(&other.moving);
        self.still.merge(&other.still);
    }

    /// The figures so far.
    pub fn report(&self) -> FieldReport {
        FieldReport { all: self.all.report(), moving: self.moving.report(), still: self.still.report() }
    }
}

impl FrameErrors {
    fn add(&mut self, pixel: &Pixel, moves: bool) {
        if !pixel.is_visible {
            return;
        }
        let error = ErrorSum { count: 1, sum: pixel.distance.into() };
        self.all.merge(error);
        if moves {
            self.moving.merge(error);
        }
    }

    /// Adds the errors of another view at the same frame.
    pub fn merge(&mut self, other: Self) {
        self.all.merge(other.all);
        self.moving.merge(other.moving);
    }
}

impl ErrorSum {
    fn merge(&mut self, other: Self) {
        self.count += other.count;
        self.sum += other.sum;
    }

    /// The mean error, or none of nothing.
    pub fn mean(self) -> Option<f64> {
        share(self.sum, self.count as f64)
    }
}

struct Pixel {
    off: [f32; 2],
    distance: f32,
    sigma: f32,
    called_visible: bool,
    is_visible: bool,
}

impl Group {
    fn add(&mut self, pixel: &Pixel) {
        if pixel.is_visible {
            self.errors.add(pixel.distance);
        }
        match (pixel.called_visible, pixel.is_visible) {
            (true, true) => {
                self.rightly_visible += 1;
                self.calibration.add(pixel.off, pixel.sigma);
            }
            (true, false) => self.wrongly_visible += 1,
            (false, true) => self.missed += 1,
            (false, false) => {}
        }
    }

    fn merge(&mut self, other: &Self) {
        self.errors.merge(&other.errors);
        self.rightly_visible += other.rightly_visible;
        self.wrongly_visible += other.wrongly_visible;
        self.missed += other.missed;
        self.calibration.merge(&other.calibration);
    }

    fn report(&self) -> GroupReport {
        let right = self.rightly_visible as f64;
        let (wrong, missed) = (self.wrongly_visible as f64, self.missed as f64);
        GroupReport {
            endpoint: self.endpoint(),
            visibility: Visibility {
                precision: share(right, right + wrong),
                recall: share(right, right + missed),
                iou: share(right, right + wrong + missed),
            },
            within: self.calibration.overall(),
            deciles: self.calibration.deciles(),
        }
    }

    fn endpoint(&self) -> Option<EndpointError> {
        Some(EndpointError {
            pixels: self.rightly_visible + self.missed,
            mean: self.errors.mean()?,
            median: self.errors.quantile(0.5)?,
            p90: self.errors.quantile(0.9)?,
        })
    }
}
