//! An order of Gaussians that depends on their values alone.

use std::cmp::Ordering;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::{MotionField, MotionOrigin};
use crate::gaussians::Gaussians;

/// Gaussians sorted by their values, neighbours near each other.
///
/// Floating-point sums, nearest neighbours at equal distances and blending at equal depths all depend on the
/// order of the Gaussians. In this one they do not depend on the order in which the Gaussians came: permuted
/// Gaussians get the permuted motion, bit for bit.
pub(super) struct ValueOrder {
    /// Index in the input of each Gaussian.
    order: Vec<usize>,
    /// Place of the first Gaussian that equals the one at each place.
    representative: Vec<usize>,
}

impl ValueOrder {
    pub(super) fn of(gaussians: &Gaussians) -> Self {
        let mut keys: Vec<(u128, usize)> = (0..gaussians.len())
            .into_par_iter()
            .map(|index| (curve(gaussians.means[index]), index))
            .collect();
        keys.par_sort_unstable_by(|a, b| {
            a.0.cmp(&b.0).then_with(|| compare_rest(gaussians, a.1, b.1)).then(a.1.cmp(&b.1))
        });
        let mut representative: Vec<usize> = Vec::with_capacity(keys.len());
        for (place, key) in keys.iter().enumerate() {
            let is_same = place > 0 && {
                let before = keys[place - 1];
                before.0 == key.0 && compare_rest(gaussians, before.1, key.1).is_eq()
            };
            representative.push(if is_same { representative[place - 1] } else { place });
        }
        Self { order: keys.into_iter().map(|(_, index)| index).collect(), representative }
    }

    /// The Gaussians in this order, without the part of their colour that depends on the direction of view:
    /// motion does not depend on it.
    pub(super) fn sorted(&self, gaussians: &Gaussians) -> Gaussians {
        Gaussians {
            means: self.order.iter().map(|&i| gaussians.means[i]).collect(),
            rotations: self.order.iter().map(|&i| gaussians.rotations[i]).collect(),
            log_scales: self.order.iter().map(|&i| gaussians.log_scales[i]).collect(),
            logit_opacities: self.order.iter().map(|&i| gaussians.logit_opacities[i]).collect(),
            sh: self.order.iter().flat_map(|&i| colour(gaussians, i)).collect(),
            sh_degree: 0,
        }
    }

    /// A field of the sorted Gaussians in the order of the input. Equal Gaussians move alike: as the first of
    /// them, which is the one that the others do not hide.
    pub(super) fn restored(&self, field: &MotionField) -> MotionField {
        let count = self.order.len();
        let mut restored = MotionField {
            translation: vec![DVec3::ZERO; count],
            rotation: vec![DQuat::IDENTITY; count],
            origin: vec![MotionOrigin::Unsolved; count],
            information: vec![DMat3::ZERO; count],
            log_scale: vec![DVec3::ZERO; count],
            orders: field.orders,
        };
        for (&index, &place) in self.order.iter().zip(&self.representative) {
            restored.translation[index] = field.translation[place];
            restored.rotation[index] = field.rotation[place];
            restored.origin[index] = field.origin[place];
            restored.information[index] = field.information[place];
            restored.log_scale[index] = field.log_scale[place];
        }
        restored
    }
}

/// The coefficients of degree 0.
fn colour(gaussians: &Gaussians, index: usize) -> [f32; 3] {
    let sh = gaussians.sh_of(index);
    [sh[0], sh[1], sh[2]]
}

/// Place of a mean along Morton's curve through the cube of all single-precision numbers: what is near in space
/// is near in memory, and equal means have equal places.
fn curve(mean: [f32; 3]) -> u128 {
    // In the order of the numbers: a set sign bit reverses the others.
    let ordered = mean.map(|c| if c.is_sign_negative() { !c.to_bits() } else { c.to_bits() | 1 << 31 });
    (0..32).rev().flat_map(|bit| ordered.map(|c| c >> bit & 1)).fold(0, |key, bit| key << 1 | u128::from(bit))
}

/// By everything but the mean.
fn compare_rest(gaussians: &Gaussians, a: usize, b: usize) -> Ordering {
    lexical(&gaussians.log_scales[a], &gaussians.log_scales[b])
        .then_with(|| lexical(&gaussians.rotations[a], &gaussians.rotations[b]))
        .then_with(|| gaussians.logit_opacities[a].total_cmp(&gaussians.logit_opacities[b]))
        .then_with(|| lexical(&colour(gaussians, a), &colour(gaussians, b)))
}

fn lexical(a: &[f32], b: &[f32]) -> Ordering {
    a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
}
