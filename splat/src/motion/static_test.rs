//! Whether a Gaussian moves at all.

use super::{MotionSettings, observe::Observation};

/// Whether the views that see a Gaussian find it at rest, by a majority weighted with their information.
///
/// A footprint is at rest in a view if its displacement is insignificant against its own standard deviation, or
/// below an absolute floor. A view too noisy to tell finds everything at rest, but then has little weight.
pub(super) fn is_at_rest(observations: &[Observation], settings: &MotionSettings) -> bool {
    let (mut at_rest, mut all) = (0.0, 0.0);
    for Observation { fit, .. } in observations {
        let weight = 1.0 / (fit.variance + settings.static_floor.powi(2)).max(f64::MIN_POSITIVE);
        let squared = fit.displacement.length_squared();
        let insignificant = squared <= settings.static_significance.powi(2) * fit.variance;
        if insignificant || squared <= settings.static_floor.powi(2) {
            at_rest += weight;
        }
        all += weight;
    }
    all > 0.0 && at_rest > settings.static_share * all
}
