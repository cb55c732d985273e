//! How good tracks are where the truth is known: end-point error, visibility, calibration of the stated standard
//! deviations, and the TAP-Vid scores of points.
//!
//! Everything is counted as it comes, in memory that does not grow with the clip: quantiles come from histograms whose
//! bins are narrower than 0.2 % of their value.

mod calibration;
mod field;
mod histogram;
mod points;
#[cfg(test)]
mod tests;

pub use calibration::{Calibration, SigmaDecile};
pub use field::{EndpointError, ErrorSum, FieldReport, FieldScores, FrameErrors, GroupReport, Visibility};
pub use points::{POINT_THRESHOLDS, PointQuery, PointReport, PointScores, interpolated};

/// `part / whole`, or none of nothing.
fn share(part: f64, whole: f64) -> Option<f64> {
    (whole > 0.0).then(|| part / whole)
}
