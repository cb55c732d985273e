//! Whether a Gaussian moves at all.

use super::{MotionSettings, lift::Lift, observe::Observation, order::Order};

/// The observations that find a Gaussian at rest, by their index, if they have most of the weight.
///
/// A view finds it at rest if the order of its footprint's motion is [`Order::Static`]: displacement and strain are
/// insignificant against the noise of the tracks, or below an absolute floor. What another surface in the footprint makes
/// of the noise is no excuse: a footprint of two motions moves. A view votes by the share of the Gaussian that it sees
/// and by the sharpness of what it sees.
pub(super) fn voters_for_rest(observations: &[Observation], settings: &MotionSettings) -> Option<Vec<usize>> {
    let (mut at_rest, mut all) = (0.0, 0.0);
    let mut voters = Vec::new();
    for (index, Observation { fit, transmittance, .. }) in observations.iter().enumerate() {
        let sharpness = 1.0 / (fit.resting_variance + settings.static_floor.powi(2)).max(f64::MIN_POSITIVE);
        if fit.order == Order::Static {
            at_rest += sharpness * transmittance;
            voters.push(index);
        }
        all += sharpness * transmittance;
    }
    (all > 0.0 && at_rest > settings.static_share * all).then_some(voters)
}

/// Whether a solved position explains more views than the `resting` that rest explains, by a motion beyond doubt: what moves
/// along the rays of most views moves for the others.
pub(super) fn refutes(lift: &Lift, resting: usize, settings: &MotionSettings) -> bool {
    let chi_squared = lift.translation.dot(lift.information * lift.translation);
    // Three components instead of the two of a displacement, of a Gaussian that most views see at rest: noise alone exceeds
    // twice the square of 3 in 0.04 % of them.
    let is_significant = chi_squared > 2.0 * settings.static_significance.powi(2);
    lift.is_determined && lift.inliers.len() > resting && is_significant
}
