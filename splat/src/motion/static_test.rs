//! Whether a Gaussian moves at all.

use super::{MotionSettings, observe::Observation, order::Order};

/// Whether most of the views that see a Gaussian find it at rest.
///
/// A view finds it at rest if the order of its footprint's motion is [`Order::Static`]: displacement and strain are
/// insignificant against the noise that the tracks claim, or below an absolute floor. Noise that only the residual
/// reveals is no excuse: a footprint of two motions moves. A view votes by the share of the Gaussian that it sees and by
/// the sharpness of what it sees.
pub(super) fn is_at_rest(observations: &[Observation], settings: &MotionSettings) -> bool {
    let (mut at_rest, mut all) = (0.0, 0.0);
    for Observation { fit, transmittance, .. } in observations {
        let sharpness = 1.0 / (fit.claimed_variance + settings.static_floor.powi(2)).max(f64::MIN_POSITIVE);
        if fit.order == Order::Static {
            at_rest += sharpness * transmittance;
        }
        all += sharpness * transmittance;
    }
    all > 0.0 && at_rest > settings.static_share * all
}
